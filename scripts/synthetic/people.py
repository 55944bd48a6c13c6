"""People who walk and meet: where each walks, which way each faces, and what the arms do.

People walk where a path of the pelvis leads them; their steps follow from it. Positions are metres on the floor, which
has the cameras around its origin; angles are degrees, 0 along x, counterclockwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from scripts.synthetic.actor import Look
from scripts.synthetic.motion import FPS, HOLD, STAND, Key, Motion, da_vinci_stand, on_feet, opening
from scripts.synthetic.reach import arm_angles
from scripts.synthetic.skeleton import Skeleton
from scripts.synthetic.steps import Step

Float = NDArray[np.float64]
Way = Sequence[tuple[float, float, float]]  # frame, x, y
Act = tuple[str, float, float]  # name in ACTS, first and last frame
Dip = tuple[float, float, float]  # frame, height of the pelvis and its way back, as shares of the stature

#: bodies whose pelvis is within this distance of the origin are entirely seen by all cameras, metres
STAGE_M = 1.5
#: frame in which everybody stands after the initialisation pose, and half a cycle of walking, frames: 2 steps a second
READY, HALF_CYCLE = 26, 7.5
_FASTER_LOWER = 0.007  # the pelvis of a person who walks at 1.2 m/s is lower by this share of the stature
_GRID = 0.25  # frames between samples of a path
_SMOOTH = 3.5  # standard deviation of the smoothing of paths and headings, frames


@dataclass(frozen=True)
class Role:
    """One person of a scene.

    Attributes:
        way: the pelvis on the floor.
        facing: frame and heading, where the person stands.
        acts: what the person does besides walking.
        stature_m, look: of the body; None for those of the options.
        posed: whether the person begins in the initialisation pose.
        strolling: whether the person looks where he or she walks, instead of to ``facing``.
    """

    way: Way
    facing: Sequence[tuple[float, float]] = ((0, 0.0),)
    acts: Sequence[Act] = ()
    stature_m: float | None = None
    look: Look | None = None
    posed: bool = True
    strolling: bool = True


@dataclass(frozen=True)
class Scene:
    """Several people over ``frames`` frames. The first role is the subject."""

    frames: int
    roles: tuple[Role, ...]


@dataclass(frozen=True)
class _Walk:
    """The pelvis on the floor over time.

    Attributes:
        frame: (T,) times, frames.
        xy: (T, 2) metres.
        yaw: (T,) degrees, continuous.
        speed: (T,) m/s.
    """

    frame: Float
    xy: Float
    yaw: Float
    speed: Float

    @staticmethod
    def along(way: Way, facing: Sequence[tuple[float, float]], frames: int, strolling: bool) -> _Walk:
        """Return the walk along a polyline that looks where it goes, and to ``facing`` (frame, degrees) where slow.

        Someone who is not ``strolling`` looks to ``facing`` all the time.
        """
        frame = np.arange(-8, frames + 8, _GRID)
        at, x, y = np.array(way, np.float64).T
        sigma = _SMOOTH / _GRID
        xy = gaussian_filter1d(np.stack([np.interp(frame, at, x), np.interp(frame, at, y)], axis=1), sigma, axis=0)
        velocity = np.gradient(xy, axis=0) / _GRID * FPS
        speed = np.linalg.norm(velocity, axis=1)
        at, degrees = np.array(facing, np.float64).T
        angle = np.radians(np.interp(frame, at, degrees))
        share = strolling * np.clip((speed - 0.2) / 0.3, 0.0, 1.0)[:, None]
        ahead = velocity / np.maximum(speed, 1e-9)[:, None]
        ahead = share * ahead + (1 - share) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        # the first heading holds until the initialisation pose has been left
        ahead[frame < READY] = np.cos(angle[0]), np.sin(angle[0])
        ahead = gaussian_filter1d(ahead, sigma, axis=0)
        return _Walk(frame, xy, np.degrees(np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))), speed)

    def at(self, frame: float) -> tuple[Float, float]:
        """Return position (2,) and heading at a time."""
        xy = np.array([np.interp(frame, self.frame, self.xy[:, c]) for c in range(2)])
        return xy, float(np.interp(frame, self.frame, self.yaw))


def _axes(degrees: float) -> tuple[Float, Float]:
    """Return the directions (2,) ahead and to the left."""
    angle = np.radians(degrees)
    return np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])


def walk(skeleton: Skeleton, name: str, frames: int, role: Role) -> Motion:
    """Return the motion of a person of this skeleton in a role, ``frames`` long."""
    posed, gestures, dips = role.posed, [], []
    for what, start, stop in sorted(role.acts, key=lambda act: act[1]):
        keys, dip = ACTS[what](skeleton, start, stop)
        gestures += keys
        dips += dip
    h = skeleton.stature_m
    walked = _Walk.along(role.way, role.facing, frames, role.strolling)
    pelvis, toes = da_vinci_stand(skeleton)
    start, heading = walked.at(0.0)
    ahead, left = _axes(heading)

    def stand(side: str, frame: float) -> tuple[tuple[float, float], float]:
        """Return toe tip and heading of a foot beneath the pelvis at a time."""
        s, (xy, yaw) = (1.0 if side == "_l" else -1.0), walked.at(frame)
        to, across = _axes(yaw)
        x, y = xy + (0.072 * h + 0.05) * to + s * 0.078 * h * across
        return (float(x), float(y)), yaw + s * 7.0

    steps: dict[str, list[Step]] = {}
    for side, toe in toes.items():
        x, y = start + toe[0] * ahead + toe[1] * left
        steps[side] = [Step(-9, -9, (float(x), float(y)), heading) if posed else Step(-9, -9, *stand(side, 0.0))]
    begin = READY if posed else 0
    if posed:
        steps["_l"].append(Step(10, 18, *stand("_l", 0.0), height_m=0.05))
        steps["_r"].append(Step(18, 26, *stand("_r", 0.0), height_m=0.05))
    for i in range(int((frames - begin) / HALF_CYCLE) + 1):
        side, lifts = ("_l", "_r")[i % 2], begin + i * HALF_CYCLE
        lands = lifts + 0.8 * HALF_CYCLE
        toe_m, turned = stand(side, lands + 0.6 * HALF_CYCLE)
        last = steps[side][-1]
        far = float(np.hypot(toe_m[0] - last.toe_m[0], toe_m[1] - last.toe_m[1]))
        if far > 0.04 or abs(turned - last.heading_deg) > 8.0:
            steps[side].append(Step(lifts, lands, toe_m, turned, height_m=min(0.03 + 0.1 * far, 0.07)))
    grid = np.arange(-1.0, frames + 2.0)
    keyed = [(-9.0, 0.523, 0.0), *dips, (frames + 9.0, 0.523, 0.0)]
    if posed:
        keyed = [(0.0, pelvis[2] / h, 0.0), (HOLD, pelvis[2] / h, 0.0), (14.0, 0.519, 0.0), *keyed[1:]]
    when, height, back = np.array(keyed, np.float64).T
    lean = np.interp(grid, (10, 14, 22, 28), (0.0, -0.09, 0.03, 0.0)) if posed else np.zeros(len(grid))
    root = {}
    for frame, z, b, sideways in zip(
        grid, np.interp(grid, when, height), np.interp(grid, when, back), lean, strict=True
    ):
        xy, yaw = walked.at(frame)
        to, across = _axes(yaw)
        x, y = xy - b * h * to + sideways * across
        fast = min(float(np.interp(frame, walked.frame, walked.speed)) / 1.2, 1.2)
        root[float(frame)] = (float(x), float(y), (float(z) - _FASTER_LOWER * fast**2) * h)
    first: list[Key] = opening(until=READY) if posed else [(0, STAND)]
    curves = [(at, {name: value for name, value in values.items() if name != "yaw"}) for at, values in first]
    curves += [(float(frame), {"yaw": walked.at(frame)[1]}) for frame in grid[::2]]
    busy = [at for at, _ in gestures]

    def swing(frame: Float) -> dict[str, Float]:
        speed = np.interp(frame, walked.frame, walked.speed)
        free = np.ones(len(frame))
        if busy:
            free = np.clip(np.maximum(busy[0] - frame, frame - busy[-1]) / 6.0, 0.0, 1.0)
        amount = free * np.clip(speed / 1.1, 0.0, 1.0) * (frame > READY if posed else 1.0)
        phase = np.cos(np.pi * (frame - begin) / HALF_CYCLE)
        return {
            "shoulder_flex_l": 22 * amount * phase,
            "shoulder_flex_r": -22 * amount * phase,
            "spine_turn": -6 * amount * phase,
        }

    motion = Motion(name, tuple(sorted([*curves, *gestures], key=lambda key: key[0])), frames, swing)
    return replace(on_feet(motion, skeleton, root, steps), placed=True)


def _rest(until: float) -> Key:
    """Return the key with arms that hang and an upright trunk."""
    arms = {name: value for name, value in STAND.items() if name.startswith(("shoulder", "elbow", "fingers"))}
    return until, arms | {"spine_flex": 0.0, "pitch": 0.0, "neck_flex": 0.0, "spine_turn": 0.0}


def _shake(skeleton: Skeleton, start: float, stop: float) -> tuple[list[Key], list[Dip]]:
    """Return the keys of a handshake: the right hand half-way to a partner 0.75 m ahead, three pumps."""
    size = skeleton.stature_m / 1.75
    guess = {"shoulder_flex": 30.0, "elbow": 60.0, "shoulder_in": 15.0}
    up, down = (arm_angles(skeleton, "_r", (0.31 * size, -0.02, z), guess) for z in (-0.04, -0.11))
    keys = [_rest(start - 8), (start, up | {"spine_flex": 6.0})]
    for k, at in enumerate(np.linspace(start + 3, stop, 6)):
        keys.append((float(at), (down if k % 2 == 0 else up) | {"spine_flex": 6.0}))
    return [*keys, _rest(stop + 9)], []


def _hug(skeleton: Skeleton, start: float, stop: float, over: bool) -> tuple[list[Key], list[Dip]]:
    """Return the keys of an embrace: both arms around a partner 0.4 m ahead, above or below the partner's arms."""
    size, z = skeleton.stature_m / 1.75, 0.12 if over else -0.12
    wide, closed = {}, {}
    for side, s in (("_l", 1.0), ("_r", -1.0)):
        guess = {"shoulder_flex": 55.0, "shoulder_abd": 70.0, "shoulder_in": 60.0, "elbow": 50.0}
        wide |= arm_angles(skeleton, side, (0.38 * size, s * 0.42 * size, z), guess)
        guess = {name: wide[name + side] for name in guess}
        closed |= arm_angles(skeleton, side, (0.49 * size, s * 0.235 * size, z), guess)
    near = {"spine_flex": 8.0, "neck_flex": 6.0}
    keys = [
        _rest(start - 18), (start - 8, wide | near), (start, closed | near), (stop, closed | near),
        (stop + 8, wide | near), _rest(stop + 18),
    ]  # fmt: skip
    return keys, []


def _crouch(skeleton: Skeleton, start: float, stop: float) -> tuple[list[Key], list[Dip]]:
    """Return the keys and the dips of a squat between two frames."""
    size = skeleton.stature_m / 1.75
    arms: dict[str, float] = {}
    for side, s in (("_l", 1.0), ("_r", -1.0)):
        guess = {"shoulder_abd": 25.0, "elbow": 70.0, "shoulder_flex": 60.0}
        arms |= arm_angles(skeleton, side, (0.40 * size, s * 0.14 * size, 0.02), guess)
    low = arms | {"pitch": 15.0, "spine_flex": 28.0, "neck_flex": -15.0}
    keys = [_rest(start - 12), (start, low), (stop, low), _rest(stop + 12)]
    return keys, [(start - 12, 0.523, 0.0), (start, 0.27, 0.13), (stop, 0.27, 0.13), (stop + 12, 0.523, 0.0)]


ACTS: dict[str, Callable[[Skeleton, float, float], tuple[list[Key], list[Dip]]]] = {
    "shake hands": _shake,
    "embrace above": partial(_hug, over=True),
    "embrace below": partial(_hug, over=False),
    "crouch": _crouch,
}
"""What people do: functions of skeleton, first and last frame, that return the keys of arms and trunk, and the dips."""
