"""The joint table: one row per joint, from which names, chains, limits, bones and the skeleton are derived.

A row of a limb is written for the left side; the right one is its mirror image. The pose vector, its limits and the
result's columns follow from a row; docs/architecture.md lists what else a new joint touches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tk.model.body.anthropometry import BodyDimensions

Float = NDArray[np.float64]

_X, _Y, _Z = np.eye(3)
# Zero configuration of the left arm (see tk.model.body.skeleton).
ARM = (_X + _Y) / np.sqrt(2)
ARM_POLE = (_Y + _Z - _X) / np.sqrt(3)
_ARM_RISE = np.cross(ARM, ARM_POLE)
# An elbow at zero twist bends inward and up: forward when the arm hangs, inward when it is raised.
CROOK = (_X - _Y) / 2 + np.sqrt(0.5) * _Z
ELBOW_AXIS = np.cross(ARM, CROOK)

# Height of the waist above the hip centres, as a share of the trunk's length: about L4, the middle of the lumbar spine.
WAIST_HEIGHT = 0.25


@dataclass(frozen=True)
class Dof:
    """A degree of freedom."""

    name: str  # what follows the joint's name, such as `flexion`
    axis: Float  # (3,) unit axis in the zero configuration, body frame, left side
    # lower, upper: limits, degrees
    lower: float = -np.inf
    upper: float = np.inf
    prismatic: bool = False  # True for a translation
    # standard deviation, degrees, of a joint that is nearly straight in most frames: its prior is about zero. Infinite:
    # the prior is about the predicted angle.
    straight_deg: float = np.inf
    # standard deviation about zero, degrees, of an angle that only landmarks show, see :mod:`tk.model.cues.landmarks`:
    # contours do not move it. Infinite: contours show it.
    landmarks_deg: float = np.inf
    added: bool = False  # whether it is beyond the paper's 24


@dataclass(frozen=True)
class Joint:
    """A row of the table."""

    name: str  # with the side, `_l` or `_r`, for a limb's joint
    # the joint centre (..., 3) in the zero configuration, body frame, left side, metres
    place: Callable[[BodyDimensions], Float]
    dofs: tuple[Dof, ...] = ()  # its degrees of freedom, in the order of the pose vector
    above: str = ""  # the joint whose last degree of freedom carries it; empty at the root
    turns: str = ""  # the segment that it moves; empty for the end of a chain
    chain: str = ""  # the chain that is optimised as one (section 6.4); empty for the trunk
    carrier: str = ""  # the segment that carries the joint centre in `/joints/position`; empty: not an output
    bone_from: str = ""  # the joint at the other end of the bone in drawings; empty at the root
    offset_m: float = np.nan  # constant offset of the output joint from a ground truth's, mean length, metres

    @property
    def kind(self) -> str:
        """The name without the side."""
        return self.name.removesuffix(side_of(self.name))

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names of its entries of the pose vector."""
        return tuple(f"{self.name}_{dof.name}" for dof in self.dofs)

    @property
    def is_added(self) -> bool:
        """Whether the paper's joint does not turn."""
        return bool(self.dofs) and all(dof.added for dof in self.dofs)


def side_of(name: str) -> str:
    """Return the side with which a name ends, ``_l`` or ``_r``; empty in the middle."""
    return name[-2:] if name.endswith(("_l", "_r")) else ""


def _within(limit_deg: float) -> tuple[float, float]:
    return -limit_deg, limit_deg


def _origin(d: BodyDimensions) -> Float:
    return np.zeros(3)


def _shoulder(d: BodyDimensions) -> Float:
    return d.shoulder_half_width * _Y + (d.trunk - d.shoulder_drop) * _Z


def _elbow(d: BodyDimensions) -> Float:
    return _shoulder(d) + d.upper_arm * ARM


def _hip(d: BodyDimensions) -> Float:
    return d.hip_half_width * _Y


def _knee(d: BodyDimensions) -> Float:
    return _hip(d) - d.thigh * _Z


def _ankle(d: BodyDimensions) -> Float:
    return _knee(d) - d.calf * _Z


def _neck(d: BodyDimensions) -> Float:
    return d.trunk * _Z


# Limits in degrees. Active ranges of healthy men with three standard deviations, Boone & Azen, J. Bone Joint Surg. Am.
# 61 (1979) 756-759, widened by 10° because a single hinge or ball stands for a whole joint complex (the shoulder
# girdle, the lumbar spine): hip flexion 122±6, extension 10±7, abduction 46±9, adduction 27±4, rotation 47±6; knee
# 143±5; elbow 143±6. The shoulder's ranges (flexion 167±5, extension 62±10, abduction 184±7, rotation 69/104) are given
# about other axes than ours: the box below holds them, and every direction of the arm but a cone of 10° about the
# singular diagonal (tests/model/body/test_skeleton.py samples them). Neck: Youdas et al., Phys. Ther. 72 (1992)
# 770-780: flexion and extension 60-70 together with the upper spine, lateral bending 40-45, rotation 70. Waist:
# textbook ranges of the lumbar spine (flexion 50, extension 15, bending 20-25, rotation 5-10), more for the rotation of
# the chest. Ankle: Boone & Azen, plantar flexion 56±6, dorsiflexion 13±4 (more when the knee is bent and loaded),
# inversion 37±5, eversion 21±5.
#
# Standard deviations of waist and ankles about zero, degrees.
_WAIST_DEG, _ANKLE_DEG = 12.0, 20.0
# Standard deviation of the head's turn about the neck, degrees. Assumed: it makes a turn that three images of the face
# show smaller by 10 %, with 30 by 20 %.
_HEAD_TURN_DEG = 45.0
# `offset_m`: length of the median offset in the trunk's frame, which `tk evaluate` removes, mean over both sides and
# the recordings that docs/evaluation.md lists (`python -m scripts.joint_offsets`).
_MIDDLE = (
    Joint("torso", _origin, turns="torso", dofs=(
        Dof("x", _X, prismatic=True), Dof("y", _Y, prismatic=True), Dof("z", _Z, prismatic=True),
        Dof("yaw", _Z), Dof("roll", _X, *_within(80.0)), Dof("pitch", _Y),
    )),
    Joint("waist", lambda d: WAIST_HEIGHT * d.trunk * _Z, above="torso", turns="pelvis", dofs=(
        Dof("roll", _X, *_within(30.0), straight_deg=_WAIST_DEG, added=True),
        Dof("pitch", -_Y, -25.0, 50.0, straight_deg=_WAIST_DEG, added=True),
        Dof("yaw", _Z, *_within(35.0), straight_deg=_WAIST_DEG, added=True),
    )),
    Joint("pelvis", _origin, above="waist", carrier="pelvis", offset_m=0.017),
    Joint("neck", _neck, above="torso", turns="head", chain="head", carrier="torso", bone_from="pelvis", dofs=(
        Dof("pitch", _Y, -70.0, 65.0), Dof("yaw", _X, *_within(50.0)),
        Dof("roll", _Z, *_within(80.0), landmarks_deg=_HEAD_TURN_DEG, added=True),
    ), offset_m=0.017),
    Joint("head_top", lambda d: _neck(d) + d.head * _Z, above="neck", chain="head", carrier="head", bone_from="neck",
          offset_m=0.020),
)  # fmt: skip
_ARM_ROWS = (
    Joint("shoulder", _shoulder, above="torso", turns="upper_arm", chain="arm", carrier="upper_arm", bone_from="neck",
          dofs=(Dof("yaw", ARM_POLE, *_within(180.0)), Dof("pitch", _ARM_RISE, *_within(80.0)),
                Dof("roll", ARM, *_within(110.0))), offset_m=0.011),
    Joint("elbow", _elbow, above="shoulder", turns="forearm", chain="arm", carrier="upper_arm", bone_from="shoulder",
          dofs=(Dof("flexion", ELBOW_AXIS, -5.0, 155.0),), offset_m=0.016),
    Joint("wrist", lambda d: _elbow(d) + d.forearm * ARM, above="elbow", chain="arm", carrier="forearm",
          bone_from="elbow", offset_m=0.013),
)  # fmt: skip
_LEG_ROWS = (
    Joint("hip", _hip, above="waist", turns="thigh", chain="leg", carrier="pelvis", bone_from="pelvis",
          dofs=(Dof("pitch", _Y, -150.0, 40.0), Dof("yaw", _X, -45.0, 80.0), Dof("roll", -_Z, *_within(70.0))),
          offset_m=0.019),
    Joint("knee", _knee, above="hip", turns="calf", chain="leg", carrier="thigh", bone_from="hip",
          dofs=(Dof("flexion", _Y, -10.0, 160.0),), offset_m=0.013),
    Joint("ankle", _ankle, above="knee", turns="foot", chain="leg", carrier="calf", bone_from="knee",
          dofs=(Dof("flexion", -_Y, -60.0, 40.0, straight_deg=_ANKLE_DEG, added=True),
                Dof("inversion", -_X, -30.0, 40.0, straight_deg=_ANKLE_DEG, added=True)), offset_m=0.011),
)  # fmt: skip


_LIMB_ROWS = (_ARM_ROWS, _LEG_ROWS)


def _on_side(rows: tuple[Joint, ...], side: str) -> tuple[Joint, ...]:
    """Return a limb's rows on one side. A mirrored rotation turns the other way: right axes are negated."""
    sided_names = {row.name for limb in _LIMB_ROWS for row in limb}
    sided_segments = {row.turns for limb in _LIMB_ROWS for row in limb if row.turns}
    mirror = np.diag([1.0, -1.0, 1.0])

    def sided(row: Joint) -> Joint:
        place, dofs = row.place, row.dofs
        if side == "_r":
            place = lambda d: row.place(d) @ mirror  # noqa: E731
            dofs = tuple(replace(dof, axis=0.0 - mirror @ dof.axis) for dof in dofs)
        names = {name: value + side for name in ("name", "turns", "chain") if (value := getattr(row, name))}
        names |= {name: value + side for name in ("above", "bone_from") if (value := getattr(row, name)) in sided_names}
        carrier = row.carrier + side if row.carrier in sided_segments else row.carrier
        return replace(row, place=place, dofs=dofs, carrier=carrier, **names)

    return tuple(sided(row) for row in rows)


TABLE: tuple[Joint, ...] = (
    *_MIDDLE,
    *(row for rows in _LIMB_ROWS for side in ("_l", "_r") for row in _on_side(rows, side)),
)
ROWS = {row.name: row for row in TABLE}

#: joints of `/joints/position`, which every result and ground truth has
JOINTS = tuple(row.name for row in TABLE if row.carrier)
#: segments of `/segments/rotation`: what the paper's joints turn, then what the others turn
SEGMENTS = tuple(row.turns for added in (False, True) for row in TABLE if row.turns and row.is_added == added)
#: names of the degrees of freedom of the bodies that results have: tk's body, the same in files written before the
#: head turned, and the paper's body
BODIES = DOF_NAMES, _UNTURNED, PAPER_DOF_NAMES = tuple(
    tuple(name for row in TABLE for dof, name in zip(row.dofs, row.dof_names, strict=True) if has(dof))
    for has in (lambda _: True, lambda dof: np.isinf(dof.landmarks_deg), lambda dof: not dof.added)
)
#: those that only landmarks show
BY_LANDMARKS = tuple(name for name in DOF_NAMES if name not in _UNTURNED)
#: the degrees of freedom with which the trunk leans
LEANS = tuple(
    f"{row.name}_{dof.name}"
    for row in TABLE if not row.chain
    for dof in row.dofs if not (dof.prismatic or dof.axis[2])
)  # fmt: skip
#: bones of drawings, as pairs of joints
BONES = tuple((row.bone_from, row.name) for row in TABLE if row.bone_from)
#: (B, 2) indices of these joints in :data:`JOINTS`
BONE_ENDS = np.array([[JOINTS.index(name) for name in bone] for bone in BONES])
#: the segments of the chains that are optimised one by one with the torso held (section 6.4)
CHAINS: dict[str, tuple[str, ...]] = {
    chain: tuple(row.turns for row in TABLE if row.chain == chain and row.turns)
    for chain in dict.fromkeys(row.chain for row in TABLE if row.chain)
}
#: (S,) index of the chain of each segment, -1 for torso and pelvis
CHAIN_OF_SEGMENT = np.array(
    [next((c for c, chain in enumerate(CHAINS.values()) if name in chain), -1) for name in SEGMENTS]
)
#: the joints at the start, in the middle and at the end of each limb: arm_l, arm_r, leg_l, leg_r
LIMBS: dict[str, tuple[str, str, str]] = {}
for _chain in CHAINS:
    _names = [row.name for row in TABLE if row.chain == _chain]
    if side_of(_chain):
        LIMBS[_chain] = (_names[0], _names[1], _names[2])
#: hinges: the middle joint of each limb, with the joints before and after it
HINGES = {
    middle: (first, last) for first, middle, last in (LIMBS[limb] for limb in ("leg_l", "leg_r", "arm_l", "arm_r"))
}
#: kinds of hinges, with the names of both sides
HINGE_KINDS = {
    name.removesuffix("_l"): (name, name.removesuffix("_l") + "_r") for name in HINGES if name.endswith("_l")
}
#: limb joints, side by side
LIMB_JOINTS = tuple(name for side in ("_l", "_r") for limb in ("arm", "leg") for name in LIMBS[limb + side])
#: limb joints without their side
LIMB_KINDS = tuple(name.removesuffix("_l") for name in LIMB_JOINTS if name.endswith("_l"))
#: the joint at which a segment begins; the trunk's segments begin at an output joint
SEGMENT_ORIGIN = {row.turns: row.name for row in TABLE if row.turns} | {"torso": "neck", "pelvis": "pelvis"}
#: the segment that carries each point of the feet
FOOT_SEGMENT = {"heel_l": "foot_l", "toe_l": "foot_l", "heel_r": "foot_r", "toe_r": "foot_r"}
#: the points of the feet, in the order of `/feet/position`
FOOT_POINTS = tuple(FOOT_SEGMENT)

HIPS, SHOULDERS, ANKLE_JOINTS = ((kind + "_l", kind + "_r") for kind in ("hip", "shoulder", "ankle"))
#: the joint between trunk and pelvis
WAIST = ROWS["hip_l"].above


def segment_below(joint: str) -> str:
    """Return the segment that a joint turns; of the end of a chain, the segment that carries it."""
    row = ROWS[joint]
    return row.turns or (segment_below(row.above) if row.above else "")


def in_joint_order(values: Float, names: Sequence[str]) -> Float:
    """Return values (F, J, ...) of :data:`JOINTS` from values (F, K, ...) of joints ``names``.

    Raises:
        KeyError: the first joint that is absent.
    """
    places = {name: k for k, name in enumerate(names)}
    return np.asarray(values, np.float64)[:, [places[name] for name in JOINTS]]
