from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.model.body.test_skeleton import DIMENSIONS, EXACT, SKELETON, random_pose
from tk.errors import ConfigError
from tk.model.body.skeleton import build_skeleton, up_rotation
from tk.model.cameras.up import UP_AXES, up_text, up_vector

seeds = st.integers(0, 2**32 - 1)


def random_up(seed: int) -> np.ndarray:
    """(3,) any direction; a third of them along an axis, and a third within a milliradian of one."""
    vector = np.random.default_rng(seed).normal(size=3)
    if seed % 3:
        vector = up_vector(UP_AXES[seed // 3 % 6]) + (seed % 3 - 1) * 1e-3 * vector
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize("name", UP_AXES)
def test_axis_keeps_its_name(name: str) -> None:
    assert up_text(name) == up_text(up_vector(name)) == up_text(3.0 * up_vector(name)) == name
    assert up_text(f" {name.upper()} ") == name
    assert np.count_nonzero(up_vector(name)) == 1


@given(seed=seeds)
def test_text_of_a_direction_converts_back(seed: int) -> None:
    vector = random_up(seed)
    text = up_text(7.5 * vector)
    np.testing.assert_allclose(up_vector(text), vector, rtol=0, atol=1e-15)
    assert up_text(text) == text  # a resumed run writes the same text


@given(seed=seeds)
def test_rotation_turns_z_to_any_direction(seed: int) -> None:
    vector = random_up(seed)
    B = up_rotation(up_text(vector))
    np.testing.assert_allclose(B.T @ B, np.eye(3), atol=1e-12)
    assert np.linalg.det(B) == pytest.approx(1)
    np.testing.assert_allclose(B[:, 2], vector, atol=1e-12)


@given(seed=seeds)
def test_rotation_is_continuous_near_an_axis(seed: int) -> None:
    near = up_vector(UP_AXES[seed % 6]) + 1e-4 * np.random.default_rng(seed).uniform(-1, 1, 3)
    np.testing.assert_allclose(up_rotation(up_text(near)), up_rotation(UP_AXES[seed % 6]), atol=1e-3)


@given(seed=seeds)
def test_skeleton_turns_with_up(seed: int) -> None:
    text = up_text(random_up(seed))
    skeleton, B = build_skeleton(DIMENSIONS, text), up_rotation(text)
    pose = random_pose(seed)
    turned = pose.copy()
    turned[:3] = B @ pose[:3]
    np.testing.assert_allclose(skeleton.joints(turned), SKELETON.joints(pose) @ B.T, rtol=0, atol=EXACT)
    np.testing.assert_array_equal(skeleton.lower, SKELETON.lower)


@pytest.mark.parametrize(
    "up", ["", "w", "north", "-", "[1, 2]", "[0, 0, 0]", '["a", 1, 2]', "[NaN, 0, 1]", "[[1, 0, 0]]", "{}", "3"]
)
def test_invalid_direction_is_refused(up: str) -> None:
    with pytest.raises(ConfigError, match=r"^up = "):
        up_vector(up)
