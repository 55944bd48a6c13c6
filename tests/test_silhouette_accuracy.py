"""Accuracy of the silhouette tracker on whole captures. Slow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scripts.silhouette_tables import CAMERAS, OURS, load, track
from tests.conftest import development_capture
from tests.conftest import track as track_capture
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_joints
from tk.settings import Settings

pytestmark = pytest.mark.slow


def test_four_views_of_the_treadmill_are_as_accurate_as_the_paper() -> None:
    data = load(development_capture("treadmill-slow"), CAMERAS, 340)
    row, _ = track(data, "tk", 4, OURS)
    assert row.ankle_share <= 2.0 and row.joints_cm <= 4.0 and row.swaps == 0
    assert row.error_share <= 12.0


@pytest.mark.parametrize(("name", "most_cm"), [("walk", 3.0), ("dance", 6.0)])
def test_silhouette_tracker_on_masks_from_the_video(name: str, most_cm: float, tmp_path: Path) -> None:
    folder = development_capture(name)
    capture = open_capture(folder, masks="none")
    summary = track_capture(capture, tmp_path / "r.h5", Settings(), method="silhouette")
    truth = read_joints(folder / "truth.h5")
    found = read_joints(tmp_path / "r.h5")
    assert summary.lost == 0
    assert 100 * np.linalg.norm(found.positions - truth.positions, axis=2).mean() <= most_cm
