"""Functions of the contour kernel against plain NumPy, each through a thin kernel."""

import numpy as np
import pytest

from tk.kernels.cone_contours import BALL, BALL_SQUARE, PLACED_NUMBERS, distance_sqr, may_hide
from tk.kernels.runtime import ensure_runtime, ti
from tk.kernels.silhouette import add_row, robust_weight, shared_weight


@ti.kernel
def _distances(
    points: ti.types.ndarray(dtype=ti.f64, ndim=3),  # (N, 3, 2) point, begin, end
    result: ti.types.ndarray(dtype=ti.f64, ndim=1),
):
    for n in range(points.shape[0]):
        e, a, b = [ti.Vector([points[n, i, 0], points[n, i, 1]]) for i in ti.static(range(3))]
        result[n] = distance_sqr(e, a, b)


def test_distance_from_a_segment_is_the_least_over_its_points():
    ensure_runtime()
    points = np.random.default_rng(0).normal(0, 1, (40, 3, 2))
    points[0, 2] = points[0, 1]
    found = np.empty(len(points))
    _distances(points, found)
    t = np.linspace(0, 1, 20001)[:, None]
    expected = [np.min(np.sum((a + t * (b - a) - e) ** 2, axis=1)) for e, a, b in points]
    np.testing.assert_allclose(found, expected, atol=1e-7)


@ti.kernel
def _hiders(
    placed: ti.types.ndarray(dtype=ti.f64, ndim=3),  # (B, 2, 16)
    eye: ti.types.ndarray(dtype=ti.f64, ndim=1),
    bits: ti.types.ndarray(dtype=ti.i64, ndim=1),
):
    for b in range(placed.shape[0]):
        bits[b] = may_hide(placed, b, 0, ti.Vector([eye[0], eye[1], eye[2]]))


def test_a_sphere_may_hide_another_where_their_images_overlap():
    """Cones of the two spheres overlap if the angle of their axes is at most the sum of their half angles."""
    ensure_runtime()
    rng = np.random.default_rng(1)
    centers, radii, eye = rng.uniform(-1, 1, (200, 2, 3)), rng.uniform(0.05, 0.4, (200, 2)), np.array([0.3, 3.0, -0.2])
    placed = np.zeros((200, 2, PLACED_NUMBERS))
    placed[..., BALL : BALL + 3], placed[..., BALL_SQUARE] = centers, radii**2
    bits = np.empty(200, np.int64)
    _hiders(placed, eye, bits)
    to = centers - eye
    distance = np.linalg.norm(to, axis=2)
    angle = np.arccos(np.sum(to[:, 0] * to[:, 1], axis=1) / distance.prod(axis=1))
    overlap = angle <= np.arcsin(radii / distance).sum(axis=1)
    np.testing.assert_array_equal(bits, np.where(overlap, 2, 0))
    assert 20 < overlap.sum() < 180


@ti.kernel
def _weights(d: ti.f64, other: ti.f64, result: ti.types.ndarray(dtype=ti.f64, ndim=1)):
    for _ in range(1):
        result[0] = robust_weight(d, other)
        result[1] = shared_weight(d, other * other)


@pytest.mark.parametrize("d", [-6.0, 0.0, 2.5])
def test_weights_of_edgels(d):
    """Geman-McClure: a quarter at the soft distance; section 4.4: d_b / (2 (d_a + d_b))."""
    ensure_runtime()
    result = np.empty(2)
    _weights(d, 6.0, result)
    np.testing.assert_allclose(result, [(1 + (d / 6) ** 2) ** -2, 6 / (2 * (abs(d) + 6))], rtol=1e-12)


@ti.kernel
def _add(values: ti.types.ndarray(dtype=ti.f64, ndim=1), result: ti.types.ndarray(dtype=ti.f64, ndim=1)):
    for _ in range(1):
        zero = values[0] * 0.0
        pull = ti.Vector([zero for _ in range(6)])
        inertia = ti.Vector([zero for _ in range(21)])
        arm = ti.Vector([values[i] for i in ti.static(range(3))])
        J = ti.Matrix([[values[3 + 3 * i + j] for j in ti.static(range(3))] for i in ti.static(range(2))])
        n = ti.Vector([values[9], values[10]])
        add_row(pull, inertia, arm, J, n, values[11], values[12], values[13])
        for i in ti.static(range(6)):
            result[i] = pull[i]
        for i in ti.static(range(21)):
            result[6 + i] = inertia[i]


def test_rows_of_an_edgel_are_two_directions_of_a_twist():
    ensure_runtime()
    values = np.random.default_rng(2).normal(0, 1, 14)
    result = np.empty(27)
    _add(values, result)
    arm, J, n, (d, weight, tangential) = values[:3], values[3:9].reshape(2, 3), values[9:11], values[11:]
    across, beside = (np.r_[np.cross(arm, g), g] for g in (J.T @ n, J.T @ [-n[1], n[0]]))
    inertia = weight * (np.outer(across, across) + tangential * np.outer(beside, beside))
    np.testing.assert_allclose(result, np.r_[weight * d * across, inertia[np.tril_indices(6)]], rtol=1e-12)
