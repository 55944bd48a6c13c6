"""Superellipsoids in Taichi against NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kernels import oracles
from tk.kernels import superellipsoid as functions
from tk.kernels.runtime import ensure_runtime, ti
from tk.model.body.superellipsoid import Superellipsoid

# logarithm and exponential instead of powers; in double precision, relative
EXACT = 1e-9
seeds = st.integers(0, 2**32 - 1)
exponents = st.floats(0.25, 1.75)
few = settings(max_examples=30)


def _kernel(real):
    @ti.kernel
    def evaluate(
        q: ti.types.ndarray(dtype=real, ndim=2),  # (N, 3)
        shape: ti.types.ndarray(dtype=real, ndim=1),  # (7,) a1 a2 a3 e1 e2 z_lower z_upper
        F: ti.types.ndarray(dtype=real, ndim=1),  # (N,) out
        G: ti.types.ndarray(dtype=real, ndim=2),  # (N, 4) out
        projected: ti.types.ndarray(dtype=real, ndim=2),  # (N, 3) out
    ):
        for n in range(q.shape[0]):
            p = ti.Vector([q[n, 0], q[n, 1], q[n, 2]])
            radii = ti.Vector([shape[0], shape[1], shape[2]])
            F[n] = functions.inside_outside(p, radii, shape[3], shape[4])
            g = functions.implicit(p, radii, shape[3], shape[4])
            for a in ti.static(range(4)):
                G[n, a] = g[a]
            s = functions.project(p, radii, shape[3], shape[4], shape[5], shape[6])
            for a in ti.static(range(3)):
                projected[n, a] = s[a]

    return evaluate


KERNELS = {np.float64: _kernel(ti.f64), np.float32: _kernel(ti.f32)}


def evaluate(q, piece, dtype=np.float64):
    """F (N,), G and its gradient (N, 4), projection (N, 3)."""
    ensure_runtime()
    shape = np.array([*piece.radii, piece.e1, piece.e2, piece.z_lower, piece.z_upper], dtype)
    out = np.empty(len(q), dtype), np.empty((len(q), 4), dtype), np.empty((len(q), 3), dtype)
    KERNELS[dtype](np.ascontiguousarray(q, dtype), shape, *out)
    return out


def piece_of(rng, e1, e2):
    """A piece of the body's sizes, cut somewhere."""
    radii = rng.uniform(0.03, 0.4, 3)
    lower, upper = np.sort(rng.uniform(-1, 1, 2)) * radii[2]
    return Superellipsoid("torso", np.eye(4), tuple(radii), e1, e2, lower, upper)


def margin(piece):
    """Least share of a radius at which the kernel's floors (powers of 1e-6, single precision's sake) play no part.

    Central differences want some distance from the planes of symmetry, too.
    """
    return max(0.05, 1e-5 ** (min(piece.e1, piece.e2) / 2))


def points_about(rng, piece, count=60):
    """Points inside and outside, clear of the planes of symmetry."""
    q = rng.uniform(-2, 2, (count, 3))
    return np.copysign(np.maximum(np.abs(q), margin(piece)), q) * piece.radii


@given(seeds, exponents, exponents)
@few
def test_values_and_gradient(seed, e1, e2):
    rng = np.random.default_rng(seed)
    piece = piece_of(rng, e1, e2)
    q = points_about(rng, piece)
    F, G, _ = evaluate(q, piece)
    np.testing.assert_allclose(F, piece.inside_outside(q), rtol=EXACT)
    np.testing.assert_allclose(G[:, 0], oracles.implicit(q, np.array(piece.radii), e1, e2), rtol=EXACT)
    numeric = oracles.implicit_gradient(q, np.array(piece.radii), e1, e2)
    np.testing.assert_allclose(G[:, 1:], numeric, rtol=1e-4, atol=1e-4 * np.abs(numeric).max())


@given(seeds, exponents, exponents, st.floats(0.5, 3))
@few
def test_implicit_is_homogeneous_of_degree_one(seed, e1, e2, scale):
    """What the Newton step rests on: G(s·q) = s·G(q), and so q·∇G = G (Euler)."""
    rng = np.random.default_rng(seed)
    piece = piece_of(rng, e1, e2)
    q = points_about(rng, piece)
    q = q[(scale * np.abs(q) > margin(piece) * np.array(piece.radii)).all(axis=1)]
    _, G, _ = evaluate(q, piece)
    _, scaled, _ = evaluate(scale * q, piece)
    np.testing.assert_allclose(scaled[:, 0], scale * G[:, 0], rtol=1e-9)
    np.testing.assert_allclose(np.sum(q * G[:, 1:], axis=1), G[:, 0], rtol=1e-6)


@given(seeds, exponents, exponents)
@few
def test_projection(seed, e1, e2):
    rng = np.random.default_rng(seed)
    piece = piece_of(rng, e1, e2)
    q = points_about(rng, piece)
    lower, upper = piece.z_lower, piece.z_upper
    q = q[np.abs(np.clip(q[:, 2], lower, upper)) > margin(piece) * piece.radii[2]]
    _, _, projected = evaluate(q, piece)
    surface = oracles.project(q, np.array(piece.radii), e1, e2, lower, upper)
    np.testing.assert_allclose(projected, surface, atol=2e-4)


@given(seeds, st.floats(0.3, 1.6), st.floats(0.3, 1.6))
@few
def test_points_of_the_surface_stay(seed, e1, e2):
    rng = np.random.default_rng(seed)
    piece = piece_of(rng, e1, e2)
    eta = np.clip(rng.uniform(*piece.eta_range, 40), -1.4, 1.4)
    omega = rng.uniform(-np.pi, np.pi, 40)
    on = piece.point(eta, omega)
    on[:, 2] = np.clip(on[:, 2], piece.z_lower, piece.z_upper)
    # where a coordinate vanishes the surface of ε < 1 is flat to rounding, that of ε > 1 has an edge
    clear = (np.abs(on) > 1e-3 * np.array(piece.radii)).all(axis=1)
    _, G, projected = evaluate(on, piece)
    np.testing.assert_allclose(projected[clear], on[clear], atol=1e-7)
    np.testing.assert_allclose(G[clear, 0], 1, atol=1e-9)


@pytest.mark.parametrize("e", [0.45, 0.8, 1.0])
def test_one_step_comes_close_to_the_surface(e):
    """From within a quarter of the radius: the projection of a voxel near the body."""
    rng = np.random.default_rng(0)
    piece = Superellipsoid("torso", np.eye(4), (0.1, 0.12, 0.3), e, e, -0.3, 0.3)
    on = piece.point(rng.uniform(-1.2, 1.2, 300), rng.uniform(-np.pi, np.pi, 300))
    q = on * rng.uniform(0.75, 1.25, (300, 1))
    _, G, projected = evaluate(q, piece)
    _, after, _ = evaluate(projected, piece)
    assert np.abs(after[:, 0] - 1).max() < 0.5 * np.abs(G[:, 0] - 1).max()
    assert np.median(np.abs(after[:, 0] - 1)) < 0.02


@pytest.mark.parametrize("e1", [0.1, 0.3, 1.0, 1.9])
@pytest.mark.parametrize("e2", [0.1, 0.3, 1.0, 1.9])
def test_single_precision_stays_finite(e1, e2):
    """The centre, the axes, the planes of symmetry and far outside, with exponents to the ends of their range."""
    piece = Superellipsoid("torso", np.eye(4), (0.05, 0.1, 0.4), e1, e2, -0.1, 0.4)
    q = np.stack(np.meshgrid(*[[-0.5, -0.1, -1e-7, 0.0, 1e-3, 0.2, 0.6]] * 3), -1).reshape(-1, 3) * [0.5, 0.5, 1]
    for values in evaluate(q, piece, np.float32):
        assert np.isfinite(values).all()
    _, _, projected = evaluate(q, piece, np.float32)
    # inside, the step is bounded by the piece's size
    clamped = np.concatenate([q[:, :2], np.clip(q[:, 2:], piece.z_lower, piece.z_upper)], axis=1)
    inside = piece.inside_outside(clamped) < 0.9
    assert (np.linalg.norm(projected - clamped, axis=1)[inside] <= 2 * 0.4 + 1e-5).all()


def test_a_point_far_outside_does_not_count_as_on_the_surface():
    """A small piece, such as a wrist's cap, sees voxels many of its own radii away."""
    piece = Superellipsoid("forearm_l", np.eye(4), (0.033, 0.033, 0.02), 1.0, 1.0, 0.0, 0.02)
    q = np.array([[0.4, 0.0, 0.01], [0.2, -0.2, 0.3], [0.01, 0.5, -0.4]])
    _, _, projected = evaluate(q, piece)
    distance = np.linalg.norm(q - projected, axis=1)
    np.testing.assert_allclose(distance, np.linalg.norm(q, axis=1), atol=0.05)


def test_single_precision_agrees_with_double():
    rng = np.random.default_rng(3)
    piece = Superellipsoid("torso", np.eye(4), (0.1, 0.15, 0.25), 0.45, 0.8, 0.0, 0.25)
    q = points_about(rng, piece, 200)
    for single, double in zip(evaluate(q, piece, np.float32)[1:], evaluate(q, piece)[1:], strict=True):
        np.testing.assert_allclose(single, double, atol=2e-5 * np.abs(double).max())
