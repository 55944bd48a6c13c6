"""Rotations there and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tk.model.body.rotations import compose, continuous, decompose, to_matrices, to_quaternions, turn

SEQUENCES = ("zxy", "yxz", "yxy")
angle = st.floats(-np.pi, np.pi)


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_composition_agrees_with_scipy(sequence: str) -> None:
    angles = np.random.default_rng(0).uniform(-3, 3, (20, 3))
    expected = Rotation.from_euler(sequence.upper(), angles).as_matrix()
    np.testing.assert_allclose(compose(sequence, angles), expected, atol=1e-12)


@pytest.mark.parametrize("sequence", SEQUENCES)
@given(a=angle, b=angle, c=angle)
def test_turns_give_the_rotation_back(sequence: str, a: float, b: float, c: float) -> None:
    R = compose(sequence, np.array([a, b, c]))
    found = decompose(sequence, R)
    # a middle angle within 1e-7 of singular is taken as singular
    np.testing.assert_allclose(compose(sequence, found), R, atol=3e-7)
    low, high = (-np.pi, 0.0) if sequence == "yxy" else (-np.pi / 2, np.pi / 2)
    assert low <= found[1] <= high


SINGULAR = [("zxy", np.pi / 2), ("yxz", -np.pi / 2), ("yxy", 0.0), ("yxy", -np.pi)]


@pytest.mark.parametrize(("sequence", "middle"), SINGULAR)
def test_singular_rotations_come_back(sequence: str, middle: float) -> None:
    R = compose(sequence, np.array([0.4, middle, -1.1]))
    found = decompose(sequence, R)
    assert found[0] == 0.0
    np.testing.assert_allclose(compose(sequence, found), R, atol=1e-9)


def test_unknown_sequence_is_refused() -> None:
    with pytest.raises(ValueError, match="xyz"):
        decompose("xyz", np.eye(3))


@given(a=angle, b=angle, c=angle)
def test_quaternions_give_the_matrix_back(a: float, b: float, c: float) -> None:
    R = compose("zxy", np.array([[a, b, c]]))
    q = to_quaternions(R)
    assert q.shape == (1, 4) and q[0, 0] >= 0
    np.testing.assert_allclose(to_matrices(q), R, atol=1e-12)
    np.testing.assert_allclose(to_matrices(-2 * q), R, atol=1e-12)


def test_scalar_is_first() -> None:
    q = to_quaternions(turn("z", np.array(np.radians(60.0))))
    np.testing.assert_allclose(q, [np.cos(np.radians(30)), 0, 0, np.sin(np.radians(30))], atol=1e-12)


def test_a_whole_turn_has_no_jump() -> None:
    q = to_quaternions(turn("y", np.linspace(0, 4 * np.pi, 60)))
    assert (np.abs(np.diff(q, axis=0)) > 0.5).any()  # w not negative: it jumps
    smooth = continuous(q)
    assert np.abs(np.diff(smooth, axis=0)).max() < 0.12
    np.testing.assert_allclose(to_matrices(smooth), to_matrices(q), atol=1e-12)
