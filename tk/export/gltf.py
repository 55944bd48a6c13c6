"""Write glTF 2.0 as one file (.glb): the tree of nodes, its animation, and one mesh whose skin are the nodes.

The mesh has a primitive, with a material, for each segment; every vertex follows the node of its segment.

Axes, units and rest pose are those of :mod:`tk.export.tree` and of glTF. An unknown frame repeats the last known pose;
`asset.extras` of the file has these frames, `lost_frames`, and the number and the time of the first frame in the
recording, `first_frame` and `first_time`; the animation begins at 0.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk import __version__
from tk.export.motion import Motion
from tk.export.tree import Tree, build_tree, rest_axes
from tk.model.body.angles import standing_axes
from tk.model.body.joints import ROWS, SEGMENTS
from tk.model.body.rotations import continuous, to_quaternions
from tk.render.figure import AROUND, Solid, figure_of
from tk.render.palette import SEGMENT_COLORS, unit_rgb

Float = NDArray[np.float64]

_FLOAT, _UINT16 = 5126, 5123  # componentType
_VERTICES, _INDICES = 34962, 34963  # bufferView.target
# twice the area of the largest triangle that is omitted: triangles at the poles of an ellipsoid have no area
_NO_AREA_M2 = 1e-10


class _Buffer:
    """The binary chunk and the JSON that describes it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: NDArray[Any], target: int | None = None, bounds: bool = False) -> int:
        """Append an array (N,) or (N, k), float32 or uint16, and return the index of its accessor; 16 numbers are a
        matrix, column by column."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        self.data += values.tobytes()
        self.data += bytes(-len(self.data) % 4)
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[values.shape[1] if values.ndim > 1 else 1]
        component = _UINT16 if values.dtype == np.uint16 else _FLOAT
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1, "componentType": component, "count": len(values), "type": kind,
        }  # fmt: skip
        if bounds:
            columns = values.reshape(len(values), -1)
            accessor |= {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_glb(motion: Motion, path: Path) -> None:
    """Write nodes, animation and the skinned mesh."""
    tree, buffer = build_tree(motion), _Buffer()
    nodes: list[dict[str, Any]] = []
    for n, name in enumerate(tree.names):
        node: dict[str, Any] = {"name": name, "translation": tree.offsets[n].tolist()}
        children = tree.children(n)
        nodes.append(node | {"children": children} if children else node)
    nodes[0]["translation"] = tree.translations[0, 0].tolist()
    document: dict[str, Any] = {
        "asset": {
            "version": "2.0",
            "generator": f"tk {__version__}",
            "extras": {
                "first_frame": int(motion.result.frames[0]),
                "first_time": float(motion.result.time[0]),
                "lost_frames": motion.result.frames[~motion.known].tolist(),
            },
        },
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "materials": [
            {
                "name": segment,
                "pbrMetallicRoughness": {"baseColorFactor": [*unit_rgb(color), 1.0], "metallicFactor": 0.0},
            }
            for segment, color in SEGMENT_COLORS.items()
        ],
        "animations": [_animation(motion, tree, buffer)],
        **_body(motion, tree, buffer),
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    if "meshes" in document:
        document["scenes"][0]["nodes"].append(len(nodes))
        nodes.append({"name": "body", "mesh": 0, "skin": 0})
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffer.data), b"BIN\0")
    whole = chunks + bytes(buffer.data)
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(whole)) + whole)


def _animation(motion: Motion, tree: Tree, buffer: _Buffer) -> dict[str, Any]:
    """Return the animation: rotations of all nodes except leaves, positions of moving nodes, linear in time from 0."""
    times = buffer.add((motion.result.time - motion.result.time[0]).astype(np.float32), bounds=True)
    quaternions = continuous(to_quaternions(tree.rotations))[..., [1, 2, 3, 0]].astype(np.float32)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for n, segment in enumerate(tree.segments):
        curves = {"rotation": quaternions[:, n]} if segment else {}
        if tree.moving[n]:
            curves["translation"] = tree.translations[:, n].astype(np.float32)
        for name, values in curves.items():
            output = buffer.add(np.ascontiguousarray(values))
            channels.append({"sampler": len(samplers), "target": {"node": n, "path": name}})
            samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
    return {"name": motion.name, "channels": channels, "samplers": samplers}


def _body(motion: Motion, tree: Tree, buffer: _Buffer) -> dict[str, Any]:
    """Return the mesh in the rest pose and its skin; nothing if the result has no body."""
    solids = figure_of(motion.result).solids
    place = np.zeros((len(tree.names), 3))  # of each node in the rest pose, the root at the origin
    for n, parent in enumerate(tree.parents):
        place[n] = tree.offsets[n] + (place[parent] if parent >= 0 else 0.0)
    bones = [n for n, segment in enumerate(tree.segments) if segment]
    primitives: list[dict[str, Any]] = []
    for s, segment in enumerate(SEGMENTS):
        own = [solid for solid in solids if solid.segment == s]
        if not own:
            continue
        node = tree.segments.index(segment)
        origin = ROWS[tree.joints[node]].place(motion.dimensions)
        to_rest = rest_axes(segment) @ standing_axes()[s].T  # from the zero configuration to the rest pose
        points, normals, faces = zip(*(_surface(solid) for solid in own), strict=True)
        starts = np.cumsum([0, *(len(p) for p in points[:-1])])
        in_body = np.concatenate(points) @ motion.T_world_body - origin
        turned = np.concatenate(normals) @ motion.T_world_body
        indices = np.concatenate([start + face.ravel() for start, face in zip(starts, faces, strict=True)])
        joints = np.zeros((len(in_body), 4), np.uint16)
        joints[:, 0] = bones.index(node)
        weights = np.tile(np.array([1, 0, 0, 0], np.float32), (len(in_body), 1))
        attributes = {
            "POSITION": buffer.add(_float32(in_body @ to_rest.T + place[node]), _VERTICES, bounds=True),
            "NORMAL": buffer.add(_float32(turned @ to_rest.T), _VERTICES),
            "JOINTS_0": buffer.add(joints, _VERTICES),
            "WEIGHTS_0": buffer.add(weights, _VERTICES),
        }
        primitives.append(
            {
                "attributes": attributes,
                "indices": buffer.add(indices.astype(np.uint16), _INDICES),
                "material": list(SEGMENT_COLORS).index(segment),
            }
        )
    if not primitives:
        return {}
    to_bones = np.tile(np.eye(4), (len(bones), 1, 1))
    to_bones[:, 3, :3] = -place[bones]  # transposed: column by column
    inverse = buffer.add(_float32(to_bones.reshape(-1, 16)))
    return {
        "meshes": [{"name": "body", "primitives": primitives}],
        "skins": [{"joints": bones, "skeleton": 0, "inverseBindMatrices": inverse}],
    }


def _surface(solid: Solid) -> tuple[Float, Float, NDArray[np.int64]]:
    """Return points (N, 3), normals (N, 3) and triangles (M, 3) of a solid in its segment's frame.

    The flat ends of a frustum have points of their own, so that their edge stays sharp. Triangles without area are
    omitted.
    """
    rings = solid.rings
    count = rings.shape[0] * AROUND
    points = np.concatenate([rings.reshape(-1, 3), rings[0], rings[-1]])
    faces = solid.triangles.copy()
    is_end = [(faces < AROUND).all(axis=1), (faces >= count - AROUND).all(axis=1)]
    faces[is_end[0]] += count
    faces[is_end[1]] += 2 * AROUND  # the copy of the last ring follows the copy of the first
    corners = points[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    kept = np.linalg.norm(across, axis=1) > _NO_AREA_M2
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, faces[kept, corner], across[kept])
    used = np.unique(faces[kept])
    length = np.linalg.norm(normals[used], axis=1, keepdims=True)
    order = np.zeros(len(points), np.int64)
    order[used] = np.arange(len(used))
    return points[used], normals[used] / length, order[faces[kept]]


def _float32(values: Float) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)
