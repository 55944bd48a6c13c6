"""The volumetric tracker's start: what tests/test_session.py and test_region_track.py do not see from outside."""

import pytest

from tests.model.ring import ring_of_cameras
from tk.config import Config
from tk.errors import ConfigError
from tk.model.anthropometry import BodyDimensions
from tk.model.cone_body import build_cone_body
from tk.model.volume import Volume
from tk.trackers.volumetric import VolumetricTracker


def test_a_body_without_hands_and_feet_is_refused() -> None:
    rig = ring_of_cameras(2, width=48, height=60)
    tracker = VolumetricTracker(rig, Volume((0, 0, 1), (2, 2, 2)), "z", Config(voxels=16))
    walker = build_cone_body(BodyDimensions.from_stature(1.7), preset="walker")
    with pytest.raises(ConfigError, match=r'the body given is "walker": --method volumetric needs a full one'):
        tracker.start([], None, None, walker)
