"""The colours of overlays, 3D views and reports: left limbs warm, right limbs cool, trunk and head green.

A joint's colour shows its standard deviation. Colours are BGR, as in OpenCV.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Color = tuple[int, int, int]

SEGMENT_COLORS: dict[str, Color] = {
    "torso": (90, 170, 60),
    "pelvis": (60, 140, 40),
    "head": (120, 210, 120),
    "upper_arm_l": (30, 110, 240),
    "forearm_l": (70, 190, 250),
    "upper_arm_r": (220, 90, 40),
    "forearm_r": (245, 190, 90),
    "thigh_l": (40, 60, 215),
    "calf_l": (130, 140, 250),
    "thigh_r": (190, 50, 140),
    "calf_r": (240, 140, 210),
    "foot_l": (90, 100, 235),
    "foot_r": (215, 95, 175),
}
#: border of a lost frame, and the body in it
LOST: Color = (50, 50, 225)
LOST_BODY: Color = (150, 150, 150)
TEXT: Color = (240, 240, 240)
BONE: Color = (245, 245, 245)
INK: Color = (20, 20, 20)

#: standard deviation of the last colour, metres; larger ones have the same. Appearance only.
SIGMA_MOST_M = 0.05
#: certain to uncertain: pale yellow, orange, red, dark violet; lightness falls steadily, so it reads without colours
_SIGMA_STOPS = np.array([[255, 246, 170], [254, 190, 75], [240, 90, 50], [190, 25, 95], [70, 15, 95]], float)


def sigma_colors(sigma_m: ArrayLike) -> NDArray[np.uint8]:
    """Return the colours (N, 3) of N standard deviations along one axis, metres, none of them NaN."""
    place = np.clip(np.asarray(sigma_m, float) / SIGMA_MOST_M, 0, 1) * (len(_SIGMA_STOPS) - 1)
    stops = np.arange(len(_SIGMA_STOPS))
    rgb = np.stack([np.interp(place, stops, channel) for channel in _SIGMA_STOPS.T], axis=-1)
    return np.asarray(rgb[..., ::-1].round(), np.uint8)


def hexadecimal(color: Color) -> str:
    """Return a colour in HTML notation."""
    b, g, r = color
    return f"#{r:02x}{g:02x}{b:02x}"
