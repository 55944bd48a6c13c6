"""Scenes with two people: where each walks, which way each faces, and what the arms do.

People walk where a path of the pelvis leads them; their steps follow from it. Positions are metres on the floor, which
has the cameras around its origin; angles are degrees, 0 along x, counterclockwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

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

#: bodies whose pelvis is within this distance of the origin are entirely seen by all cameras, metres
STAGE_M = 1.5
#: frame in which everybody stands after the initialisation pose, and half a cycle of walking, frames: 2 steps a second
READY, HALF_CYCLE = 26, 7.5
_FASTER_LOWER = 0.007  # the pelvis of a person who walks at 1.2 m/s is lower by this share of the stature
_GRID = 0.25  # frames between samples of a path
_SMOOTH = 3.5  # standard deviation of the smoothing of paths and headings, frames


@dataclass(frozen=True)
class Role:
    """One person of a scene; without stature or look, those of person 0."""

    motion: Callable[[Skeleton], Motion]
    stature_m: float | None = None
    look: Look | None = None


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


def walk(
    skeleton: Skeleton,
    name: str,
    frames: int,
    way: Way,
    facing: Sequence[tuple[float, float]],
    gestures: Sequence[Key] = (),
    dips: Sequence[tuple[float, float, float]] = (),
    posed: bool = True,
    strolling: bool = True,
) -> Motion:
    """Return a motion along a path.

    Args:
        skeleton: the person's.
        name: of the motion.
        frames: natural length.
        way: the pelvis on the floor.
        facing: frame and heading, where the person stands.
        gestures: keys of the arms and the trunk; the arms swing between them.
        dips: frame, height of the pelvis and its way back, as shares of the stature, where it is not a walker's.
        posed: whether the person begins in the initialisation pose.
        strolling: whether the person looks where he or she walks, instead of to ``facing``.
    """
    h = skeleton.stature_m
    walked = _Walk.along(way, facing, frames, strolling)
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
    keys = [(at, {name: value for name, value in values.items() if name != "yaw"}) for at, values in first]
    keys += [(float(frame), {"yaw": walked.at(frame)[1]}) for frame in grid[::2]]
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

    motion = Motion(name, tuple(sorted([*keys, *gestures], key=lambda key: key[0])), frames, swing)
    return replace(on_feet(motion, skeleton, root, steps), placed=True)


def _circle(
    start: float, stop: float, radii: tuple[float, float], turns: float, phase_deg: float = 0.0, step: float = 2.0
) -> list[tuple[float, float, float]]:
    """Return a way around the origin on an ellipse; negative turns are clockwise."""
    frame = np.arange(start, stop + step, step)
    angle = np.radians(phase_deg) + 2 * np.pi * turns * (frame - start) / (stop - start)
    return [
        (float(f), radii[0] * float(np.cos(a)), radii[1] * float(np.sin(a))) for f, a in zip(frame, angle, strict=True)
    ]


def _rest(until: float) -> Key:
    """Return the key with arms that hang and an upright trunk."""
    arms = {name: value for name, value in STAND.items() if name.startswith(("shoulder", "elbow", "fingers"))}
    return until, arms | {"spine_flex": 0.0, "pitch": 0.0, "neck_flex": 0.0, "spine_turn": 0.0}


def _shake(skeleton: Skeleton, start: float, stop: float) -> list[Key]:
    """Return the keys of a handshake: the right hand half-way to a partner 0.75 m ahead, three pumps."""
    size = skeleton.stature_m / 1.75
    guess = {"shoulder_flex": 30.0, "elbow": 60.0, "shoulder_in": 15.0}
    up, down = (arm_angles(skeleton, "_r", (0.31 * size, -0.02, z), guess) for z in (-0.04, -0.11))
    keys = [_rest(start - 8), (start, up | {"spine_flex": 6.0})]
    for k, at in enumerate(np.linspace(start + 3, stop, 6)):
        keys.append((float(at), (down if k % 2 == 0 else up) | {"spine_flex": 6.0}))
    return [*keys, _rest(stop + 9)]


def _hug(skeleton: Skeleton, start: float, stop: float, over: bool) -> list[Key]:
    """Return the keys of an embrace: both arms around a partner 0.4 m ahead, above or below the partner's arms."""
    size, z = skeleton.stature_m / 1.75, 0.10 if over else -0.10
    wide, closed = {}, {}
    for side, s in (("_l", 1.0), ("_r", -1.0)):
        guess = {"shoulder_flex": 55.0, "shoulder_abd": 40.0, "shoulder_in": 30.0, "elbow": 50.0}
        wide |= arm_angles(skeleton, side, (0.38 * size, s * 0.34 * size, z), guess)
        guess = {name: wide[name + side] for name in guess}
        closed |= arm_angles(skeleton, side, (0.43 * size, s * 0.12 * size, z), guess)
    near = {"spine_flex": 8.0, "neck_flex": 6.0}
    return [
        _rest(start - 18), (start - 8, wide | near), (start, closed | near), (stop, closed | near),
        (stop + 8, wide | near), _rest(stop + 18),
    ]  # fmt: skip


def _crouch(skeleton: Skeleton, start: float, stop: float) -> tuple[list[Key], list[tuple[float, float, float]]]:
    """Return the keys and the dips of a squat between two frames."""
    size = skeleton.stature_m / 1.75
    arms: dict[str, float] = {}
    for side, s in (("_l", 1.0), ("_r", -1.0)):
        guess = {"shoulder_abd": 25.0, "elbow": 70.0, "shoulder_flex": 60.0}
        arms |= arm_angles(skeleton, side, (0.40 * size, s * 0.14 * size, 0.02), guess)
    low = arms | {"pitch": 15.0, "spine_flex": 28.0, "neck_flex": -15.0}
    keys = [_rest(start - 12), (start, low), (stop, low), _rest(stop + 12)]
    return keys, [(start - 12, 0.523, 0.0), (start, 0.27, 0.13), (stop, 0.27, 0.13), (stop + 12, 0.523, 0.0)]


# --- the scenes -------------------------------------------------------------------------------------------------------

_WOMAN = Look(hair=(0.20, 0.10, 0.04), shirt=(0.06, 0.22, 0.40), trousers=(0.16, 0.15, 0.14))
_GREEN = Look(hair=(0.02, 0.015, 0.012), shirt=(0.08, 0.26, 0.07), trousers=(0.22, 0.17, 0.10), stripes=True)
_GREY = Look(hair=(0.12, 0.11, 0.10), shirt=(0.30, 0.30, 0.31), trousers=(0.05, 0.05, 0.06))


def _crossing_0(s: Skeleton) -> Motion:
    way = [(READY, -1.0, 0.0), *_circle(34, 165, (1.0, 0.85), 1.6, 180)]
    return walk(s, "crossing", 165, way, [(0, 0.0)])


def _crossing_1(s: Skeleton) -> Motion:
    way = [(READY, 0.6, 0.1), *_circle(32, 165, (0.48, 0.36), -2.2, 10)]
    return walk(s, "crossing", 165, way, [(0, 180.0)])


def _handshake_0(s: Skeleton) -> Motion:
    way = [
        (READY, -0.95, -0.2), (46, -0.40, 0.0), (76, -0.40, 0.0), (84, -0.75, -0.1), (100, 0.15, -0.50),
        (114, 0.85, -0.3), (120, 0.85, -0.1), (134, 0.38, 0.05), (165, 0.38, 0.05),
    ]  # fmt: skip
    gestures = [*_shake(s, 54, 70), *_shake(s, 144, 158)]
    return walk(s, "handshake", 165, way, [(0, 0.0), (95, 0.0), (112, 90.0), (125, 180.0)], gestures)


def _handshake_1(s: Skeleton) -> Motion:
    way = [
        (READY, 0.9, 0.2), (46, 0.38, 0.0), (76, 0.38, 0.0), (84, 0.75, 0.1), (100, -0.15, 0.30),
        (114, -0.85, 0.4), (120, -0.88, 0.2), (134, -0.40, 0.05), (165, -0.40, 0.05),
    ]  # fmt: skip
    gestures = [*_shake(s, 54, 70), *_shake(s, 144, 158)]
    return walk(s, "handshake", 165, way, [(0, 180.0), (95, 180.0), (112, 270.0), (125, 360.0)], gestures)


def _entering_0(s: Skeleton) -> Motion:
    way = [(READY, -0.5, 0.0), (60, -0.5, 0.0), *_circle(68, 160, (0.6, 0.6), 1.0, 180)]
    return walk(s, "entering", 160, way, [(0, 0.0)])


def _entering_1(s: Skeleton) -> Motion:
    way = [
        (0, 3.6, 2.4), (30, 1.9, 1.25), (46, 0.9, 0.5), (60, 0.25, -0.1), (76, 0.1, -0.8), (92, 0.1, 0.1),
        (108, -0.8, 0.7), (124, -0.1, 0.2), (142, 1.0, -0.8), (160, 2.2, -1.8),
    ]  # fmt: skip
    return walk(s, "entering", 160, way, [(0, 215.0)], posed=False)


def _entering_2(s: Skeleton) -> Motion:
    way = [(0, -4.3, 2.3), (62, -4.2, 2.3), (108, -1.3, 0.9), (124, -0.6, -0.2), (142, 0.3, -0.3), (160, 0.5, 0.6)]
    return walk(s, "entering", 160, way, [(0, -30.0)], posed=False)


def _embrace_0(s: Skeleton) -> Motion:
    way = [
        (READY, -0.9, 0.0), (48, -0.20, 0.0), (74, -0.20, 0.0), (92, -0.80, -0.05), (96, -0.80, -0.05),
        (114, -0.2, 0.02), (136, -0.2, 0.02), (154, -0.75, 0.05), (158, -0.75, 0.05), (172, -0.40, 0.0),
    ]  # fmt: skip
    gestures = [*_hug(s, 56, 66, True), *_hug(s, 120, 130, False)]
    return walk(s, "embrace", 172, way, [(0, 0.0), (172, 0.0)], gestures, strolling=False)


def _embrace_1(s: Skeleton) -> Motion:
    way = [
        (READY, 0.9, 0.1), (48, 0.20, 0.0), (74, 0.20, 0.0), (92, 0.75, 0.1), (96, 0.75, 0.1),
        (114, 0.2, 0.0), (136, 0.2, 0.0), (154, 0.8, -0.1), (158, 0.8, -0.1), (172, 0.40, 0.0),
    ]  # fmt: skip
    gestures = [*_hug(s, 56, 66, False), *_hug(s, 120, 130, True)]
    return walk(s, "embrace", 172, way, [(0, 180.0), (172, 180.0)], gestures, strolling=False)


def _crouch_0(s: Skeleton) -> Motion:
    keys, dips = _crouch(s, 66, 88)
    way = [
        (READY, -0.9, -0.3), (50, -0.55, 0.35), (100, -0.55, 0.35), (116, 0.3, 0.75), (132, 0.95, 0.1),
        (148, 0.35, -0.45), (165, -0.5, -0.6),
    ]  # fmt: skip
    return walk(s, "crouching", 165, way, [(0, 0.0), (50, 0.0), (60, -20.0), (104, -20.0)], keys, dips)


def _crouch_1(s: Skeleton) -> Motion:
    way = [
        (READY, 0.75, 0.3), (54, 0.05, 0.1), (92, 0.05, 0.1), (108, 0.75, 0.0), (116, 0.6, -0.2), (132, 0.0, 0.1),
        (150, -0.3, -0.1), (165, -0.5, 0.3),
    ]  # fmt: skip
    return walk(s, "crouching", 165, way, [(0, 180.0), (54, 180.0), (70, 120.0), (90, 200.0)])


def _similar_0(s: Skeleton) -> Motion:
    way = [
        (READY, -0.9, 0.15), (52, 0.75, 0.15), (64, 0.90, -0.45), (90, -0.75, -0.35), (100, -0.85, -0.1),
        *_circle(110, 175, (0.45, 0.45), 0.9, 190),
    ]  # fmt: skip
    return walk(s, "similar", 175, way, [(0, 0.0)])


def _similar_1(s: Skeleton) -> Motion:
    way = [
        (READY, 0.9, -0.35), (52, -0.75, -0.35), (64, -0.85, 0.25), (90, 0.70, 0.35), (98, 0.95, 0.1),
        *_circle(112, 175, (0.95, 0.8), -0.75, -20),
    ]  # fmt: skip
    return walk(s, "similar", 175, way, [(0, 180.0)])


def _subject(s: Skeleton) -> Motion:
    way = [(READY, -0.6, 0.0), *_circle(36, 120, (0.6, 0.55), 1.2, 180)]
    return walk(s, "bystander", 120, way, [(0, 0.0)])


def _standing(x: float, y: float, degrees: float) -> Callable[[Skeleton], Motion]:
    return lambda s: walk(s, "bystander", 120, [(0, x, y), (120, x, y)], [(0, degrees)], posed=False)


def _passing(s: Skeleton) -> Motion:
    way = [(0, 3.6, 2.4), (35, 1.9, 1.3), (60, 0.4, 0.2), (85, -1.1, -0.9), (120, -3.0, -2.3)]
    return walk(s, "bystander", 120, way, [(0, 215.0)], posed=False)


#: scenes by name; the first role is the subject
SCENES: dict[str, tuple[Role, ...]] = {
    "crossing": (Role(_crossing_0), Role(_crossing_1, 1.66, _WOMAN)),
    "handshake": (Role(_handshake_0), Role(_handshake_1, 1.80, _GREY)),
    "entering": (Role(_entering_0), Role(_entering_1, 1.70, _GREEN), Role(_entering_2, 1.62, _WOMAN)),
    "embrace": (Role(_embrace_0), Role(_embrace_1, 1.64, _GREEN)),
    "crouching": (Role(_crouch_0), Role(_crouch_1, 1.83, _GREY)),
    "similar": (Role(_similar_0), Role(_similar_1, 1.75)),
    "bystander-one": (Role(_subject), Role(_standing(2.2, -1.0, 155.0), 1.80, _GREY)),
    "bystander-two": (Role(_subject), Role(_standing(0.0, 2.3, -90.0), 1.70, _WOMAN)),
    "bystander-all": (Role(_subject), Role(_standing(1.35, 0.25, 180.0), 1.70, _GREEN)),
    "bystander-walking": (Role(_subject), Role(_passing, 1.80, _GREY)),
}  # fmt: skip
