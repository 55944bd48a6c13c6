"""The experiment of figure 4 at a small size: what it counts, on a made picture, and one run on a shared capture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scripts.figure4_edges import (
    RECALLS,
    Curve,
    Detector,
    describe,
    detectors,
    grey_canny,
    main,
    measure,
    rgb_edges,
    run,
)
from scripts.paper.edge_maps import HIGH
from tests.conftest import development_capture


def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A red person (h, w, 3) on a grey floor with a hard shadow to the right of them; the empty floor; the mask."""
    plate = np.full((120, 160, 3), 200, np.uint8)
    image, mask = plate.copy(), np.zeros((120, 160), np.uint8)
    image[30:90, 90:130] = 130  # the shadow
    mask[20:100, 40:80] = 255
    image[mask > 0] = (60, 70, 210)
    image[40:80, 45:60] = (45, 52, 158)  # shading on the shirt
    return cv2.GaussianBlur(image, (0, 0), 0.7), plate, mask


def test_image_is_split_into_outline_shadow_and_clothes() -> None:
    picture = describe(*scene())
    y, x = np.nonzero(picture.outline)
    assert len(y) == 2 * (80 + 40) - 4
    assert set(zip((y.min(), y.max(), x.min(), x.max()), (20, 99, 40, 79), strict=True)) == {
        (20, 20), (99, 99), (40, 40), (79, 79),
    }  # fmt: skip
    assert picture.shadow[35:85, 95:125].all() and not picture.shadow[:, :30].any()
    assert picture.clothes[60, 70] and not (picture.clothes & picture.shadow).any()
    assert not picture.clothes[:20].any() and not picture.clothes[20:23].any()


def test_colour_edges_skip_shadow_and_find_the_outline() -> None:
    picture = describe(*scene())
    threshold = np.array([HIGH])
    colour = measure([picture], Detector("rgb", rgb_edges, threshold))
    grey = measure([picture], Detector("grey", grey_canny, np.array([100.0])))
    assert colour.recall[0] == grey.recall[0] == 1
    assert colour.shadow[0] == 0
    assert grey.shadow[0] > 2 * 60 + 40 - 20  # three sides of the shadow at least


def test_static_edges_are_no_shadow_clutter() -> None:
    image, plate, mask = scene()
    for p in (image, plate):
        p[60:62, 84:140] = 20  # a line on the floor, through the shadow
    detector = Detector("grey", grey_canny, np.array([750.0]))  # its low one is above the shadow's own border
    assert describe(image, plate, mask).shadow[60, 100]
    assert measure([describe(image, plate, mask)], detector).shadow[0] == 0
    assert measure([describe(image, np.full_like(plate, 200), mask)], detector).shadow[0] > 30


def test_clutter_is_read_between_thresholds() -> None:
    curve = Curve(np.array([0.5, 0.7, 0.9]), np.array([0.0, 10.0, 30.0]), np.array([1.0, 1.0, 5.0]))
    assert curve.at(0.8, "shadow") == pytest.approx(20)
    assert curve.at(0.6, "clothes") == pytest.approx(1)
    assert np.isnan(curve.at(0.95, "shadow")), "not reached, not made up"


@pytest.mark.slow
def test_figure_and_table_are_made_from_a_capture(tmp_path: Path) -> None:
    curves = run([development_capture("walk")], [30], tmp_path, cameras=["cam1", "cam2"])
    assert (tmp_path / "figure4-walk.png").stat().st_size > 20_000
    assert (tmp_path / "figure4.md").read_text(encoding="utf-8").count("| walk |") == len(detectors()) == 4
    for _, curve in curves["walk"]:
        assert (np.diff(curve.recall) >= 0).all() and curve.recall[-1] > max(RECALLS)
    clutter = {d.name: c.at(0.9, "shadow") + c.at(0.9, "clothes") for d, c in curves["walk"] if d.sigma == 1}
    assert clutter["RGB edges"] < clutter["grey Canny"], "the paper's claim"


def test_unsuitable_capture_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")])
    assert "nowhere" in str(stop.value)
