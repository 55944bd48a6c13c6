"""Proportions of the average body."""

from dataclasses import fields

import pytest

from tests.model.figures import scaled
from tk.errors import ConfigError
from tk.model.body.anthropometry import FRACTIONS, BodyDimensions

NAMES = [f.name for f in fields(BodyDimensions)]


@pytest.mark.parametrize("stature", [1.1, 1.5, 1.75, 2.1])
def test_average_body_has_the_given_stature(stature):
    """The segments of a standing person add up, to the rounding of the table and a shoe's sole."""
    body = BodyDimensions.from_stature(stature)
    assert -0.005 < body.stature / stature - 1 < 0.02
    assert body.barefoot == pytest.approx(stature)


def test_every_dimension_is_proportional_to_the_stature():
    small, large = BodyDimensions.from_stature(1.0), BodyDimensions.from_stature(2.0)
    for name in NAMES:
        assert getattr(large, name) == pytest.approx(2 * getattr(small, name)), name


def test_limbs_taper_and_thighs_hardly_overlap():
    d = BodyDimensions.from_stature(1.75)
    assert d.upper_arm_radius > d.elbow_radius > d.wrist_radius
    assert d.thigh_radius > d.knee_radius > d.ankle_radius
    assert d.hip_half_width < d.hips_half_width and d.neck_radius < d.head_radius
    # the two thighs do not overlap
    assert d.thigh_radius < d.hip_half_width


def test_table_agrees_with_drillis_and_contini():
    """In Winter's figure 4.1, fractions of the stature, where joint centres are given."""
    # not the upper arm, which is there from the acromion instead of the joint's centre
    winter = {"forearm": 0.146, "hand": 0.108, "thigh": 0.245, "calf": 0.246, "ankle_height": 0.039, "foot": 0.152}
    for name, value in winter.items():
        shoe = 0.013 if name == "ankle_height" else 0.0
        assert value - 0.01 < FRACTIONS[name] < value + 0.01 + shoe, name


@pytest.mark.parametrize("factor", [0.0, -1.0, 100.0, float("nan"), float("inf")])
def test_impossible_dimensions_are_refused_by_name(factor):
    with pytest.raises(ConfigError, match=r"body dimension calf = .* must lie between 0 and 3 m"):
        scaled(BodyDimensions.from_stature(1.75), calf=factor)
