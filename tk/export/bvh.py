"""Write BVH files, for Blender and other animation programs.

Axes and rest pose are those of :mod:`tk.export.tree`: Y up, facing +Z, a T pose with the lengths of the fitted body.
The format does not state its unit: metres, or centimetres, which many animation programs assume. Rotations are Z, then
X, then Y about moving axes, degrees. An unknown frame repeats the last known pose. The format has no number or time of
the first frame.

Only the root, whose OFFSET is 0, has position channels. Some programs replace the OFFSET of a joint by its position
channels, others add them, so that channels of another joint would be ambiguous. A BVH file thus holds one length per
segment: the median. If lengths vary by more than the clavicles' 2 mm, joints deviate by the sum of these variations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.export.motion import Motion
from tk.export.tree import Tree, build_tree
from tk.model.body.rotations import decompose, follow

#: lengths of a metre
BVH_UNITS = {"m": 1.0, "cm": 100.0}
_POSITION = ("Xposition", "Yposition", "Zposition")
_ROTATION = ("Zrotation", "Xrotation", "Yrotation")
# m, deviation of a joint above which a note is printed
_NOTED_M = 0.01


def write_bvh(motion: Motion, path: Path, units: str = "m") -> str | None:
    """Write the tree; head, hands and toes are End Sites. Heels are omitted: a foot can have only one End Site.

    Args:
        units: one of :data:`BVH_UNITS`.

    Returns:
        A note if the joints of the file deviate from the result because lengths of segments vary.
    """
    tree = build_tree(motion)
    scale = BVH_UNITS[units]
    columns = [scale * tree.translations[:, 0]]
    columns += [np.degrees(follow(decompose("zxy", tree.rotations[:, node]))) for node in _in_order(tree, 0)]
    lines = ["HIERARCHY", *_node(replace(tree, offsets=scale * tree.offsets), 0, "")]
    lines += ["MOTION", f"Frames: {len(motion)}", f"Frame Time: {1 / motion.fps:.8f}"]
    lines += [_numbers(row) for row in np.concatenate(columns, axis=1)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    off = _deviation(tree)
    if off <= _NOTED_M:
        return None
    return f"joints are up to {100 * off:.1f} cm off: the segments' lengths vary, and the format holds one of each"


def _deviation(tree: Tree) -> float:
    """Return the largest deviation of a node in the file, metres."""
    turned, moved = np.zeros_like(tree.rotations), np.zeros_like(tree.translations)
    for n, parent in enumerate(tree.parents):
        if parent < 0:
            turned[:, n] = tree.rotations[:, n]
            continue
        turned[:, n] = turned[:, parent] @ tree.rotations[:, n]
        lost = tree.translations[:, n] - tree.offsets[n]
        moved[:, n] = moved[:, parent] + np.einsum("fab,fb->fa", turned[:, parent], lost)
    return float(np.linalg.norm(moved, axis=-1).max())


def _is_tip(tree: Tree, node: int) -> bool:
    return not tree.segments[node]


def _in_order(tree: Tree, node: int) -> Iterator[int]:
    """Yield the nodes with channels in the order of the hierarchy."""
    yield node
    for child in tree.children(node):
        if not _is_tip(tree, child):
            yield from _in_order(tree, child)


def _node(tree: Tree, node: int, indent: str) -> Iterator[str]:
    """Yield the lines of the hierarchy for a node and its descendants."""
    name, inner = tree.names[node], indent + "  "
    if _is_tip(tree, node):
        yield f"{indent}End Site"
    else:
        yield f"{indent}{'JOINT' if indent else 'ROOT'} {name}"
    yield f"{indent}{{"
    yield f"{inner}OFFSET " + _numbers(tree.offsets[node])
    if not _is_tip(tree, node):
        channels = _ROTATION if indent else (*_POSITION, *_ROTATION)
        yield f"{inner}CHANNELS {len(channels)} " + " ".join(channels)
        children = [child for child in tree.children(node) if not tree.names[child].startswith("heel")]
        for child in children:
            yield from _node(tree, child, inner)
        if not children:
            yield from (f"{inner}End Site", f"{inner}{{", f"{inner}  OFFSET " + _numbers(np.zeros(3)), f"{inner}}}")
    yield f"{indent}}}"


def _numbers(values: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.6f}" for value in np.round(values, 6) + 0.0)  # + 0.0: no -0
