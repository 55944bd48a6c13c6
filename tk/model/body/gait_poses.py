"""Rough poses of a walking person: hypotheses of the initialisation ("multiple different poses can be hypothesized and
tested", silhouette paper, section 4.6).

The curves are textbook sagittal joint angles of level walking (Perry, *Gait Analysis*, 1992, chapters 5 and 6) in
their simplest form: the hip swings between 30° of flexion at heel strike and 10° of extension; the knee yields by 15°
in early stance and bends by 60° in swing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.skeleton import Skeleton, shoulder_angles

Float = NDArray[np.float64]


def hip_and_knee(phase: float) -> tuple[float, float]:
    """Return hip and knee flexion, radians, at a phase in [0, 1) of the leg's cycle; 0 is heel strike."""
    phase %= 1.0
    hip = 10.0 + 20.0 * np.cos(2 * np.pi * phase)
    swing = (phase - 0.72) / 0.13
    stance = (phase - 0.15) / 0.10
    knee = 4.0 + 12.0 * np.exp(-(stance**2)) + 55.0 * np.exp(-(swing**2))
    return float(np.radians(hip)), float(np.radians(knee))


def standing_pose(skeleton: Skeleton) -> Float:
    """Return the pose (D,): upright at the origin, arms hanging, legs together."""
    return walking_pose(skeleton, None)


def walking_pose(skeleton: Skeleton, phase: float | None) -> Float:
    """Return the pose (D,) at a phase of the left leg's cycle, at the origin, facing forward; None: standing."""
    pose = np.zeros(len(skeleton.names))
    for side, lag in (("l", 0.0), ("r", 0.5)):
        hip, knee = hip_and_knee(phase + lag) if phase is not None else (0.0, np.radians(3.0))
        pose[skeleton.index(f"hip_{side}_pitch")] = -hip
        pose[skeleton.index(f"knee_{side}_flexion")] = knee
        # each arm swings with the other leg
        swing = np.radians(20.0) * np.cos(2 * np.pi * (phase + lag + 0.5)) if phase is not None else 0.0
        arm = np.array([np.sin(swing), 0.12, -np.cos(swing)])
        yaw, pitch = shoulder_angles(arm / np.linalg.norm(arm))
        pose[skeleton.index(f"shoulder_{side}_yaw")] = yaw
        pose[skeleton.index(f"shoulder_{side}_pitch")] = pitch
        pose[skeleton.index(f"elbow_{side}_flexion")] = np.radians(20.0 if phase is not None else 10.0)
    return pose


def neutral_pose(skeleton: Skeleton) -> Float:
    """Return the Da Vinci pose (D,): upright, arms level and sideways, legs 15° apart (Kehl 2006, section 6.3)."""
    pose = np.zeros(len(skeleton.names))
    for side in ("l", "r"):
        pose[skeleton.index(f"shoulder_{side}_yaw")] = np.radians(30.0)
        pose[skeleton.index(f"shoulder_{side}_pitch")] = np.arcsin(1 / np.sqrt(3))
        pose[skeleton.index(f"hip_{side}_yaw")] = np.radians(15.0)
    return pose


def gait_figures(skeleton: Skeleton, headings: int, phases: int, p_pelvis: Float, first: float = 0.0) -> Float:
    """Return poses (B, D) with the pelvis at ``p_pelvis`` (3,): walking phases, standing and Da Vinci pose at headings.

    Headings are evenly spaced, beginning with ``first``, radians.
    """
    figures = [walking_pose(skeleton, i / phases) for i in range(phases)]
    figures += [standing_pose(skeleton), neutral_pose(skeleton)]
    poses = []
    for heading in first + np.arange(headings) * 2 * np.pi / headings:
        for figure in figures:
            pose = figure.copy()
            pose[skeleton.index("torso_yaw")] = heading
            pose[:3] = p_pelvis
            poses.append(pose)
    return np.array(poses)
