"""A whole capture: plan the motion, place the rig, render, write the folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import cv2
import h5py
import numpy as np
import tomli_w
from numpy.typing import NDArray

from scripts.synthetic.actor import Actor, Look, make_actor
from scripts.synthetic.motion import MOTIONS, Motion, plan_path, pose_at
from scripts.synthetic.motion import Path as PelvisPath
from scripts.synthetic.render import Body, composite, render_actor, sample_rays, shadow_maps
from scripts.synthetic.rig import make_rig
from scripts.synthetic.scene import Lamps, RoomView, make_lamps, view_room
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
_OFFSETS = np.array([[-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])
_MOMENTS = EXPOSURE_FRAMES * np.array([-0.375, 0.125, 0.375, -0.125])
_AMBIENT_BONES = ("ankle_l", "ankle_r", "knee_l", "knee_r", "hip_l", "hip_r", "lumbar", "chest", "head")
_AMBIENT_RADII_M = (0.07, 0.07, 0.07, 0.07, 0.11, 0.11, 0.15, 0.15, 0.11)


@dataclass(frozen=True)
class Options:
    """What to render. ``size`` is (width, height) in pixels, ``crf`` x264's constant rate factor."""

    motion: str = "demo"
    frames: int | None = None
    cameras: int = 5
    size: tuple[int, int] = (640, 480)
    seed: int = 0
    stature_m: float = 1.75
    look: Look = field(default_factory=Look)
    crf: int = 20


@dataclass(frozen=True)
class Plan:
    """Everything of a capture except its pixels.

    Attributes:
        poses: (F) bone frames at the middle of each exposure.
        joints: (F, 15, 3) true joint centres, metres.
        bodies: by holding side of the cube, or {None: body}.
    """

    options: Options
    motion: Motion
    skeleton: Skeleton
    path: PelvisPath
    poses: Pose
    joints: Float
    bodies: dict[str | None, Body]
    rig: Rig
    volume: Volume
    lamps: Lamps

    @property
    def frame_count(self) -> int:
        return len(self.joints)

    def body(self, frame: int) -> Body:
        return self.bodies[self.motion.held_by(frame)]

    def shadow(self, frame: int) -> NDArray[np.float32]:
        """The lamps' shadow maps at this frame, the same for all cameras."""
        return shadow_maps(self.body(frame), self.poses[frame : frame + 1], self.lamps)


def plan_capture(options: Options) -> Plan:
    """Choose motion, rig and volume; the same options give the same plan."""
    skeleton = make_skeleton(options.stature_m)
    motion = MOTIONS[options.motion](skeleton)
    frames = motion.frames if options.frames is None else options.frames
    path = plan_path(motion, skeleton, frames)
    poses = pose_at(motion, skeleton, path, np.arange(frames, dtype=np.float64))
    holders: list[str | None] = [*sorted({side for _, side in motion.cube})] or [None]
    bodies = {
        side: Body.of(
            make_actor(skeleton, cube_bone=None if side is None else "wrist" + side),
            options.look.colors(),
            options.look.stripes,
        )
        for side in holders
    }
    centers, radii = [], []
    for side, body in bodies.items():
        held = np.array([motion.held_by(frame) == side for frame in range(frames)])
        c, r = body.actor.balls(poses[np.flatnonzero(held)])
        centers.append(c.reshape(-1, 3))
        radii.append(np.tile(r, int(held.sum())))
    ball_centers, ball_radii = np.concatenate(centers), np.concatenate(radii)
    lower = (ball_centers - ball_radii[:, None]).min(axis=0)
    upper = (ball_centers + ball_radii[:, None]).max(axis=0)
    lamps = make_lamps(lower, upper)
    rng = np.random.default_rng([options.seed, 1])
    rig = make_rig(options.cameras, *options.size, ball_centers, ball_radii, rng)
    return Plan(
        options, motion, skeleton, path, poses, joint_positions(skeleton, poses), bodies, rig,
        _volume(lower, upper), lamps,
    )  # fmt: skip


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
        self._rays = sample_rays(self.camera, _OFFSETS)
        self._room: RoomView = view_room(self.camera, plan.lamps)

    def frame(self, frame: int, shadow: NDArray[np.float32] | None = None) -> Picture:
        """The picture of frame number ``frame``; ``shadow`` is ``plan.shadow(frame)``, where it is at hand.

        Frames do not depend on each other.
        """
        plan = self.plan
        body = plan.body(frame)
        shadow = plan.shadow(frame) if shadow is None else shadow
        moving = pose_at(plan.motion, plan.skeleton, plan.path, frame + _MOMENTS)
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
    bones = [plan.skeleton.index(name) for name in _AMBIENT_BONES]
    return np.column_stack([plan.poses.origin[frame, bones], _AMBIENT_RADII_M]).astype(np.float32)


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
    settings = {
        "name": name,
        "fps": plan.motion.fps,
        "up": "z",
        "volume": {"center": list(plan.volume.center), "size": list(plan.volume.size)},
        "subject": {"height": plan.options.stature_m},
        "init": {"frame": 0, "pose": "da-vinci"},
    }
    path.write_text(tomli_w.dumps(settings), encoding="utf-8")


def _write_truth(plan: Plan, name: str, path: Path) -> None:
    with h5py.File(path, "w") as file:
        frames = np.arange(plan.frame_count, dtype=np.int64)
        file["frames"] = frames
        file["time"] = frames / plan.motion.fps
        position = file.create_dataset("joints/position", data=plan.joints)
        position.attrs.create("names", list(JOINTS), dtype=h5py.string_dtype())
        file.attrs.update({"capture": name, "fps": plan.motion.fps, "units": "m", "up": "z"})


class _Video:
    """Writes an H.264 file image by image."""

    def __init__(self, path: Path, camera: Camera, plan: Plan) -> None:
        self._container = av.open(str(path), "w")
        self._stream = self._container.add_stream("libx264", rate=Fraction(plan.motion.fps).limit_denominator(1000))
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
    "plan_capture",
    "write_calibration",
    "write_capture",
]
