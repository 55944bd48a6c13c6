"""Connected components of voxels."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage

from tk.model.hull.voxel_table import components


@pytest.mark.parametrize("share", [0.0, 0.2, 0.35, 0.6])
def test_components_are_numbered_as_by_scipy(share: float) -> None:
    shown = np.random.default_rng(3).random((12, 9, 11)) < share
    np.testing.assert_array_equal(components(shown), scipy.ndimage.label(shown)[0])
