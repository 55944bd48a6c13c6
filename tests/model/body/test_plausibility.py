"""Sizes that cannot be a person's."""

from __future__ import annotations

import re

import pytest

from tk.errors import CaptureError
from tk.model.body.plausibility import check_extent, check_stature, height_contradiction


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


def test_a_fitted_body_may_contradict_a_given_height() -> None:
    for fitted in (1.70, 1.75, 1.80):
        assert height_contradiction(fitted, 1.75) == ""
    for fitted, which in ((1.64, "less"), (1.87, "more")):
        assert re.search(rf"1\.\d\d m or {which}, .* capture.toml says 1.75 m", height_contradiction(fitted, 1.75))
