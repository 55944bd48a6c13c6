"""Sources without a folder: frame sets that are rendered in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from tests.conftest import QUICK, Silent
from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, STATURE, walk
from tk.io import settings_file
from tk.io.captures.frames import FrameSet
from tk.io.results.reader import read_result
from tk.model.cameras.volume import Volume
from tk.model.masks.silhouettes import draw_silhouettes
from tk.model.setup import Setup, Subject
from tk.run.session import estimates, track_source
from tk.trackers.protocol import Observation, share

SETTINGS = settings_file.from_toml(QUICK)
RIG = ring_of_cameras(3, width=160, height=200)
POSES = walk(5)
SETUP = Setup(RIG, Volume((0.0, 0.0, 1.0), (3.0, 3.0, 2.2)), "z", 15.0, (Subject(STATURE, body=BODY),))
LATENCY_S = 0.25


@dataclass(frozen=True)
class Rendered:
    """A source of unknown length, as a live camera is; its clock does not start at 0."""

    poses: np.ndarray
    name = where = "rendered"
    first_frame = 0
    frame_count = None
    time_offset_s = (0.0,) * len(RIG)
    has_masks = True
    masks_from = "rendered"

    def frames(self, start: int = 0, stop: int | None = None) -> AbstractContextManager[Iterator[FrameSet]]:
        scene = np.random.default_rng(0).integers(0, 200, (len(RIG), *RIG.frame_shape, 3), np.uint8)
        sets = (
            FrameSet(i, LATENCY_S + i / SETUP.fps, np.maximum(scene, masks[..., None]), masks)
            for i, masks in enumerate(draw_silhouettes(BODY, RIG, self.poses))
        )
        return nullcontext(islice(sets, start, stop))

    def background(self) -> None:
        return None

    def shifted(self, time_offset_s: Sequence[float]) -> None:
        return None


def test_a_source_in_memory_is_tracked() -> None:
    found = list(estimates(SETUP, Rendered(POSES), SETTINGS, frames=(1, 4)))
    assert [e.frame for e in found] == [1, 2, 3]
    assert [e.time for e in found] == [LATENCY_S + i / SETUP.fps for i in (1, 2, 3)]  # the source's clock
    for estimate, pose in zip(found, POSES[1:], strict=False):
        assert np.linalg.norm(estimate.joints - BODY.skeleton.joints(pose), axis=1).mean() < 0.03


def test_a_source_of_unknown_length_is_written_until_it_ends(tmp_path: Path) -> None:
    summary = track_source(SETUP, Rendered(POSES), tmp_path / "r.h5", SETTINGS, Silent(), causal=True)
    result = read_result(tmp_path / "r.h5")
    assert summary.frames == len(result.frames) == len(POSES) and summary.lost == 0
    assert result.meta.capture == "rendered" and result.smoothed is not None
    np.testing.assert_allclose(result.time, LATENCY_S + np.arange(len(POSES)) / SETUP.fps)


def test_the_second_pass_needs_no_folder(tmp_path: Path) -> None:
    track_source(SETUP, Rendered(POSES), tmp_path / "r.h5", SETTINGS, Silent())
    result = read_result(tmp_path / "r.h5")
    expected = np.array([BODY.skeleton.joints(pose) for pose in POSES])
    assert np.linalg.norm(result.joints - expected, axis=2).mean() < 0.03


def test_pixels_of_another_subject_are_separated() -> None:
    own, other = np.zeros((2, 3, 4, 4), bool)
    own[:, :2], other[:, 1:3] = True, True
    masks = np.where(own | other, np.uint8(255), np.uint8(0))
    frame = Observation(0, np.zeros((3, 4, 4, 3), np.uint8), masks)
    assert share(frame, [None]) == [frame]
    first, second = share(frame, [own, other])
    assert first.others is not None and second.others is not None
    np.testing.assert_array_equal(first.others, other & ~own)
    np.testing.assert_array_equal(first.masks > 0, own)
    np.testing.assert_array_equal(second.masks > 0, other)


def test_a_session_of_two_subjects_returns_the_first() -> None:
    """Both trackers begin at the same person, so each tracks what the other one covers in the frame before."""
    found = list(estimates(replace(SETUP, subjects=2 * SETUP.subjects), Rendered(POSES), SETTINGS, frames=(0, 3)))
    assert [e.frame for e in found] == [0, 1, 2] and all(np.isfinite(e.joints).all() for e in found)
