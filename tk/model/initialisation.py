"""Finds the subject in the Da Vinci pose (Kehl 2006, section 6.3).

The hull's centroid gives the place; planes swept through the hull find the feet (from below), the hands (from both
sides) and the crown (from above); ratios of the stature give the rest. The paper leaves open how the heading is found.
The arms span the widest horizontal direction, and of its two senses the one is taken towards which the feet stick out
of the legs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tk.errors import CaptureError
from tk.model.anthropometry import (
    ANKLE_HEIGHT,
    CALF_LENGTH,
    FOREARM_LENGTH,
    HEAD_LENGTH,
    HIP_HALF_WIDTH,
    SHOULDER_DROP,
    SHOULDER_HALF_WIDTH,
    THIGH_LENGTH,
    TRUNK_LENGTH,
    UPPER_ARM_LENGTH,
    BodyDimensions,
)
from tk.model.body import neutral_pose
from tk.model.skeleton import JOINTS, Skeleton, build_skeleton, shoulder_angles, up_rotation
from tk.model.volume import VoxelGrid

Float = NDArray[np.float64]

# A person is between these two tall, standing on the feet (metres).
LEAST_STATURE, GREATEST_STATURE = 0.8, 2.4


@dataclass(frozen=True)
class Landmarks:
    """What the plane sweeps find, world frame, metres.

    Attributes:
        centroid, crown: (3,); feet, hands: (2, 3), left and right.
        left: (3,) horizontal unit vector from the right hand to the left one.
        toes_m: how far the feet stick out forwards from the legs' axes, metres: what the heading rests on.
        up: (3,) unit vector.
        stature: crown above the soles.
    """

    centroid: Float
    crown: Float
    feet: Float
    hands: Float
    left: Float
    toes_m: float
    up: Float
    stature: float


def find_landmarks(occupancy: NDArray[np.bool_], grid: VoxelGrid, up: str = "z") -> Landmarks:
    """Plane sweeps through the largest connected part of a hull.

    Args:
        occupancy: (nx, ny, nz) active voxels.
        grid: where they are.
        up: the world axis that points up.

    Raises:
        CaptureError: there is no upright figure with two feet and two hands apart.
    """
    p_world = grid.centers(np.flatnonzero(largest_part(occupancy)))
    hint = "use --init-pose FILE, or [init] frame of capture.toml for a frame with arms and legs spread"
    if len(p_world) < 50:
        raise CaptureError(
            f"initialisation: the visual hull is empty ({len(p_world)} voxels): check the masks; or {hint}"
        )
    B = up_rotation(up)
    p = p_world @ B  # x, y horizontal, z up
    voxel = grid.voxel_m
    floor, top = p[:, 2].min() - voxel / 2, p[:, 2].max() + voxel / 2
    stature = float(top - floor)
    if not LEAST_STATURE < stature < GREATEST_STATURE:
        raise CaptureError(
            f"initialisation: the hull is {stature:.2f} m tall, a standing person {LEAST_STATURE} to "
            f"{GREATEST_STATURE} m: check the masks and the calibration's unit; or {hint}"
        )
    centroid = p.mean(axis=0)
    # The arms: the widest horizontal direction of the body above the hips.
    upper = p[p[:, 2] > floor + 0.6 * stature]
    spread = np.linalg.svd(upper[:, :2] - upper[:, :2].mean(axis=0), full_matrices=False)[2]
    lateral = np.array([spread[0, 0], spread[0, 1], 0.0])
    along = (p - centroid) @ lateral
    reach = along.max() - along.min()
    if reach < 0.65 * stature:
        raise CaptureError(
            f"initialisation: the hull is only {reach:.2f} m wide at {stature:.2f} m height: "
            f"no Da Vinci pose in this frame; {hint}"
        )
    # from left to right and back: the hands are what the first planes meet
    hands = []
    for edge, sense in ((along.max(), 1.0), (along.min(), -1.0)):
        hand = p[sense * (edge - along) < 0.06 * stature]
        hands.append(hand.mean(axis=0) + sense * 0.03 * stature * lateral)
    # from below: two foot patches, apart along the arms' direction
    low = p[p[:, 2] < floor + 0.12 * stature]
    side = (low - centroid) @ lateral
    if len(low) < 4 or side.max() - side.min() < 0.15 * stature:
        raise CaptureError(f"initialisation: the feet are not apart: no Da Vinci pose in this frame; {hint}")
    middle = (side.max() + side.min()) / 2
    feet = [low[side > middle].mean(axis=0), low[side <= middle].mean(axis=0)]
    for foot in feet:
        foot[2] = floor
    toes = _toes(p, floor, stature, side_of=lambda q: (q - centroid) @ lateral > middle)
    forward = np.array([lateral[1], -lateral[0], 0.0])  # lateral × up: where the subject faces if lateral is left
    left = lateral if toes @ forward > 0 else -lateral
    crown = p[p[:, 2] > top - 0.05 * stature].mean(axis=0)
    crown[2] = top
    return Landmarks(
        centroid=B @ centroid,
        crown=B @ crown,
        feet=np.array(feet if left @ lateral > 0 else feet[::-1]) @ B.T,
        hands=np.array(hands if left @ lateral > 0 else hands[::-1]) @ B.T,
        left=B @ left,
        toes_m=float(abs(toes @ forward)),
        up=B[:, 2],
        stature=stature,
    )


def largest_part(occupancy: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest 6-connected part: phantom volumes and specks are left out."""
    labels, count = ndimage.label(occupancy)
    if count < 2:
        return occupancy
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == sizes.argmax()


def _toes(p: Float, floor: float, stature: float, side_of: Callable[[Float], NDArray[np.bool_]]) -> Float:
    """(3,) horizontal offset of the feet from the shins' axes, the mean of both legs."""
    offsets = []
    height = p[:, 2] - floor
    for sense in (True, False):
        leg = p[side_of(p) == sense]
        h = height[side_of(p) == sense]
        foot, shin = leg[h < 0.05 * stature], leg[(h > 0.10 * stature) & (h < 0.24 * stature)]
        if len(foot) < 2 or len(shin) < 6:
            continue
        # the shin's axis, carried down to the foot
        slope = np.polyfit(shin[:, 2], shin[:, :2], 1)
        offsets.append(foot[:, :2].mean(axis=0) - (slope[0] * foot[:, 2].mean() + slope[1]))
    mean = np.mean(offsets, axis=0) if offsets else np.zeros(2)
    return np.array([mean[0], mean[1], 0.0])


def da_vinci_pose(marks: Landmarks, stature_m: float | None, up: str) -> tuple[BodyDimensions, Float]:
    """Average body and pose that meet the landmarks.

    Args:
        marks: of :func:`find_landmarks`.
        stature_m: the subject's height, metres; the hull's own where it is not known.
        up: the world axis that points up.

    Returns:
        Dimensions and pose (D,).
    """
    stature = stature_m or marks.stature
    dimensions = BodyDimensions.from_stature(stature)
    skeleton = build_skeleton(dimensions, up)
    B = skeleton.T_world_body
    left = marks.left
    forward = np.cross(left, marks.up)
    hands, feet = marks.hands, marks.feet
    pose = neutral_pose(skeleton)

    # Legs: from the feet up. Their spread follows from how far the feet are apart.
    leg = (THIGH_LENGTH + CALF_LENGTH) * stature
    gap = (feet[0] - feet[1]) @ left
    tilt = np.arcsin(np.clip((gap / 2 - HIP_HALF_WIDTH * stature) / leg, -0.2, 0.7))
    pelvis_height = leg * np.cos(tilt) + ANKLE_HEIGHT * stature
    # the trunk's axis: between crown and feet, horizontally; feet stick out forwards, so the crown counts more
    base = feet.mean(axis=0)
    pelvis = base + pelvis_height * marks.up
    horizontal = 0.7 * (marks.crown - base) + 0.3 * (marks.centroid - base)
    pelvis = pelvis + (horizontal - (horizontal @ marks.up) * marks.up)
    pose[:3] = pelvis

    x, y = (B.T @ forward)[:2]
    pose[skeleton.index("torso_yaw")] = np.arctan2(y, x)
    for side, sign, hand in (("l", 1.0, hands[0]), ("r", -1.0, hands[1])):
        pose[skeleton.index(f"hip_{side}_yaw")] = tilt
        # the arm points from the shoulder to the hand
        rise, aside = (TRUNK_LENGTH - SHOULDER_DROP) * stature, sign * SHOULDER_HALF_WIDTH * stature
        d = hand - (pelvis + rise * marks.up + aside * left)
        d = d / np.linalg.norm(d)
        arm = np.array([d @ forward, sign * (d @ left), d @ marks.up])
        yaw, pitch = shoulder_angles(arm)
        pose[skeleton.index(f"shoulder_{side}_yaw")] = yaw
        pose[skeleton.index(f"shoulder_{side}_pitch")] = pitch
    return dimensions, skeleton.clip(pose)


def certainty(skeleton: Skeleton) -> Float:
    """(D,) how far the initial pose may be off, one standard deviation, radians and metres.

    Arms and legs are straight in the Da Vinci pose, and how a straight limb is turned about itself cannot be seen.
    """
    result = np.where(skeleton.prismatic, 0.3, 0.5)
    for k, name in enumerate(skeleton.names):
        if "flexion" in name:
            result[k] = 0.1
        elif "roll" in name and "torso" not in name:
            result[k] = 0.15
    return result


def rough_pose(
    joints: dict[str, Float], angles: dict[str, float], height_m: float | None, up: str
) -> tuple[BodyDimensions, Float]:
    """Average body and pose from what a person wrote down.

    Args:
        joints: name → (3,) metres of some joints; or empty.
        angles: name → value of some entries of the configuration vector (radians, metres); or empty.
        height_m: the subject's height; without it, the joints' distances tell, else 1.72 m.
        up: the world axis that points up.

    Returns:
        Dimensions and pose (D,).
    """
    stature = height_m or _stature_of(joints) or 1.72
    dimensions = BodyDimensions.from_stature(stature)
    skeleton = build_skeleton(dimensions, up)
    pose = np.zeros(len(skeleton.names))
    if angles:
        pose = neutral_pose(skeleton)
        for name, value in angles.items():
            pose[skeleton.index(name)] = value
        return dimensions, skeleton.clip(pose)
    rows = [JOINTS.index(name) for name in joints]
    targets = np.array([joints[name] for name in joints])

    def residual(p: Float) -> Float:
        # a little weight on plain angles settles what the joints leave open
        return np.concatenate([((skeleton.joints(p)[rows] - targets) / 0.02).ravel(), 0.2 * (p[3:] - rest[3:])])

    from scipy.optimize import least_squares  # takes half a second to import

    lower, upper = skeleton.lower - 1e-9, skeleton.upper + 1e-9
    best = None
    for yaw in np.arange(8) * np.pi / 4:
        rest = neutral_pose(skeleton)
        for side in ("l", "r"):  # arms down, legs together
            hanging = shoulder_angles(np.array([0.0, 0.2, -0.98]))
            rest[skeleton.index(f"shoulder_{side}_yaw")], rest[skeleton.index(f"shoulder_{side}_pitch")] = hanging
            rest[skeleton.index(f"hip_{side}_yaw")] = 0.0
        rest[:3] = targets.mean(axis=0) - skeleton.joints(rest)[rows].mean(axis=0)
        rest[skeleton.index("torso_yaw")] = yaw
        fit = least_squares(residual, rest, bounds=(lower, upper), max_nfev=60)
        if best is None or fit.cost < best.cost:
            best = fit
    assert best is not None
    return dimensions, skeleton.clip(best.x)


def _stature_of(joints: dict[str, Float]) -> float | None:
    """Median stature that the distances of neighbouring joints stand for; None where there are too few."""
    table = {
        ("pelvis", "neck"): TRUNK_LENGTH,
        ("neck", "head_top"): HEAD_LENGTH,
        ("shoulder_l", "shoulder_r"): 2 * SHOULDER_HALF_WIDTH,
    }
    for side in ("l", "r"):
        table |= {
            (f"shoulder_{side}", f"elbow_{side}"): UPPER_ARM_LENGTH,
            (f"elbow_{side}", f"wrist_{side}"): FOREARM_LENGTH,
            (f"hip_{side}", f"knee_{side}"): THIGH_LENGTH,
            (f"knee_{side}", f"ankle_{side}"): CALF_LENGTH,
        }
    known = [(a, b, ratio) for (a, b), ratio in table.items() if a in joints and b in joints]
    found = [np.linalg.norm(joints[a] - joints[b]) / ratio for a, b, ratio in known]
    return float(np.clip(np.median(found), LEAST_STATURE, GREATEST_STATURE)) if len(found) >= 3 else None


def rough_certainty(skeleton: Skeleton) -> Float:
    """(D,) how far a pose written down by hand may be off, one standard deviation, radians and metres."""
    return np.where(skeleton.prismatic, 0.1, 0.3)
