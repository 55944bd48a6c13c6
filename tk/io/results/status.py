"""Status of a frame: the values of `/status`."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Status(IntEnum):
    """The values of `/status`."""

    TRACKED = 0
    INITIALISED = 1
    RECOVERED = 2
    LOST = 3
    SUSPECT = 4
    ABSENT = 5


#: meaning of each value
STATUS_MEANING = ("tracked", "initialised", "recovered after loss", "lost", "suspect", "absent")


def has_pose(status: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return for each status (...) whether the frame has a pose: True unless the person is lost or absent."""
    return ~np.isin(status, (Status.LOST, Status.ABSENT))
