"""Boards in images: where the points are, which board a picture shows, and the sheet to print."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scripts.synthetic.boards import texture
from tests.calibration.rigs import footages
from tests.conftest import Tk
from tests.io.conftest import write_video
from tk.calibration.boards import Board, make_board
from tk.calibration.detection import detect
from tk.calibration.footage import Footage, choose, read_footage
from tk.calibration.misses import explain_miss
from tk.calibration.poses import exp

Float = NDArray[np.float64]
Grey = NDArray[np.uint8]

SQUARES = {"charuco": 0.11, "chessboard": 0.08, "circles": 0.07, "aprilgrid": 0.1}
CHARUCO = make_board("charuco", None, 0.11)


def picture(board: Board, far_m: float = 2.0, tilt_deg: float = 25.0, blur_px: float = 0.7) -> tuple[Grey, Float]:
    """An image (480, 640) of a board before a camera without distortion, and the pixels of its points."""
    focal = 520.0
    rotation = exp(np.radians(tilt_deg) * np.array([0.5, 0.8, 0.1])) @ exp(np.array([0.0, 0.0, 0.2]))
    matrix = np.array([[focal, 0, 319.5], [0, focal, 239.5], [0, 0, 1.0]])
    place = np.array([0.05, -0.03, far_m]) - rotation @ board.corners.mean(axis=0)
    onto = matrix @ np.stack([rotation[:, 0], rotation[:, 1], place], axis=1)
    texels = texture(board)
    scale = board.size_m[0] / texels.shape[1]
    from_texels = onto @ np.array([[scale, 0, scale / 2], [0, scale, scale / 2], [0, 0, 1.0]])
    fine = np.array([[4.0, 0, 1.5], [0, 4, 1.5], [0, 0, 1]]) @ from_texels
    large = cv2.warpPerspective(texels, fine, (2560, 1920), flags=cv2.INTER_AREA, borderValue=0.5)
    seen = cv2.GaussianBlur(cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA), (0, 0), blur_px)
    noisy = 255 * seen**0.5 + np.random.default_rng(0).normal(0, 1.0, seen.shape)
    points = np.column_stack([board.points[:, :2], np.ones(len(board.points))]) @ onto.T
    return np.clip(noisy, 0, 255).astype(np.uint8), points[:, :2] / points[:, 2:]


@pytest.mark.parametrize("kind", SQUARES)
def test_points_of_each_board_are_found(kind: str) -> None:
    board = make_board(kind, None, SQUARES[kind])
    grey, true = picture(board, 1.4 if kind == "aprilgrid" else 1.8)
    found = detect(grey, board)
    assert found is not None and len(found.ids) > 0.8 * len(true)
    off = np.linalg.norm(found.pixels - true[found.ids], axis=1)
    # the centre of a tilted circle's image is not the image of its centre
    assert np.median(off) < (0.25 if kind == "circles" else 0.1)


@pytest.mark.parametrize("far_m", [1.0, 3.0, 4.5])
def test_small_squares_are_exact(far_m: float) -> None:
    """At 4.5 m a square has 12 pixels, and a marker's module 1.6."""
    grey, true = picture(CHARUCO, far_m)
    found = detect(grey, CHARUCO)
    assert found is not None and len(found.ids) >= 20
    assert np.sqrt(((found.pixels - true[found.ids]) ** 2).sum(axis=1).mean()) < 0.08


@pytest.mark.parametrize("printed", make_board("charuco", "7x6", 0.1).patterns)
def test_charuco_board_of_any_version_of_opencv_is_found(printed: Board, tmp_path: Path) -> None:
    grey, true = picture(printed)
    (tmp_path / "a").mkdir()
    cv2.imwrite(str(tmp_path / "a" / "0.png"), grey)
    (footage,), board = read_footage(tmp_path, make_board("charuco", "7x6", 0.1), None, lambda _: None)
    found = footage.seen[0].detection
    assert board == printed and len(found.ids) > 20
    np.testing.assert_allclose(found.pixels, true[found.ids], atol=0.3)


def test_hidden_part_of_a_charuco_board_is_left_out() -> None:
    grey, true = picture(CHARUCO)
    x = int(true[:, 0].mean()) + 10
    grey[:, x:] = 90
    found = detect(grey, CHARUCO)
    assert found is not None and 8 <= len(found.ids) < 24
    np.testing.assert_allclose(found.pixels, true[found.ids], atol=0.3)


def test_image_without_a_board_has_no_points() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
    other, _ = picture(make_board("chessboard", None, 0.08), 1.8)
    for board in (CHARUCO, make_board("chessboard", None, 0.08), make_board("aprilgrid", None, 0.1)):
        assert detect(cv2.GaussianBlur(noise, (0, 0), 2), board) is None
    assert detect(other, CHARUCO) is None


def missed(grey: Grey, board: Board) -> str:
    footage = Footage("b", Path("boards/b"), instants=[0, 1], samples=[grey, np.full_like(grey, 90)])
    return explain_miss(footage, board, ["c"])


@pytest.mark.parametrize(
    ("board", "part"),
    [
        (
            make_board("charuco", None, 0.11, None, "5x5_50"),
            "markers of another dictionary are found: give --dictionary 4x4_50",
        ),
        (make_board("charuco", "5x4", 0.11), "a board 7x5 of these markers is found: give --size 7x5"),
        pytest.param(
            make_board("chessboard", None, 0.11),
            "a charuco 7x5 of 4x4_50 is found: give --board charuco --size 7x5",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_nearest_miss_is_named(board: Board, part: str) -> None:
    line = missed(picture(CHARUCO)[0], board)
    assert line.startswith(f"camera b: no board {board.title} in 2 images (nor in c); ") and part in line


def test_mirrored_blurred_and_flat_images_are_named() -> None:
    grey, _ = picture(CHARUCO)
    assert "a mirrored one is found" in missed(np.ascontiguousarray(grey[:, ::-1]), CHARUCO)
    assert "blurred" in missed(picture(CHARUCO, 1.6, blur_px=5.0)[0], CHARUCO)
    assert "one colour" in missed(np.full_like(grey, 30), CHARUCO)


@pytest.mark.slow
def test_inner_corners_of_a_chessboard_are_not_its_squares() -> None:
    grey, _ = picture(make_board("chessboard", "10x7", 0.08), 1.8)
    assert "give --board chessboard --size 10x7" in missed(grey, make_board("chessboard", "9x6", 0.08))


def test_chosen_instants_are_sharp_and_different() -> None:
    recorded = footages()
    chosen, _ = choose(recorded, 12)
    assert len(chosen) == 12 and sum(len(cameras) > 1 for cameras in chosen.values()) >= 4
    assert all(instant in recorded[c].seen for instant, cameras in chosen.items() for c in cameras)
    assert 3 in choose(recorded, 2, 3)[0]
    same = recorded[0].seen[100]
    recorded[0].seen.update({200 + k: same for k in range(5)})
    assert not {200, 201, 202} & set(choose(recorded, 200)[0])


def test_videos_that_differ_by_a_frame_are_searched_at_the_same_instants(tmp_path: Path) -> None:
    for name, count in (("a", 480), ("b", 481)):
        (tmp_path / name).mkdir()
        write_video(tmp_path / name / f"{name}.avi", np.zeros((count, 48, 64, 3), np.uint8))
        (tmp_path / name / f"._{name}.avi").write_bytes(b"of macOS")
    (a, b), _ = read_footage(tmp_path, CHARUCO, None, lambda _: None)
    assert a.instants == b.instants[: len(a.instants)] and len(b.instants) - len(a.instants) <= 1


@pytest.mark.parametrize("kind", SQUARES)
def test_sheet_has_the_board_in_its_size(tk: Tk, tmp_path: Path, kind: str) -> None:
    path = tmp_path / "board.pdf"
    ran = tk("calibrate", "--print", path, "--board", kind, "--paper", "A3")
    assert ran.code == 0 and "print at 100 %" in ran.err
    text = path.read_bytes().decode("latin-1")
    square_m = float(re.findall(r"--square ([\d.]+)", text)[0])
    assert "MediaBox [0 0 1190.5512 841.8898]" in text  # 420 × 297 mm in points
    if kind == "chessboard":
        widths = {float(line.split()[2]) for line in re.findall(r"[\d.]+ [\d.]+ [\d.]+ [\d.]+ re", text)[:20]}
        assert len(widths) == 1 and abs(widths.pop() - 1000 * square_m * 72 / 25.4) < 1e-3
    tk("calibrate", "--print", path, "--board", kind).complaint("board.pdf", "--force")
    tk("calibrate", "--print", path, "--board", kind, "--square", "0", "--force").complaint("--square 0")
    place = int(text.split("startxref\n")[1].split()[0])
    assert text[place:].startswith("xref")


def test_board_that_does_not_fit_is_refused(tk: Tk, tmp_path: Path) -> None:
    tk("calibrate", "--print", tmp_path / "a.pdf", "--square", "0.2").complaint("larger than A4")
    tk("calibrate", "--print", tmp_path / "a.pdf", "--size", "40x40", "--dictionary", "4x4_1000").complaint("A4")
