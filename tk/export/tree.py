"""Convert a motion to a tree of nodes with local rotations, for animation formats.

The rest pose, with zero rotations, is a T pose: upright, facing +Z, arms level to the sides, thumbs forward. Axes are X
to the left, Y up, Z forward; metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.export.motion import LEFT_UP_FORWARD, Motion
from tk.model.body.rotations import turn
from tk.model.body.skeleton import WAIST_HEIGHT

Float = NDArray[np.float64]

# Node, its parent, the segment that it rotates; leaves rotate with their parent.
_TRUNK = (("pelvis", "", "pelvis"), ("lumbar", "pelvis", "torso"), ("neck", "lumbar", "head"), ("head_top", "neck", ""))
_SIDE = (
    ("shoulder", "lumbar", "upper_arm"), ("elbow", "shoulder", "forearm"), ("wrist", "elbow", "forearm"),
    ("hand", "wrist", ""), ("hip", "pelvis", "thigh"), ("knee", "hip", "calf"), ("ankle", "knee", "foot"),
    ("toe", "ankle", ""), ("heel", "ankle", ""),
)  # fmt: skip
# m, variation of a node's position in its parent above which the position is written for each frame.
_FIXED_WITHIN = 1e-4


@dataclass(frozen=True)
class Tree:
    """N nodes over F frames, parents first.

    Attributes:
        names: names of the 15 joints, the lumbar joint, tips of hands, toes and heels.
        parents: (N,) index of each node's parent; -1 for the root.
        segments: segment that each node rotates; empty for leaves.
        offsets: (N, 3) position of each node in its parent, rest pose; zero for the root.
        rotations: (F, N, 3, 3) rotation of each node from the rest pose, relative to its parent.
        translations: (F, N, 3) position of each node in its parent; of the root, in the world.
        moving: (N,) True where the position varies: the root, and the shoulders, which rise with the arms.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    segments: tuple[str, ...]
    offsets: Float
    rotations: Float
    translations: Float
    moving: NDArray[np.bool_]

    def children(self, node: int) -> list[int]:
        """Return the children of a node; of -1, the root."""
        return [child for child, parent in enumerate(self.parents) if parent == node]


def build_tree(motion: Motion) -> Tree:
    """Return the tree of a motion."""
    rows = [*_TRUNK, *(_sided(row, side) for side in ("_l", "_r") for row in _SIDE)]
    names = tuple(row[0] for row in rows)
    parents = tuple(names.index(row[1]) if row[1] else -1 for row in rows)
    segments = tuple(row[2] for row in rows)
    A = LEFT_UP_FORWARD @ motion.T_world_body.T
    positions = np.stack([_position(motion, name) @ A.T for name in names], axis=1)
    rotated = np.empty((len(motion), len(names), 3, 3))
    for n, segment in enumerate(segments):
        # a leaf turns with its parent
        rotated[:, n] = A @ motion.rotation(segment) @ rest_axes(segment).T if segment else rotated[:, parents[n]]
    rotations, translations = rotated.copy(), positions.copy()
    for n, parent in enumerate(parents):
        if parent >= 0:
            back = np.swapaxes(rotated[:, parent], -1, -2)
            rotations[:, n] = back @ rotated[:, n]
            translations[:, n] = np.einsum("fab,fb->fa", back, positions[:, n] - positions[:, parent])
    offsets = np.median(translations[motion.known], axis=0)
    offsets[0] = 0.0
    moving = np.abs(translations - offsets).max(axis=(0, 2)) > _FIXED_WITHIN
    moving[0] = True
    return Tree(names, parents, segments, offsets, rotations, translations, moving)


def _sided(row: tuple[str, ...], side: str) -> tuple[str, ...]:
    """Return a row of :data:`_SIDE` for one side."""
    return tuple(part + side if part and part not in ("lumbar", "pelvis") else part for part in row)


def rest_axes(segment: str) -> Float:
    """Return a segment's axes (3, 3) of :mod:`tk.model.body.angles` in the rest pose: X left, Y up, Z forward."""
    level = {"_l": 0.5 * np.pi, "_r": -0.5 * np.pi}.get(segment[-2:], 0.0) if "arm" in segment else 0.0
    return LEFT_UP_FORWARD @ turn("x", np.array(level))


def _position(motion: Motion, name: str) -> Float:
    """Return the positions (F, 3) of a node, metres, world frame."""
    d = motion.dimensions
    if name == "lumbar":
        return motion.point("pelvis") + motion.rotation("pelvis") @ [0.0, 0.0, WAIST_HEIGHT * d.trunk]
    if name.startswith("hand"):
        side = name[-2:]
        return motion.point("wrist" + side) + motion.rotation("forearm" + side) @ [0.0, 0.0, -d.hand]
    return motion.point(name)
