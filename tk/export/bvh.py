"""Write BVH files, for Blender and other animation programs.

Axes and rest pose are those of :mod:`tk.export.tree`: Y up, facing +Z, a T pose with the lengths of the fitted body.
The format does not state its unit: metres, or centimetres, which many animation programs assume. Rotations are Z, then
X, then Y about moving axes, degrees. The root and the shoulders, which rise with the arms, have position channels; they
are the position in the parent and replace the OFFSET. An unknown frame repeats the last known pose.
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


def write_bvh(motion: Motion, path: Path, units: str = "m") -> None:
    """Write the tree; head, hands and toes are End Sites. Heels are omitted: a foot can have only one End Site.

    Args:
        units: one of :data:`BVH_UNITS`.
    """
    tree = build_tree(motion)
    scale = BVH_UNITS[units]
    tree = replace(tree, offsets=scale * tree.offsets, translations=scale * tree.translations)
    columns = []
    for node in _in_order(tree, 0):
        if tree.moving[node]:
            columns.append(tree.translations[:, node])
        columns.append(np.degrees(follow(decompose("zxy", tree.rotations[:, node]))))
    lines = ["HIERARCHY", *_node(tree, 0, "")]
    lines += ["MOTION", f"Frames: {len(motion)}", f"Frame Time: {1 / motion.fps:.8f}"]
    lines += [_numbers(row) for row in np.concatenate(columns, axis=1)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


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
        channels = (*(_POSITION if tree.moving[node] else ()), *_ROTATION)
        yield f"{inner}CHANNELS {len(channels)} " + " ".join(channels)
        children = [child for child in tree.children(node) if not tree.names[child].startswith("heel")]
        for child in children:
            yield from _node(tree, child, inner)
        if not children:
            yield from (f"{inner}End Site", f"{inner}{{", f"{inner}  OFFSET " + _numbers(np.zeros(3)), f"{inner}}}")
    yield f"{indent}}}"


def _numbers(values: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.6f}" for value in np.round(values, 6) + 0.0)  # + 0.0: no -0
