"""Cameras from pictures of a board."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scripts.calibrate_cameras import FLOOR, main, make_board
from tk.io.captures.calibration import read_calibration

Float = NDArray[np.float64]
SQUARE_M = 0.11
SIZE, FOCAL = (960, 720), 750.0
MATRIX = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])


def camera(angle_deg: float, height_m: float) -> tuple[Float, Float]:
    """World to camera, for one that looks at a point 0.9 m above the floor."""
    place = np.array([2.5 * np.cos(np.radians(angle_deg)), 2.5 * np.sin(np.radians(angle_deg)), height_m])
    z = np.array([0.0, 0.0, 0.9]) - place
    x = np.cross(z, [0.0, 0.0, 1.0])
    axes = np.array([x, np.cross(z, x), z])
    rotation = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return rotation, -rotation @ place


CAMERAS = {"left": camera(0.0, 2.0), "right": camera(60.0, 1.8)}
SUFFIX = {"left": ".png", "right": ".JPG"}


def write_picture(file: Path, rotation: Float, translation: Float) -> None:
    """The board, seen by a camera in whose frame it has this pose."""
    image = make_board(SQUARE_M).generateImage((1400, 1000))
    across = 7 * SQUARE_M / 1400
    onto = MATRIX @ np.stack([rotation[:, 0] * across, rotation[:, 1] * across, translation], axis=1)
    file.parent.mkdir(parents=True, exist_ok=True)
    seen = cv2.warpPerspective(image, onto, SIZE, flags=cv2.INTER_AREA, borderValue=128)
    cv2.imwrite(str(file), cv2.GaussianBlur(seen, (3, 3), 0))


@pytest.fixture(scope="module")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The board on the floor, at six places that both cameras see, and at five before each camera."""
    folder = tmp_path_factory.mktemp("boards")
    rng = np.random.default_rng(0)
    middle = np.array([3.5, 2.5, 0.0]) * SQUARE_M
    towards = np.array([np.cos(np.radians(30.0)), np.sin(np.radians(30.0)), 0.3])  # where both cameras are
    for n in range(7):
        if n == 0:
            turn, place = cv2.Rodrigues(FLOOR[0])[0], np.zeros(3)
        else:
            z = -towards / np.linalg.norm(towards)
            x = np.cross([0.0, 0.0, 1.0], z) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], z))
            turn = cv2.Rodrigues(rng.uniform(-0.4, 0.4, 3))[0] @ np.stack([x, np.cross(z, x), z], axis=1)
            place = np.append(rng.uniform(-0.3, 0.3, 2), rng.uniform(0.6, 1.3)) - turn @ middle
        for name, (rotation, translation) in CAMERAS.items():
            write_picture(folder / name / f"{n:04d}{SUFFIX[name]}", rotation @ turn, rotation @ place + translation)
    for k, name in enumerate(CAMERAS):
        for n in range(10 * k + 10, 10 * k + 15):
            turn = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0]
            place = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), 1.0]) - turn @ middle
            write_picture(folder / name / f"{n:04d}{SUFFIX[name]}", turn, place)
    return folder


def test_cameras_are_found_from_pictures_of_a_board(
    boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([str(boards), "--square", str(SQUARE_M), "-o", str(tmp_path / "calibration.toml")])
    assert "2 cameras; median error 0." in capsys.readouterr().out
    for found in read_calibration(tmp_path / "calibration.toml").rig:
        rotation, translation = CAMERAS[found.name]
        turn = cv2.Rodrigues(found.rotation @ rotation.T)[0]
        assert np.degrees(np.linalg.norm(turn)) < 0.3
        assert np.linalg.norm(found.rotation.T @ found.translation - rotation.T @ translation) < 0.02  # metres
        assert abs(found.matrix[0, 0] / FOCAL - 1) < 0.01


def test_board_that_no_camera_sees_on_the_floor_is_an_error(boards: Path, tmp_path: Path) -> None:
    for name in CAMERAS:
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0000.png"), np.full(SIZE[::-1], 128, np.uint8))
        picture = boards / name / f"0001{SUFFIX[name]}"
        (tmp_path / name / picture.name).write_bytes(picture.read_bytes())
    with pytest.raises(SystemExit, match="on the floor: lay it nearer"):
        main([str(tmp_path), "-o", str(tmp_path / "calibration.toml")])


@pytest.mark.parametrize("square", [200, 11, 0.0002, -0.1, float("nan")])
def test_square_that_is_not_in_metres_is_refused(tmp_path: Path, square: float) -> None:
    with pytest.raises(SystemExit, match="the side of a square is in metres"):
        main([str(tmp_path), f"--square={square}", "-o", str(tmp_path / "calibration.toml")])


def test_folder_without_pictures_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="holds no folder of pictures"):
        main([str(tmp_path)])
    (tmp_path / "cam1").mkdir()
    (tmp_path / "cam1" / "0000.jpeg").write_bytes(b"x")
    with pytest.raises(SystemExit, match="is not a picture that can be decoded"):
        main([str(tmp_path)])
    (tmp_path / "cam1" / "board.jpeg").write_bytes(b"x")
    with pytest.raises(SystemExit, match=r"board\.jpeg: needs a number"):
        main([str(tmp_path)])


def test_board_is_written_for_printing(tmp_path: Path) -> None:
    main(["--print", str(tmp_path / "board.png")])
    assert cv2.imread(str(tmp_path / "board.png")).shape[:2] == (3000, 4200)
