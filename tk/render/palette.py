"""The colours of overlays, 3D views and reports: left limbs warm, right limbs cool, trunk and head green.

A joint's colour shows its standard deviation. Colours are BGR, as in OpenCV.
"""

from __future__ import annotations

from collections.abc import Sequence
from colorsys import hls_to_rgb

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.model.body.joints import CHAINS, SEGMENTS, side_of

Color = tuple[int, int, int]

# Hue of each limb, degrees, and of the trunk with the head. Appearance only.
_HUES_DEG = {"": 135.0, "arm_l": 25.0, "leg_l": 5.0, "arm_r": 215.0, "leg_r": 280.0}


# Hues of the people after the first, who are drawn in one colour each, degrees. Appearance only.
_PEOPLE_DEG = (50.0, 320.0, 180.0, 100.0)


def _shades(hue_deg: float, segments: Sequence[str]) -> dict[str, Color]:
    """Return the colours of segments, dark ones beside light ones."""
    colors = {}
    for k, segment in enumerate((*segments[::2], *segments[1::2])):
        rgb = hls_to_rgb(hue_deg / 360, 0.45 + 0.1 * k, 0.7)
        r, g, b = (round(255 * value) for value in rgb)
        colors[segment] = (b, g, r)
    return colors


_TRUNK = tuple(segment for segment in SEGMENTS if not side_of(segment))
SEGMENT_COLORS = {
    segment: color
    for limb, hue_deg in _HUES_DEG.items()
    for segment, color in _shades(hue_deg, CHAINS.get(limb, _TRUNK)).items()
}
#: border of a lost frame, and the body in it
LOST: Color = (50, 50, 225)
LOST_BODY: Color = (150, 150, 150)
TEXT: Color = (240, 240, 240)
BONE: Color = (245, 245, 245)
INK: Color = (20, 20, 20)
#: background, floor grid and cameras of the views in three dimensions
BACKGROUND: Color = (34, 30, 28)
FLOOR: Color = (78, 70, 66)
WIRE: Color = (190, 170, 150)
#: elevation of the viewer in these views, degrees
ELEVATION_DEG = 14.0

#: standard deviation of the last colour, metres; larger ones have the same. Appearance only.
SIGMA_MOST_M = 0.05
#: the darkest of the 256 colours of Matplotlib's "inferno" that is used, dark violet: black would not show. The colours
#: run from pale yellow; lightness falls steadily, so they can be read without colour.
_DARKEST = 60


def sigma_colors(sigma_m: ArrayLike) -> NDArray[np.uint8]:
    """Return the colours (N, 3) of N standard deviations along one axis, metres, none of them NaN."""
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[::-1, None], cv2.COLORMAP_INFERNO)[:, 0]
    share = np.clip(np.asarray(sigma_m, float) / SIGMA_MOST_M, 0, 1)
    return np.asarray(table[(share * (255 - _DARKEST)).round().astype(int)], np.uint8)


def unit_rgb(color: Color) -> list[float]:
    """Return red, green and blue of a colour in [0, 1]."""
    return [channel / 255 for channel in reversed(color)]


def hexadecimal(color: Color) -> str:
    """Return a colour in HTML notation."""
    b, g, r = color
    return f"#{r:02x}{g:02x}{b:02x}"


def person_color(person: int) -> Color:
    """Return the colour of a person; the first person's segments have colours of their own, and this is the trunk's."""
    if person == 0:
        return SEGMENT_COLORS[_TRUNK[0]]
    r, g, b = hls_to_rgb(_PEOPLE_DEG[(person - 1) % len(_PEOPLE_DEG)] / 360, 0.5, 0.8)
    return round(255 * b), round(255 * g), round(255 * r)
