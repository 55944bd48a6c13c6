"""A body's objective in one frame: samples, voxels, terms, and what is kept from call to call."""

import numpy as np
import pytest

from tests.model.figures import DIMENSIONS, grid_around, skin_of, surface_index, voxelise
from tk.kernels.nearest import SurfaceIndex
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.joints import CHAIN_OF_SEGMENT, CHAINS, JOINTS
from tk.model.cues.objective import CHAIN_NAMES, SIGMA_M, BodyObjective, FrameObjective, even, pick
from tk.settings import VolumetricSettings

BODY = skin_of(DIMENSIONS)
SKELETON = BODY.skeleton
D = len(SKELETON.names)
BOTH, SURFACE = VolumetricSettings.coverage_weight, 0.0
ALL_CHAINS = np.arange(len(CHAINS))


@pytest.fixture(scope="module")
def objective():
    return BodyObjective(BODY, BOTH)


@pytest.fixture(scope="module")
def truth():
    pose = neutral_pose(SKELETON)
    pose[:4] = 0.2, 0.1, 0.95, 0.5
    return pose


@pytest.fixture(scope="module")
def index(truth):
    grid = grid_around(BODY, truth, 0.03)
    return surface_index(voxelise(BODY, truth, grid), grid)


@pytest.fixture
def frame(objective, index):
    return FrameObjective(objective, index, np.random.default_rng(0))


# Samples


@pytest.mark.parametrize("scale", [1, 2])
def test_draw_has_the_proportions_of_section_6_4(scale):
    samples = BodyObjective(BODY, BOTH, scale=scale).draw(np.random.default_rng(0))
    assert len(set(samples)) == len(samples)
    chain = CHAIN_OF_SEGMENT[BODY.segment[samples]]
    counts = [np.sum(chain == c) for c in (-1, *range(5))]
    assert counts == [60 * scale] + [20 * scale] * 5


def test_all_samples_are_drawn_in_many_iterations(objective):
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(400):
        seen |= set(objective.draw(rng).tolist())
    assert len(seen) > 0.99 * len(BODY.points)


def test_spread_is_even_and_always_the_same(objective):
    samples = objective.spread()
    np.testing.assert_array_equal(samples, objective.spread())
    assert len(set(samples)) == len(samples)
    # every piece that has samples worth the name has some among them
    counts = np.bincount(BODY.piece, minlength=len(BODY.pieces))
    assert set(np.flatnonzero(counts > 30)) <= set(BODY.piece[samples])


@pytest.mark.parametrize("count", [1, 7, 10, 50])
def test_pick_and_even(count):
    samples = np.arange(100, 110, dtype=np.int32)
    for chosen in (pick(np.random.default_rng(0), samples, count), even(samples, count)):
        assert len(chosen) == min(count, 10) == len(set(chosen)) and set(chosen) <= set(samples)


# All degrees of freedom


def test_same_iteration_same_samples_in_all_rows(frame, truth):
    evaluate = frame.full()
    poses = np.repeat(truth[None] + 0.02, 3, 0)
    first, again, next_one = (evaluate(poses, np.ones((3, D)), i) for i in (0, 0, 1))
    np.testing.assert_array_equal(first.value, again.value)
    np.testing.assert_array_equal(first.gradient, again.gradient)
    assert not np.array_equal(first.gradient, next_one.gradient)
    assert np.ptp(first.value) == 0 and np.ptp(first.gradient, axis=0).max() == 0
    assert first.value.shape == (3,) and first.gradient.shape == first.hessian_vector.shape == (3, D)


def test_gradient_descends_towards_the_true_pose(frame, truth):
    """On average over draws, −∇f of a displaced body points towards its place, along each axis."""
    evaluate = frame.full()
    for axis in range(3):
        for sign in (-1, 1):
            pose = truth.copy()
            pose[axis] += sign * 0.05
            mean = np.mean([evaluate(pose[None], np.zeros((1, D)), i).gradient[0] for i in range(10)], axis=0)
            assert sign * mean[axis] > 0


# How well a pose explains a frame


def test_value_is_least_at_the_truth(frame, truth):
    best = frame.value(truth)
    rng = np.random.default_rng(3)
    for _ in range(15):
        assert frame.value(truth + rng.normal(0, 0.1, D)) > best
    assert frame.value(truth + 0.3 * np.eye(D)[0]) > 5 * best


def test_fit_at_the_truth_explains_all_voxels(frame, truth):
    fit = frame.fit(truth)
    assert fit.unmatched.mean() < 0.01 and fit.beyond(SIGMA_M).mean() < 0.01
    samples, voxels, _ = frame.even
    assert len(fit.unmatched) == len(samples) and len(fit.beyond(0.1)) == len(voxels)
    assert len(set(voxels)) == len(voxels) >= 600


def test_a_displaced_arm_is_unsupported_and_its_voxels_unexplained(frame, truth):
    """The left arm hangs in the model and is level in the data."""
    pose = truth.copy()
    pose[SKELETON.index("shoulder_l_pitch")] -= np.radians(60)
    fit = frame.fit(pose)
    chain = CHAIN_OF_SEGMENT[BODY.segment[frame.even[0]]]
    left = CHAIN_NAMES.index("arm_l")
    assert fit.unmatched[chain == left].mean() > 0.5 and fit.unmatched[chain != left].mean() < 0.02
    # the voxels that are left over are the real arm's: to the left of the body
    x = frame.index.positions[frame.even[1][fit.beyond(SIGMA_M)]] - SKELETON.joints(truth)[0]
    yaw = truth[3]
    assert fit.beyond(SIGMA_M).mean() > 0.02 and (x @ [-np.sin(yaw), np.cos(yaw), 0] > 0.1).all()


def test_damping_is_what_inliers_would_give(frame, truth):
    """Near the truth the translations' curvature approaches it."""
    damping = frame.damping(0.3)
    assert damping.shape == (D,) and (damping > 0).all()
    np.testing.assert_allclose(damping[3:], damping[0] * 0.09)
    assert 0.7 * damping[0] < frame.curvature(truth)[0, 0] < 1.05 * damping[0]


# Chains


def test_samples_of_a_chain_have_gradients_for_it_and_the_torso_only(index, truth):
    frame = FrameObjective(BodyObjective(BODY, SURFACE), index, np.random.default_rng(0))
    result = frame.chains(ALL_CHAINS, truth)(np.repeat(truth[None], 5, 0) + 0.03, np.zeros((5, D)), 0)
    torso = ~frame.free.any(axis=0)
    for c in ALL_CHAINS:
        assert (np.abs(result.gradient[c][frame.free[c] | torso]) > 1e-6).all()
        np.testing.assert_array_equal(result.gradient[c][~frame.free[c] & ~torso], 0)


def test_rows_of_a_chain_share_its_samples(frame, truth):
    owner = np.array([2, 0, 2])
    evaluate = frame.chains(owner, truth)
    result = evaluate(np.repeat(truth[None] + 0.02, 3, 0), np.zeros((3, D)), 0)
    np.testing.assert_array_equal(result.gradient[0], result.gradient[2])
    assert not np.array_equal(result.gradient[0], result.gradient[1])


@pytest.mark.parametrize("coverage", [BOTH, SURFACE])
def test_curvature_of_a_chain_is_that_of_its_own_objective(index, truth, coverage):
    """The mean over draws of its Gauss-Newton products. A chain is a fraction of the whole body's mean."""
    frame = FrameObjective(BodyObjective(BODY, coverage), index, np.random.default_rng(0))
    hessians = frame.chain_curvatures(truth)
    for c in ALL_CHAINS:
        free = np.flatnonzero(frame.free[c])
        evaluate = frame.chains(np.full(len(free), c), truth)
        rows = np.repeat(truth[None], len(free), 0), np.eye(D)[free]
        drawn = np.mean([evaluate(*rows, i).hessian_vector[:, free] for i in range(30)], axis=0)
        damping = np.diag(frame.damping(0.045)[free])
        ratio = np.linalg.eigvals(np.linalg.solve(hessians[c][np.ix_(free, free)] + damping, drawn + damping)).real
        assert 0.6 < ratio.min() <= ratio.max() < 1.6, (CHAIN_NAMES[c], ratio)


def test_every_chain_may_cover_the_voxels_that_the_body_does_not_explain(frame, truth):
    pose = truth.copy()
    pose[SKELETON.index("hip_l_pitch")] -= np.radians(80)
    voxels = frame.even[1]
    nobody = set(voxels[frame.fit(pose).beyond(SIGMA_M)])
    assert nobody
    pools = frame.chain_voxels(pose)
    draws = [frame.draw_chains(pools)[1] for _ in range(300)]
    for chain in range(len(CHAINS)):
        assert nobody <= {*np.ravel([drawn[chain] for drawn in draws])} <= {*voxels}


# Settings


def test_without_coverage_no_voxel_counts(index, truth):
    frame = FrameObjective(BodyObjective(BODY, SURFACE), index, np.random.default_rng(0))
    fit = frame.fit(truth)
    assert len(fit.linear.residual) == len(frame.even[0]) and fit.value < 0.1
    result = frame.chains(ALL_CHAINS, truth)(np.repeat(truth[None], 5, 0), np.zeros((5, D)), 0)
    assert np.isfinite(result.value).all()


@pytest.mark.parametrize("points", [(1, 1, 5), (5000, 500, 3000)])
def test_few_and_more_points_than_there_are(index, truth, monkeypatch, points):
    for name, count in zip(("TORSO_SAMPLES", "CHAIN_SAMPLES", "COVERAGE_VOXELS"), points, strict=True):
        monkeypatch.setattr(f"tk.model.cues.objective.{name}", count)
    frame = FrameObjective(BodyObjective(BODY, BOTH), index, np.random.default_rng(0))
    poses = np.repeat(truth[None], 5, 0)
    for evaluate in (frame.full(), frame.chains(ALL_CHAINS, truth)):
        result = evaluate(poses, np.zeros((5, D)), 0)
        assert np.isfinite(result.value).all() and np.isfinite(result.gradient).all()


def test_a_frame_of_one_voxel(objective, truth):
    """A hull that is all but lost must not end the run."""
    index = SurfaceIndex.build(truth[None, :3], np.full(1, -1), 0.06)
    frame = FrameObjective(objective, index, np.random.default_rng(0))
    assert np.isfinite(frame.value(truth)) and np.isfinite(frame.curvature(truth)).all()
    assert np.isfinite(frame.chain_curvatures(truth)).all()
    result = frame.chains(ALL_CHAINS, truth)(np.repeat(truth[None], 5, 0), np.zeros((5, D)), 0)
    assert np.isfinite(result.value).all()


def test_a_leg_inside_the_other_finds_no_voxel(frame, truth):
    """Two limbs cannot be in one place. Where the legs cross, the right one's samples are unmatched.""" ""
    folded = truth.copy()
    knee_l = SKELETON.joints(truth)[JOINTS.index("knee_l")]

    def miss(yaw):
        folded[SKELETON.index("hip_r_yaw")] = yaw
        return np.linalg.norm(SKELETON.joints(folded)[JOINTS.index("knee_r")] - knee_l)

    folded[SKELETON.index("hip_r_yaw")] = min(np.linspace(-1, 0.5, 200), key=miss)
    leg = CHAIN_OF_SEGMENT[BODY.segment] == CHAIN_NAMES.index("leg_r")

    def unmatched(problem, pose):
        fit = problem.fit(pose)
        return (fit.linear.partner[: len(problem.even[0])][leg[problem.even[0]]] < 0).mean()

    assert unmatched(frame, truth) == 0
    assert unmatched(frame, folded) > 0.1
