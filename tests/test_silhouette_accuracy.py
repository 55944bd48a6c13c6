"""The silhouette tracker on whole captures. Slow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scripts.silhouette_tables import CAMERAS, OURS, load, track
from tests.conftest import Silent
from tk.io.captures.capture import open_capture
from tk.io.results.writer import read_joints
from tk.run.session import track as track_capture
from tk.settings import Settings

CAPTURES = Path(__file__).resolve().parents[2] / "shared" / "captures"
TREADMILL = CAPTURES / "treadmill-slow"

pytestmark = pytest.mark.slow


@pytest.mark.skipif(not TREADMILL.is_dir(), reason=f"no {TREADMILL.name} among the shared captures")
def test_treadmill_with_four_views() -> None:
    data = load(TREADMILL, CAMERAS, 340)
    row, _ = track(data, "tk", 4, OURS)
    assert row.ankle_share <= 2.0 and row.joints_cm <= 4.0 and row.swaps == 0
    assert row.error_share <= 12.0


@pytest.mark.parametrize(("name", "most_cm"), [("walk", 3.0), ("dance", 6.0)])
def test_masks_from_the_video(name: str, most_cm: float, tmp_path: Path) -> None:
    if not (CAPTURES / name).is_dir():
        pytest.skip(f"no {name} among the shared captures")
    capture = open_capture(CAPTURES / name, masks="none")
    summary = track_capture(capture, tmp_path / "r.h5", Settings(), Silent(), method="silhouette")
    truth = read_joints(CAPTURES / name / "truth.h5")
    found = read_joints(tmp_path / "r.h5")
    assert summary.lost == 0
    assert 100 * np.linalg.norm(found.positions - truth.positions, axis=2).mean() <= most_cm
