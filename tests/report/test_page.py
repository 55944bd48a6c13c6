"""The contents of a report, and its behaviour in a browser."""

from __future__ import annotations

import base64
import json
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scripts.browser import Page, browser_page, find_browser
from tests.conftest import FRAMES, Tk
from tests.report.conftest import LOST, NOTE, with_partner
from tk.cli import main
from tk.evaluation.joints import evaluate_files
from tk.io.results.data import Result
from tk.io.results.reader import read_result
from tk.io.results.status import Status
from tk.model.body.expected_error import in_cm
from tk.model.body.joints import JOINTS
from tk.render.figure import figure_of
from tk.report.data import hinge_sigma_deg
from tk.report.page import build_page, made_here
from tk.report.pictures import choose_rows


def data_of(page: str) -> dict[str, Any]:
    """Return the data in a page."""
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    found: dict[str, Any] = json.loads(text)
    return found


def unpacked(packed: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed["data"]), "<f4").reshape(packed["shape"])


def test_page_contains_the_result(complete: Path) -> None:
    result = read_result(complete)
    page = build_page(result, [])
    data = data_of(page)
    assert data["frames"] == list(range(FRAMES)) and data["capture"] == "made <up>" and data["notes"] == ["first", NOTE]
    joints = unpacked(data["people"][0]["positions"])
    # the scene is the world moved: distances stay, and up is z
    flat = joints.reshape(-1, 3).astype(float)
    world = result.joints.reshape(-1, 3)
    rng = np.random.default_rng(0)
    i, j = rng.integers(0, len(flat), (2, 200))
    np.testing.assert_allclose(
        np.linalg.norm(flat[i] - flat[j], axis=1), np.linalg.norm(world[i] - world[j], axis=1), atol=1e-5
    )
    np.testing.assert_allclose(flat[i, 2] - flat[j, 2], world[i, 2] - world[j, 2], atol=1e-5)
    np.testing.assert_allclose(unpacked(data["people"][0]["sigma"]), result.sigma, rtol=1e-6)
    assert np.isnan(unpacked(data["people"][0]["sigma"])[3, 8])
    (knee,) = (panel for panel in data["people"][0]["angles"] if panel["title"] == "Knee flexion")
    assert [line["side"] for line in knee["lines"]] == ["left", "right"]
    np.testing.assert_allclose(unpacked(knee["lines"][0]["values"]), result.angles["knee_l"][:, 0], atol=1e-4)
    assert "sigma" in knee["lines"][0]
    assert {camera["name"] for camera in data["scene"]["cameras"]} == set()


def test_body_points_match_the_overlay(complete: Path) -> None:
    result = read_result(complete)
    person = data_of(build_page(result, []))["people"][0]
    figure = figure_of(result)
    row = 5
    transforms = unpacked(person["transforms"])[row]
    ours, theirs = [], []
    for solid, handed in zip(figure.solids, person["solids"], strict=True):
        T = transforms[handed["segment"]]
        ours.append(unpacked(handed["rings"])[0] @ T[:, :3].T + T[:, 3])
        there = figure.transforms[row, solid.segment]
        theirs.append(solid.rings[0] @ there[:3, :3].T + there[:3, 3])
    a, b = np.concatenate(ours), np.concatenate(theirs)
    joints = unpacked(person["positions"])[row]
    for k in range(15):
        np.testing.assert_allclose(
            np.linalg.norm(a - joints[k], axis=1), np.linalg.norm(b - figure.joints[row, k], axis=1), atol=1e-4
        )


def test_expected_error_is_a_range_for_all_joints_and_for_each(complete: Path) -> None:
    result = read_result(complete)
    assert result.expected_error is not None and result.mean_error_range is not None
    (person,) = data_of(build_page(result, []))["people"]
    assert person["expectedMean"] == in_cm(result.mean_error_range)
    low, high = 100 * result.mean_error_range
    assert low < 100 * np.nanmean(result.expected_error[result.has_pose]) < high
    assert len(person["expected"]) == len(JOINTS) and all(" to " in text for text in person["expected"])
    assert np.isnan(result.expected_error[3, 8]), "unknown where sigma is unknown"
    without = replace(result, sigma=None)
    assert without.expected_error is without.mean_error_range is None
    (person,) = data_of(build_page(without, []))["people"]
    assert (person["expectedMean"], person["expected"]) == ("", None)


def left_out(result: Result, camera: int, rows: slice) -> Result:
    """Return a result without a camera in some frames."""
    assert result.residual is not None
    residual = result.residual.copy()
    residual[rows, camera] = np.nan
    return replace(result, residual=residual)


def test_cameras_that_were_left_out_are_counted(complete: Path) -> None:
    result = read_result(complete)
    assert data_of(build_page(result, []))["leftOut"] == [0, 0, 0, 0]
    one = left_out(result, 2, slice(None))
    assert data_of(build_page(one, []))["leftOut"] == [0, 0, FRAMES - len(LOST), 0], "not in lost frames"
    two = left_out(with_partner(result), 2, slice(None))
    assert data_of(build_page(two, []))["leftOut"] == [0, 0, 5, 0], (
        "where the second person has a pose, too, it was used"
    )
    assert data_of(build_page(replace(result, residual=None), []))["leftOut"] == []


def test_page_has_errors_only_with_a_truth(complete: Path, tiny: Path, tmp_path: Path) -> None:
    result = read_result(complete)
    assert data_of(build_page(result, []))["people"][0]["truth"] is None
    assert data_of(build_page(result, [], truth=tmp_path / "none.h5"))["people"][0]["truth"] is None
    errors = data_of(build_page(result, [], truth=tiny / "truth.h5"))["people"][0]["truth"]
    found = evaluate_files(complete, tiny / "truth.h5")
    assert errors["rows"][1] == ["12 limb joints", found.raw.limbs.mean_cm, found.corrected.limbs.mean_cm]
    assert unpacked(errors["frames"]).mean() == pytest.approx(found.raw.all.mean_cm, rel=1e-4)
    assert result.sigma is not None
    turned = replace(
        result,
        meta=replace(result.meta, joint_names=JOINTS[::-1]),
        joints=result.joints[:, ::-1],
        sigma=result.sigma[:, ::-1],
    )
    again = data_of(build_page(turned, [], truth=tiny / "truth.h5"))["people"][0]["truth"]
    assert again["frames"] == errors["frames"], "whatever the order of the joints in the file"


def test_page_loads_nothing_and_escapes_text(complete: Path) -> None:
    page = build_page(read_result(complete), [])
    assert "default-src 'none'" in page
    assert set(re.findall(r"https?://[^\"'\s]+", page)) == {"http://www.w3.org/2000/svg"}, "a name, not an address"
    assert not re.search(r"<(?:link|script|img|iframe)[^>]*(?:src|href)=(?!\"data:)", page)
    assert "<title>made &lt;up&gt;: walk.h5</title>" in page
    assert NOTE not in page and "{{" not in re.sub(r"<script.*?</script>", "", page, flags=re.S)


def longer(result: Result, count: int) -> Result:
    """Return a result that repeats the same frames."""
    frames = np.arange(count)
    return replace(result.at_rows(frames % len(result)), frames=frames, time=frames / 15)


def test_page_of_1000_frames_is_below_4_megabytes(complete: Path) -> None:
    page = build_page(longer(read_result(complete), 1000), [])
    assert len(page) < 4e6  # and five pictures of some 100 kB


def test_page_of_ten_minutes_shows_some_frames_and_counts_all(complete: Path) -> None:
    result = longer(read_result(complete), 36_000)
    pictures = [{"row": 35_999, "why": "the last", "jpeg": ""}]
    page = build_page(result, pictures)
    assert len(page) < 9.4e6  # 10 MB with five pictures of some 100 kB
    data = data_of(page)
    assert data["frameCount"] == 36_000 and len(data["frames"]) == 36_000 / data["step"] <= 4000
    assert data["frames"][1] == data["step"] and data["pictures"][0]["frame"] == 35_999
    (person,) = data["people"]
    assert person["lostCount"] == (result.status == Status.LOST).sum() and len(person["status"]) == len(data["frames"])


def test_sigma_of_flexion_matches_random_positions(complete: Path) -> None:
    figure = figure_of(read_result(complete))
    rng = np.random.default_rng(2)
    names = ("hip_l", "knee_l", "ankle_l")
    index = [JOINTS.index(name) for name in names]
    sigma_deg = hinge_sigma_deg(figure, names)
    assert figure.sigma is not None
    for row in (1, 2, 5):
        scale = 0.1  # small errors: the formula is of first order
        drawn = figure.joints[row, index] + scale * figure.sigma[row, index, None] * rng.normal(size=(20000, 3, 3))
        u, v = drawn[:, 0] - drawn[:, 1], drawn[:, 2] - drawn[:, 1]
        cosine = (u * v).sum(axis=1) / np.linalg.norm(u, axis=1) / np.linalg.norm(v, axis=1)
        angle = np.degrees(np.arccos(cosine))
        if angle.mean() < 170:  # a straight leg's angle cannot grow
            assert sigma_deg[row] == pytest.approx(angle.std() / scale, rel=0.05)


def test_images_show_lost_worst_and_typical_frames(complete: Path, tracked: Path) -> None:
    result = read_result(complete)
    choices = {choice.row: choice.why for choice in choose_rows(result)}
    assert choices[LOST[0]] == "first lost frame" and choices[11] == "among the worst: mean E_S 30 %"
    assert sum(why.startswith("typical") for why in choices.values()) >= 1
    some = choose_rows(result, range(1, 14, 3))
    assert some[0].row == LOST[1] and len(some) > 2 and {choice.row for choice in some} <= {1, 4, 7, 10, 13}
    unknown = choose_rows(read_result(tracked))
    assert len(unknown) == 5 and {choice.why for choice in unknown} == {"spread over the recording"}


def test_report_writes_a_page(tk: Tk, complete: Path, tiny: Path, tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    ran = tk("report", complete, tiny, "-o", target)
    assert ran.code == 0 and ran.err.endswith(f"wrote {target}\n") and made_here(target)  # after progress, if slow
    data = data_of(target.read_text(encoding="utf-8"))
    assert {picture["row"] for picture in data["pictures"]} >= {LOST[0], 11}
    assert len(data["scene"]["cameras"]) == 4
    tk("report", complete, "-o", target).complaint("page.html: exists", "--force")
    assert tk("report", complete, "-o", target, "--force").code == 0
    assert data_of(target.read_text(encoding="utf-8"))["pictures"] == []
    tk("report", complete, "-o", tmp_path / "no" / "page.html").complaint("does not exist")
    tk("report", tmp_path / "none.h5").complaint("none.h5: no such file")


# --- in a browser -----------------------------------------------------------------------------------------------------

chromium = pytest.mark.skipif(find_browser() is None, reason="no Chromium is installed (Debian's package: chromium)")


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    """A page of one browser, shared by all tests."""
    with browser_page() as opened:
        yield opened


def wait_for(page: Page, condition: str, seconds: float = 20.0) -> None:
    """Wait until an expression is true."""
    deadline = time.monotonic() + seconds
    while not page.run(condition):
        assert time.monotonic() < deadline, condition
        time.sleep(0.05)


@pytest.fixture(scope="module")
def report(complete: Path, tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The complete result's report, read-only."""
    path = tmp_path_factory.mktemp("report") / "walk.html"
    main(["report", str(complete), str(tiny), "-o", str(path)], standalone_mode=False)
    return path


@pytest.fixture
def opened(report: Path, page: Page) -> Page:
    """The report in the browser, at its first frame."""
    page.said.clear()
    page.open(report)
    return page


@chromium
def test_page_plays_and_stops_at_the_end(opened: Page) -> None:
    assert opened.run("report.row") == 0 and opened.run("report.playing") is False
    before = opened.run("document.getElementById('view').toDataURL()")
    opened.press(" ")
    assert opened.run("report.playing") is True
    wait_for(opened, "report.row > 2")
    wait_for(opened, f"report.row === {FRAMES - 1} && !report.playing")
    assert opened.run("document.getElementById('view').toDataURL()") != before
    opened.run("document.getElementById('play').click()")  # begins again
    wait_for(opened, "report.playing && report.row < 9")
    opened.press(" ")
    assert opened.run("report.playing") is False
    assert opened.said == []


@chromium
def test_page_seeks_by_keys_slider_and_images(opened: Page) -> None:
    opened.press("ArrowRight")
    opened.press("ArrowRight")
    opened.press("ArrowLeft")
    assert opened.run("report.row") == 1
    opened.run(
        "(() => { const s = document.getElementById('scrubber'); s.value = 9; s.dispatchEvent(new Event('input')); })()"
    )
    assert opened.run("report.row") == 9
    assert opened.run("document.getElementById('clock').textContent") == "frame 9 · 0.60 s"
    opened.press("End")
    assert opened.run("report.row") == FRAMES - 1
    opened.press("Home")
    opened.run("document.querySelector('#shots button').click()")
    assert opened.run("report.row") == LOST[0], "a picture leads to its frame"
    turned = opened.run("document.getElementById('view').toDataURL()")
    box = opened.run("JSON.stringify(document.getElementById('view').getBoundingClientRect())")
    top = json.loads(box)["top"]
    opened.run("scrollTo(0, 0)")
    opened.drag((300, max(top, 0) + 150), (420, max(top, 0) + 170))
    wait_for(opened, f"document.getElementById('view').toDataURL() !== {json.dumps(turned)}")
    assert opened.said == []


@chromium
def test_page_marks_lost_frames(opened: Page) -> None:
    opened.run(f"report.show({LOST[0] - 1})")
    assert opened.run("document.getElementById('badge').hidden") is True
    opened.run(f"report.show({LOST[0]})")
    assert opened.run("document.getElementById('badge').hidden") is False
    assert opened.run("document.getElementById('status').textContent") == "lost"
    assert opened.run("document.querySelectorAll('.chart')[0].querySelectorAll('rect.lost').length") == len(LOST)
    assert opened.run("document.querySelector('#figures .bad dd').textContent").startswith("2")


@chromium
def test_page_shows_all_sections(opened: Page) -> None:
    assert opened.run("document.querySelectorAll('#notes li')[1].textContent") == NOTE
    assert opened.run("document.getElementById('title').textContent") == "made <up>"
    assert opened.run("document.querySelectorAll('#angle-charts .chart').length") > 15
    bands = opened.run(
        "[...document.querySelectorAll('.band')].map((path) => path.getAttribute('d').split('M').length)"
    )
    assert sorted(bands) == [2, 2, 2, 3], "σ of an elbow is unknown in one frame, which divides its band"
    assert opened.run("document.querySelectorAll('#sigma-table tr').length") == 16
    assert opened.run("[...document.images].every((image) => image.complete && image.naturalWidth > 100)") is True
    assert opened.run("document.images.length") >= 3
    assert opened.run("document.documentElement.scrollWidth <= window.innerWidth") is True, "nothing sticks out"
    assert opened.run("document.querySelector('.chart path.line').getAttribute('d').includes('NaN')") is False
    assert opened.said == []


@chromium
def test_page_compares_with_the_truth(opened: Page) -> None:
    rows = opened.run("[...document.querySelectorAll('#truth-table tr')].map((row) => row.textContent)")
    assert len(rows) == 1 + 2 + len(JOINTS) and rows[1].startswith("all 15") and rows[3].startswith("pelvis")
    assert opened.run("document.getElementById('truth').hidden") is False
    assert opened.run("document.querySelectorAll('#truth-charts path.line').length") == 1


@chromium
def test_page_has_a_block_for_each_person(complete: Path, page: Page, tmp_path: Path) -> None:
    target = tmp_path / "two.html"
    target.write_text(build_page(with_partner(read_result(complete)), []), encoding="utf-8")
    page.said.clear()
    page.open(target)
    rows = page.run("[...document.querySelectorAll('#people tr')].map((row) => row.textContent)")
    key = page.run("document.getElementById('key').textContent")
    assert " ".join(key.split()) == "left right trunk, head Person 1"
    assert len(rows) == 3 and "Person 1" in rows[2] and f"1 of {FRAMES - 4}" in rows[2]
    assert page.run("document.querySelector(document.querySelectorAll('#people a')[1].hash).id") == "person-1"
    assert page.run("document.querySelectorAll('#angle-charts-1 .chart').length") > 15
    for row, status, alone in ((0, "absent", True), (5, "lost", False), (8, "tracked", True)):
        page.run(f"report.show({row})")
        assert page.run("document.getElementById('status-1').textContent") == status
        assert page.run("document.getElementById('badge').hidden") is alone
    assert page.run("document.documentElement.scrollWidth <= window.innerWidth") is True, "nothing sticks out"
    assert page.said == []


@chromium
@pytest.mark.parametrize(
    "rows, title, text",
    [
        (slice(None), "made <up>: 3 of 4 cameras used", "Left out: cam3 (all frames)."),
        (slice(0, 3), "made <up>", f"Left out: cam3 (3 of {FRAMES - len(LOST)} frames)."),
    ],
)
def test_headline_counts_the_cameras_used(
    complete: Path, page: Page, tmp_path: Path, rows: slice, title: str, text: str
) -> None:
    target = tmp_path / "page.html"
    target.write_text(build_page(left_out(read_result(complete), 2, rows), []), encoding="utf-8")
    page.said.clear()
    page.open(target)
    assert page.run("document.getElementById('title').textContent") == title
    assert page.run("document.getElementById('left-out').textContent").startswith(text)
    assert page.run("document.getElementById('left-out').hidden") is False
    numbers = page.run("[...document.querySelectorAll('#now-cameras .number')].map((box) => box.textContent)")
    assert numbers[2] == "left out" and numbers[1].endswith("%") and page.said == []


def test_people_with_different_frames_are_aligned(complete: Path) -> None:
    result = read_result(complete)
    first, second = with_partner(result).people
    np.testing.assert_array_equal(first.joints, result.joints)
    assert second.frames.tolist() == result.frames.tolist() and (second.status[:4] == Status.ABSENT).all()
    assert np.isnan(second.joints[:4]).all() and np.isfinite(second.joints[4:]).all()
    assert choose_rows(with_partner(result))[0].row == 5, "the first frame in which anybody is lost"


@chromium
def test_page_fits_a_small_screen(opened: Page, report: Path) -> None:
    opened.open(report, 390, 800)
    assert opened.run("document.documentElement.scrollWidth <= window.innerWidth") is True, "nothing sticks out"
    assert opened.run("document.getElementById('scrubber').getBoundingClientRect().width") > 250
    assert opened.said == []


@chromium
def test_results_of_the_volumetric_tracker_are_shown(tracked: Path, page: Page, tk: Tk, tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    assert tk("report", tracked, "-o", target).code == 0
    page.said.clear()
    page.open(target, dark=True)
    page.press(" ")
    wait_for(page, "report.row > 2")
    text = page.run("document.body.innerText")
    for missing in ("has no E_S", "No images", "has no joint angles", "has no σ"):
        assert missing in text
    assert page.said == []


def test_status_numbers_match_the_page() -> None:
    """The page chooses colours by these numbers."""
    assert [status.name for status in Status] == ["TRACKED", "INITIALISED", "RECOVERED", "LOST", "SUSPECT", "ABSENT"]
    assert [int(status) for status in Status] == list(range(6))
