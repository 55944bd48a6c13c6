"""Which person is which subject."""

from __future__ import annotations

import numpy as np
import pytest

from tk.model.setup import Subject
from tk.people.choose import matched
from tk.people.find import LocatedPerson


def person(position: tuple[float, float, float], height_m: float) -> LocatedPerson:
    nothing = np.zeros(4)
    return LocatedPerson(
        position=np.array(position), height_m=height_m, volume_m3=0.06, inside=True,
        views=nothing > 0, share=nothing, points=np.zeros((0, 3)), voxel_m=0.05,
    )  # fmt: skip


@pytest.mark.parametrize("up", ["z", "y", "-y"])
def test_subjects_are_matched_by_place_on_the_floor_and_height(up: str) -> None:
    axis = "xyz".index(up[-1])
    near, far = np.full(3, 0.2), np.full(3, 1.5)
    near[axis], far[axis] = 0.9, 0.9
    people = [person(tuple(near), 1.80), person(tuple(far), 1.62)]
    place = far.copy()
    place[axis] = 0.0  # a mark on the floor
    there, tall = Subject(position=place), Subject(1.80)
    assert matched([there, tall], people, up) == [tall, there]


def test_a_subject_of_whom_nothing_is_known_gives_way_to_one_who_fits() -> None:
    (found,) = matched([Subject(in_init_pose=False), Subject(1.78)], [person((0, 0, 0.9), 1.80)], "z")
    assert found.height_m == 1.78
