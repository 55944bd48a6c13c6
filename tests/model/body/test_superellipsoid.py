"""Truncated superellipsoids: equations, samples, bad shapes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from tests.model.figures import skin_of
from tk.errors import ConfigError
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.superellipsoid import Superellipsoid

PIECES = skin_of(BodyDimensions.from_stature(1.75)).pieces
seeds = st.integers(0, 2**32 - 1)
exponents = st.floats(0.3, 1.7)
many = settings(max_examples=60)


def piece_of(rng, e1=1.0, e2=1.0, whole=False):
    radii = rng.uniform(0.03, 0.4, 3)
    lower, upper = (-1, 1) if whole else np.sort(rng.uniform(-1, 1, 2))
    return Superellipsoid("torso", np.eye(4), tuple(radii), e1, e2, lower * radii[2], upper * radii[2])


def angles_of(rng, count=40):
    """η and ω away from the planes of symmetry, where powers of sine and cosine have kinks or are flat to rounding."""
    eta = rng.uniform(0.15, np.pi / 2 - 0.15, count) * rng.choice([-1, 1], count)
    omega = rng.uniform(0.15, np.pi / 2 - 0.15, count) + rng.integers(0, 4, count) * np.pi / 2 - np.pi
    return eta, omega


@given(seeds, exponents, exponents)
@many
def test_surface_points_have_inside_outside_one(seed, e1, e2):
    rng = np.random.default_rng(seed)
    piece = piece_of(rng, e1, e2)
    points = piece.point(*angles_of(rng))
    np.testing.assert_allclose(piece.inside_outside(points), 1, rtol=1e-9)
    assert (piece.inside_outside(0.99 * points) < 1).all() and (piece.inside_outside(1.01 * points) > 1).all()


@given(seeds, exponents, exponents)
@many
def test_normals_are_perpendicular_to_the_surface(seed, e1, e2):
    """Eq. 2 against the cross product of eq. 1's tangents, by central differences."""
    rng = np.random.default_rng(seed)
    piece = piece_of(rng, e1, e2)
    eta, omega = angles_of(rng)
    h = 1e-6
    along_eta = piece.point(eta + h, omega) - piece.point(eta - h, omega)
    along_omega = piece.point(eta, omega + h) - piece.point(eta, omega - h)
    numeric = np.cross(along_omega, along_eta)
    numeric /= np.linalg.norm(numeric, axis=1, keepdims=True)
    normals = piece.normal(eta, omega)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-12)
    np.testing.assert_allclose(normals, numeric, atol=1e-5)


@given(seeds, exponents, exponents)
@many
def test_normals_are_the_gradient_of_inside_outside(seed, e1, e2):
    rng = np.random.default_rng(seed)
    piece = piece_of(rng, e1, e2)
    eta, omega = angles_of(rng)
    points, h = piece.point(eta, omega), 1e-7
    steps = h * np.eye(3)
    gradient = np.stack([piece.inside_outside(points + d) - piece.inside_outside(points - d) for d in steps], -1)
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    np.testing.assert_allclose(piece.normal(eta, omega), gradient, atol=1e-4)


def test_exponents_of_one_give_an_ellipsoid():
    piece = Superellipsoid("head", np.eye(4), (0.1, 0.2, 0.3), 1.0, 1.0, -0.3, 0.3)
    eta, omega = angles_of(np.random.default_rng(0))
    x, y, z = piece.point(eta, omega).T
    np.testing.assert_allclose((x / 0.1) ** 2 + (y / 0.2) ** 2 + (z / 0.3) ** 2, 1)
    np.testing.assert_allclose(piece.inside_outside(np.array([0.05, 0.1, -0.15])), 0.75)


@given(seeds, exponents, exponents)
@many
def test_contained_points_are_inside_and_between_the_planes(seed, e1, e2):
    rng = np.random.default_rng(seed)
    piece = piece_of(rng, e1, e2)
    q = rng.uniform(-1.2, 1.2, (200, 3)) * piece.radii
    expected = [piece.inside_outside(x) < 1 and piece.z_lower <= x[2] <= piece.z_upper for x in q]
    np.testing.assert_array_equal(piece.contains(q), expected)


@pytest.mark.parametrize("e1", [0.02, 0.3, 1.0, 1.7, 1.99])
@pytest.mark.parametrize("e2", [0.02, 0.3, 1.0, 1.7, 1.99])
def test_degenerate_exponents_stay_finite(e1, e2):
    """From nearly a box to nearly an octahedron, the poles and the equator included; warnings are errors here."""
    piece = Superellipsoid("torso", np.eye(4), (0.1, 0.15, 0.3), e1, e2, -0.3, 0.3)
    eta, omega = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 21), np.linspace(-np.pi, np.pi, 41))
    points, normals = piece.point(eta, omega), piece.normal(eta, omega)
    assert np.isfinite(points).all() and (np.abs(points) <= np.array(piece.radii) * (1 + 1e-12)).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, rtol=1e-9)
    assert (np.sum(points * normals, axis=-1) > -1e-12).all()
    e, w = piece.samples(0.03)
    assert len(e) > 100 and np.isfinite(piece.normal(e, w)).all()


# Samples


def area_per_sample(piece, spacing):
    """Area of the surface nearest to each sample, by a fine mesh, in units of the spacing squared."""
    samples = piece.point(*piece.samples(spacing))
    mesh = piece.point(*np.meshgrid(np.linspace(*piece.eta_range, 250), np.linspace(-np.pi, np.pi, 251), indexing="ij"))
    across, down = mesh[1:, 1:] - mesh[:-1, :-1], mesh[1:, :-1] - mesh[:-1, 1:]
    area = np.linalg.norm(np.cross(across, down), axis=-1) / 2
    middle = (mesh[1:, 1:] + mesh[:-1, :-1] + mesh[1:, :-1] + mesh[:-1, 1:]) / 4
    owner = cKDTree(samples).query(middle.reshape(-1, 3))[1]
    return np.bincount(owner, area.ravel(), minlength=len(samples)) / spacing**2


@pytest.mark.parametrize("piece", [p for p in PIECES if not p.segment.endswith("_r")], ids=lambda p: p.segment)
def test_samples_of_the_body_are_uniform_in_area(piece):
    area = area_per_sample(piece, 0.03)
    assert 0.8 < area.mean() < 1.5  # the wrist's cap has room for four
    assert area.max() / area.min() < 2


@pytest.mark.parametrize("e1", [0.45, 1.0, 1.9])
@pytest.mark.parametrize("e2", [0.45, 1.0, 1.9])
def test_samples_of_other_shapes_are_uniform_in_area(e1, e2):
    """Equal steps of the angles would leave a box's faces nearly bare: their densities differ by hundreds."""
    area = area_per_sample(Superellipsoid("torso", np.eye(4), (0.12, 0.17, 0.3), e1, e2, -0.3, 0.3), 0.03)
    assert area.mean() == pytest.approx(1, abs=0.2)
    low, high = np.percentile(area, [2, 98])
    assert high / low < 3


@given(seeds, exponents, exponents, st.floats(0.01, 0.5))
@many
def test_samples_lie_on_the_piece(seed, e1, e2, spacing):
    """Any spacing, larger than the piece too: at least one sample, none beyond the planes."""
    piece = piece_of(np.random.default_rng(seed), e1, e2)
    eta, omega = piece.samples(spacing)
    assert len(eta) == len(omega) >= 1
    z = piece.point(eta, omega)[:, 2]
    assert z.min() >= piece.z_lower - 1e-9 and z.max() <= piece.z_upper + 1e-9


def test_eta_range_ends_at_the_planes():
    for piece in PIECES:
        z = piece.point(np.array(piece.eta_range), np.zeros(2))[:, 2]
        np.testing.assert_allclose(z, [piece.z_lower, piece.z_upper], atol=1e-12)


# Bad shapes

GOOD = {"radii": (0.1, 0.1, 0.3), "e1": 1.0, "e2": 1.0, "z_lower": -0.1, "z_upper": 0.3}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radii": (0.1, 0.0, 0.3)}, "radii"),
        ({"radii": (0.1, 0.1, -0.3)}, "radii"),
        ({"e1": 0.0}, "exponents"),
        ({"e2": 2.0}, "exponents"),
        ({"e1": float("nan")}, "exponents"),
        ({"z_lower": 0.3}, "cut"),
        ({"z_upper": 0.31}, "cut"),
        ({"z_lower": -0.31}, "cut"),
    ],
)
def test_impossible_shapes_are_refused_by_name(change, message):
    Superellipsoid("thigh_l", np.eye(4), **GOOD)
    with pytest.raises(ConfigError, match=f"superellipsoid of thigh_l: {message}"):
        Superellipsoid("thigh_l", np.eye(4), **(GOOD | change))
