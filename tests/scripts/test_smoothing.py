"""The script on a small result: what it prints, and that noise it is given comes out."""

from __future__ import annotations

import numpy as np
import pytest

from scripts.smoothing import bridging_cm, errors, main
from tests.export.conftest import FRAMES, Write, write

__all__ = ["write"]  # the fixture


def test_smoothing_is_compared_with_the_ground_truth(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    result = write("result.h5", lost=np.zeros(FRAMES, np.uint8))
    main([str(result), str(write("truth.h5")), "--gaps", "2"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:2] == ["tracked", "0.00"] and lines[2].startswith("smoothed")
    assert lines[3].startswith("gaps of 2 frames: bridged ")
    assert 0 < bridging_cm(result, 2) < 3


def test_errors_match_their_definition() -> None:
    true = np.zeros((5, 15, 3))
    joints = np.add(true, [0.03, 0.0, 0.04])
    found = errors(joints, true, 10.0)
    assert found.distance_cm == pytest.approx(5) and found.less_offset_cm == pytest.approx(0)
    moving = true + np.arange(5)[:, None, None] * [0.01, 0.0, 0.0]
    assert errors(moving, true, 10.0).velocity_m_s == pytest.approx(0.1)
    assert errors(moving, true, 10.0).acceleration_m_s2 == pytest.approx(0)
