"""The silhouette tracker on silhouettes of its own body, drawn by ray casting."""

import numpy as np
import pytest

from tests.model.figures import draw_silhouettes, scaled
from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, NAMES, STATURE, errors, find_again_elsewhere, observe, walk
from tk.model.body.cone_body import build_cone_body
from tk.model.setup import InitPose, Subject
from tk.settings import SilhouetteSettings
from tk.trackers.silhouette import SilhouetteTracker

RIG = ring_of_cameras(3, width=240, height=300)
# A pixel is 1 cm wide at the subject; a joint rests on dozens of edgels in three views.
CLOSE_M = 0.015


POSES = walk(6)
MASKS = draw_silhouettes(BODY, RIG, POSES)


def init_of(pose) -> InitPose:
    return InitPose({}, dict(zip(NAMES, pose, strict=True)), None, STATURE)


def tracker_at(pose, **settings) -> SilhouetteTracker:
    """A tracker of the true body that starts near a pose."""
    tracker = SilhouetteTracker(RIG, "z", SilhouetteSettings(adapt=False, **settings))
    init = init_of(pose)
    tracker.start([observe(MASKS[0])], Subject(init=init))
    return tracker


def test_a_disturbed_pose_converges_to_the_true_one():
    rng = np.random.default_rng(2)
    disturbed = POSES[0] + np.where(np.arange(len(NAMES)) < 3, 0.03, 0.07) * rng.choice([-1, 1], len(NAMES))
    tracker = tracker_at(disturbed)
    before = np.linalg.norm(BODY.skeleton.joints(disturbed) - BODY.skeleton.joints(POSES[0]), axis=1)
    estimate = tracker.step(observe(MASKS[0]))
    assert before.mean() > 0.05
    assert errors(estimate, POSES[0]).mean() < CLOSE_M
    assert estimate.status == "initialised" and estimate.objective < 0.1
    assert set(estimate.timing) == set(tracker.timing_stages)
    assert len(tracker.stages) == 3 and estimate.iterations[0] == 3  # far from there all iterations are made
    assert (estimate.iterations <= [3, 3, 4]).all()


def test_a_walk_is_tracked_and_resumed_bit_for_bit():
    tracker = tracker_at(POSES[0])
    estimates = []
    for i, masks in enumerate(MASKS):
        estimates.append(tracker.step(observe(masks, i)))
        if i == 2:
            model, state = dict(tracker.model()), tracker.state
    assert [e.status for e in estimates] == ["initialised"] + ["tracked"] * 5
    assert max(errors(e, p).mean() for e, p in zip(estimates, POSES, strict=True)) < CLOSE_M
    second = SilhouetteTracker(RIG, "z", tracker.settings)
    second.take_model(model)
    second.state = state
    for i in range(3, 6):
        np.testing.assert_array_equal(second.step(observe(MASKS[i], i)).pose, estimates[i].pose)


def test_start_adapts_the_body_dimensions():
    thick = scaled(BODY.dimensions, thigh_radius=1.25, head_radius=1.15)
    masks = draw_silhouettes(build_cone_body(thick), RIG, POSES[:3])
    tracker = SilhouetteTracker(RIG, "z", SilhouetteSettings())
    init = init_of(POSES[0])
    tracker.start([observe(m, i) for i, m in enumerate(masks)], Subject(init=init))
    found = tracker.body.dimensions
    # what is known of bodies holds radii back a little: three frames, edgels that are taken to err by 3 px
    for name in ("thigh_radius", "head_radius"):
        true, average = getattr(thick, name), getattr(BODY.dimensions, name)
        assert 0.5 < (getattr(found, name) - average) / (true - average) < 1.2, name
    assert found.stature == pytest.approx(STATURE, rel=0.02)


def test_empty_masks_are_a_lost_frame_and_the_next_frame_is_recovered():
    tracker = tracker_at(POSES[0])
    first = tracker.step(observe(MASKS[0]))
    lost = tracker.step(observe(np.zeros_like(MASKS[0]), 1))
    assert lost.status == "lost" and np.isinf(lost.objective)
    assert np.isfinite(lost.pose).all() and np.abs(lost.pose - first.pose).max() < 0.1
    assert tracker.step(observe(MASKS[1], 2)).status == "recovered"
    assert tracker.step(observe(MASKS[2], 3)).status == "tracked"


def test_a_person_who_returns_at_another_place_is_found():
    find_again_elsewhere(tracker_at(POSES[0]), RIG, POSES[:3], 2 * CLOSE_M)


def test_a_tracker_that_was_not_started_says_so():
    with pytest.raises(RuntimeError, match="no body yet"):
        SilhouetteTracker(RIG, "z").step(observe(MASKS[0]))
