"""A calibration made at one picture size, a video of another: what can be explained is put right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tk.errors import CalibrationError
from tk.model.cameras.camera import Camera

#: codecs pad pictures to blocks of 16 pixels: a difference below this is padding that has been cut off, or left on
_BLOCK = 16


def fit_size(camera: Camera, width: int, height: int, clip: Path) -> tuple[Camera, str | None]:
    """The camera of a video of ``width`` × ``height`` pixels, and a line that says what was done to it.

    - The calibration does not say a size (0 × 0): the video's is taken.
    - A few pixels of difference (1088 rows against 1080) are a codec's padding at the right and the bottom. Pixels keep
      their places, so the matrix stays and the size becomes the video's.
    - One exact ratio in both directions is a scaled picture: the matrix is scaled. Pixel centres lie at integer
      coordinates, so a pixel x goes to s (x + ½) - ½.

    Raises:
        CalibrationError: the sizes agree in none of these ways.
    """
    calibrated = (camera.width, camera.height)
    if calibrated in ((width, height), (0, 0)):
        return replace(camera, width=width, height=height), None
    sizes = f"camera {camera.name!r}: calibrated at {camera.width}×{camera.height}, video {width}×{height}"
    if abs(width - camera.width) < _BLOCK and abs(height - camera.height) < _BLOCK:
        return (
            replace(camera, width=width, height=height),
            f"{sizes}: a codec's padding at the right and the bottom; the matrix stays as it is",
        )
    if width * camera.height == height * camera.width:
        scale = width / camera.width
        matrix = np.diag([scale, scale, 1.0]) @ camera.matrix
        matrix[:2, 2] = scale * (camera.matrix[:2, 2] + 0.5) - 0.5
        return (
            replace(camera, matrix=matrix, width=width, height=height),
            f"{sizes}: the video is scaled by {scale:g}, and so is the matrix",
        )
    turned = (
        "; is the video turned by 90°?"
        if abs(width - camera.height) < _BLOCK and abs(height - camera.width) < _BLOCK
        else ""
    )
    ratios = f"{width / camera.width:.4g} and {height / camera.height:.4g}"
    raise CalibrationError(
        f"{clip}: {sizes}: neither a few pixels of padding nor one scale in both directions ({ratios}){turned}; "
        "calibrate at the video's size, or export the video at the calibration's"
    )
