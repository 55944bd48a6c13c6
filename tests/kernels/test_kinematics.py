"""Forward kinematics in Taichi against the skeleton's own float64 NumPy."""

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tk.kernels import kinematics
from tk.kernels.kinematics import forward_tree, load_rotation, load_translation
from tk.kernels.runtime import ensure_runtime, ti
from tk.kernels.vectors import triple
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.skeleton import SEGMENTS, build_skeleton

SKELETON = build_skeleton(BodyDimensions.from_stature(1.75))
D = len(SKELETON.names)
# double precision over a chain of nine transforms of metre-long levers
EXACT = 1e-13
# single precision over the same chain, metres
SINGLE = 3e-6
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=25)


def poses_of(rng, count):
    return rng.uniform(-np.pi, np.pi, (count, D))


def points_of(rng, count):
    """Points of the zero configuration and the segments that carry them."""
    return rng.normal(0, 0.7, (count, 3)), rng.integers(0, len(SEGMENTS), count)


@functools.cache
def _place_kernel(real):
    @ti.kernel
    def place(
        tree: ti.types.ndarray(dtype=real, ndim=2),  # (D, 11)
        local: ti.types.ndarray(dtype=real, ndim=2),  # (N, 3)
        last_dof: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        joints: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 18) scratch
        world: ti.types.ndarray(dtype=real, ndim=3),  # (B, N, 3) out
    ):
        for b in range(pose.shape[0]):
            forward_tree(tree, pose, b, b, joints)
            for n in range(local.shape[0]):
                k = last_dof[n]
                x = load_rotation(joints, b, k) @ triple(local, n, 0) + load_translation(joints, b, k)
                for i in ti.static(range(3)):
                    world[b, n, i] = x[i]

    return place


def place(local, segment, poses):
    """Points of the zero configuration carried to poses (B, D), in their precision."""
    ensure_runtime()
    s, dtype = SKELETON, poses.dtype
    world = np.empty((len(poses), len(local), 3), dtype)
    _place_kernel(ti.f64 if dtype == np.float64 else ti.f32)(
        s.tree.astype(dtype),
        np.ascontiguousarray(local, dtype),
        s.segment_dof[segment].astype(np.int32),
        np.ascontiguousarray(poses),
        np.empty((len(poses), D, kinematics.JOINT_NUMBERS), dtype),
        world,
    )
    return world


def place_oracle(local, segment, poses):
    placed = np.empty((len(poses), len(local), 3))
    for b, pose in enumerate(poses):
        T = SKELETON.segment_transforms(pose)
        for n, (x, s) in enumerate(zip(local, segment, strict=True)):
            placed[b, n] = T[s, :3, :3] @ x + T[s, :3, 3]
    return placed


@given(seeds)
@few
def test_place_equals_the_skeletons_transforms(seed):
    rng = np.random.default_rng(seed)
    poses, (local, segment) = poses_of(rng, 3), points_of(rng, 20)
    expected = place_oracle(local, segment, poses)
    np.testing.assert_allclose(place(local, segment, poses), expected, rtol=0, atol=EXACT)
    single = place(local, segment, poses.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, place_oracle(local, segment, poses.astype(np.float32)), rtol=0, atol=SINGLE)


def test_angles_too_small_for_their_cosine():
    """1 − cos(1e-9) rounds to 0; the first order must remain."""
    poses = np.full((1, D), 1e-9)
    local, segment = points_of(np.random.default_rng(2), 10)
    moved = place(local, segment, poses)[0] - local
    expected = place_oracle(local, segment, poses)[0] - local
    assert np.abs(moved).max() > 1e-10
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-15)


def test_a_batch_is_its_rows():
    rng = np.random.default_rng(3)
    poses, (local, segment) = poses_of(rng, 9), points_of(rng, 17)
    together = place(local, segment, poses)
    for b in range(len(poses)):
        np.testing.assert_array_equal(together[b], place(local, segment, poses[b : b + 1])[0])


@ti.kernel
def _rotate(
    axes: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (N, 3)
    angles: ti.types.ndarray(dtype=ti.f64, ndim=1),  # (N,)
    rotations: ti.types.ndarray(dtype=ti.f64, ndim=3),  # (N, 3, 3) out
):
    for n in range(angles.shape[0]):
        R = kinematics.rodrigues(triple(axes, n, 0), angles[n])
        for i, j in ti.static(ti.ndrange(3, 3)):
            rotations[n, i, j] = R[i, j]


@given(seeds, st.sampled_from([1e-12, 1e-6, 1.0, np.pi, 2 * np.pi]))
@few
def test_rodrigues_is_a_rotation_about_the_axis(seed, scale):
    ensure_runtime()
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(20, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = rng.uniform(-scale, scale, 20)
    rotations = np.empty((20, 3, 3))
    _rotate(axes, angles, rotations)
    np.testing.assert_allclose(rotations, Rotation.from_rotvec(axes * angles[:, None]).as_matrix(), atol=1e-14, rtol=0)


@ti.kernel
def _twists(
    tree: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (D, 11)
    chain: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
    pose: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (1, D)
    joints: ti.types.ndarray(dtype=ti.f64, ndim=3),  # (1, D, 18) out
):
    for _ in range(1):
        kinematics.forward_chain(tree, chain, pose, 0, 0, joints)


@pytest.mark.parametrize("seed", range(5))
def test_velocity_of_a_point_is_the_derivative_of_its_place(seed):
    """∂x/∂p_k by central differences, for every degree of freedom above the point."""
    ensure_runtime()
    rng = np.random.default_rng(seed)
    pose, (local, segment) = poses_of(rng, 1)[0], points_of(rng, 12)
    s = SKELETON
    joints = np.empty((1, D, kinematics.JOINT_NUMBERS))
    tree = s.tree
    _twists(tree, np.arange(D, dtype=np.int32), pose[None], joints)
    w, v = np.split(joints[0, :, kinematics.TWIST :], 2, axis=1)
    velocities = np.cross(w, place(local, segment, pose[None])[0][:, None]) + v
    h = 1e-6
    steps = h * np.eye(D)
    numeric = (place(local, segment, pose + steps) - place(local, segment, pose - steps)) / (2 * h)
    above = s.ancestors[segment]
    np.testing.assert_allclose(velocities[above], numeric.transpose(1, 0, 2)[above], rtol=0, atol=1e-8)
    np.testing.assert_array_equal(numeric.transpose(1, 0, 2)[~above], 0)
    chain = np.flatnonzero(s.ancestors[segment[0]]).astype(np.int32)
    some = np.full_like(joints, np.nan)
    _twists(tree, chain, pose[None], some)
    np.testing.assert_array_equal(some[:, chain], joints[:, chain])
    assert np.isnan(np.delete(some, chain, axis=1)).all(), "the others are not touched"
