"""The volumetric tracker: what tests/test_session.py and test_region_track.py do not see from outside."""

from dataclasses import replace

import numpy as np

from tests.model.figures import draw_silhouettes
from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, STATURE, errors, observe, walk
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.volume import Volume
from tk.model.setup import Subject
from tk.settings import Settings, VolumetricSettings
from tk.trackers.volumetric import VolumetricTracker


def test_limb_search_recovers_most_displaced_arms() -> None:
    """Arms that are raised, level and somewhat forward; and hanging, the forearm folded up against the upper arm."""
    rig = ring_of_cameras(4, width=240, height=300)
    pose = walk(1)[0]
    masks = draw_silhouettes(BODY, rig, pose[None])[0]
    images = np.full((*masks.shape, 3), 90, np.uint8)
    config = Settings(voxels=48, volumetric=VolumetricSettings(edge_weight=0.0))  # one colour has no edges
    tracker = VolumetricTracker(rig, Volume((0, 0, 1), (2, 2, 2.2)), "z", config)
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
