"""A whole capture: plan the motion, place the rig, render, write the folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import combinations
from pathlib import Path

import av
import cv2
import h5py
import numpy as np
import tomli_w
from numpy.typing import NDArray
from scipy import ndimage

from scripts.synthetic.actor import Actor, Look, make_actor
from scripts.synthetic.motion import MOTIONS, Motion, plan_path, pose_at
from scripts.synthetic.motion import Path as PelvisPath
from scripts.synthetic.people import STAGE_M, walk
from scripts.synthetic.render import Body, composite, render_actor, sample_rays, shadow_maps
from scripts.synthetic.rig import make_rig
from scripts.synthetic.scene import Lamps, RoomView, make_lamps, view_room
from scripts.synthetic.scenes import SCENES
from scripts.synthetic.sensor import Sensor
from scripts.synthetic.skeleton import JOINTS, Pose, Skeleton, joint_positions, make_skeleton
from tk.io.captures.calibration import camera_table
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.volume import Volume

Float = NDArray[np.float64]

BACKGROUND_FRAMES = 25
VOLUME_MARGIN_M = 0.15
EXPOSURE_FRAMES = 0.25
"""Shutter time, in frames: 1/60 s at 15 frames a second, 1/120 s at 30."""
# Four samples a pixel: a rotated grid in space, in an order of moments that has no drift across the pixel.
OFFSETS = np.array([[-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])
_MOMENTS = EXPOSURE_FRAMES * np.array([-0.375, 0.125, 0.375, -0.125])
_AMBIENT_BONES = ("ankle_l", "ankle_r", "knee_l", "knee_r", "hip_l", "hip_r", "lumbar", "chest", "head")
_AMBIENT_RADII_M = (0.07, 0.07, 0.07, 0.07, 0.11, 0.11, 0.15, 0.15, 0.11)


@dataclass(frozen=True)
class Options:
    """What to render.

    Attributes:
        motion: name of a motion, or of a scene with several people.
        size: (width, height) in pixels.
        stature_m, look: those of the actor; in a scene, of people without their own.
        crf: x264's constant rate factor.
        only: numbers of the people to render in a scene; everything else is as with all of them.
        fps: frames a second; None: the motion's own. A scene keeps its own.
    """

    motion: str = "demo"
    frames: int | None = None
    cameras: int = 5
    size: tuple[int, int] = (640, 480)
    seed: int = 0
    stature_m: float = 1.75
    look: Look = field(default_factory=Look)
    crf: int = 20
    only: tuple[int, ...] | None = None
    fps: float | None = None


@dataclass(frozen=True)
class Performer:
    """One person of a capture.

    Attributes:
        poses: (F) bone frames at the middle of each exposure.
        joints: (F, 15, 3) true joint centres, metres.
        bodies: by holding side of the cube, or {None: body}.
    """

    motion: Motion
    skeleton: Skeleton
    path: PelvisPath
    poses: Pose
    joints: Float
    bodies: dict[str | None, Body]

    @staticmethod
    def plan(motion: Motion, skeleton: Skeleton, look: Look, frames: int) -> Performer:
        """Return the person who performs a motion."""
        path = plan_path(motion, skeleton, frames)
        poses = pose_at(motion, skeleton, path, np.arange(frames, dtype=np.float64))
        holders: list[str | None] = [*sorted({side for _, side in motion.cube})] or [None]
        bodies = {
            side: Body.of(
                make_actor(skeleton, cube_bone=None if side is None else "wrist" + side), look.colors(), look.stripes
            )
            for side in holders
        }
        return Performer(motion, skeleton, path, poses, joint_positions(skeleton, poses), bodies)

    def body(self, frame: int) -> Body:
        return self.bodies[self.motion.held_by(frame)]

    def balls(self, chosen: NDArray[np.bool_]) -> tuple[Float, Float]:
        """Return centres (K, 3) and radii (K,) of balls that bound the body in the chosen frames (F,), metres."""
        centers, radii = [np.zeros((0, 3))], [np.zeros(0)]
        for side, body in self.bodies.items():
            held = chosen & np.array([self.motion.held_by(frame) == side for frame in range(len(chosen))])
            c, r = body.actor.balls(self.poses[np.flatnonzero(held)])
            centers.append(c.reshape(-1, 3))
            radii.append(np.tile(r, int(held.sum())))
        return np.concatenate(centers), np.concatenate(radii)

    def within(self, volume: Volume) -> NDArray[np.int64]:
        """Return the frames in which the pelvis is in a volume."""
        pelvis = self.joints[:, JOINTS.index("pelvis")]
        return np.flatnonzero(((volume.lower <= pelvis) & (pelvis <= volume.upper)).all(axis=1))


@dataclass(frozen=True)
class Plan:
    """Everything of a capture except its pixels.

    Attributes:
        people: those who are rendered, by number.
    """

    options: Options
    people: dict[int, Performer]
    rig: Rig
    volume: Volume
    lamps: Lamps

    @property
    def subject(self) -> Performer:
        """The person with the smallest number."""
        return self.people[min(self.people)]

    @property
    def frame_count(self) -> int:
        return len(self.subject.joints)

    @property
    def fps(self) -> float:
        return self.subject.motion.fps

    def body(self, frame: int) -> Body:
        return Body.join([person.body(frame) for person in self.people.values()])

    def poses(self, frames: Float) -> Pose:
        """Return the bone frames of all people at (T,) times in frames."""
        return Pose.join([pose_at(p.motion, p.skeleton, p.path, frames) for p in self.people.values()])

    def shadow(self, frame: int) -> NDArray[np.float32]:
        """The lamps' shadow maps at this frame, the same for all cameras."""
        return shadow_maps(self.body(frame), self.poses(np.array([float(frame)])), self.lamps)


def plan_capture(options: Options) -> Plan:
    """Choose motion, rig and volume; the same options give the same plan.

    The rig sees a single actor all the time; in a scene, everybody who is on the stage.
    """
    people = _cast(options)
    centers, radii = [], []
    for person in people:
        pelvis = person.joints[:, JOINTS.index("pelvis"), :2]
        c, r = person.balls(np.linalg.norm(pelvis, axis=1) <= (STAGE_M if options.motion in SCENES else np.inf))
        centers.append(c)
        radii.append(r)
    ball_centers, ball_radii = np.concatenate(centers), np.concatenate(radii)
    lower = (ball_centers - ball_radii[:, None]).min(axis=0)
    upper = (ball_centers + ball_radii[:, None]).max(axis=0)
    rng = np.random.default_rng([options.seed, 1])
    rig = make_rig(options.cameras, *options.size, ball_centers, ball_radii, rng)
    only = range(len(people)) if options.only is None else options.only
    if not set(only) <= set(range(len(people))):
        raise ValueError(f"{options.motion} has the people 0 to {len(people) - 1}, not {', '.join(map(str, only))}")
    rendered = {k: people[k] for k in sorted(set(only))}
    return Plan(options, rendered, rig, _volume(lower, upper), make_lamps(lower, upper))


def _cast(options: Options) -> list[Performer]:
    """Return everybody of a scene, or the single actor of a motion."""
    if options.motion not in SCENES:
        skeleton = make_skeleton(options.stature_m)
        motion = MOTIONS[options.motion](skeleton)
        motion = motion if options.fps is None else motion.at_rate(options.fps)
        return [Performer.plan(motion, skeleton, options.look, options.frames or motion.frames)]
    scene, people = SCENES[options.motion], []
    for role in scene.roles:
        skeleton = make_skeleton(role.stature_m or options.stature_m)
        motion = walk(skeleton, options.motion, scene.frames, role)
        people.append(Performer.plan(motion, skeleton, role.look or options.look, options.frames or scene.frames))
    return people


def crossings(plan: Plan, step: int = 4) -> int:
    """Return how often two people cross: their silhouettes overlap in two views or more, pelvises less than 1 m apart.

    Silhouettes are drawn roughly, in every ``step``-th pixel.
    """
    people = list(plan.people.values())
    shown = [_outlines(plan, person, step) for person in people]
    count = 0
    for (a, one), (b, other) in combinations(zip(people, shown, strict=True), 2):
        apart = np.linalg.norm(a.joints[:, JOINTS.index("pelvis")] - b.joints[:, JOINTS.index("pelvis")], axis=1)
        cross = ((one & other).any(axis=(2, 3)).sum(axis=1) >= 2) & (apart < 1.0)
        # a pause of less than half a second ends no crossing
        cross = ndimage.binary_closing(np.pad(cross, 8), np.ones(8, np.bool_))
        count += int(ndimage.label(cross)[1])
    return count


def _outlines(plan: Plan, person: Performer, step: int) -> NDArray[np.bool_]:
    """Return (F, C, h, w) a person's silhouettes in every ``step``-th pixel: a thick line for each cone."""
    width, height = (side // step for side in plan.options.size)
    images = np.zeros((plan.frame_count, len(plan.rig), height, width), np.uint8)
    for frame, views in enumerate(images):
        centers, radii = person.body(frame).actor.balls(person.poses[frame : frame + 1])
        for camera, image in zip(plan.rig, views, strict=True):
            pixels, depth = camera.project(centers[0])
            if not np.isfinite(pixels).all():
                continue  # behind the camera or beside it
            ends = np.clip(pixels / step, -1e4, 1e4).round().astype(int).reshape(2, -1, 2).swapaxes(0, 1)
            thick = np.maximum(camera.matrix[0, 0] * 2 * radii / depth / step, 1).round().astype(int).reshape(2, -1)
            for (a, b), size in zip(ends.tolist(), thick.min(axis=0).tolist(), strict=True):
                cv2.line(image, a, b, 1, min(size, 255))
    return images.astype(np.bool_)


def _volume(lower: Float, upper: Float) -> Volume:
    """Return the box with its margin, rounded to 5 cm; it ends just below the floor."""
    low = np.floor((lower - VOLUME_MARGIN_M) * 20) / 20
    high = np.ceil((upper + VOLUME_MARGIN_M) * 20) / 20
    low[2] = max(low[2], -0.05)
    center, size = np.round((low + high) / 2, 3).tolist(), np.round(high - low, 3).tolist()
    return Volume((center[0], center[1], center[2]), (size[0], size[1], size[2]))


@dataclass(frozen=True)
class Picture:
    """``image`` (H, W, 3) uint8 RGB and ``mask`` (H, W) uint8, 255 where the actor covers half of a pixel or more."""

    image: NDArray[np.uint8]
    mask: NDArray[np.uint8]


class CameraRenderer:
    """Renders what one camera of a plan records."""

    def __init__(self, plan: Plan, index: int) -> None:
        self.plan, self.camera = plan, plan.rig[index]
        self.sensor = Sensor.draw(np.random.default_rng([plan.options.seed, 2, index]), self.camera.width)
        self._noise_seed = [plan.options.seed, 3, index]
        self._rays = sample_rays(self.camera, OFFSETS)
        self._room: RoomView = view_room(self.camera, plan.lamps)

    def frame(self, frame: int, shadow: NDArray[np.float32] | None = None) -> Picture:
        """The picture of frame number ``frame``; ``shadow`` is ``plan.shadow(frame)``, where it is at hand.

        Frames do not depend on each other.
        """
        plan = self.plan
        body = plan.body(frame)
        shadow = plan.shadow(frame) if shadow is None else shadow
        moving = plan.poses(frame + _MOMENTS)
        actor = render_actor(self.camera, self._rays, body, moving, plan.lamps, shadow)
        linear = composite(self._room, plan.lamps, shadow, _ambient_balls(plan, frame), actor)
        mask = np.where(actor[..., 3] >= 0.5, 255, 0).astype(np.uint8)
        return Picture(self.sensor.expose(linear, frame, np.random.default_rng([*self._noise_seed, frame])), mask)

    def background(self) -> Iterator[NDArray[np.uint8]]:
        """Yield :data:`BACKGROUND_FRAMES` images of the empty scene, recorded before the capture."""
        linear = self._room.indirect + self._room.direct.sum(axis=0)
        for frame in range(-BACKGROUND_FRAMES, 0):
            yield self.sensor.expose(linear, frame, np.random.default_rng([*self._noise_seed, 10_000 - frame]))


def _ambient_balls(plan: Plan, frame: int) -> NDArray[np.float32]:
    balls = []
    for person in plan.people.values():
        bones = [person.skeleton.index(name) for name in _AMBIENT_BONES]
        balls.append(np.column_stack([person.poses.origin[frame, bones], _AMBIENT_RADII_M]))
    return np.concatenate(balls).astype(np.float32)


def write_capture(
    plan: Plan, folder: Path, *, masks: bool = False, name: str | None = None,
    progress: Callable[[int, int], None] = lambda done, frames: None,
) -> None:  # fmt: skip
    """Render a plan into a capture folder. ``progress`` is called after each frame."""
    folder.mkdir(parents=True, exist_ok=True)
    name = name or plan.options.motion
    write_calibration(plan.rig, folder / "calibration.toml")
    _write_settings(plan, name, folder / "capture.toml")
    _write_truth(plan, name, folder / "truth.h5")
    for kind in ("videos", "background"):
        (folder / kind).mkdir(exist_ok=True)
    renderers = [CameraRenderer(plan, index) for index in range(len(plan.rig))]
    for renderer in renderers:
        with _Video(folder / "background" / f"{renderer.camera.name}.mp4", renderer.camera, plan) as video:
            for image in renderer.background():
                video.write(image)
        if masks:
            (folder / "masks" / renderer.camera.name).mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        videos = [
            stack.enter_context(_Video(folder / "videos" / f"{camera.name}.mp4", camera, plan)) for camera in plan.rig
        ]
        for frame in range(plan.frame_count):
            shadow = plan.shadow(frame)
            for renderer, video in zip(renderers, videos, strict=True):
                picture = renderer.frame(frame, shadow)
                video.write(picture.image)
                if masks:
                    cv2.imwrite(str(folder / "masks" / renderer.camera.name / f"{frame:06d}.png"), picture.mask)
            progress(frame + 1, plan.frame_count)


def write_calibration(rig: Rig, path: Path) -> None:
    """Write the rig as `calibration.toml`."""
    tables = {camera.name: camera_table(camera) for camera in rig}
    path.write_text(tomli_w.dumps({**tables, "metadata": {"adjusted": False, "error": 0.0}}), encoding="utf-8")


def _write_settings(plan: Plan, name: str, path: Path) -> None:
    scene = SCENES.get(plan.options.motion)
    posed = scene is None or scene.roles[min(plan.people)].posed
    settings = {
        "name": name,
        "fps": plan.fps,
        "up": "z",
        "volume": {"center": list(plan.volume.center), "size": list(plan.volume.size)},
        "subject": {"height": plan.subject.skeleton.stature_m},
        "init": {"frame": 0, "pose": "da-vinci" if posed else "any"},
    }
    path.write_text(tomli_w.dumps(settings), encoding="utf-8")


def _write_truth(plan: Plan, name: str, path: Path) -> None:
    """Write the joints; in a scene those of the frames in which a person is in the volume.

    Several people are in /people/0, /people/1, … in the order of their numbers, and the first one at the top level.
    """
    scene = plan.options.motion in SCENES
    with h5py.File(path, "w") as file:
        for k, person in enumerate(plan.people.values()):
            frames = person.within(plan.volume) if scene else np.arange(plan.frame_count, dtype=np.int64)
            if k == 0:
                _write_joints(file, person, frames)
            if len(plan.people) > 1:
                _write_joints(file.create_group(f"people/{k}"), person, frames)
        file.attrs.update({"capture": name, "fps": plan.fps, "units": "m", "up": "z"})


def _write_joints(group: h5py.Group, person: Performer, frames: NDArray[np.int64]) -> None:
    group["frames"] = frames
    group["time"] = frames / person.motion.fps
    position = group.create_dataset("joints/position", data=person.joints[frames])
    position.attrs.create("names", list(JOINTS), dtype=h5py.string_dtype())


class _Video:
    """Writes an H.264 file image by image."""

    def __init__(self, path: Path, camera: Camera, plan: Plan) -> None:
        self._container = av.open(str(path), "w")
        self._stream = self._container.add_stream("libx264", rate=Fraction(plan.fps).limit_denominator(1000))
        self._stream.width, self._stream.height = camera.width, camera.height
        self._stream.pix_fmt = "yuv420p"
        # with macroblock trees some files of a hundred differ from run to run on a busy machine, one thread or not
        crf = str(plan.options.crf)
        self._stream.options = {"crf": crf, "preset": "slow", "threads": "1", "x264-params": "mbtree=0"}

    def write(self, image: NDArray[np.uint8]) -> None:
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        for packet in self._stream.encode(frame):
            self._container.mux(packet)

    def __enter__(self) -> _Video:
        return self

    def __exit__(self, *_: object) -> None:
        for packet in self._stream.encode():
            self._container.mux(packet)
        self._container.close()


__all__ = [
    "Actor",
    "CameraRenderer",
    "Options",
    "Picture",
    "Plan",
    "crossings",
    "plan_capture",
    "write_calibration",
    "write_capture",
]
