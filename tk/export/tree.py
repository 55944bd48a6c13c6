"""Convert a motion to a tree of nodes with local rotations, for animation formats.

The rest pose, with zero rotations, is a T pose: upright, facing +Z, arms level to the sides, thumbs forward. Axes are X
to the left, Y up, Z forward; metres.

A shoulder rises with its arm, along a line that is fixed to the trunk. Its parent is therefore a clavicle, a node in
the middle of the trunk that turns so that the shoulder lies in the right direction. The clavicle's length varies by
2 mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.export.motion import LEFT_UP_FORWARD, Motion
from tk.model.body.joints import FOOT_SEGMENT, LIMBS, ROWS, SEGMENT_ORIGIN, TABLE, WAIST, segment_below
from tk.model.body.rotations import half_turn, turn

Float = NDArray[np.float64]

# The trunk's nodes: name, parent, segment that it rotates. The tree begins at the pelvis, the joint table at the torso.
_TRUNK = (("pelvis", "", "pelvis"), ("lumbar", "pelvis", "torso"))
# The wrist of each hand: its tip is a leaf.
_HANDS = {f"hand{side}": LIMBS[f"arm{side}"][2] for side in ("_l", "_r")}
# The shoulder that each clavicle carries.
_CLAVICLES = {f"clavicle{side}": LIMBS[f"arm{side}"][0] for side in ("_l", "_r")}
# m, variation of a node's position in its parent above which the position is written for each frame.
_FIXED_WITHIN = 1e-4


@dataclass(frozen=True)
class Tree:
    """N nodes over F frames, parents first."""

    # names of the joints, with `lumbar` for the waist, and of the clavicles and the tips of hands, toes and heels
    names: tuple[str, ...]
    joints: tuple[str, ...]  # the joint in whose place each node is; empty for clavicles and tips
    parents: tuple[int, ...]  # (N,) index of each node's parent; -1 for the root
    # segment that each node rotates, the torso for a clavicle; empty for leaves. A segment's first node moves its body.
    segments: tuple[str, ...]
    offsets: Float  # (N, 3) position of each node in its parent, rest pose; zero for the root
    rotations: Float  # (F, N, 3, 3) rotation of each node from the rest pose, relative to its parent
    translations: Float  # (F, N, 3) position of each node in its parent; of the root, in the world
    # (N,) True where the position varies: the root, and the shoulders, by the variation of the clavicles' lengths
    moving: NDArray[np.bool_]

    def children(self, node: int) -> list[int]:
        """Return the children of a node; of -1, the root."""
        return [child for child, parent in enumerate(self.parents) if parent == node]


def build_tree(motion: Motion) -> Tree:
    """Return the tree of a motion."""
    rows = _nodes()
    names = tuple(row[0] for row in rows)
    joints = tuple(WAIST if name == "lumbar" else name if name in ROWS else "" for name in names)
    parents = tuple(names.index(row[1]) if row[1] else -1 for row in rows)
    segments = tuple(row[2] for row in rows)
    A = LEFT_UP_FORWARD @ motion.T_world_body.T
    positions = np.stack([_position(motion, name) @ A.T for name in names], axis=1)
    rotated = np.empty((len(motion), len(names), 3, 3))
    for n, segment in enumerate(segments):
        # a leaf turns with its parent
        rotated[:, n] = A @ motion.rotation(segment) @ rest_axes(segment).T if segment else rotated[:, parents[n]]
    for name, shoulder in _CLAVICLES.items():
        n = names.index(name)
        along = np.einsum("fba,fb->fa", rotated[:, n], positions[:, names.index(shoulder)] - positions[:, n])
        rotated[:, n] = rotated[:, n] @ _swing(np.array([1.0 if name.endswith("_l") else -1.0, 0.0, 0.0]), along)
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
    return Tree(names, joints, parents, segments, offsets, rotations, translations, moving)


def _nodes() -> list[tuple[str, str, str]]:
    """Return name, parent and segment of each node, parents first; leaves have no segment."""
    above = {"torso": "lumbar", WAIST: "pelvis"}
    limbs = [row for row in TABLE if row.above and row.name not in (WAIST, "pelvis")]
    carried = {shoulder: clavicle for clavicle, shoulder in _CLAVICLES.items()}
    rows = [*_TRUNK, *((clavicle, "lumbar", "torso") for clavicle in _CLAVICLES)]
    rows += [(row.name, carried.get(row.name, above.get(row.above, row.above)), row.turns) for row in limbs]
    rows += [(hand, wrist, "") for hand, wrist in _HANDS.items()]
    rows += [(point, SEGMENT_ORIGIN[segment], "") for point, segment in FOOT_SEGMENT.items()]
    parents = {parent for _, parent, _ in rows}
    return [
        (name, parent, segment_below(name) if name in parents and not segment else segment)
        for name, parent, segment in rows
    ]


def rest_axes(segment: str) -> Float:
    """Return a segment's axes (3, 3) of :mod:`tk.model.body.angles` in the rest pose: X left, Y up, Z forward."""
    level = {"_l": 0.5 * np.pi, "_r": -0.5 * np.pi}.get(segment[-2:], 0.0) if "arm" in segment else 0.0
    return LEFT_UP_FORWARD @ turn("x", np.array(level))


def _swing(start: Float, along: Float) -> Float:
    """Return the smallest rotations (F, 3, 3) that turn a unit vector (3,) into the directions of vectors (F, 3)."""
    middle = start + along / np.linalg.norm(along, axis=-1, keepdims=True)
    return half_turn(middle) @ half_turn(start)


def _position(motion: Motion, name: str) -> Float:
    """Return the positions (F, 3) of a node, metres, world frame."""
    if name in _HANDS:
        wrist = _HANDS[name]
        return motion.point(wrist) + motion.rotation(segment_below(wrist)) @ [0.0, 0.0, -motion.dimensions.hand]
    if name in _CLAVICLES:  # as high as the shoulder of a level arm, in the middle of its range
        return motion.fixed_point("torso", ROWS[_CLAVICLES[name]].place(motion.dimensions) * [1.0, 0.0, 1.0])
    return motion.point(WAIST if name == "lumbar" else name)
