"""Compute clinical joint angles from the rotations of the segments.

When the body stands upright with hanging arms (thumbs forward, elbows straight), every segment has the axes x forward,
y to the left, z up along its length, and thus the same rotation. Angles follow the recommendations of the International
Society of Biomechanics (ISB) where they exist: Wu et al., J. Biomech. 35 (2002) 543-548 for hip, ankle and spine; Wu et
al., J. Biomech. 38 (2005) 981-992 for shoulder and elbow. Its axes are X forward, Y up, Z to the right. The ISB defines
them by bony landmarks, which cameras do not see; here they are axes of the model, so an angle may differ by a constant
of some degrees. The knee follows Grood & Suntay, J. Biomech. Eng. 105 (1983) 136-144, the pelvis Baker, Gait & Posture
13 (2001) 1-6.

Rotations of left limbs are mirrored first, so that the same movement has the same sign on both sides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.body.joints import ARM, BY_LANDMARKS, CROOK, DOF_NAMES, ROWS, WAIST
from tk.model.body.rotations import decompose
from tk.model.body.skeleton import SEGMENTS, Skeleton

Float = NDArray[np.float64]

_FORWARD, _LEFT, _UP = np.eye(3)
#: axes of ISB and OpenSim (forward, up, right) as rows in tk's axes (forward, left, up)
FORWARD_UP_RIGHT = np.array([_FORWARD, _UP, 0.0 - _LEFT])
_ISB = FORWARD_UP_RIGHT.T
#: mirrors a rotation R of a left limb in ISB axes: M R M.
MIRROR = np.diag([1.0, 1.0, -1.0])

# The axes of the left arm in the zero configuration, body frame: up along the arm, and forward, where the forearm goes
# when the elbow bends (see tk.model.body.skeleton).
_ARM_AXES = np.column_stack([CROOK, np.cross(-ARM, CROOK), -ARM])


@dataclass(frozen=True)
class AngleSet:
    """The angles of one joint."""

    joint: str  # name of the joint and of the dataset `/angles/<joint>`
    # parent, child: names of the segments; parent None is the world
    parent: str | None
    child: str
    sequence: str  # Euler sequence (moving axes) from the parent's to the child's ISB axes
    columns: tuple[tuple[str, int, float], ...]  # for each angle its name, its index in the sequence, and its sign
    convention: str  # zero position, signs and source, in words

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the angles, in the order of the columns."""
        return tuple(name for name, _, _ in self.columns)

    def unmeasured(self, pose_names: Sequence[str], landmarks: bool = True) -> dict[str, str]:
        """Return the angles that are the same in all poses, which is no measurement, each with the reason.

        Args:
            pose_names: the body's degrees of freedom; about the axis of the angle it may have none at the joint.
            landmarks: whether landmarks were used, see :data:`~tk.model.body.joints.BY_LANDMARKS`.
        """
        seen = [name for name in pose_names if landmarks or name not in BY_LANDMARKS]
        return {
            name: UNSEEN if self._turns(pose_names, k) else UNMEASURED
            for name, k, _ in self.columns
            if not self._turns(seen, k)
        }

    def _turns(self, pose_names: Sequence[str], k: int) -> bool:
        """Return whether a body with these degrees of freedom turns about axis k of the sequence at the joint."""
        row = ROWS.get(WAIST if self.joint == "lumbar" else self.joint)
        if self.parent is None or row is None:
            return True
        axes = [_ISB.T @ dof.axis for dof, name in zip(row.dofs, row.dof_names, strict=True) if name in pose_names]
        # the arms' axes are oblique
        return len(axes) >= len(self.names) or any(abs(axis["xyz".index(self.sequence[k])]) > 0.5 for axis in axes)

    @property
    def mirrored(self) -> bool:
        """Return True for a joint of the left side, whose rotation is mirrored."""
        return self.joint.endswith("_l")


def _sets() -> tuple[AngleSet, ...]:
    spine = (("flexion", 0, -1.0), ("lateral_bending", 1, 1.0), ("rotation", 2, 1.0))
    trunk_words = (
        "flexion forward, lateral bending to the right, rotation to the left are positive; turns Z-X-Y "
        "(Wu et al. 2002, there with the opposite sign of flexion)"
    )
    found = [
        AngleSet(
            "pelvis",
            None,
            "pelvis",
            "yxz",
            (("tilt", 2, -1.0), ("obliquity", 1, 1.0), ("rotation", 0, 1.0)),
            "against the world: anterior tilt, left side up, turned to the left are positive; turns rotation, "
            "obliquity, tilt (Baker 2001)",
        ),
        AngleSet("lumbar", "pelvis", "torso", "zxy", spine, f"trunk against pelvis: {trunk_words}"),
        AngleSet("neck", "torso", "head", "zxy", spine, f"head against trunk: {trunk_words}"),
    ]
    for side in ("l", "r"):
        found += [
            AngleSet(
                f"shoulder_{side}",
                "torso",
                f"upper_arm_{side}",
                "yxy",
                (("plane", 0, 1.0), ("elevation", 1, -1.0), ("rotation", 2, 1.0)),
                "upper arm against trunk, turns Y-X-Y (Wu et al. 2005, there with negative elevation): the plane of "
                "elevation is 0 for abduction, 90 for forward flexion; elevation is 0 for the hanging arm; internal "
                "rotation is positive; with the arm hanging only the sum of plane and rotation is determined",
            ),
            AngleSet(
                f"elbow_{side}",
                f"upper_arm_{side}",
                f"forearm_{side}",
                "zxy",
                (("flexion", 0, 1.0),),
                "0 is straight, flexion is positive (Wu et al. 2005)",
            ),
            AngleSet(
                f"hip_{side}",
                "pelvis",
                f"thigh_{side}",
                "zxy",
                (("flexion", 0, 1.0), ("adduction", 1, 1.0), ("rotation", 2, 1.0)),
                "thigh against pelvis, turns Z-X-Y (Wu et al. 2002): flexion, adduction, internal rotation positive",
            ),
            AngleSet(
                f"knee_{side}",
                f"thigh_{side}",
                f"calf_{side}",
                "zxy",
                (("flexion", 0, -1.0),),
                "0 is straight, flexion is positive (Grood & Suntay 1983)",
            ),
            AngleSet(
                f"ankle_{side}",
                f"calf_{side}",
                f"foot_{side}",
                "zxy",
                (("dorsiflexion", 0, 1.0), ("inversion", 1, 1.0)),
                "foot against shin, turns Z-X-Y (Wu et al. 2002): 0 is a right angle, dorsiflexion and inversion are "
                "positive",
            ),
        ]
    return tuple(found)


ANGLES: tuple[AngleSet, ...] = _sets()
#: why an angle is NaN in every frame
UNMEASURED, UNSEEN = "the body has no degree of freedom for it", "only landmarks show it, and none were used"


def by_reason(unmeasured: Mapping[str, str]) -> str:
    """Return what is NaN in every frame (name → reason) as a text, such as ``a, b: reason``; "" if nothing is."""
    reasons = dict.fromkeys(unmeasured.values())
    return "; ".join(
        f"{', '.join(name for name, why in unmeasured.items() if why == reason)}: {reason}" for reason in reasons
    )


def standing_rotations(skeleton: Skeleton, transforms: Float) -> Float:
    """Return rotations (F, S, 3, 3) from the segments' axes (defined above) to the world.

    ``transforms`` are those of :meth:`Skeleton.segment_transforms`.
    """
    return transforms[..., :3, :3] @ skeleton.T_world_body @ standing_axes()


def standing_axes() -> Float:
    """Return the segments' axes (S, 3, 3) in the zero configuration, body frame; identity except for the arms."""
    mirror = np.diag([1.0, -1.0, 1.0])
    arms = {"_l": _ARM_AXES, "_r": mirror @ _ARM_AXES @ mirror}
    return np.array([arms[name[-2:]] if "arm" in name else np.eye(3) for name in SEGMENTS])


def joint_angles(
    rotations: Float,
    T_world_body: Float,
    segments: Sequence[str] = SEGMENTS,
    pose_names: Sequence[str] = DOF_NAMES,
    landmarks: bool = True,
) -> dict[str, Float]:
    """Return the angles by joint, degrees, each (..., k) with the columns of :data:`ANGLES`; NaN if unmeasured.

    Args:
        rotations: (..., S, 3, 3) from :func:`standing_rotations`.
        T_world_body: (3, 3) the world's forward, left and up axes as columns; see :class:`Skeleton`.
        segments: names of the S segments.
        pose_names: names of the degrees of freedom that the body has.
        landmarks: whether landmarks were used.
    """
    result = {}
    for angles in ANGLES:
        if angles.child not in segments:  # a foot that is fixed to the calf
            result[angles.joint] = np.full((*rotations.shape[:-3], len(angles.columns)), np.nan)
            continue
        parent = T_world_body if angles.parent is None else rotations[..., segments.index(angles.parent), :, :]
        child = rotations[..., segments.index(angles.child), :, :]
        turns = decompose(angles.sequence, _in_isb(np.swapaxes(parent, -1, -2) @ child, angles.mirrored))
        degrees = np.degrees(np.stack([sign * turns[..., k] for _, k, sign in angles.columns], axis=-1))
        degrees[..., np.isin(angles.names, list(angles.unmeasured(pose_names, landmarks)))] = np.nan
        result[angles.joint] = degrees
    return result


def _in_isb(R: Float, mirrored: bool) -> Float:
    """Return a rotation (..., 3, 3) between two segments in ISB axes, mirrored if requested."""
    R = _ISB.T @ R @ _ISB
    return MIRROR @ R @ MIRROR if mirrored else R
