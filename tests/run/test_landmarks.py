"""Landmarks of a network in a run: in the result, and after a run is taken up again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Silent, StopAt
from tests.model.landmarks import landmarks_of
from tests.run.test_source import BODY, ONE, POSES, RIG, SETTINGS, SETUP, first_pose
from tk.io.captures.frames import FrameSet
from tk.io.results.reader import read_result
from tk.model.body.body_points import LANDMARKS
from tk.run.learned_masks import LEARNED, SEGMENTER
from tk.run.offline import REFINED
from tk.run.segmentation import Labels
from tk.run.session import track_task
from tk.run.task import Task, TrackOptions

POSED = replace(SETUP, subjects=(replace(SETUP.subjects[0], init=first_pose(POSES[0])),))
ASKED = range(0, len(POSES), 2)  # frames that the network sees


def seen(frame: int) -> np.ndarray:
    return landmarks_of(RIG, BODY, POSES[frame], 0.02, seed=frame)


@pytest.fixture(autouse=True)
def network(monkeypatch: pytest.MonkeyPatch) -> None:
    """The source's own masks, as if a network had made them, and the landmarks that it saw in some frames."""

    def make(*_: object) -> Callable[[FrameSet], Labels]:
        def label(frame: FrameSet) -> Labels:
            asked = frame.index in ASKED
            sources = np.full(len(RIG), SEGMENTER if asked else LEARNED, np.uint8)
            assert frame.masks is not None
            return Labels(frame.masks, None, sources, seen(frame.index)[None] if asked else None)

        return label

    monkeypatch.setattr("tk.run.prefetch.make_labeller", make)
    for module in ("plan", "segmentation"):
        monkeypatch.setattr(f"tk.run.{module}.sources_of_masks", lambda _: ("learned", "both", "segmenter"))


def test_result_has_the_landmarks_that_were_seen_and_a_resumed_run_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    """The second pass goes over frames of both runs."""
    whole, stopped = tmp_path / "whole.h5", tmp_path / "stopped.h5"
    options = TrackOptions(replace(SETTINGS, landmarks="auto"))
    track_task(Task(POSED, ONE, options), whole, Silent())
    assert track_task(Task(POSED, ONE, options), stopped, StopAt(2)).interrupted
    assert REFINED not in read_result(stopped).model
    assert not track_task(Task(POSED, ONE, options), stopped, Silent(), resume=True).interrupted
    result, found = read_result(whole), read_result(stopped)
    assert result.model[REFINED] == found.model[REFINED] == 1
    assert result.meta.landmark_names == LANDMARKS
    assert result.landmarks is not None and result.landmarks.shape == (len(POSES), len(RIG), len(LANDMARKS), 3)
    for frame, stored in zip(result.frames.tolist(), result.landmarks, strict=True):
        expected = seen(frame) if frame in ASKED else np.full(stored.shape, np.nan)
        np.testing.assert_array_equal(stored, expected[..., :3].astype(np.float32))
    for name in ("frames", "landmarks", "pose", "joints", "sigma", "status"):
        np.testing.assert_array_equal(getattr(found, name), getattr(result, name), err_msg=name)
    joints = np.array([BODY.skeleton.joints(pose) for pose in POSES])
    assert np.linalg.norm(result.joints - joints, axis=2).mean() < 0.03
    assert np.isfinite(result.angles["neck"]).all()
    assert not any(joint.unmeasured for joint in result.meta.angles)
