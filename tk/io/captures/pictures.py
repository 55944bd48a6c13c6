"""Clips of images in files of their own: a folder of numbered pictures, or a single picture."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import VideoError
from tk.io.captures.clip import Clip, Image, Reader, deliver
from tk.io.captures.mask_forms import without_palette

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pbm", ".pgm", ".ppm")


@dataclass(frozen=True, kw_only=True)
class PictureClip(Clip):
    """Numbered pictures in a folder, or one picture; made by :func:`probe_pictures`."""

    files: tuple[Path, ...]

    def open(self) -> Reader:
        return _PictureReader(self)


def probe_pictures(path: Path, is_mask: bool = False) -> PictureClip:
    """List the numbered images of a folder, or take one image file, and decode the first.

    The number stands at the end of the file's name. The first number is 0 or 1, and there are no gaps.

    Raises:
        VideoError: no pictures, a gap in the numbers, a number used twice, or the first cannot be decoded.
    """
    files = _numbered_pictures(path) if path.is_dir() else (path,)
    height, width = read_picture(files[0], is_mask).shape[:2]
    return PictureClip(path, width, height, len(files), is_mask, files=files)


def picture_number(path: Path) -> int | None:
    """Return the number at the end of an image's name; None without one."""
    digits = re.search(r"[0-9]+$", path.stem)
    return int(digits.group()) if digits else None


class _PictureReader:
    def __init__(self, clip: PictureClip) -> None:
        self._clip = clip
        self._index = 0

    def skip(self) -> None:
        self._index += 1

    def jump(self, number: int) -> int:
        self._index = max(number, self._index)
        return self._index

    def read(self, out: Image) -> None:
        clip = self._clip
        if self._index >= len(clip.files):
            raise VideoError(f"{clip.path}: has no picture number {self._index}; it holds {len(clip.files)}")
        path = clip.files[self._index]
        picture = read_picture(path, clip.is_mask)
        self._index += 1
        deliver(clip, picture, path, out)

    def close(self) -> None:
        pass


def _numbered_pictures(folder: Path) -> tuple[Path, ...]:
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path.suffix.lower() not in PICTURE_SUFFIXES:
            continue
        number = picture_number(path)
        if number is None:
            raise VideoError(f"{path}: its name has no number at the end; pictures are called 000000.png, 000001.png …")
        if number in files:
            raise VideoError(f"{folder}: both {files[number].name} and {path.name} are picture {number}; keep one")
        files[number] = path
    if not files:
        raise VideoError(f"{folder}: holds no pictures; they are called 000000.png, 000001.png …")
    numbers = sorted(files)
    if numbers[0] > 1:
        raise VideoError(f"{folder}: starts with {files[numbers[0]].name}; the first picture has number 0 (or 1)")
    for expected, number in enumerate(numbers, numbers[0]):
        if number != expected:
            raise VideoError(
                f"{folder}: picture {expected} is missing between {files[expected - 1].name} and {files[number].name}"
            )
    return tuple(files[number] for number in numbers)


def read_picture(path: Path, is_mask: bool) -> NDArray[Any]:
    """Return a picture (H, W, 3) in BGR; of a mask (H, W) or (H, W, channels) as it is stored.

    Raises:
        VideoError: there is no such file, or it cannot be decoded.
    """
    if not path.is_file():
        raise VideoError(f"{path}: there is no such file")
    coded = path.read_bytes()
    picture = None
    if _has_end(coded):
        flags = cv2.IMREAD_UNCHANGED if is_mask else cv2.IMREAD_COLOR
        picture = cv2.imdecode(np.frombuffer(coded, np.uint8), flags)
    if picture is None:
        raise VideoError(f"{path}: is not a picture that can be decoded, or is cut off")
    return without_palette(picture, coded) if is_mask else picture


def _has_end(coded: bytes) -> bool:
    """Return False for a truncated PNG or JPEG: OpenCV would fill up a JPEG with grey, libpng would print an error."""
    if not coded:
        return False
    if coded.startswith(b"\x89PNG"):
        return b"IEND\xaeB`\x82" in coded  # with its checksum
    return not coded.startswith(b"\xff\xd8") or b"\xff\xd9" in coded
