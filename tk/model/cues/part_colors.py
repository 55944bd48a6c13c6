"""Colours of a body's parts, learned while the person moves: how likely is a pixel's colour on each part?

Parts of one group (:data:`~tk.model.body.cone_body.COLOR_GROUPS`) share a model: a histogram over 16 levels of blue,
green and red. Unlike a single Gaussian it represents a shirt with stripes, or an arm half in a sleeve.

Carried objects are in the mask, too. A colour is foreign if it is seen outside the body more often than on it, or was
never seen on it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.line_search import COLOR_BINS, Regions
from tk.model.body.cone_body import COLOR_GROUPS, ConeBody
from tk.model.stateful import Stateful

Float = NDArray[np.float64]
Single = NDArray[np.float32]

# Standard deviation of the smoothing over bins, in bins: gain and white colour differ a little between cameras.
_SMOOTHING = 0.7
# Share of a part's pixels that may have any colour: outlines, shadows, carried objects.
_ANYTHING = 0.02
# Share of what is learned that a frame replaces: it follows a change of light or clothes within about 20 frames.
RATE = 0.05
# Logarithm of the largest likelihood ratio that one pixel may give.
_MOST_LOG_RATIO = 5.0
# Weight of a contour between two parts of different colours, relative to a silhouette's edge.
_CONTOUR_WEIGHT = 0.5


class RenderedBody(NamedTuple):
    """A body on a grid of rays, and the colours of its parts."""

    label: NDArray[np.uint8]  # (V, h, w), 1 + the part that a ray meets first, 0 where it meets nothing
    depth: NDArray[np.float32]  # (V, h, w), see `tk.kernels.raycast.Cast`
    group: NDArray[np.int32] | None = None  # (P,) the colour group of each part; None if the colours are unknown
    # (G + 1, COLOR_BINS) log p(colour | group), last log p(colour | person); None if the colours are unknown
    log_likelihood: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class LearnedColors:
    """Counts of the colours of each group (G, COLOR_BINS), and beside the body (COLOR_BINS,); None before any are
    learned."""

    counts: Float | None
    outside: Float | None


class PartColors(Stateful[LearnedColors]):
    """The colour models of one person.

    Args:
        body: the body with the parts.

    Attributes:
        log_likelihood: (G + 1, COLOR_BINS) log p(colour | group), and last log p(colour | person); None before any
            colours are learned.
        foreign: (COLOR_BINS,) bool, colours that are not the person's.
        mismatch: (COLOR_BINS, G) in [0, 1], how much less likely a colour is in a group than in its likeliest group.
    """

    State = LearnedColors

    def __init__(self, body: ConeBody) -> None:
        self._group = body.color_group
        self._counts: Float | None = None
        self._outside: Float | None = None
        self._forget()

    def _forget(self) -> None:
        self.foreign = np.zeros(COLOR_BINS, np.bool_)
        self.log_likelihood: NDArray[np.float32] | None = None
        self.mismatch = np.zeros((COLOR_BINS, len(COLOR_GROUPS)), np.float32)

    @property
    def known(self) -> bool:
        """Return whether any colours have been learned."""
        return self._counts is not None

    def learn(self, bins: NDArray[np.int32], label: NDArray[np.uint8], weight: Single | None = None) -> None:
        """Learn the colours (N,) of the mask's pixels; they show the parts ``label - 1`` (N,), or none: 0. ``weight``:
        (N,) in [0, 1], how far each pixel counts; None: fully."""
        shown = label > 0
        counts = np.zeros((len(COLOR_GROUPS), COLOR_BINS)) if self._counts is None else self._counts
        before = np.zeros(COLOR_BINS) if self._outside is None else self._outside
        flat = self._group[label[shown].astype(np.int64) - 1] * COLOR_BINS + bins[shown]
        of_shown, of_rest = (None, None) if weight is None else (weight[shown], weight[~shown])
        seen = np.bincount(flat, of_shown, minlength=counts.size).reshape(counts.shape)
        outside = np.bincount(bins[~shown], of_rest, minlength=COLOR_BINS)
        rate = RATE if self.known else 1.0
        self._counts = (1 - rate) * counts + rate * seen
        self._outside = (1 - rate) * before + rate * outside
        self._update()

    def _update(self) -> None:
        assert self._counts is not None and self._outside is not None
        smooth = _smooth(np.concatenate([self._counts, self._outside[None]]))
        outside, rows = smooth[-1], np.concatenate([smooth[:-1], smooth[:-1].sum(axis=0, keepdims=True)])
        total = np.sum(rows, axis=1, keepdims=True)
        share = rows / np.maximum(total, 1e-9)
        log_likelihood = np.log(((1 - _ANYTHING) * share + _ANYTHING / COLOR_BINS).astype(np.float32))
        self.log_likelihood = log_likelihood
        self.mismatch = np.ascontiguousarray(deficit(log_likelihood.max(axis=0), log_likelihood[:-1]).T)
        self.foreign = outside + _ANYTHING * total[-1] / COLOR_BINS > rows[-1]

    def regions(self, images: NDArray[np.uint8], size: tuple[int, int]) -> Regions | None:
        """Return the colour cue of images (V, h, w, 3), reduced or not, of cameras of a ``size`` (H, W), for the
        contours; None without images, and before any colours are learned."""
        if self.log_likelihood is None or not images.size:
            return None
        step = size[0] // images.shape[1]
        return Regions(np.ascontiguousarray(images), self.log_likelihood, _CONTOUR_WEIGHT, step)

    def likeness(self, bins: NDArray[np.int32]) -> float:
        """Return the mean log-likelihood of colours (N,), relative to that of the learned colours: about 0 if they are
        the person's, less otherwise. 0 before any colours are learned."""
        if self.log_likelihood is None or self._counts is None or not len(bins):
            return 0.0
        likeliest, seen = self.log_likelihood.max(axis=0), self._counts.sum(axis=0)
        return float(likeliest[bins].mean() - seen @ likeliest / seen.sum())

    def _restored(self) -> None:
        if self.known:
            self._update()
        else:
            self._forget()


def deficit(likelier: Single, log_likelihood: Single) -> Single:
    """Return in [0, 1] by how much log-likelihoods (...) are below others (...): 0 if they are not, 1 from
    :data:`_MOST_LOG_RATIO` on."""
    return np.clip((likelier - log_likelihood) / _MOST_LOG_RATIO, 0.0, 1.0)


def color_bins(images: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return (...) the bin of each pixel (..., 3) BGR, numbered as in the kernels."""
    blue, green, red = images[..., 0], images[..., 1], images[..., 2]
    return (blue & np.uint8(0xF0)).astype(np.int32) << 4 | (green & np.uint8(0xF0) | red >> 4)


def _smooth(counts: Float) -> NDArray[np.float32]:
    """Return histograms (N, COLOR_BINS), each smoothed over neighbouring bins."""
    cubes = counts.astype(np.float32)
    for _ in range(3):  # along the last axis of each cube, which then becomes the first of the three
        cubes = _smoothing() @ cubes.reshape(-1, 256, 16).swapaxes(1, 2)
    return cubes.reshape(counts.shape)


@functools.cache
def _smoothing() -> NDArray[np.float32]:
    """Return the matrix (16, 16) that smooths a histogram of 16 bins, a column."""
    across = 2 * int(4 * _SMOOTHING + 0.5) + 1
    weights = cv2.GaussianBlur(np.eye(16), (1, across), _SMOOTHING, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(weights, np.float32)
