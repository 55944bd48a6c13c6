"""The colours of overlays, 3D views and reports: left limbs warm, right limbs cool, trunk and head green.

A joint's colour shows its standard deviation. Colours are BGR, as in OpenCV.
"""

from __future__ import annotations

from collections.abc import Sequence
from colorsys import hls_to_rgb
from functools import cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.model.body.joints import CHAINS, SEGMENTS, side_of

Color = tuple[int, int, int]

# Hue of each limb, degrees, and of the trunk with the head. Appearance only.
_HUES_DEG = {"": 135.0, "arm_l": 25.0, "leg_l": 5.0, "arm_r": 215.0, "leg_r": 280.0}


# Hue of the second person, and the angle to the next one's, degrees: the golden angle, which keeps any number of hues
# apart. People after the first are drawn in one colour each.
_SECOND_DEG, _NEXT_DEG = 50.0, 137.50776


def of_hue(hue_deg: float, lightness: float = 0.5, saturation: float = 0.8) -> Color:
    """Return a colour from its hue (0 red, 120 green, 240 blue), lightness and saturation in [0, 1]."""
    r, g, b = hls_to_rgb(hue_deg / 360 % 1.0, lightness, saturation)
    return round(255 * b), round(255 * g), round(255 * r)


def grey(lightness: float) -> Color:
    """Return a grey; 0 is black, 1 is white."""
    return of_hue(0.0, lightness, 0.0)


def _shades(hue_deg: float, segments: Sequence[str]) -> dict[str, Color]:
    """Return the colours of segments, dark ones beside light ones."""
    order = (*segments[::2], *segments[1::2])
    return {segment: of_hue(hue_deg, 0.45 + 0.1 * k, 0.7) for k, segment in enumerate(order)}


_TRUNK = tuple(segment for segment in SEGMENTS if not side_of(segment))
SEGMENT_COLORS = {
    segment: color
    for limb, hue_deg in _HUES_DEG.items()
    for segment, color in _shades(hue_deg, CHAINS.get(limb, _TRUNK)).items()
}
#: the colours of legends: of each side those of arm and leg, by their first segment
SIDE_COLORS: dict[str, tuple[Color, ...]] = {
    side: tuple(SEGMENT_COLORS[CHAINS[f"{limb}_{side[0]}"][0]] for limb in ("arm", "leg")) for side in ("left", "right")
} | {"trunk, head": (SEGMENT_COLORS[_TRUNK[0]],)}
# The other colours, by what they show. Appearance only.
#: errors: the border of a lost frame, a finding, a mask outside the hull
LOST = of_hue(0.0)
#: the body in a lost frame, and the cameras
LOST_BODY = WIRE = grey(0.6)
#: light letters and bones; white paper
TEXT = BONE = grey(0.95)
PAPER = grey(1.0)
#: dark letters and borders; the background of dark pictures
INK = BACKGROUND = grey(0.1)
FLOOR = grey(0.28)
#: the working volume
VOLUME = of_hue(210.0, 0.6)
#: elevation of the viewer in these views, degrees
ELEVATION_DEG = 14.0

#: standard deviation of the last colour, metres; larger ones have the same. Appearance only.
SIGMA_MOST_M = 0.05
#: the darkest of the 256 colours of Matplotlib's "inferno" that is used, dark violet: black would not show. The colours
#: run from pale yellow; lightness falls steadily, so they can be read without colour.
_DARKEST = 60


def sigma_colors(sigma_m: ArrayLike) -> NDArray[np.uint8]:
    """Return the colours (N, 3) of N standard deviations along one axis, metres, none of them NaN."""
    share = np.clip(np.asarray(sigma_m, float) / SIGMA_MOST_M, 0, 1)
    return np.asarray(_inferno()[(share * (255 - _DARKEST)).round().astype(int)], np.uint8)


@cache
def _inferno() -> NDArray[np.uint8]:
    return np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[::-1, None], cv2.COLORMAP_INFERNO)[:, 0])


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
    return of_hue(_SECOND_DEG + (person - 1) * _NEXT_DEG)
