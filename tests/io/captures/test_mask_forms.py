"""Masks in the forms that programs write."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.conftest import refused
from tests.io.conftest import write_picture, write_video
from tk.errors import VideoError
from tk.io.captures.clip_folder import probe
from tk.io.captures.pictures import probe_pictures

H, W = 48, 64
TRUE = np.zeros((H, W), np.uint8)
TRUE[10:40, 20:35] = 255
BODY = TRUE > 0
PHOTO = np.random.default_rng(0).integers(20, 250, (H, W, 3)).astype(np.uint8)


def write_palette(path: Path, index: np.ndarray, *colors: tuple[int, int, int]) -> None:
    """Write a PNG with a palette."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + row.astype(np.uint8).tobytes() for row in index)
    head = struct.pack(">IIBBBBB", W, H, 8, 3, 0, 0, 0)
    parts = (chunk(b"IHDR", head), chunk(b"PLTE", bytes(sum(colors, ()))), chunk(b"IDAT", zlib.compress(rows)))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts) + chunk(b"IEND", b""))


def read(path: Path, count: int = 1) -> list[np.ndarray]:
    reader = probe(path, is_mask=True).open()
    masks = [np.empty((H, W), np.uint8) for _ in range(count)]
    for mask in masks:
        reader.read(mask)
    reader.close()
    return masks


def alpha(mask: np.ndarray, picture: np.ndarray = PHOTO) -> np.ndarray:
    return np.dstack([picture, mask])


RIGHT: dict[str, np.ndarray] = {
    "white": TRUE,
    "one": BODY.astype(np.uint8),
    "two": BODY.astype(np.uint8) * 2,
    "38": BODY.astype(np.uint8) * 38,
    "grey 100": BODY.astype(np.uint8) * 100,
    "grey 200": BODY.astype(np.uint8) * 200,
    "16 bits": TRUE.astype(np.uint16) * 257,
    "16 bits, one": BODY.astype(np.uint16),
    "16 bits, 300": BODY.astype(np.uint16) * 300,
    "16 bits, 255": TRUE.astype(np.uint16),
    "three channels": np.dstack([TRUE] * 3),
    "three channels, one": np.dstack([BODY.astype(np.uint8)] * 3),
    "one colour": BODY[..., None] * np.array([0, 0, 128], np.uint8),
    "colour of a person": BODY[..., None] * np.array([60, 20, 220], np.uint8),
    "alpha": alpha(TRUE),
    "alpha, black behind": alpha(TRUE, PHOTO * BODY[..., None]),
    "alpha, 16 bits": alpha(TRUE, PHOTO).astype(np.uint16) * 257,
    "opaque": alpha(np.full_like(TRUE, 255), np.dstack([TRUE] * 3)),
}


@pytest.mark.parametrize("form", RIGHT)
def test_mask_of_one_person_is_read(tmp_path: Path, form: str) -> None:
    picture = RIGHT[form]
    write_picture(tmp_path / "cam1" / "000000.png", np.zeros_like(picture))  # nobody yet
    write_picture(tmp_path / "cam1" / "000001.png", picture)
    write_picture(tmp_path / "cam1" / "000002.png", picture)
    empty, *shown = read(tmp_path / "cam1", 3)
    for mask in shown:
        np.testing.assert_array_equal(mask, TRUE)
    if form != "opaque":
        assert not empty.any()


@pytest.mark.parametrize("first", [(0, 0, 0), (255, 255, 255), (31, 119, 180)], ids=["black", "white", "blue"])
def test_palette_of_one_object_is_read(tmp_path: Path, first: tuple[int, int, int]) -> None:
    path = tmp_path / "000000.png"
    write_palette(path, BODY, first, (128, 0, 0), (0, 128, 0))
    np.testing.assert_array_equal(read(path)[0], TRUE)
    write_palette(path, BODY * 2, first, (128, 0, 0), (0, 128, 0))
    np.testing.assert_array_equal(read(path)[0], TRUE)


def test_soft_edges_and_jpeg_are_read(tmp_path: Path) -> None:
    soft = cv2.GaussianBlur(TRUE, (9, 9), 2.5)
    for name, picture in (("a.png", soft), ("b.jpg", TRUE), ("c.png", alpha(soft)), ("d.jpg", np.dstack([soft] * 3))):
        write_picture(tmp_path / name, picture)
        assert np.count_nonzero(read(tmp_path / name)[0] != TRUE) < 40


def test_faint_picture_of_a_usual_clip_shows_nobody(tmp_path: Path) -> None:
    """A matte may hold small numbers where nobody is; in a clip of white masks they are not the person."""
    for k, picture in enumerate([TRUE, TRUE // 4, PHOTO[..., 0] // 4, BODY.astype(np.uint8)]):
        write_picture(tmp_path / "cam1" / f"{k:06d}.png", picture)
    assert [bool(mask.any()) for mask in read(tmp_path / "cam1", 4)] == [True, False, False, False]


def labels(*values: int) -> np.ndarray:
    picture = np.zeros((H, W), np.uint8)
    for k, value in enumerate(values):
        picture[10:40, 5 + 10 * k : 15 + 10 * k] = value
    return picture


WRONG: dict[str, tuple[np.ndarray, tuple[str, ...]]] = {
    "several labels": (labels(1, 2, 38), ("the values 0, 1, 2, 38 in 1 channel", "the largest is 38")),
    "no black": (np.where(BODY, 2, 1).astype(np.uint8), ("the values 1, 2 in 1 channel", "the largest is 2")),
    "grey photograph": (PHOTO[..., 0] * BODY, ("values of grey in 1 channel", "the largest is 249")),
    "colour photograph": (PHOTO * BODY[..., None], ("colours in 3 channels", "the largest is 249")),
    "on green": (np.where(BODY[..., None], PHOTO, np.array([0, 255, 0])).astype(np.uint8), ("colours in 3 channels",)),
    "several colours": (
        np.dstack([labels(128, 0, 64), labels(0, 128, 64), labels(0, 0, 0)]),
        ("colours in 3 channels", "the largest is 128"),
    ),
    "faint grey": (np.minimum(PHOTO[..., 0] * BODY, 100), ("in 1 channel", "the largest is 100")),
}


@pytest.mark.parametrize("form", WRONG)
def test_picture_that_is_no_mask_is_refused(tmp_path: Path, form: str) -> None:
    picture, parts = WRONG[form]
    path = tmp_path / "000000.png"
    write_picture(path, picture)
    with refused(VideoError, path, "is no mask", *parts, "people must be white (255)"):
        read(path)


def test_inverted_masks_are_refused(tmp_path: Path) -> None:
    write_picture(tmp_path / "000000.png", 255 - TRUE)
    with refused(VideoError, tmp_path / "000000.png", "is white along its edges", "invert the masks"):
        read(tmp_path / "000000.png")


def test_second_label_in_a_later_picture_is_refused(tmp_path: Path) -> None:
    for k, value in enumerate((1, 1, 2)):
        write_picture(tmp_path / "cam1" / f"{k:06d}.png", BODY.astype(np.uint8) * value)
    assert probe_pictures(tmp_path / "cam1", is_mask=True).frame_count == 3
    with refused(VideoError, "000002.png", "the values 0, 2 in 1 channel"):
        read(tmp_path / "cam1", 3)


@pytest.mark.parametrize(
    ("picture", "part"),
    [
        (lambda: np.dstack([TRUE // 255 * 100] * 3), "the largest is 1"),
        (lambda: np.dstack([labels(1, 2, 38)] * 3), "in 3 channels"),
        (lambda: BODY[..., None] * PHOTO, "colours in 3 channels"),
        (lambda: np.dstack([TRUE] * 3), None),
    ],
    ids=["grey 100", "labels", "photograph", "white"],
)
def test_videos_are_judged_alike(tmp_path: Path, picture: Callable[[], Any], part: str | None) -> None:
    path = tmp_path / "cam1.avi"
    blank = np.zeros((H, W, 3), np.uint8)
    write_video(path, [blank, picture().astype(np.uint8), picture().astype(np.uint8)])
    if part is None:
        assert np.count_nonzero(read(path, 3)[2] != TRUE) < 60
    else:
        with refused(VideoError, path, "is no mask", part):
            read(path, 3)
