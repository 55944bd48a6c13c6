"""Finding the subject: a body of superellipsoids as voxels, at random places, headings and statures."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.model.figures import grid_around, voxelise
from tk.errors import CaptureError
from tk.model import initialisation
from tk.model.anthropometry import BodyDimensions
from tk.model.body import build_body, neutral_pose
from tk.model.initialisation import (
    certainty,
    da_vinci_pose,
    find_landmarks,
    largest_part,
    rough_certainty,
    rough_pose,
    shoulder_angles,
)
from tk.model.skeleton import JOINTS, build_skeleton
from tk.model.volume import Volume, VoxelGrid

VOXEL_M = 0.03
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=8, deadline=None)


class Figure:
    """A person in the Da Vinci pose, or one that differs from it, as voxels."""

    def __init__(self, stature=1.75, up="z", place=(0.0, 0.0, 1.0), yaw=0.0, arms=None, **degrees):
        self.up = up
        self.body = build_body(BodyDimensions.from_stature(stature), up, spacing_m=0.06)
        self.skeleton = self.body.skeleton
        self.pose = neutral_pose(self.skeleton)
        self.pose[:3] = place
        self.pose[3] = yaw
        for name, value in degrees.items():
            self.pose[self.skeleton.index(name)] = np.radians(value)
        if arms is not None:
            for side in ("l", "r"):
                yaw_k, pitch_k = (self.skeleton.index(f"shoulder_{side}_{a}") for a in ("yaw", "pitch"))
                self.pose[[yaw_k, pitch_k]] = shoulder_angles(np.array(arms) / np.linalg.norm(arms))
        self.grid = grid_around(self.body, self.pose, VOXEL_M)
        self.occupancy = voxelise(self.body, self.pose, self.grid)

    @property
    def joints(self):
        return dict(zip(JOINTS, self.skeleton.joints(self.pose), strict=True))

    def landmarks(self):
        return find_landmarks(self.occupancy, self.grid, self.up)


def random_figure(seed, **changes):
    rng = np.random.default_rng(seed)
    place, yaw = rng.uniform(-1.5, 1.5, 3), rng.uniform(-np.pi, np.pi)
    ups = ("z", "-y", "x", "y", "-z", "-x")
    return Figure(rng.uniform(1.45, 2.0), ups[rng.integers(6)], place, yaw, **changes)


@given(seeds)
@few
def test_landmarks(seed):
    """Feet, hands, crown and heading, to the size of a voxel and of what a plane first meets."""
    figure = random_figure(seed)
    marks, joints, B = figure.landmarks(), figure.joints, figure.skeleton.T_world_body
    h = figure.body.dimensions.stature
    up = B[:, 2]
    np.testing.assert_allclose(marks.up, up)
    # legs apart lower the crown by 2 %
    assert 0.95 < marks.stature / h < 1.01
    yaw = figure.pose[3]
    left = B @ [-np.sin(yaw), np.cos(yaw), 0]
    assert np.degrees(np.arccos(np.clip(marks.left @ left, -1, 1))) < 2, "not the heading, or to the wrong side"
    assert marks.toes_m > 0.02 * h, "the heading rests on nothing"
    assert np.linalg.norm(marks.crown - joints["head_top"]) < 0.03 * h
    for i, side in enumerate(("l", "r")):
        # the middle of the hand's last 6 % of the stature lies beyond the wrist
        assert np.linalg.norm(marks.hands[i] - joints[f"wrist_{side}"]) < 0.09 * h
        sole = joints[f"ankle_{side}"] - figure.body.dimensions.ankle_height * up
        assert np.linalg.norm(marks.feet[i] - sole) < 0.06 * h


@given(seeds, st.booleans())
@few
def test_da_vinci_pose(seed, stature_known):
    """All joints to 3.5 cm, their mean to 2 cm, the heading to 2°; only the stature is a prior."""
    figure = random_figure(seed)
    stature = figure.body.dimensions.stature if stature_known else None
    dimensions, pose = da_vinci_pose(figure.landmarks(), stature, figure.up)
    skeleton = build_skeleton(dimensions, figure.up)
    np.testing.assert_array_equal(skeleton.clip(pose), pose)
    error = np.linalg.norm(skeleton.joints(pose) - figure.skeleton.joints(figure.pose), axis=1)
    limit = 0.05 if stature_known else 0.035
    assert error.max() < limit and error.mean() < 0.7 * limit
    heading = (pose[3] - figure.pose[3] + np.pi) % (2 * np.pi) - np.pi
    assert abs(np.degrees(heading)) < 2


@pytest.mark.parametrize("raise_deg", [-10, 10])
@pytest.mark.parametrize("spread_deg", [8, 25])
def test_arms_and_legs_of_another_spread(raise_deg, spread_deg):
    """The captures' init pose: arms within 10° of level, legs spread."""
    t = np.radians(raise_deg)
    figure = Figure(yaw=0.4, arms=(0, np.cos(t), np.sin(t)), hip_l_yaw=spread_deg, hip_r_yaw=spread_deg)
    dimensions, pose = da_vinci_pose(figure.landmarks(), None, "z")
    error = np.linalg.norm(build_skeleton(dimensions).joints(pose) - figure.skeleton.joints(figure.pose), axis=1)
    assert error.max() < 0.08 and error.mean() < 0.05


def test_feet_tell_front_from_back_at_any_heading():
    """The arms' direction alone has two senses; each is found for its own heading."""
    for yaw in np.radians([0, 90, 180, 270]):
        left = Figure(yaw=yaw).landmarks().left
        np.testing.assert_allclose(left, [-np.sin(yaw), np.cos(yaw), 0], atol=0.04)


def test_a_phantom_beside_the_person_changes_nothing():
    figure = Figure(yaw=1.0)
    before = figure.landmarks()
    figure.occupancy[:3, :3, :8] = True
    after = figure.landmarks()
    np.testing.assert_allclose(after.left, before.left, atol=1e-12)
    np.testing.assert_allclose(after.hands, before.hands, atol=1e-12)


def test_largest_part_counts_faces_only():
    occupancy = np.zeros((6, 6, 6), bool)
    occupancy[1, 1, 1:5] = True
    occupancy[2, 2, 1:4] = True  # joined by an edge only
    part = largest_part(occupancy)
    assert part.sum() == 4 and part[1, 1, 1:5].all()
    np.testing.assert_array_equal(largest_part(part), part)
    assert not largest_part(np.zeros((3, 3, 3), bool)).any()


# What a user may get wrong


def message_of(figure):
    with pytest.raises(CaptureError) as raised:
        figure.landmarks()
    message = str(raised.value)
    assert "\n" not in message and "--init-pose FILE" in message and "capture.toml" in message
    return message


def test_an_empty_hull_is_named():
    figure = Figure()
    figure.occupancy[:] = False
    assert "the visual hull is empty (0 voxels)" in message_of(figure)


def test_arms_down_are_named():
    assert "no Da Vinci pose" in message_of(Figure(arms=(0.05, 0.25, -0.97)))


def test_closed_legs_are_named():
    assert "feet are not apart" in message_of(Figure(hip_l_yaw=-6.9, hip_r_yaw=-6.9))


def test_someone_sitting_with_arms_down_is_named():
    sitting = {f"hip_{s}_pitch": -90 for s in "lr"} | {f"knee_{s}_flexion": 90 for s in "lr"}
    assert message_of(Figure(arms=(0.05, 0.25, -0.97), **sitting))


@pytest.mark.parametrize(("scale", "tall"), [(0.3, "0.5"), (1000.0, "17")])
def test_a_calibration_in_other_units_is_named(scale, tall):
    figure = Figure()
    g = figure.grid
    figure.grid = VoxelGrid(tuple(scale * np.array(g.origin)), scale * g.voxel_m, g.shape)
    message = message_of(figure)
    assert "m tall" in message and "unit" in message and tall in message


def test_a_full_volume_is_named():
    grid = VoxelGrid.cover(Volume((0, 0, 1), (2.4, 2.4, 2.4)), 16)
    with pytest.raises(CaptureError, match=r"2\.40 m tall"):
        find_landmarks(np.ones(grid.shape, bool), grid)


# Poses written down by hand


@given(seeds)
@settings(max_examples=3, deadline=None)
def test_rough_pose_meets_the_joints(seed):
    """Of a body of average proportions in an everyday pose: all but the ends of the joints' ranges."""
    rng = np.random.default_rng(seed)
    skeleton = build_skeleton(BodyDimensions.from_stature(1.8))
    rest = neutral_pose(skeleton)
    for side in ("l", "r"):
        hanging = shoulder_angles(np.array([0.1, 0.3, -0.95]))
        rest[[skeleton.index(f"shoulder_{side}_{a}") for a in ("yaw", "pitch")]] = hanging
        rest[skeleton.index(f"elbow_{side}_flexion")] = 0.4
        rest[skeleton.index(f"knee_{side}_flexion")] = 0.3
    pose = skeleton.clip(rest + rng.normal(0, 0.12, len(rest)) * ~skeleton.prismatic)
    pose[:4] = [*rng.uniform(-1, 1, 3), rng.uniform(-np.pi, np.pi)]
    joints = dict(zip(JOINTS, skeleton.joints(pose), strict=True))
    dimensions, found = rough_pose(joints, {}, 1.8, "z")
    error = np.linalg.norm(build_skeleton(dimensions).joints(found) - skeleton.joints(pose), axis=1)
    assert error.max() < 0.04 and error.mean() < 0.02


def test_rough_pose_takes_the_stature_from_the_joints():
    skeleton = build_skeleton(BodyDimensions.from_stature(1.62))
    joints = dict(zip(JOINTS, skeleton.joints(neutral_pose(skeleton)), strict=True))
    limbs = {name: x for name, x in joints.items() if name not in ("head_top", "pelvis")}
    dimensions, _ = rough_pose(limbs, {}, None, "z")
    assert dimensions.thigh == pytest.approx(BodyDimensions.from_stature(1.62).thigh, rel=0.01)


def test_rough_pose_from_angles_is_clipped_and_otherwise_taken_as_written():
    angles = {"torso_x": 0.4, "torso_yaw": 1.0, "knee_l_flexion": 9.0}
    dimensions, pose = rough_pose({}, angles, 1.7, "-y")
    skeleton = build_skeleton(dimensions, "-y")
    assert pose[skeleton.index("torso_x")] == 0.4 and pose[skeleton.index("torso_yaw")] == 1.0
    k = skeleton.index("knee_l_flexion")
    assert pose[k] == skeleton.upper[k]
    assert dimensions == BodyDimensions.from_stature(1.7)


@pytest.mark.parametrize("of", [certainty, rough_certainty])
def test_certainty_is_positive_and_mirror_symmetric(of):
    skeleton = build_skeleton(BodyDimensions.from_stature(1.75))
    deviations = of(skeleton)
    assert deviations.shape == (24,) and (deviations > 0).all()
    for name, value in zip(skeleton.names, deviations, strict=True):
        if "_l_" in name:
            assert deviations[skeleton.index(name.replace("_l_", "_r_"))] == value


def test_limbs_turned_about_themselves_are_held():
    """What cannot be seen of a straight limb is believed more than what can."""
    skeleton = build_skeleton(BodyDimensions.from_stature(1.75))
    deviations = dict(zip(skeleton.names, initialisation.certainty(skeleton), strict=True))
    assert deviations["hip_l_roll"] < deviations["hip_l_pitch"]
    assert deviations["knee_l_flexion"] < deviations["hip_l_pitch"]
