"""The volumetric tracker: what tests/test_session.py and test_region_track.py do not see from outside."""

from dataclasses import replace

import numpy as np
import pytest

from tests.model.figures import draw_silhouettes
from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, STATURE, errors, observe, walk
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.volume import Volume
from tk.model.setup import Subject
from tk.settings import Settings, VolumetricSettings
from tk.trackers.volumetric import VolumetricTracker


# level, somewhat forward; hanging, with the forearm folded up against the upper arm
@pytest.mark.parametrize("angles", [(0.0, 1.5, 0.0, 0.0), (1.5, 0.0, 0.0, 2.3)], ids=["raised", "folded"])
def test_limb_search_recovers_a_displaced_arm(angles: tuple[float, ...]) -> None:
    rig = ring_of_cameras(4, width=240, height=300)
    pose = walk(1)[0]
    masks = draw_silhouettes(BODY, rig, pose[None])[0]
    images = np.full((*masks.shape, 3), 90, np.uint8)
    config = Settings(voxels=48, volumetric=VolumetricSettings(edge_weight=0.0))  # one colour has no edges
    tracker = VolumetricTracker(rig, Volume((0, 0, 1), (2, 2, 2.2)), "z", config)
    tracker.start([observe(masks, 0, images)], Subject(STATURE, body=BODY))
    model, state = dict(tracker.model()), tracker.state
    wrong = state.pose.copy()
    names = ("shoulder_l_yaw", "shoulder_l_pitch", "shoulder_l_roll", "elbow_l_flexion")
    wrong[[tracker.skin.skeleton.index(name) for name in names]] = angles
    off = {}
    due = tracker._finder.search_frames
    for index in (due, due + 1):
        tracker.take_model(model)
        tracker.state = replace(state, pose=wrong, previous=wrong)
        off[index] = errors(tracker.step(observe(masks, index, images)), pose)[JOINTS.index("wrist_l")]
    assert off[due + 1] > 0.4  # a descent alone does not come back
    assert off[due] < 0.05
