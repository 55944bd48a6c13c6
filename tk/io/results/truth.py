"""The ground truth in the frames of a result."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.io.results.data import Result
from tk.io.results.reader import read_people

Float = NDArray[np.float64]


def truth_of(result: Result, path: Path) -> Float | None:
    """Return the ground-truth joints (P, F, 15, 3) of each person in the result's frames, NaN if missing; None without
    the file."""
    if not path.exists():
        return None
    people = read_people(path)
    places = np.full((len(people), len(result), *people[0].positions.shape[1:]), np.nan)
    for person, track in zip(places, people, strict=True):
        _, mine, theirs = np.intersect1d(result.frames, track.frames, return_indices=True)
        person[mine] = track.positions[theirs]
    return places
