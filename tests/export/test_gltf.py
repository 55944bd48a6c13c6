"""glTF, read by pygltflib; nodes and animation applied as the format's specification says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pygltflib
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tests.export.conftest import FIRST, FPS, FRAMES, LOST, Write
from tests.model.figures import surface_points
from tk.export import export, read_motion
from tk.io.results.reader import read_result
from tk.kernels.cones import CONE
from tk.model.body.skeleton import JOINTS
from tk.trackers.bodies import body_and_poses

TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
DTYPES = {5126: np.float32, 5123: np.uint16}


def array(file: pygltflib.GLTF2, index: int) -> np.ndarray:
    accessor = file.accessors[index]
    view = file.bufferViews[accessor.bufferView]
    width = TYPES[accessor.type]
    values = np.frombuffer(
        file.binary_blob(), DTYPES[accessor.componentType], accessor.count * width, view.byteOffset
    ).reshape(accessor.count, width)
    assert values.nbytes == view.byteLength
    if accessor.min:  # pygltflib gives [] where there is none
        np.testing.assert_array_equal(values.min(axis=0), np.array(accessor.min, np.float32))
        np.testing.assert_array_equal(values.max(axis=0), np.array(accessor.max, np.float32))
    return values


def frame_transforms(file: pygltflib.GLTF2, f: int) -> dict[str, np.ndarray]:
    """(4, 4) of every node to the world in a frame."""
    (animation,) = file.animations
    local = []
    for node in file.nodes:
        assert node.rotation is None or node.rotation == [0, 0, 0, 1]
        T = np.eye(4)
        T[:3, 3] = node.translation or 0.0
        local.append(T)
    for channel in animation.channels:
        sampler = animation.samplers[channel.sampler]
        times, values = array(file, sampler.input), array(file, sampler.output)
        assert len(times) == len(values) == FRAMES
        if channel.target.path == "rotation":
            local[channel.target.node][:3, :3] = Rotation.from_quat(values[f]).as_matrix()
        else:
            local[channel.target.node][:3, 3] = values[f]
    found: dict[str, np.ndarray] = {}

    def descend(index: int, above: np.ndarray) -> None:
        node = file.nodes[index]
        found[node.name] = above @ local[index]
        for child in node.children or []:
            descend(child, found[node.name])

    for root in file.scenes[file.scene].nodes:
        descend(root, np.eye(4))
    assert len(found) == len(file.nodes)
    return found


def load(path: Path) -> pygltflib.GLTF2:
    file = pygltflib.GLTF2().load_binary(str(path))
    assert file is not None and file.asset.version == "2.0"
    return file


def test_gltf_reproduces_the_joints(write: Write) -> None:
    path = write()
    motion, _ = read_motion(path)
    (target,) = export(path, ["gltf"]).files
    assert target.suffix == ".glb"
    file = load(target)
    times = array(file, file.animations[0].samplers[0].input)[:, 0]
    np.testing.assert_allclose(times, np.arange(FRAMES) / FPS, atol=1e-6)
    for f in np.flatnonzero(motion.known):
        found = frame_transforms(file, f)
        for name in (*JOINTS, "toe_l", "heel_r"):
            x, y, z = motion.point(name)[f]
            np.testing.assert_allclose(found[name][:3, 3], [y, z, x], atol=1e-4, err_msg=name)


def test_lost_frames_are_held_and_listed(write: Write) -> None:
    path = write()
    file = load(export(path, ["gltf"]).files[0])
    before = frame_transforms(file, LOST[0] - 1)
    for name, T in frame_transforms(file, LOST[1]).items():
        np.testing.assert_array_equal(T, before[name])
    frames = read_motion(path)[0].result.frames
    first = {"first_frame": FIRST, "first_time": FIRST / FPS}
    assert file.asset.extras == {**first, "lost_frames": [int(frames[f]) for f in LOST]}


def test_skinned_mesh_lies_on_the_body(write: Write) -> None:
    """In a frame, the vertices of each segment, moved by its bone, lie where the body's surface lies."""
    path = write()
    restored = body_and_poses(read_result(path))
    assert restored is not None
    body, tracked = restored
    f = 7
    angle, z = np.meshgrid(np.linspace(-np.pi, np.pi, 60), np.linspace(0, 1, 9))
    unscaled = np.stack([np.cos(angle), np.sin(angle), z], axis=-1).reshape(-1, 3)
    cones = [p for p, part in enumerate(body.parts) if part.kind == CONE]
    sampled = {p: surface_points(body, tracked[f], np.full(len(unscaled), p), unscaled) for p in cones}
    file = load(export(path, ["gltf"]).files[0])
    T = frame_transforms(file, f)
    (skin,), (mesh,) = file.skins, file.meshes
    (node,) = (node for node in file.nodes if node.mesh is not None)
    assert node.skin == 0 and file.nodes.index(node) in file.scenes[0].nodes
    inverse = array(file, skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
    bones = np.array([T[file.nodes[n].name] for n in skin.joints]) @ inverse
    assert {file.materials[p.material].name for p in mesh.primitives} == {part.segment for part in body.parts}
    for primitive in mesh.primitives:
        segment = file.materials[primitive.material].name
        weights = array(file, primitive.attributes.WEIGHTS_0)
        np.testing.assert_array_equal(weights.sum(axis=1), 1)
        moved = np.einsum("vj,vjab->vab", weights, bones[array(file, primitive.attributes.JOINTS_0)])
        at = (moved[:, :3, :3] @ array(file, primitive.attributes.POSITION)[..., None])[..., 0] + moved[:, :3, 3]
        facing = (moved[:, :3, :3] @ array(file, primitive.attributes.NORMAL)[..., None])[..., 0]
        triangles = array(file, primitive.indices).reshape(-1, 3)
        assert triangles.max() == len(at) - 1
        np.testing.assert_allclose(np.linalg.norm(facing, axis=1), 1, atol=1e-4)
        # front faces look out: the sides of a triangle turn about its normal
        a, b, c = (at[triangles[:, k]] for k in range(3))
        across = np.cross(b - a, c - a)
        big = np.linalg.norm(across, axis=1) > 1e-7
        along = (across * facing[triangles].mean(axis=1))[big].sum(axis=1)
        assert (along > 0).mean() > 0.98
        # glTF's axes are left, up, forward; a point of the surface lies on a triangle or nearly so
        mine = np.concatenate([sampled[p] for p in cones if body.parts[p].segment == segment] or [at[:, [2, 0, 1]]])
        inside = np.random.default_rng(0).dirichlet([1, 1, 1], 40)
        surface = np.einsum("km,mta->kta", inside, np.stack([a, b, c])).reshape(-1, 3)
        distance, _ = cKDTree(np.concatenate([at, surface])).query(mine[:, [1, 2, 0]])
        assert distance.mean() < 0.01 and distance.max() < 0.03, segment
