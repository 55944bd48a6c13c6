"""Sizes that are impossible for a person.

The limits are wide: a value outside is impossible, or so unlikely that a wrong calibration, wrong masks or a wrong pose
are likelier. Statures: adults measure 1.3 to 2.2 m, children of six 1 m and more (WHO growth reference 2007: three
standard deviations below the median). The height of a smaller person is given in `capture.toml`.
"""

from __future__ import annotations

import math

from tk.errors import CaptureError
from tk.model.body.body_fit import STATURE_DEVIATION

# Statures that are accepted if the height is not given, metres: see above.
STATURE_M = (1.0, 2.3)
# Greatest extent of a person, in heights: crouched with bent arms (0.55), upright with raised arms (1.5).
EXTENT = (0.55, 1.5)
# A given height is contradicted by a fitted body that is so many standard deviations (STATURE_DEVIATION) off, 6 %. The
# prior holds the fit at about half of a difference, so the silhouettes then show 10 to 15 % more or less than given:
# more than a hat and thick soles, less than lenses that are all 1.2 times too long (the fit is 7 to 8 % off).
_CONTRADICTED = 4.0

_CAUSES = "the unit or the scale of calibration.toml is wrong, or the masks show more or less than the person"


def fits_height(extent_m: float, height_m: float) -> bool:
    """Return whether a person of this height may have this greatest extent; True for an unknown one (NaN)."""
    return not (extent_m < EXTENT[0] * height_m or extent_m > EXTENT[1] * height_m)


def check_extent(extent_m: float, height_m: float) -> None:
    """Refuse a hull that is too small or too large for a person of this height.

    Args:
        extent_m: the hull's greatest extent; NaN without a hull, which is accepted.
        height_m: the height in `capture.toml`.

    Raises:
        CaptureError: with the likely causes.
    """
    if not fits_height(extent_m, height_m):
        raise CaptureError(
            f"the person measures {extent_m:.2f} m in the images, but [subject] height in capture.toml says "
            f"{height_m:.2f} m: {_CAUSES}"
        )


def height_contradiction(fitted_m: float, height_m: float) -> str:
    """Return why a fitted body contradicts the given height, one line; empty if it does not.

    The height is the mean of the body's prior, so the fit leaves it only where many silhouettes demand it: cameras that
    all have too long a focal length show everybody smaller, and agree about a person between them.

    Args:
        fitted_m: height of the body without shoes, metres.
        height_m: the height in `capture.toml`.
    """
    if abs(math.log(fitted_m / height_m)) <= _CONTRADICTED * STATURE_DEVIATION:
        return ""
    return (
        f"the silhouettes fit a person of {fitted_m:.2f} m or {'less' if fitted_m < height_m else 'more'}, but "
        f"[subject] height in capture.toml says {height_m:.2f} m: correct it, or {_CAUSES}"
    )


def check_stature(stature_m: float) -> None:
    """Refuse an impossible stature, estimated from silhouettes because `capture.toml` has no height.

    Raises:
        CaptureError: with the likely causes.
    """
    if not STATURE_M[0] <= stature_m <= STATURE_M[1]:
        raise CaptureError(
            f"the person measures {stature_m:.2f} m in the images: {_CAUSES}; if the size is right, or the person "
            "does not stand at the beginning, give [subject] height in capture.toml"
        )
