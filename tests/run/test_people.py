"""The people of a run who are not tracked."""

from __future__ import annotations

import numpy as np

from tk.kernels.raycast import Cast
from tk.run.people import Bystander


def test_second_of_two_bystanders_is_removed() -> None:
    depth = np.full((4, 3, 3), 2.0, np.float32)
    both = [Bystander(np.array([x, 0.0, 1.0]), Cast(np.ones((4, 3, 3), np.uint8), depth)) for x in (0.0, 1.0)]
    first, second = both
    both.remove(second)
    assert len(both) == 1 and both[0] is first
