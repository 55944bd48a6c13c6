"""Colours of a body's parts, learned as the person moves: which part does a pixel show?

Left and right share a model, as clothes do. A model is a histogram over 16 levels of blue, green and red; it holds what
a shirt with stripes, or an arm half in a sleeve, has of colours, which no single Gaussian does.

What the person carries is in the mask, too. Its colours are seen beside the body more than on it, or were never seen on
it before: such a colour is foreign.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from tk.kernels.line_search import COLOR_BINS, Regions
from tk.model.body.cone_body import ConeBody

Float = NDArray[np.float64]

GROUPS = ("torso", "pelvis", "head", "upper_arm", "forearm", "hand", "thigh", "calf", "foot")
# Standard deviation of the smoothing over bins, in bins: gain and white balance differ a little from camera to camera.
_SMOOTHING = 0.7
_SMOOTH = gaussian_filter1d(np.eye(16, dtype=np.float32), _SMOOTHING, axis=0, mode="nearest").T
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

    Attributes:
        group: (P,) the group of each part.
        log_likelihood: (G, COLOR_BINS) log p(colour | group); None before any colours are known.
        foreign: (COLOR_BINS,) bool, colours that are not the person's.
        mismatch: (COLOR_BINS, G) in [0, 1]: how much less likely a colour is on a part than on the part that it suits
            best.
    """

    def __init__(self, body: ConeBody) -> None:
        self.group = np.array([GROUPS.index(_group(part.component)) for part in body.parts], np.int32)
        self._counts: Float = np.zeros((len(GROUPS), COLOR_BINS))
        self._beside: Float = np.zeros(COLOR_BINS)
        self.foreign = np.zeros(COLOR_BINS, np.bool_)
        self.log_likelihood: NDArray[np.float32] | None = None
        self.mismatch = np.zeros((COLOR_BINS, len(GROUPS)), np.float32)

    @property
    def known(self) -> bool:
        """Whether any colours have been learned."""
        return self.log_likelihood is not None

    def learn(self, bins: NDArray[np.int32], label: NDArray[np.uint8]) -> None:
        """Take up the colours (N,) of the person's pixels, which show the parts ``label - 1`` (N,), or none: 0."""
        shown = label > 0
        flat = self.group[label[shown].astype(np.int64) - 1] * COLOR_BINS + bins[shown]
        seen = np.bincount(flat, minlength=self._counts.size).reshape(self._counts.shape)
        beside = np.bincount(bins[~shown], minlength=COLOR_BINS)
        rate = _RATE if self.known else 1.0
        self._counts = (1 - rate) * self._counts + rate * seen
        self._beside = (1 - rate) * self._beside + rate * beside
        self._update()

    def _update(self) -> None:
        *rows, beside = _smooth(np.concatenate([self._counts, self._beside[None]]))
        total = np.sum(rows, axis=1, keepdims=True)
        share = rows / np.maximum(total, 1e-9)
        told = np.log(((1 - _ANYTHING) * share + _ANYTHING / COLOR_BINS).astype(np.float32))
        self.log_likelihood = told
        self.mismatch = np.ascontiguousarray(np.minimum((told.max(axis=0) - told) / _MOST_LOG_RATIO, 1.0).T)
        self.foreign = beside + _ANYTHING * total.sum() / COLOR_BINS > np.sum(rows, axis=0)

    def regions(self, images: NDArray[np.uint8]) -> Regions | None:
        """What the contours' search needs to use the colours of images (V, H, W, 3); None before any are known."""
        if self.log_likelihood is None:
            return None
        return Regions(np.ascontiguousarray(images), self.log_likelihood, self.group, _CONTOUR_WEIGHT)

    def state(self) -> dict[str, Any]:
        """What :meth:`restore` needs."""
        return {"colors": self._counts, "colors_beside": self._beside} if self.known else {}

    def restore(self, state: Any) -> None:
        """Take up what :meth:`state` gave."""
        if "colors" in state:
            self._counts = np.asarray(state["colors"], np.float64)
            self._beside = np.asarray(state["colors_beside"], np.float64)
            self._update()


def color_bins(images: NDArray[np.uint8]) -> NDArray[np.int32]:
    """(...) the bin of each pixel (..., 3) BGR, as the kernels number them."""
    blue, green, red = (images[..., i] >> 4 for i in range(3))
    return np.asarray((blue.astype(np.int32) << 8) | (green << 4 | red))


def _smooth(counts: Float) -> NDArray[np.float32]:
    """Histograms (N, COLOR_BINS), each smoothed over its neighbouring bins."""
    cubes = counts.reshape(-1, 16, 16, 16).astype(np.float32)
    for _ in range(3):  # along the last axis, which then becomes the first of the three
        cubes = np.moveaxis(cubes @ _SMOOTH, 3, 1)
    return cubes.reshape(counts.shape)


def _group(component: str) -> str:
    return component[:-2] if component.endswith(("_l", "_r")) else component
