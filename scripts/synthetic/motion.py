"""Motions: joint angles over time, and the path of the pelvis that keeps the standing foot where it is; or, where the
feet are placed step by step, the path of the pelvis and the legs that lead from it to the feet.

All motions start in the Da Vinci pose, hold it for :data:`HOLD` frames and take :data:`BLEND` frames to leave it; at 30
frames a second, where the feet step out of it, a few more.
Angles are keyed in degrees and joined by monotone cubics (no overshoot past a limit); the gait is a periodic function
on top.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from scripts.synthetic.reach import arm_angles, leg_angles
from scripts.synthetic.skeleton import LIMITS_DEG, Pose, Skeleton, forward, sole_points
from scripts.synthetic.steps import Step, foot_track

Float = NDArray[np.float64]
Key = tuple[float, Mapping[str, float]]  # frame, degrees of the angles that the key sets

FPS = 15.0
HOLD, BLEND = 10, 12
START = HOLD + BLEND
_STEPS = 16  # evaluations a frame for the pelvis path
KNEE_RADIUS = 0.066 / 1.75
"""From the knee's centre to the floor it kneels on, trousers included, as a share of the stature."""

DA_VINCI: dict[str, float] = {"yaw": 0.0} | {
    name + side: value
    for side in ("_l", "_r")
    for name, value in {
        "shoulder_abd": 88.0, "shoulder_flex": 2.0, "elbow": 5.0, "fingers": 8.0, "hip_abd": 17.0, "hip_flex": 3.0,
        "knee": 4.0,
    }.items()
}  # fmt: skip
STAND: dict[str, float] = {
    name + side: value
    for side in ("_l", "_r")
    for name, value in {
        "shoulder_abd": 14.0, "shoulder_flex": 2.0, "shoulder_in": 12.0, "elbow": 18.0, "fingers": 25.0,
        "hip_abd": 4.0, "hip_flex": 4.0, "knee": 7.0,
    }.items()
}  # fmt: skip


@dataclass(frozen=True)
class Motion:
    """What the actor does.

    Attributes:
        name: as on the command line.
        keys: (frame, angles in degrees); angles that a key does not name keep to the curve through their other keys.
        layer: angles in degrees added on top, a function of time in frames (T,).
        cube: side ("_l" or "_r") that holds the cube over the frames, in steps (frame, side); empty for no cube.
        frames: natural length.
        fps: frames a second.
        root: the pelvis (T, 3) in metres over (T,) frames; without it, it goes where the standing foot takes it.
        placed: whether ``root`` is in the world; otherwise the path is centred on the world's origin.
    """

    name: str
    keys: tuple[Key, ...]
    frames: int
    layer: Callable[[Float], dict[str, Float]] | None = None
    cube: tuple[tuple[int, str], ...] = ()
    fps: float = FPS
    root: Callable[[Float], Float] | None = None
    placed: bool = False

    @functools.cached_property
    def _curves(self) -> dict[str, Callable[[Float], Float]]:
        """Functions that return each angle, degrees, at (T,) times in frames."""
        points: dict[str, list[tuple[float, float]]] = {name: [] for name in LIMITS_DEG}
        for at, values in self.keys:
            for name, value in values.items():
                points[name].append((at, value))
        return {name: _curve(own) for name, own in points.items()}

    def angles(self, frame: Float) -> dict[str, Float]:
        """Radians of every angle at (T,) times in frames."""
        frame = np.asarray(frame, dtype=np.float64)
        result = {name: curve(frame) for name, curve in self._curves.items()}
        sway = np.sin(2 * np.pi * frame / self.fps * 0.45)  # nobody stands quite still
        result["spine_side"] = result["spine_side"] + 0.6 * sway
        result["neck_turn"] = result["neck_turn"] + 1.5 * sway
        if self.layer is not None:
            for name, added in self.layer(frame).items():
                result[name] = result[name] + added
        return {name: np.radians(value) for name, value in result.items()}

    def at_rate(self, fps: float) -> Motion:
        """Return the same motion, in the same time, with another number of frames a second."""
        k = fps / self.fps
        layer, root = self.layer, self.root
        return replace(
            self,
            keys=tuple((k * frame, angles) for frame, angles in self.keys),
            frames=round(k * self.frames),
            layer=None if layer is None else lambda frame: layer(frame / k),
            cube=tuple((round(k * frame), side) for frame, side in self.cube),
            root=None if root is None else lambda frame: root(frame / k),
            fps=fps,
        )

    def held_by(self, frame: int) -> str | None:
        """Side whose hand holds the cube in this frame."""
        side = None
        for start, holder in self.cube:
            if frame >= start:
                side = holder
        return side


def _curve(points: Sequence[tuple[float, float]]) -> Callable[[Float], Float]:
    """Return the curve through (time, value) points, constant before and after them; 0 without points."""
    if len(points) < 2:
        value = points[0][1] if points else 0.0
        return lambda frame: np.full(len(frame), value)
    x, y = np.array(points).T
    cubics = PchipInterpolator(x, y)
    return lambda frame: np.asarray(cubics(np.clip(frame, x[0], x[-1])))


@dataclass(frozen=True)
class Path:
    """The pelvis of a motion over time: ``frame`` (T,) and ``root`` (T, 3) metres."""

    frame: Float
    root: Float

    def at(self, frame: Float) -> Float:
        return np.stack([np.interp(frame, self.frame, self.root[:, c]) for c in range(3)], axis=1)


def plan_path(motion: Motion, skeleton: Skeleton, frames: int) -> Path:
    """Where the pelvis goes: the lower foot stands on the floor and does not slide, the other one is free.

    The horizontal path is centred on the world's origin, unless the motion is placed.
    """
    frame = np.arange(-_STEPS, (frames + 1) * _STEPS) / _STEPS
    if motion.root is not None:
        root = motion.root(frame)
        if not motion.placed:
            root[:, :2] -= (root[:, :2].max(axis=0) + root[:, :2].min(axis=0)) / 2
        return Path(frame, root)
    soles = sole_points(skeleton, forward(skeleton, motion.angles(frame)))  # (T, 2, 3, 3), pelvis at the origin
    low = soles[..., 2].min(axis=2)  # (T, 2)
    weight = np.exp(-(low - low.min(axis=1, keepdims=True)) / 0.012)
    weight /= weight.sum(axis=1, keepdims=True)
    weight = _smooth(weight, _STEPS)
    feet = soles[:, :, 1, :2]  # the balls of the feet
    step = np.diff(feet, axis=0) * (weight[1:] + weight[:-1])[..., None] / 2
    xy = np.concatenate([np.zeros((1, 2)), -np.cumsum(step.sum(axis=1), axis=0)])
    z = -_smooth(low.min(axis=1, keepdims=True), _STEPS / 2)
    xy = _smooth(xy, _STEPS / 2)
    xy -= (xy.max(axis=0) + xy.min(axis=0)) / 2
    return Path(frame, np.concatenate([xy, z], axis=1))


def _smooth(values: Float, sigma: float) -> Float:
    """Gaussian smoothing of (T, K) along time, ends repeated."""
    reach = int(np.ceil(3 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel, mode="valid") for column in padded.T], axis=1)


def pose_at(motion: Motion, skeleton: Skeleton, path: Path, frame: Float) -> Pose:
    """Bone frames at (T,) times in frames."""
    return forward(skeleton, motion.angles(frame), path.at(frame))


# --- the motions ---------------------------------------------------------------------------------------------------


def opening(first: Mapping[str, float] | None = None, until: float = START) -> list[Key]:
    """Return the first keys: Da Vinci pose, then ``first`` (standing by default) from frame ``until`` on."""
    target = dict.fromkeys(DA_VINCI, 0.0) | STAND | dict(first or {})
    start = dict.fromkeys([*target, "pitch", "neck_flex", "spine_flex"], 0.0) | DA_VINCI
    return [(0, start), (HOLD, start), (until, target)]


def _both(values: Mapping[str, float]) -> dict[str, float]:
    return {name + side: value for name, value in values.items() for side in ("_l", "_r")}


def _window(frame: Float, start: float, stop: float, ramp: float = 8.0) -> Float:
    """0 outside [start, stop], 1 inside, smooth ramps."""
    x = np.clip(np.minimum(frame - start, stop - frame) / ramp, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def gait(frame: Float, start: float, stop: float, cycle: float = 17.0) -> dict[str, Float]:
    """Walking on top of the standing pose; one cycle (two steps) lasts ``cycle`` frames.

    Curves after the sagittal angles of normal gait (Winter 1991): hip 20 degrees either way, knee 60 in swing.
    """
    on = _window(frame, start, stop)
    result: dict[str, Float] = {}
    for side, shift in (("_l", 0.0), ("_r", 0.5)):
        phase = 2 * np.pi * ((frame - start) / cycle + shift + 0.25)  # 0 is the heel's contact
        swing = np.exp(-((np.angle(np.exp(1j * (phase - 2 * np.pi * 0.74))) / 0.75) ** 2))
        load = np.exp(-((np.angle(np.exp(1j * (phase - 2 * np.pi * 0.15))) / 0.5) ** 2))
        push = np.exp(-((np.angle(np.exp(1j * (phase - 2 * np.pi * 0.60))) / 0.45) ** 2))
        result["hip_flex" + side] = on * (5 + 21 * np.cos(phase))
        result["knee" + side] = on * (50 * swing + 9 * load)
        result["ankle" + side] = on * (-14 * push)
        result["shoulder_flex" + side] = on * (-2 - 24 * np.cos(phase))
        result["elbow" + side] = on * (12 - 12 * np.cos(phase))
    phase = 2 * np.pi * ((frame - start) / cycle + 0.25)
    result["yaw"] = on * (-5 * np.cos(phase))
    result["spine_turn"] = on * (9 * np.cos(phase))
    result["spine_flex"] = on * 3.0
    return result


def demo(skeleton: Skeleton) -> Motion:
    """Steps, a turn of the body, a raised arm, a bend, a kick."""
    keys = opening()
    keys += [
        (26, {"yaw": 0.0}),
        (46, {"yaw": 50.0, "shoulder_abd_l": 14, "shoulder_flex_l": 2, "shoulder_in_l": 12, "elbow_l": 18,
              "spine_flex": 0, "spine_side": 0, "neck_turn": 0, "hip_abd_l": 4, "shoulder_abd_r": 14, "neck_flex": 0}),
        (54, {"shoulder_abd_l": 148, "shoulder_flex_l": 12, "shoulder_in_l": 0, "elbow_l": 12, "spine_side": -9,
              "neck_turn": 18, "spine_flex": 2, "shoulder_abd_r": 24, "elbow_r": 25}),
        (59, {"shoulder_abd_l": 105, "shoulder_flex_l": 25, "elbow_l": 35, "spine_flex": 24, "spine_side": -4,
              "neck_turn": 0, "neck_flex": -6, "hip_flex_r": 4, "hip_flex_l": 12, "knee_l": 16,
              "shoulder_abd_r": 38, "elbow_r": 45, "knee_r": 7, "pitch": 0, "shoulder_flex_r": 2}),
        (64, {"shoulder_abd_l": 58, "shoulder_flex_l": 15, "elbow_l": 40, "spine_flex": 4, "hip_flex_r": 15,
              "knee_r": 62, "hip_flex_l": 6, "knee_l": 12, "shoulder_flex_r": 20, "hip_abd_r": 6, "ankle_r": 0}),
        (67, {"hip_flex_r": 68, "knee_r": 18, "ankle_r": -25, "spine_flex": -6, "shoulder_flex_r": -22,
              "shoulder_abd_r": 45, "knee_l": 14, "pitch": -6}),
        (71, {"hip_flex_r": 28, "knee_r": 45, "ankle_r": -5, "shoulder_abd_r": 30, "shoulder_flex_r": 0, "elbow_r": 30,
              "pitch": 0}),
        (75, STAND | {"yaw": 50.0, "spine_flex": 2, "ankle_r": 0, "neck_flex": 0, "spine_side": 0}),
    ]  # fmt: skip
    return Motion("demo", tuple(keys), 75, lambda frame: gait(frame, 20, 50))


def arms_close(skeleton: Skeleton) -> Motion:
    """Arms move close to the body and away from it (Kehl 2006, section 7.2)."""
    near = _both({"shoulder_abd": 4, "shoulder_flex": 4, "elbow": 8, "shoulder_in": 15})
    wide = _both({"shoulder_abd": 62, "shoulder_flex": 5, "elbow": 12, "shoulder_in": 0})
    front = _both({"shoulder_abd": 10, "shoulder_flex": 22, "elbow": 98, "shoulder_in": 38})
    keys = opening(near)
    for frame, pose in (
        (32, near),
        (40, wide),
        (48, near),
        (54, near),
        (62, front),
        (70, front),
        (80, wide),
        (89, near),
    ):
        keys.append((frame, pose))
    return Motion("arms-close", tuple(keys), 90)


def fast(skeleton: Skeleton) -> Motion:
    """Arm and leg swings of up to 31 degrees between frames (Kehl 2006, section 7.4, fig. 14)."""

    def swings(frame: Float) -> dict[str, Float]:
        arms, legs = _window(frame, START, 74, 10), _window(frame, 52, 88, 8)
        phase = 2 * np.pi * frame / 13.0
        kick = np.maximum(np.sin(2 * np.pi * (frame - 52) / 16.0), 0) ** 2
        # 60 degrees over a period of 13 frames: 60 * 2 sin(pi / 13) = 28.7 degrees a frame, 30 with the ramp
        return {
            "shoulder_flex_r": arms * (38 + 60 * np.sin(phase)),
            "shoulder_flex_l": arms * (38 - 60 * np.sin(phase)),
            "hip_flex_r": legs * 62 * kick,
            "knee_r": legs * 18 * kick,
        }

    return Motion("fast", tuple(opening({"shoulder_in_l": 0, "shoulder_in_r": 0})), 90, swings)


def pass_cube(skeleton: Skeleton) -> Motion:
    """A cube of 20 cm in one hand, passed to the other and back (Kehl 2006, section 7.5)."""
    hold_r = arm_angles(skeleton, "_r", (0.42, -0.16, 0.02), {"shoulder_in": 25, "elbow": 80})
    hold_l = arm_angles(skeleton, "_l", (0.42, 0.16, 0.02), {"shoulder_in": 25, "elbow": 80})
    away_r = arm_angles(skeleton, "_r", (0.30, -0.52, 0.08), {"shoulder_abd": 45, "elbow": 60})
    away_l = arm_angles(skeleton, "_l", (0.30, 0.52, 0.08), {"shoulder_abd": 45, "elbow": 60})
    keys = opening()
    for frame, values in (
        (30, STAND | away_r), (40, hold_r | hold_l), (43, hold_r | hold_l), (52, away_l | away_r),
        (58, away_l | {"yaw": 25.0}), (68, hold_r | hold_l | {"yaw": 25.0}), (71, hold_r | hold_l),
        (80, away_r | away_l), (89, away_r | away_l | {"yaw": 0.0}),
    ):  # fmt: skip
        keys.append((frame, values))
    # the cube is in the right hand from the start: the Da Vinci pose is held with it
    return Motion("object", tuple(keys), 90, cube=((0, "_r"), (42, "_l"), (70, "_r")))


def pedal(skeleton: Skeleton) -> Motion:
    """The lower arms rotate around each other like the pedals of a bicycle (Kehl 2006, fig. 11)."""
    cycle, keys = 20.0, opening()
    guess = {"_l": {"shoulder_in": 45.0, "elbow": 85.0, "shoulder_flex": 30.0}, "_r": {}}
    guess["_r"] = dict(guess["_l"])
    previous: dict[str, dict[str, float]] = guess
    for step in range(41):
        frame = START + 6 + step * cycle / 12
        values: dict[str, float] = {}
        for side, s, shift in (("_l", 1.0, 0.0), ("_r", -1.0, np.pi)):
            phase = 2 * np.pi * step / 12 + shift
            target = (0.33 + 0.095 * np.cos(phase), -s * 0.03, 0.05 + 0.095 * np.sin(phase))
            solved = arm_angles(skeleton, side, target, previous[side])
            previous[side] = {name[:-2]: value for name, value in solved.items()}
            values |= solved
        keys.append((frame, values))
    return Motion("pedal", tuple(keys), 96)


def kick(skeleton: Skeleton) -> Motion:
    """Hands on the hips, then kicks with both legs while turning, arms in defence (Kehl 2006, section 7.3)."""
    hips: dict[str, float] = {}
    guard: dict[str, float] = {}
    for side, s in (("_l", 1.0), ("_r", -1.0)):
        hips |= arm_angles(skeleton, side, (-0.01, s * 0.265, -0.21), {"shoulder_abd": 45, "shoulder_flex": -25,
                                                                   "elbow": 95, "shoulder_in": 60})  # fmt: skip
        guard |= arm_angles(
            skeleton, side, (0.30, s * 0.10, 0.16), {"elbow": 120, "shoulder_in": 30, "shoulder_flex": 35}
        )
    ready = {"hip_flex_l": 10.0, "hip_flex_r": 10.0, "knee_l": 16.0, "knee_r": 16.0, "hip_abd_l": 9.0, "hip_abd_r": 9.0}
    keys = opening(hips | ready)
    keys += [(34, hips | ready | {"yaw": 0.0, "spine_flex": 0.0}), (41, guard | ready | {"yaw": 10.0})]
    for at, leg, yaw in ((47, "r", 25.0), (61, "l", 5.0), (75, "r", 40.0)):
        keys += [
            (at - 4, ready | {"spine_flex": 2.0, f"ankle_{leg}": 0.0}),
            (at, {f"hip_flex_{leg}": 55.0, f"knee_{leg}": 90.0, "yaw": yaw, f"ankle_{leg}": -5.0}),
            (at + 4, {f"hip_flex_{leg}": 78.0, f"knee_{leg}": 14.0, "spine_flex": -10.0, f"ankle_{leg}": -25.0}),
            (at + 8, {f"hip_flex_{leg}": 45.0, f"knee_{leg}": 75.0, "spine_flex": -2.0, f"ankle_{leg}": -5.0}),
        ]
    keys.append((88, guard | ready | {"yaw": 40.0, "spine_flex": 0.0, "ankle_r": 0.0}))
    return Motion("kick", tuple(keys), 90)


def on_feet(
    motion: Motion, skeleton: Skeleton, root: Mapping[float, tuple[float, float, float]],
    steps: Mapping[str, Sequence[Step]],
) -> Motion:  # fmt: skip
    """Return the motion with legs from the pelvis, keyed by frame in metres, to the feet of ``steps`` by side."""
    curve = PchipInterpolator(np.array(list(root), dtype=np.float64), np.array(list(root.values())))
    last = max(root)

    def pelvis(frame: Float) -> Float:
        return curve(np.clip(frame, 0.0, last))

    grid = np.arange(-1.0, motion.frames + 2.0)
    angles, legs = motion.angles(grid), {}
    for side, placed in steps.items():
        track = foot_track(placed, grid)
        push = {"ankle" + side: angles["ankle" + side] - track.push}
        legs |= push | dict(leg_angles(skeleton, side, {**angles, **push}, pelvis(grid), track.toe, track.heading))
    curves = {name: PchipInterpolator(grid, np.degrees(values)) for name, values in legs.items()}

    def layer(frame: Float) -> dict[str, Float]:
        added = {} if motion.layer is None else motion.layer(frame)
        return added | {name: curve(np.clip(frame, grid[0], grid[-1])) for name, curve in curves.items()}

    keys = tuple((at, {name: v for name, v in values.items() if name not in curves}) for at, values in motion.keys)
    return replace(motion, keys=keys, layer=layer, root=pelvis)


def da_vinci_stand(skeleton: Skeleton) -> tuple[Float, dict[str, Float]]:
    """Return the pelvis (3,) above the origin, and each side's toe tip (3,), in the Da Vinci pose; metres."""
    pose = forward(skeleton, {name: np.radians([value]) for name, value in DA_VINCI.items()})
    soles = sole_points(skeleton, pose)[0]
    height = np.array([0.0, 0.0, -soles[..., 2].min()])
    return height, {side: soles[i, 2] + height for i, side in enumerate(("_l", "_r"))}


def turn(skeleton: Skeleton) -> Motion:
    """Eleven steps on the spot that lead all the way round in three seconds, with the arms swinging and gesturing."""
    h, begin, cycle = skeleton.stature_m, 30.0, 9.2
    pelvis, toes = da_vinci_stand(skeleton)
    across = {"shoulder_abd": 28.0, "shoulder_in": 50.0, "elbow": 85.0, "shoulder_flex": 25.0}
    front_r = arm_angles(skeleton, "_r", (0.30, 0.0, -0.11), across)
    front_l = arm_angles(skeleton, "_l", (0.28, 0.0, -0.05), across)
    point_l = arm_angles(skeleton, "_l", (0.36, 0.30, 0.10), {"elbow": 70, "shoulder_flex": 40})
    point_r = arm_angles(skeleton, "_r", (0.34, -0.28, 0.06), {"elbow": 75, "shoulder_flex": 35})
    down = {name: STAND[name] for name in ("shoulder_abd_l", "shoulder_flex_l", "shoulder_in_l", "elbow_l")}
    down_l, down_r = down | {"elbow_l": 32.0}, {name[:-1] + "r": value for name, value in down.items()}
    keys = opening(until=28)
    keys += [
        (31, {"yaw": 0.0, "neck_turn": 0.0, "spine_turn": 0.0}),
        (36, {"yaw": 14.0, "neck_turn": 16.0, "spine_turn": 6.0}),
        (42, front_r | down_l | {"spine_flex": 3.0}),
        (54, front_r | down_l),
        (66, point_l | down_r | {"elbow_r": 40.0}),
        (74, point_l | down_r | {"elbow_r": 55.0, "spine_flex": 4.0}),
        (87, front_l | down_r | {"elbow_r": 34.0}),
        (98, front_l | point_r),
        (112, down_l | point_r | {"neck_turn": 14.0, "spine_turn": 5.0}),
        (114, {"yaw": 349.0}),
        (120, {"yaw": 360.0, "neck_turn": 0.0, "spine_turn": 0.0}),
        (129, STAND | {"spine_flex": 0.0}),
    ]  # fmt: skip

    def swings(frame: Float) -> dict[str, Float]:
        swing = _window(frame, begin, begin + 10.5 * cycle) * np.sin(np.pi * (frame - begin) / cycle)
        return {"shoulder_flex_l": -9 * swing, "shoulder_flex_r": 9 * swing, "spine_side": 1.5 * swing}

    motion = Motion("turn", tuple(keys), 136, swings, fps=30.0)

    def middle(degrees: float) -> Float:
        """The centre of the steps: a small circle to the left, as people turn."""
        angle = np.radians(degrees)
        return 0.10 * np.array([np.sin(angle), 1.0 - np.cos(angle)])

    def stand(side: str, degrees: float) -> tuple[tuple[float, float], float]:
        """Toe tip and heading of a foot beneath a pelvis that has turned by this much."""
        s, angle = 1.0 if side == "_l" else -1.0, np.radians(degrees)
        ahead, left = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        x, y = middle(degrees) + (0.072 * h + 0.05) * ahead + s * 0.078 * h * left
        return (float(x), float(y)), degrees + s * 7.0

    def yaw(frame: float) -> float:
        return float(np.degrees(motion.angles(np.array([frame]))["yaw"][0]))

    steps = {side: [Step(0, 0, (float(toe[0]), float(toe[1])))] for side, toe in toes.items()}
    steps["_l"].append(Step(10, 18, *stand("_l", 0.0), height_m=0.05))
    steps["_r"].append(Step(18, 26, *stand("_r", 0.0), height_m=0.05))
    root = {0.0: tuple(pelvis), 10.0: tuple(pelvis), 14.0: (0.0, -0.09, 0.519 * h), 22.0: (0.0, 0.03, 0.523 * h)}
    for i in range(11):
        lifts, side = begin + i * cycle, ("_l", "_r")[i % 2]
        lands = lifts + 0.8 * cycle
        # a foot is set down to where the pelvis will be in the middle of its stance
        steps[side].append(Step(lifts, lands, *stand(side, yaw(lands + 0.6 * cycle)), height_m=0.065))
        standing, at = (-1.0 if side == "_l" else 1.0), lifts + 0.4 * cycle
        turned = np.radians(yaw(at))
        x, y = middle(yaw(at)) + 0.025 * standing * np.array([-np.sin(turned), np.cos(turned)])
        root[at] = (float(x), float(y), 0.526 * h)
        x, y = middle(yaw(lifts - 0.1 * cycle))
        root[lifts - 0.1 * cycle] = (float(x), float(y), 0.520 * h)
    root[133.0] = (*map(float, middle(360.0)), 0.528 * h)
    return on_feet(motion, skeleton, dict(sorted(root.items())), steps)


def crouch(skeleton: Skeleton) -> Motion:
    """Down into a squat, on one knee, on both, sitting on the heels; up again over one knee."""
    h = skeleton.stature_m
    pelvis, toes = da_vinci_stand(skeleton)
    foot = 0.072 * h + 0.06  # the toe tip ahead of the ankle
    toe_x, toe_y, out = float(toes["_l"][0]), 0.064 * h, 5.0
    knee_x, knee_z, shank_deg = _kneeling_shank(skeleton)
    knee_x += toe_x

    def above_knee(thigh_deg: float) -> tuple[float, float, float]:
        """The pelvis when both knees are on the floor and the thighs rise by this angle."""
        angle, thigh = np.radians(thigh_deg), 0.245 * h
        return knee_x - thigh * float(np.cos(angle)), 0.0, knee_z + thigh * float(np.sin(angle))

    sit = shank_deg + 180 - 150.0  # knees bent by 150 degrees
    front_x = toe_x + 0.43 * h
    end_x = toe_x + 0.50 * h
    stand_z = 0.527 * h
    root: dict[float, tuple[float, float, float]] = {
        0: (0.0, 0.0, float(pelvis[2])),
        10: (0.0, 0.0, float(pelvis[2])),
        14: (0.0, -0.09, 0.519 * h),
        22: (0.0, 0.03, 0.523 * h),
        28: (toe_x - foot + 0.02, 0.0, stand_z),
        39: (toe_x - foot - 0.13 * h, 0.0, 0.37 * h),
        50: (toe_x - foot - 0.13 * h, 0.0, 0.245 * h),
        54: (toe_x - foot - 0.12 * h, -0.01, 0.240 * h),
    }
    for share in (0.33, 0.67):
        a, b = np.array(root[54]), np.array(above_knee(68.0))
        root[54 + 14 * share] = tuple(map(float, a + share * (b - a) + [0, -0.015, 0.03]))
    root |= {68: above_knee(68.0), 73: above_knee(72.0), 91: above_knee(86.0)}
    for start, stop, a, b in ((91, 104, 86.0, sit), (112, 123, sit, 88.0)):
        for share in np.linspace(0.0, 1.0, 6):
            eased = share * share * (3 - 2 * share)
            root[start + float(share) * (stop - start)] = above_knee(a + float(eased) * (b - a))
    root |= {
        139: above_knee(94.0),
        147: (end_x - foot - 0.10, 0.01, 0.38 * h),
        154: (end_x - foot + 0.01, 0.02, 0.50 * h),
        163: (end_x - foot + 0.02, 0.0, stand_z),
    }
    steps = {
        side: [Step(0, 0, (float(toe[0]), float(toe[1]))), Step(*when, (toe_x, s * toe_y), s * out, 0.05)]
        for side, s, when, toe in (("_l", 1.0, (10, 18), toes["_l"]), ("_r", -1.0, (18, 26), toes["_r"]))
    }
    steps["_l"] += [
        Step(55, 67, (front_x, toe_y), out, 0.08),
        Step(73, 90, (toe_x, toe_y), out, 0.05),
        Step(122, 138, (end_x, toe_y), out, 0.06),
    ]
    steps["_r"].append(Step(144, 158, (end_x, -toe_y), -out, 0.06))

    def hands(x: float, y: float, z: float, guess: Mapping[str, float]) -> dict[str, float]:
        return arm_angles(skeleton, "_l", (x, y, z), guess) | arm_angles(skeleton, "_r", (x, -y, z), guess)

    size = h / 1.75
    before = hands(0.44 * size, 0.14 * size, 0.21 * size, {"shoulder_abd": 25, "elbow": 70, "shoulder_flex": 70})
    low = hands(0.36 * size, 0.13 * size, -0.12, {"shoulder_in": 25, "elbow": 75, "shoulder_flex": 25})
    lap = hands(0.27 * size, 0.16 * size, -0.31 * size, {"shoulder_in": 20, "elbow": 45, "shoulder_flex": 20})
    keys = opening({"spine_flex": 2.0}, until=28)
    keys += [
        (40, before | {"pitch": 15.0, "spine_flex": 14.0, "neck_flex": -8.0}),
        (50, before | {"pitch": 16.0, "spine_flex": 30.0, "neck_flex": -18.0}),
        (54, before | {"pitch": 16.0, "spine_flex": 30.0, "neck_flex": -18.0}),
        (61, before),
        (70, low | {"pitch": 6.0, "spine_flex": 10.0, "neck_flex": 0.0}),
        (74, low | {"pitch": 5.0, "spine_flex": 8.0, "neck_flex": 4.0}),
        (91, low | {"pitch": 2.0, "spine_flex": 6.0, "neck_flex": 5.0}),
        (104, lap | {"pitch": 8.0, "spine_flex": 14.0, "neck_flex": 0.0}),
        (112, lap | {"pitch": 8.0, "spine_flex": 12.0, "neck_flex": -3.0}),
        (123, low | {"pitch": 4.0, "spine_flex": 6.0, "neck_flex": 0.0}),
        (139, low | {"pitch": 10.0, "spine_flex": 12.0}),
        (148, low | {"pitch": 20.0, "spine_flex": 16.0, "neck_flex": -8.0}),
        (164, STAND | {"pitch": 0.0, "spine_flex": 2.0, "neck_flex": 0.0}),
    ]
    return on_feet(Motion("crouch", tuple(keys), 166, fps=30.0), skeleton, dict(sorted(root.items())), steps)


def _kneeling_shank(skeleton: Skeleton) -> tuple[float, float, float]:
    """How far the knee is ahead of the toe tip, its height, both in metres, and the shank's slope in degrees when knee
    and toe tip are on the floor."""
    bend = np.linspace(90.0, 125.0, 3501)
    pose = forward(skeleton, {"knee_l": np.radians(bend)})
    knee, toe = pose.origin[:, skeleton.index("knee_l")], sole_points(skeleton, pose)[:, 0, 2]
    height = KNEE_RADIUS * skeleton.stature_m
    best = int(np.abs(knee[:, 2] - toe[:, 2] - height).argmin())
    return float(knee[best, 0] - toe[best, 0]), height, float(bend[best] - 90.0)


MOTIONS: dict[str, Callable[[Skeleton], Motion]] = {
    "demo": demo,
    "arms-close": arms_close,
    "fast": fast,
    "object": pass_cube,
    "pedal": pedal,
    "kick": kick,
    "turn": turn,
    "crouch": crouch,
}
"""Motion by its name on the command line."""
