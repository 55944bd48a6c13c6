"""A camera that is upside down is not taken for a second person, and a second person not for a wrong camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from tests.model.test_people import FINDER, RIG, VOLUME, drawn
from tk.model.setup import Setup, Subject
from tk.people.choose import really_there
from tk.people.find import LocatedPerson
from tk.trackers.protocol import Frame

SETUP = Setup(RIG, VOLUME, "z", 15.0, (Subject(None, 0),))


def opening(frames: Sequence[np.ndarray]) -> list[Frame]:
    """Return observations of masks (C, H, W) bool."""
    return [Frame(k, np.empty((len(RIG), 0, 0, 3), np.uint8), np.uint8(255) * m) for k, m in enumerate(frames)]


def both(frames: list[Frame]) -> tuple[Sequence[LocatedPerson], Sequence[LocatedPerson]]:
    """Return who is found in all cameras, and who is really there."""
    found = FINDER.find(frames[0].masks)
    return found, really_there(FINDER, SETUP, frames, found)


@pytest.mark.parametrize(
    ("place", "camera", "seen"),
    [((-0.7, -0.7), 0, 2), ((0.3, -0.6), 2, 1), ((0.8, 0.0), 3, 1), ((0.1, 0.2), 4, 0), ((-0.5, 0.4), 3, 0)],
)
def test_a_camera_upside_down_hides_nobody_and_makes_nobody(place: tuple[float, float], camera: int, seen: int) -> None:
    frames = []
    for k in range(2):
        masks = drawn([(place[0] + 0.1 * k, place[1])]).any(axis=0)
        masks[camera] = masks[camera, ::-1, ::-1]
        frames.append(masks)
    found, (person,) = both(opening(frames))
    assert len(found) == seen
    assert np.linalg.norm(person.position[:2] - place) < 0.15
    assert person.height_m == pytest.approx(1.75, abs=0.1)
    assert np.flatnonzero(~person.views).tolist() == [camera]


@pytest.mark.parametrize("cameras", [[0], [0, 1], [0, 1, 2, 3, 4]])
def test_a_second_person_whom_some_cameras_show_stays(cameras: list[int]) -> None:
    frames = []
    for k in range(2):
        alone = drawn([(0.3 + 0.1 * k, 0.6), (-0.7, -0.4)])
        alone[1, [c for c in range(len(RIG)) if c not in cameras]] = False
        frames.append(alone.any(axis=0))
    found, people = both(opening(frames))
    assert people is found
