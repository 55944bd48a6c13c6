"""Motions: joint angles over time, and the path of the pelvis that keeps the standing foot where it is.

All motions start in the Da Vinci pose, hold it for :data:`HOLD` frames and take :data:`BLEND` frames to leave it.
Angles are keyed in degrees and joined by monotone cubics (no overshoot past a limit); the gait is a periodic function
on top.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from scripts.synthetic.reach import arm_angles
from scripts.synthetic.skeleton import LIMITS_DEG, Pose, Skeleton, forward, sole_points

Float = NDArray[np.float64]
Key = tuple[float, Mapping[str, float]]  # frame, degrees of the angles that the key sets

FPS = 15.0
HOLD, BLEND = 10, 12
START = HOLD + BLEND
_STEPS = 16  # evaluations a frame for the pelvis path

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
    """

    name: str
    keys: tuple[Key, ...]
    frames: int
    layer: Callable[[Float], dict[str, Float]] | None = None
    cube: tuple[tuple[int, str], ...] = ()

    def angles(self, frame: Float) -> dict[str, Float]:
        """Radians of every angle at (T,) times in frames."""
        frame = np.asarray(frame, dtype=np.float64)
        curves: dict[str, list[tuple[float, float]]] = {name: [] for name in LIMITS_DEG}
        for at, values in self.keys:
            for name, value in values.items():
                curves[name].append((at, value))
        result = {}
        for name, points in curves.items():
            if not points:
                result[name] = np.zeros(len(frame))
                continue
            x, y = np.array(points).T
            result[name] = (
                np.full(len(frame), y[0]) if len(x) == 1 else PchipInterpolator(x, y)(np.clip(frame, x[0], x[-1]))
            )
        sway = np.sin(2 * np.pi * frame / FPS * 0.45)  # nobody stands quite still
        result["spine_side"] = result["spine_side"] + 0.6 * sway
        result["neck_turn"] = result["neck_turn"] + 1.5 * sway
        if self.layer is not None:
            for name, added in self.layer(frame).items():
                result[name] = result[name] + added
        return {name: np.radians(value) for name, value in result.items()}

    def held_by(self, frame: int) -> str | None:
        """Side whose hand holds the cube in this frame."""
        side = None
        for start, holder in self.cube:
            if frame >= start:
                side = holder
        return side


@dataclass(frozen=True)
class Path:
    """The pelvis of a motion over time: ``frame`` (T,) and ``root`` (T, 3) metres."""

    frame: Float
    root: Float

    def at(self, frame: Float) -> Float:
        return np.stack([np.interp(frame, self.frame, self.root[:, c]) for c in range(3)], axis=1)


def plan_path(motion: Motion, skeleton: Skeleton, frames: int) -> Path:
    """Where the pelvis goes: the lower foot stands on the floor and does not slide, the other one is free.

    The horizontal path is centred on the world's origin.
    """
    frame = np.arange(-_STEPS, (frames + 1) * _STEPS) / _STEPS
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


def _opening(first: Mapping[str, float] | None = None) -> list[Key]:
    """Da Vinci pose, then ``first`` (standing by default) from frame START on."""
    target = dict.fromkeys(DA_VINCI, 0.0) | STAND | dict(first or {})
    start = dict.fromkeys([*target, "pitch", "neck_flex", "spine_flex"], 0.0) | DA_VINCI
    return [(0, start), (HOLD, start), (START, target)]


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
    keys = _opening()
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
    keys = _opening(near)
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

    return Motion("fast", tuple(_opening({"shoulder_in_l": 0, "shoulder_in_r": 0})), 90, swings)


def pass_cube(skeleton: Skeleton) -> Motion:
    """A cube of 20 cm in one hand, passed to the other and back (Kehl 2006, section 7.5)."""
    hold_r = arm_angles(skeleton, "_r", (0.42, -0.16, 0.02), {"shoulder_in": 25, "elbow": 80})
    hold_l = arm_angles(skeleton, "_l", (0.42, 0.16, 0.02), {"shoulder_in": 25, "elbow": 80})
    away_r = arm_angles(skeleton, "_r", (0.30, -0.52, 0.08), {"shoulder_abd": 45, "elbow": 60})
    away_l = arm_angles(skeleton, "_l", (0.30, 0.52, 0.08), {"shoulder_abd": 45, "elbow": 60})
    keys = _opening()
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
    cycle, keys = 20.0, _opening()
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
    keys = _opening(hips | ready)
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


MOTIONS: dict[str, Callable[[Skeleton], Motion]] = {
    "demo": demo,
    "arms-close": arms_close,
    "fast": fast,
    "object": pass_cube,
    "pedal": pedal,
    "kick": kick,
}
"""Motion by its name on the command line."""
