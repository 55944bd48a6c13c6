"""Pose and dimensions together: a body of known dimensions as voxels, the average body to start from."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.model.figures import grid_around, surface_index, voxelise
from tk.kernels.objective import ObjectiveSettings
from tk.model.anthropometry import BodyDimensions
from tk.model.body import build_body, neutral_pose
from tk.model.fitting import GROUPS, FitConfig, apply_factors, fit_body, fitted_body
from tk.model.initialisation import certainty, da_vinci_pose, find_landmarks
from tk.model.objective import SamplingConfig
from tk.model.skeleton import JOINTS, build_skeleton

VOXEL_M = 0.02
AVERAGE = BodyDimensions.from_stature(1.75)
LENGTHS = ("trunk", "head", "upper_arm", "forearm", "thigh", "calf", "shoulder_half_width")
GIRTHS = ("chest_half_width", "chest_half_depth", "upper_arm_radius", "elbow_radius", "thigh_radius", "knee_radius")


class Subject:
    """A body in the Da Vinci pose as a frame's surface voxels, and where the tracker would start."""

    def __init__(self, up="z", **factors):
        self.up = up
        self.dimensions = AVERAGE.scaled(**factors)
        body = build_body(self.dimensions, up, spacing_m=0.06)
        self.pose = neutral_pose(body.skeleton)
        self.pose[:4] = 0.3, -0.2, 1.0, 0.7
        grid = grid_around(body, self.pose, VOXEL_M)
        occupancy = voxelise(body, self.pose, grid)
        self.index = surface_index(occupancy, grid)
        self.joints = body.skeleton.joints(self.pose)
        marks = find_landmarks(occupancy, grid, up)
        self.start = da_vinci_pose(marks, self.dimensions.stature, up)

    def fit(self, frames=1, settings=None, config=None):
        dimensions, pose = self.start
        return fit_body(
            dimensions,
            np.repeat(pose[None], frames, 0),
            [self.index] * frames,
            self.up,
            settings or ObjectiveSettings(),
            SamplingConfig(),
            certainty(build_skeleton(dimensions, self.up)),
            config,
        )

    def joint_errors(self, dimensions, pose):
        errors = np.linalg.norm(build_skeleton(dimensions, self.up).joints(pose) - self.joints, axis=1)
        return dict(zip(JOINTS, errors, strict=True))


@pytest.fixture(scope="module")
def subject():
    """Long arms, short legs, a long trunk, broad and strong."""
    return Subject(
        upper_arm=1.05, forearm=1.05, thigh=0.96, calf=0.96, trunk=1.04, thigh_radius=1.2, chest_half_width=1.15
    )


@pytest.fixture(scope="module")
def fitted(subject):
    return subject.fit()


@pytest.mark.parametrize("name", LENGTHS)
def test_lengths(subject, fitted, name):
    assert getattr(fitted[0], name) == pytest.approx(getattr(subject.dimensions, name), abs=0.02)


@pytest.mark.parametrize("name", GIRTHS)
def test_girths(subject, fitted, name):
    assert getattr(fitted[0], name) == pytest.approx(getattr(subject.dimensions, name), abs=0.01)


def test_girths_come_closer_than_the_average_body(subject, fitted):
    start, truth = subject.start[0], subject.dimensions
    for name in ("thigh_radius", "chest_half_width"):
        before, after = (abs(getattr(d, name) - getattr(truth, name)) for d in (start, fitted[0]))
        assert after < 0.5 * before, name


def test_joints(subject, fitted):
    before = subject.joint_errors(*subject.start)
    after = subject.joint_errors(fitted[0], fitted[1][0])
    assert np.mean(list(after.values())) < 0.7 * np.mean(list(before.values()))
    assert max(after.values()) < 0.04, after


def test_limits_hold(subject, fitted):
    skeleton = build_skeleton(fitted[0])
    np.testing.assert_array_equal(skeleton.clip(fitted[1]), fitted[1])


def test_same_input_same_bits(subject):
    config = FitConfig(rounds=3)
    (a, p), (b, q) = subject.fit(config=config), subject.fit(config=config)
    assert a == b
    np.testing.assert_array_equal(p, q)


def test_several_frames_agree_with_one(subject, fitted):
    """The same frame twice: the prior counts half, the poses come out alike."""
    dimensions, poses = subject.fit(frames=2)
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-9)
    for name in LENGTHS:
        assert getattr(dimensions, name) == pytest.approx(getattr(subject.dimensions, name), abs=0.02)


def test_the_average_body_stays_average():
    """Nothing to explain: dimensions keep to a few per cent of the truth, that is, of the prior."""
    subject = Subject()
    dimensions, _ = subject.fit()
    for name in LENGTHS:
        assert getattr(dimensions, name) == pytest.approx(getattr(subject.dimensions, name), abs=0.015), name


def test_another_up_gives_the_same_body(subject, fitted):
    """Voxels lie otherwise in another grid; the fit is the same to their size."""
    turned = Subject("-y", **{n: getattr(subject.dimensions, n) / getattr(AVERAGE, n) for n in LENGTHS + GIRTHS})
    dimensions, _ = turned.fit()
    for name in LENGTHS + GIRTHS:
        assert getattr(dimensions, name) == pytest.approx(getattr(fitted[0], name), abs=0.01), name


def test_without_the_coverage_term(subject):
    """The paper's objective has none; the fit must not read what it did not fill."""
    dimensions, poses = subject.fit(settings=ObjectiveSettings(coverage_weight=0.0))
    assert np.isfinite(poses).all()
    assert dimensions.thigh_radius == pytest.approx(subject.dimensions.thigh_radius, abs=0.01)


# Factors


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_factors_multiply(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-0.2, 0.2, (2, len(GROUPS)))
    once, twice = apply_factors(AVERAGE, a + b), apply_factors(apply_factors(AVERAGE, a), b)
    for f in fields(AVERAGE):
        assert getattr(once, f.name) == pytest.approx(getattr(twice, f.name), rel=1e-12)
    assert apply_factors(AVERAGE, np.zeros(len(GROUPS))) == AVERAGE


def test_each_group_moves_its_own_dimensions():
    for i, (names, deviation) in enumerate(GROUPS):
        moved = apply_factors(AVERAGE, 0.1 * np.eye(len(GROUPS))[i])
        changed = {f.name for f in fields(AVERAGE) if getattr(moved, f.name) != getattr(AVERAGE, f.name)}
        assert changed == set(names) and 0 < deviation < 1


def test_the_trackers_body_is_the_fitted_one():
    body = fitted_body(AVERAGE, "y")
    assert body.dimensions == AVERAGE
    np.testing.assert_array_equal(body.points, build_body(AVERAGE, "y").points)
