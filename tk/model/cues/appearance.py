"""The colours of the body's patches (Kehl 2006, section 6.1.3).

Each patch has one Gaussian per YUV channel. The paper learns the model on the initialised body, segments the surface
voxels by it once a frame and updates the means by eq. 16. In its section 7.2 wrong assignments destroy the models. The
paper has no guard against this; the guards here are:

- a colour is learned only from samples near a voxel that a camera sees;
- a patch with fewer than three such samples is not updated;
- a lost frame updates nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tk.kernels.appearance import segment

Float = NDArray[np.float64]

# ITU-R BT.601 luma and colour differences, from B, G, R: U and V are B - Y and R - Y, scaled to a maximum. Three
# decimals, as the standard is printed.
_LUMA = np.array([0.114, 0.587, 0.299])
_BLUE, _, _RED = np.eye(3)
_MOST = ((_BLUE, 0.436), (_RED, 0.615))
_COLORS = [most * (color - _LUMA) / (1 - color @ _LUMA) for color, most in _MOST]
_YUV_FROM_BGR = np.round([_LUMA, *_COLORS], 3)

# α of eq. 16: the paper's.
RATE = 0.3
# Minimum standard deviations of Y, U, V, levels of 255: shading changes Y more than U and V.
FLOOR_YUV = (16.0, 6.0, 6.0)
# A voxel fits a patch if every channel lies within this many standard deviations of the mean. The paper does not say
# what fits.
WIDTH = 2.5


@dataclass(frozen=True)
class Appearance:
    """Colour models of P patches, YUV levels 0…255."""

    mean: Float  # (P, 3)
    deviation: Float  # (P, 3) standard deviations
    known: NDArray[np.bool_]  # (P,) bool; False for patches without voxels at the start, which fit every voxel

    @staticmethod
    def learn(patches: int, patch: NDArray[np.integer], colors_bgr: NDArray[np.floating]) -> Appearance:
        """Learn the models from the voxels near the initialised body.

        Args:
            patches: P.
            patch: (N,) patch of each sample.
            colors_bgr: (N, 3) colour of its nearest voxel.
        """
        yuv = to_yuv(colors_bgr)
        mean = np.zeros((patches, 3))
        deviation = np.zeros((patches, 3))
        known = np.zeros(patches, bool)
        for p in range(patches):
            mine = yuv[patch == p]
            if len(mine) >= 3:
                mean[p] = np.median(mine, axis=0)
                deviation[p] = 1.4826 * np.median(np.abs(mine - mean[p]), axis=0)
                known[p] = True
        return Appearance(mean, np.maximum(deviation, FLOOR_YUV), known)

    def segment(self, colors_bgr: NDArray[np.floating], seen: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return bit masks (V,) of the patches that each voxel fits."""
        bound = np.where(self.known[:, None], WIDTH * self.deviation, 1e9)
        return segment(self.mean, bound, to_yuv(colors_bgr), seen)

    def updated(self, patch: NDArray[np.integer], colors_bgr: NDArray[np.floating]) -> Appearance:
        """Return the models after eq. 16, from the colours (N, 3) of this frame's samples on patches (N,)."""
        P = len(self.mean)
        count = np.bincount(patch, minlength=P)
        yuv = to_yuv(colors_bgr)
        incoming = np.stack([np.bincount(patch, weights=yuv[:, a], minlength=P) for a in range(3)], axis=1)
        learns = self.known & (count >= 3)
        incoming = np.where(learns[:, None], incoming / np.maximum(count, 1)[:, None], self.mean)
        return replace(self, mean=(1 - RATE) * self.mean + RATE * incoming)


def to_yuv(colors_bgr: NDArray[np.floating]) -> Float:
    """Convert colours (N, 3) from BGR 0…255 to YUV; U and V lie around 0."""
    return np.asarray(colors_bgr, np.float64) @ _YUV_FROM_BGR.T
