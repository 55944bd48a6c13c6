"""Colours of a body's parts, learned as the person moves: which part does a pixel show?

Left and right share a model, as clothes do. A model is a histogram over 16 levels of blue, green and red; it holds what
a shirt with stripes, or an arm half in a sleeve, has of colours, which no single Gaussian does.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tk.kernels.silhouette import COLOR_BINS, Regions
from tk.model.cone_body import ConeBody

Float = NDArray[np.float64]

GROUPS = ("torso", "pelvis", "head", "upper_arm", "forearm", "hand", "thigh", "calf", "foot")
# Standard deviation of the smoothing over bins, in bins: gain and white balance differ a little from camera to camera.
_SMOOTHING = 0.7
# Share of a part's pixels that may have any colour: outlines, shadows, what the person carries.
_ANYTHING = 0.02
# How much of the models a frame's colours replace.
_RATE = 0.05
# A pixel's colour says at most this about the parts, as a ratio of likelihoods: e⁵.
_MOST_LOG_RATIO = 5.0
# Weight of a contour between two parts of different colours, beside that of a silhouette's edge.
_CONTOUR_WEIGHT = 0.5


class PartColors:
    """The colour models of one person.

    Args:
        body: whose parts they are.
    """

    def __init__(self, body: ConeBody) -> None:
        self.group = np.array([GROUPS.index(_group(part.component)) for part in body.parts], np.int32)
        self._counts: Float = np.zeros((len(GROUPS), COLOR_BINS))
        self.log_likelihood: NDArray[np.float32] | None = None

    @property
    def known(self) -> bool:
        """Whether any colours have been learned."""
        return self.log_likelihood is not None

    def learn(self, bins: NDArray[np.int32], label: NDArray[np.uint8]) -> None:
        """Take up the colours (N,) of pixels that show the parts ``label - 1`` (N,)."""
        flat = self.group[label.astype(np.int64) - 1] * COLOR_BINS + bins
        seen = np.bincount(flat, minlength=self._counts.size).reshape(self._counts.shape)
        self._counts = seen.astype(np.float64) if not self.known else (1 - _RATE) * self._counts + _RATE * seen
        self._update()

    def _update(self) -> None:
        cubes: list[Float] = [
            gaussian_filter(row.reshape(16, 16, 16), _SMOOTHING, mode="nearest").ravel() for row in self._counts
        ]
        share = np.stack(cubes).astype(np.float64)
        share = share / np.maximum(share.sum(axis=1, keepdims=True), 1e-9)
        self.log_likelihood = np.log((1 - _ANYTHING) * share + _ANYTHING / COLOR_BINS).astype(np.float32)

    def mismatch(self) -> NDArray[np.float32]:
        """(COLOR_BINS, G) in [0, 1]: how much less likely a colour is on a part than on the part that it suits best."""
        if self.log_likelihood is None:
            return np.zeros((COLOR_BINS, len(GROUPS)), np.float32)
        worse = (self.log_likelihood.max(axis=0) - self.log_likelihood) / _MOST_LOG_RATIO
        return np.ascontiguousarray(np.clip(worse, 0.0, 1.0).T)

    def regions(self, images: NDArray[np.uint8]) -> Regions | None:
        """What the contours' search needs to use the colours of images (V, H, W, 3); None before any are known."""
        if self.log_likelihood is None:
            return None
        return Regions(np.ascontiguousarray(images), self.log_likelihood, self.group, _CONTOUR_WEIGHT)

    def state(self) -> dict[str, Any]:
        """What :meth:`restore` needs."""
        return {"colors": self._counts} if self.known else {}

    def restore(self, state: Any) -> None:
        """Take up what :meth:`state` gave."""
        if "colors" in state:
            self._counts = np.asarray(state["colors"], np.float64)
            self._update()


def color_bins(images: NDArray[np.uint8]) -> NDArray[np.int32]:
    """(...) the bin of each pixel (..., 3) BGR, as the kernels number them."""
    levels = images.astype(np.int32) >> 4
    return np.asarray((levels[..., 0] << 8) | (levels[..., 1] << 4) | levels[..., 2])


def _group(component: str) -> str:
    return component[:-2] if component.endswith(("_l", "_r")) else component
