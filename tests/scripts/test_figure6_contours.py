"""The figure of the contours: all of it on the made-up pose, its refusals."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from scripts.figure6_contours import SCALE, VISIBLE, main


def test_figure_shows_visible_and_occluded_contours(tmp_path: Path) -> None:
    out = tmp_path / "figures" / "figure6.png"
    main(["-o", str(out)])
    sheet = cv2.imread(str(out))
    assert sheet is not None and sheet.shape == (480 * SCALE, 4 * 640 * SCALE, 3)
    for panel in np.split(sheet, 4, axis=1)[:3]:
        assert (panel == VISIBLE).all(axis=2).sum() > 1000
        assert (panel[..., 2].astype(int) > panel[..., 1] + 30).any(), "thin red lines"
    assert not (np.split(sheet, 4, axis=1)[3] == VISIBLE).all(axis=2).any(), "the strips have a panel of their own"


def test_capture_without_result_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["-o", str(tmp_path / "a.png"), "--capture", str(tmp_path)])
    assert "go together" in capsys.readouterr().err


def test_unsuitable_capture_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="nowhere"):
        main(["-o", str(tmp_path / "a.png"), "--capture", str(tmp_path / "nowhere"), "--result", "none.h5"])
