"""Adapt a camera calibrated at one image size to a video of another size."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tk.errors import CalibrationError
from tk.model.cameras.camera import Camera

#: codecs pad images to blocks of 16 pixels: a smaller difference in size is padding, removed or kept
_BLOCK = 16


def fit_size(camera: Camera, width: int, height: int, clip: Path) -> tuple[Camera, str | None]:
    """Return the camera of a video of ``width`` × ``height`` pixels, and a note about the change.

    - A calibration without a size (0 × 0) takes the video's size.
    - A difference of a few pixels (1088 rows against 1080) is a codec's padding at the right and the bottom: the matrix
      stays the same.
    - One exact ratio in both directions is a scaled image: the matrix is scaled. Pixel centres are integers, so a pixel
      x maps to s (x + ½) - ½.

    Raises:
        CalibrationError: none of these rules applies.
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
