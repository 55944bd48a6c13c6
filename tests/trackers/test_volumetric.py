"""The volumetric tracker: what tests/test_session.py and test_region_track.py do not see from outside."""

from dataclasses import replace

import numpy as np
import pytest

from tests.model.figures import draw_silhouettes
from tests.model.landmarks import landmarks_of
from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, NAMES, STATURE, errors, observe, walk
from tk.model.body.gait_poses import standing_pose
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume
from tk.model.setup import Subject
from tk.settings import Settings, VolumetricSettings
from tk.trackers.reason import Reason
from tk.trackers.volumetric import VolumetricTracker

RIG = ring_of_cameras(4, width=240, height=300)
VOLUME = Volume((0, 0, 1), (2, 2, 2.2))
CONFIG = Settings(voxels=48, volumetric=VolumetricSettings(edge_weight=0.0))  # one colour has no edges


def grey(rig: Rig) -> np.ndarray:
    """Images (C, H, W, 3) of one colour."""
    return np.full((len(rig), *rig.frame_shape, 3), 90, np.uint8)


@pytest.mark.parametrize("asked", [False, True])
def test_start_takes_the_heading_of_the_landmarks(asked: bool) -> None:
    """Of a person whose masks show both headings; the network has seen the frame, or is asked."""
    both = np.stack([standing_pose(BODY.skeleton)] * 2)
    both[:, :3] = [0.05, -0.04, 0.93]
    both[:, NAMES.index("torso_yaw")] = 0.6, 0.6 + np.pi
    masks, pose = draw_silhouettes(BODY, RIG, both).max(axis=0), both[1]  # by the masks alone it is the first one
    seen = landmarks_of(RIG, BODY, pose, 0.03)
    frame = observe(masks, 0, grey(RIG))
    frame = replace(frame, ask=lambda _: seen) if asked else replace(frame, landmarks=seen[None])
    tracker = VolumetricTracker(RIG, VOLUME, "z", CONFIG)
    tracker.start([frame], Subject(STATURE, body=BODY))
    heading = tracker.state.pose[tracker.skin.skeleton.index("torso_yaw")]
    assert np.cos(heading - pose[NAMES.index("torso_yaw")]) > 0.9


def test_an_empty_mask_excludes_its_camera_only() -> None:
    """A frame is lost with fewer than two cameras, and where masks exclude each other, each with its own reason."""
    poses = walk(2)
    masks, images = draw_silhouettes(BODY, RIG, poses), grey(RIG)
    tracker = VolumetricTracker(RIG, VOLUME, "z", CONFIG)
    tracker.start([observe(m, i, images) for i, m in enumerate(masks)], Subject(STATURE, body=BODY))
    state, found = tracker.state, {}
    contradicting = masks[1].copy()
    contradicting[::2, : RIG.frame_shape[0] // 2], contradicting[1::2, RIG.frame_shape[0] // 2 :] = 0, 0
    for name, empty in (("all", []), ("three", [3]), ("one", [0, 1, 3]), ("contradicting", [])):
        shown = (contradicting if name == "contradicting" else masks[1]).copy()
        shown[empty] = 0
        tracker.state = state
        found[name] = tracker.step(observe(shown, 1, images))
    assert [e.found for e in found.values()] == [Reason.NONE, Reason.NONE, Reason.NOBODY, Reason.UNEXPLAINED]
    assert errors(found["three"], poses[1]).mean() < errors(found["all"], poses[1]).mean() + 0.02
    np.testing.assert_array_equal(found["one"].pose, state.pose)


def test_limb_search_recovers_most_displaced_arms() -> None:
    """Arms that are raised, level and somewhat forward; and hanging, the forearm folded up against the upper arm."""
    pose, images = walk(1)[0], grey(RIG)
    masks = draw_silhouettes(BODY, RIG, pose[None])[0]
    tracker = VolumetricTracker(RIG, VOLUME, "z", CONFIG)
    tracker.start([observe(masks, 0, images)], Subject(STATURE, body=BODY))
    model, state = dict(tracker.model()), tracker.state
    due, recovered = tracker._finder.search_frames, []
    for side in "lr":
        for angles in ((0.0, 1.5, 0.0, 0.0), (1.5, 0.0, 0.0, 2.3)):
            wrong = state.pose.copy()
            names = ("shoulder_{}_yaw", "shoulder_{}_pitch", "shoulder_{}_roll", "elbow_{}_flexion")
            wrong[[tracker.skin.skeleton.index(name.format(side)) for name in names]] = angles
            off = {}
            for index in (due, due + 1):
                tracker.take_model(model)
                tracker.state = replace(state, pose=wrong, previous=wrong)
                error = errors(tracker.step(observe(masks, index, images)), pose)
                off[index] = error[JOINTS.index("wrist_" + side)]
            if off[due + 1] > 0.4:  # a descent alone does not come back
                recovered.append(off[due] < 0.05)
    assert len(recovered) >= 3 and sum(recovered) >= len(recovered) - 1
