"""Regions of voxels, against SciPy's."""

import numpy as np
import pytest
import scipy

from tk.model.hull.coarse import regions


@pytest.mark.parametrize(("shape", "share"), [((9, 8, 7), 0.03), ((6, 9, 8), 0.15), ((4, 5, 3), 1.0), ((4, 4, 4), 0.0)])
def test_regions_are_those_of_scipy(shape: tuple[int, ...], share: float) -> None:
    voxels = np.random.default_rng(0).random(shape) < share
    found, (expected, count) = regions(voxels), scipy.ndimage.label(voxels, np.ones((3, 3, 3)))
    assert found.max() == count
    pairs = np.unique(np.stack([found.ravel(), expected.ravel()], axis=1), axis=0)
    assert len(pairs) == len(np.unique(expected)) and ((pairs > 0).sum(axis=1) != 1).all()
