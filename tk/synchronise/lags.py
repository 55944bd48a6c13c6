"""Correlation of two signals at all lags, with its significance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

Float = NDArray[np.float64]


def fast_length(least: int) -> int:
    """Return a length of at least ``least`` whose Fourier transform is fast."""
    return int(next_fast_len(least, real=True))


def correlate(a: Float, b: Float, least: int) -> tuple[NDArray[np.int64], Float, Float]:
    """Return lags, the correlation coefficient at each, and its significance in standard deviations.

    At a lag n, ``a[k]`` is compared with ``b[k - n]``, over the samples that both have. The significance takes into
    account that neighbouring samples are alike (Bartlett's formula).

    Args:
        a, b: (N, F), (M, F) signals; F is summed over. Their means are 0.
        least: fewest samples that are compared.

    Returns:
        lags (L,), coefficients (L,), significances (L,).
    """
    size = fast_length(len(a) + len(b))

    def cross(x: Float, y: Float) -> Float:
        total = np.zeros(size // 2 + 1, complex)
        for f in range(x.shape[1]):
            total += rfft(x[:, f], size) * np.conj(rfft(y[:, f], size))
        return np.asarray(irfft(total, size))

    lags = np.arange(-len(b) + 1, len(a))
    both = cross(a, b)[lags]
    square_a, square_b = (a**2).sum(axis=1, keepdims=True), (b**2).sum(axis=1, keepdims=True)
    energy_a = cross(square_a, np.ones((len(b), 1)))[lags]
    energy_b = cross(np.ones((len(a), 1)), square_b)[lags]
    overlap = np.minimum(len(a), len(b) + lags) - np.maximum(0, lags)
    usable = overlap >= least
    # where one signal is nearly constant there is nothing to compare
    floor = 1e-3 * np.sqrt(max(float(square_a.mean() * square_b.mean()), 0.0)) * overlap + 1e-300
    scale = np.sqrt(np.maximum(energy_a, 0.0) * np.maximum(energy_b, 0.0))
    r = np.where(usable, both / np.maximum(scale, floor), 0.0)
    own_a, own_b = cross(a, a), cross(b, b)
    near = np.arange(-min(len(a), len(b)) + 1, min(len(a), len(b)))
    alike = float((own_a[near] * own_b[near]).sum() / max(own_a[0] * own_b[0], 1e-300))
    z = np.arctanh(np.clip(r, -0.999, 0.999)) * np.sqrt(overlap / max(alike, 1.0))
    return lags, r, np.where(usable, z, -np.inf)
