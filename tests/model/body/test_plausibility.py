"""Sizes that cannot be a person's."""

from __future__ import annotations

import pytest

from tk.errors import CaptureError
from tk.model.body.plausibility import check_extent, check_stature


def test_impossible_sizes_are_refused() -> None:
    for stature in (1.05, 1.5, 2.2):
        check_stature(stature)
    for stature in (0.9, 2.4):
        with pytest.raises(CaptureError, match=r"measures .* scale of calibration.toml .* \[subject\] height"):
            check_stature(stature)
    for extent in (1.1, 1.75, 2.4, float("nan")):
        check_extent(extent, 1.75)
    for extent in (0.9, 3.0):
        with pytest.raises(CaptureError, match=r"measures .* capture.toml says 1.75 m"):
            check_extent(extent, 1.75)
