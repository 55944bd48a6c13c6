"""The values of `/status`."""

from __future__ import annotations

from enum import IntEnum


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
