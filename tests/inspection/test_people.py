"""Who `tk inspect` finds in a capture: walkers drawn into the masks of a ring of cameras."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.conftest import Tk
from tests.model.figures import BODY, draw_silhouettes
from tests.walkers import RIG, stroll, write_masks
from tk.inspection.people import PeopleWatch
from tk.io.captures.capture import open_capture
from tk.people.find import LocatedPerson, PeopleFinder
from tk.run.segmentation import Labels

FRAMES = 12


def write_walkers(folder: Path, ways: list[list[tuple[float, float]]]) -> None:
    """Write a capture of people who walk from the first to the last point of their ways."""
    places = [np.linspace(*way, FRAMES).T for way in ways]
    write_masks(folder, np.max([draw_silhouettes(BODY, RIG, stroll(x, 15, y)) for x, y in places], axis=0))


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two people who walk past each other, 0.7 m apart."""
    folder = tmp_path_factory.mktemp("crossing")
    write_walkers(folder, [[(-0.7, -0.35), (0.7, -0.35)], [(0.8, 0.35), (-0.8, 0.35)]])
    return folder


def test_people_who_cross_keep_their_numbers(tk: Tk, crossing: Path, tmp_path: Path) -> None:
    ran = tk("inspect", crossing, "--json", "-o", tmp_path)
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    people = found["people"]
    assert [person["number"] for person in people] == [0, 1]
    for person, (start, stop) in zip(people, [(-0.7, 0.7), (0.8, -0.8)], strict=True):
        assert person["inside"] == 1.0 and len(person["cameras"]) == 4
        assert person["frames"][0] == 0 and person["frames"][-1] > FRAMES - 5
        path = np.array(person["path"])
        assert path[0, 0] == pytest.approx(start, abs=0.2)
        assert path[-1, 0] == pytest.approx(stop, abs=0.45)
        assert (np.sign(path[:, 1]) == np.sign(start)).all()
    assert any(line.startswith("2 people are in view, 2 of them in the volume") for line in found["findings"])
    assert not any("not connected" in line for line in found["findings"])
    plan = cv2.imread(str(tmp_path / "people.png"))
    assert min(plan.shape[:2]) > 500


def test_people_outside_the_volume_make_no_camera_inconsistent(tk: Tk, tmp_path: Path) -> None:
    write_walkers(tmp_path, [[(-0.3, -0.5), (0.3, -0.5)], [(2.2, 0.9), (0.9, 0.9)]])
    ran = tk("inspect", tmp_path, "--json")
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    first, second = found["people"]
    assert first["enters"] == 0 and 0 < second["enters"] < FRAMES and 0 < second["inside"] < 1
    assert found["extent_m"] == pytest.approx(1.75, abs=0.1)
    assert max(camera["outside"] for camera in found["cameras"]) < 0.05
    findings = "\n".join(found["findings"])
    assert "do not belong together" not in findings and "something else" not in findings
    assert f"person 1 enters the volume at about frame {second['enters']}" in findings


def test_checks_and_numbers_begin_when_the_first_person_enters(tk: Tk, tmp_path: Path) -> None:
    write_walkers(tmp_path, [[(-0.3, 1.8), (0.3, 1.8)], [(2.4, 0.3), (0.2, 0.3)]])
    found = json.loads(tk("inspect", tmp_path, "--json").out)
    person, other = found["people"]
    assert 0 == person["frames"][0] < person["enters"] <= found["frames"][0]
    assert other["enters"] is None
    assert f"the volume is empty before about frame {person['enters']}: tk track" in "".join(found["findings"])
    assert found["with_hull"] == 1.0


def test_one_person_is_listed_without_a_finding(tk: Tk, tmp_path: Path) -> None:
    write_walkers(tmp_path, [[(-0.3, 0.0), (0.3, 0.0)]])
    ran = tk("inspect", tmp_path)
    assert ran.code == 0, ran.err
    assert "person 0: frames 0 to " in ran.out and "person 1:" not in ran.out
    assert "people are in view" not in ran.out


def person(x: float) -> LocatedPerson:
    position = np.array([x, 0.0, 0.9])
    return LocatedPerson(position, 1.7, 0.08, position[None], 0.06, np.ones(4, bool), np.ones(4), abs(x) < 1.3)


def test_people_are_numbered_in_the_order_in_which_they_enter_the_volume(
    crossing: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, third, never = 0.1, 0.5, 1.1, 2.5
    looks = iter([[never, 1.5, first], [never, 1.4, first, second]] + 20 * [[never, third, first, second]])
    monkeypatch.setattr(PeopleFinder, "find", lambda *_, **__: tuple(map(person, next(looks))))
    watch = PeopleWatch(open_capture(crossing), range(FRAMES))
    for index in filter(watch.wants, range(FRAMES)):
        watch.look(index, Labels(np.zeros((4, 120, 160), np.uint8)))
    assert [(p.number, p.path[-1][0]) for p in watch.people()] == list(enumerate([first, second, third, never]))
    assert [p.enters for p in watch.people()] == [0, 3, 6, None]


def test_numbers_of_the_first_frame_stay_when_a_ghost_is_left_out(
    crossing: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`tk track` counts everybody who is found in the first frame."""

    looks = iter([(person(0.1), person(0.3), person(1.0))] + 20 * [(person(0.1), person(1.0))])
    monkeypatch.setattr(PeopleFinder, "find", lambda *_, **__: next(looks))
    watch = PeopleWatch(open_capture(crossing), range(FRAMES))
    for index in filter(watch.wants, range(FRAMES)):
        watch.look(index, Labels(np.zeros((4, 120, 160), np.uint8)))
    assert [(p.number, p.path[0][0]) for p in watch.people()] == [(0, 0.1), (2, 1.0)]
