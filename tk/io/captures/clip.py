"""The images of one camera on disk, read in order: what videos and folders of pictures have in common."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import VideoError
from tk.io.captures.mask_forms import MaskForm
from tk.kernels.mask_values import PERSON

# OpenCV and FFmpeg write nothing to the terminal, unless the user sets these variables: errors here name the file.
# FFmpeg's level is read when the first video is opened; -8 is its AV_LOG_QUIET. OpenCV reads its own on import.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
if "OPENCV_LOG_LEVEL" not in os.environ:
    (getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel)(0)  # OpenCV 4, OpenCV 5

Image = NDArray[np.uint8]


class Reader(Protocol):
    """Reads the images of a clip in order. One thread at a time."""

    def read(self, out: Image) -> None:
        """Write the next image into ``out``: (H, W, 3) BGR, or (H, W) with 0 and 255 for a mask.

        Raises:
            VideoError: there is no next image, it cannot be decoded, or its size differs.
        """

    def skip(self) -> None:
        """Skip the next image. Raises as :meth:`read` does."""

    def jump(self, number: int) -> int:
        """Skip images before image ``number`` as far as none has to be decoded. Return the number of the next image,
        ``number`` at most, unless that was read before."""

    def close(self) -> None: ...


@dataclass(frozen=True)
class Clip(ABC):
    """A sequence of images on disk."""

    path: Path  # the file or folder, as messages name it
    width: int  # of the images, pixels
    height: int
    frame_count: int  # number of images
    is_mask: bool = False
    # (N,) times of the images, seconds, increasing, as the file gives them; None if it gives none
    times_s: NDArray[np.float64] | None = field(default=None, compare=False)
    recorded_size: tuple[int, int] | None = None  # width and height in the files, if the clip is reduced
    mask_form: MaskForm = field(default_factory=MaskForm, compare=False, repr=False)  # of a clip of masks

    @abstractmethod
    def open(self) -> Reader:
        """Return a reader at the first image."""

    @property
    def parts(self) -> tuple[Clip, ...]:
        """The clips whose images follow one another in this one."""
        return (self,)

    def shown(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the number of the image that each frame shows, the nearest before the start and after the end; -1 if
        the frame is blank."""
        return np.clip(frames, 0, self.frame_count - 1)

    def reduced(self, factor: int) -> Clip:
        """Return the same images, reduced as :meth:`tk.model.cameras.camera.Camera.reduced` says. A mask's pixel shows
        the person if at least half of its square does."""
        if factor == 1:
            return self
        size = self.width, self.height
        return replace(self, width=size[0] // factor, height=size[1] // factor, recorded_size=size)


def deliver(clip: Clip, picture: NDArray[Any], path: Path, out: Image) -> None:
    """Write a recorded image into ``out``, reduced as the clip says.

    Raises:
        VideoError: the image has another size than the clip.
    """
    height, width = picture.shape[:2]
    check_size(clip, width, height, path)
    if clip.is_mask:
        picture = clip.mask_form.convert(picture, path)
    if clip.recorded_size:
        factor = width // clip.width
        whole = picture[: factor * clip.height, : factor * clip.width]
        picture = np.asarray(cv2.resize(whole, (clip.width, clip.height), interpolation=cv2.INTER_AREA))
        if clip.is_mask:
            picture = _binarised(picture)
    if not np.may_share_memory(picture, out):
        out[...] = picture


def check_size(clip: Clip, width: int, height: int, path: Path) -> None:
    expected = clip.recorded_size or (clip.width, clip.height)
    if (width, height) != expected:
        raise VideoError(f"{path}: is {width}×{height}; the pictures before it are {expected[0]}×{expected[1]}")


def _binarised(grey: NDArray[Any]) -> Image:
    return np.asarray(cv2.threshold(grey, PERSON - 1, 255, cv2.THRESH_BINARY)[1], np.uint8)
