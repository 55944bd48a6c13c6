"""Draw the pictures of docs/tutorial.md: docs/layouts.png (where cameras stand) and docs/boards.png (a board in view).

python -m scripts.tutorial_pictures
"""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
_GOOD, _BAD, _GREY, _INK = (70, 140, 60), (60, 60, 190), (150, 150, 150), (60, 60, 60)
_SIDE, _SCALE = 420, 45.0  # pixels of a plan, pixels a metre
Image = NDArray[np.uint8]

#: plans from above: title, azimuths of the cameras in degrees, whether they are good
_PLANS = (
    ("good: four at about 90 degrees", (40, 128, 221, 312), True),
    ("good: three at about 120 degrees", (30, 150, 268), True),
    ("bad: two pairs that face each other", (0, 90, 180, 270), False),
    ("bad: all on one side", (40, 65, 90, 115), False),
)


def plan(title: str, azimuths: tuple[int, ...], good: bool) -> Image:
    """Return a plan from above (H, W, 3): the volume, and the cameras with their views."""
    image = np.full((_SIDE + 40, _SIDE, 3), 255, np.uint8)
    middle = np.array([_SIDE / 2, _SIDE / 2 + 30])
    color = _GOOD if good else _BAD
    views = image.copy()
    for azimuth in np.radians(azimuths):
        eye = middle + 3.7 * _SCALE * np.array([np.cos(azimuth), -np.sin(azimuth)])
        edges = [
            eye + 5.5 * _SCALE * np.array([np.cos(azimuth + np.pi + turn), -np.sin(azimuth + np.pi + turn)])
            for turn in np.radians([-32, 32])
        ]
        cv2.fillPoly(views, [np.round([eye, *edges]).astype(np.int32)], color, cv2.LINE_AA)
        image = cv2.addWeighted(views, 0.12, image, 0.88, 0)
        views = image.copy()
        cv2.circle(image, tuple(np.round(eye).astype(int).tolist()), 9, color, -1, cv2.LINE_AA)
    half = 1.2 * _SCALE
    corners = [tuple(np.round(middle + sign * half).astype(int).tolist()) for sign in (-1, 1)]
    cv2.rectangle(image, corners[0], corners[1], _GREY, 2, cv2.LINE_AA)
    cv2.circle(image, tuple(np.round(middle).astype(int).tolist()), 12, _INK, 2, cv2.LINE_AA)
    cv2.putText(image, title, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.55, color, 1, cv2.LINE_AA)
    return image


def boards() -> Image:
    """Return five images of the board of `tk demo --raw` side by side, with what they are good for."""
    shown = (
        ("cam1", 0, "on the floor: the world", True),
        ("cam3", 8, "towards the camera", True),
        ("cam3", 40, "close, in a corner", True),
        ("cam1", 8, "turned away: not seen", False),
        ("cam1", 3, "nearly edge-on: too flat", False),
    )
    tiles = []
    for camera, n, text, good in shown:
        with av.open(str(ROOT / "tk" / "data" / "boards" / f"{camera}.mp4")) as video:
            images = [frame.to_ndarray(format="bgr24") for frame in video.decode(video=0)]
        tile = cv2.copyMakeBorder(cv2.resize(images[n], (320, 240)), 30, 0, 0, 4, cv2.BORDER_CONSTANT, value=(255,) * 3)
        cv2.putText(tile, text, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _GOOD if good else _BAD, 1, cv2.LINE_AA)
        tiles.append(tile)
    return np.hstack(tiles)


def main() -> None:
    """Run the command."""
    cv2.imwrite(str(ROOT / "docs" / "layouts.png"), np.hstack([plan(*one) for one in _PLANS]))
    cv2.imwrite(str(ROOT / "docs" / "boards.png"), boards())


if __name__ == "__main__":
    main()
