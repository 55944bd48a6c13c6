"""Several people: who was found, identity switches, misses and false positives of made-up trajectories."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.conftest import Tk
from tests.evaluation.test_joints import STANDING
from tk.errors import ResultError
from tk.evaluation.people import evaluate_people
from tk.io.results.data import JointTrack
from tk.io.results.status import Status
from tk.model.body.joints import JOINTS

COUNT = 40
RNG = np.random.default_rng(0)


def walking(start: float, speed: float) -> JointTrack:
    """Return a person who walks along x from ``start``, m, by ``speed``, m a frame."""
    shift = np.zeros((COUNT, 1, 3))
    shift[:, 0, 0] = start + speed * np.arange(COUNT)
    return JointTrack(Path("file.h5"), np.arange(COUNT), STANDING + shift)


TRUTH = (walking(-1.0, 0.05), walking(1.0, -0.05))  # they meet in frame 20
FAR = JointTrack(Path("file.h5"), np.arange(COUNT), np.tile(STANDING + np.array([0.0, 4.0, 0.0]), (COUNT, 1, 1)))


def crossing_apart() -> tuple[JointTrack, JointTrack]:
    """Return two people who pass each other 1 m apart."""
    a, b = TRUTH
    return a, replace(b, positions=b.positions + np.array([0.0, 1.0, 0.0]))


def swapped(people: tuple[JointTrack, JointTrack], begin: int, stop: int) -> tuple[JointTrack, ...]:
    a, b = (person.positions.copy() for person in people)
    a[begin:stop], b[begin:stop] = b[begin:stop].copy(), a[begin:stop].copy()
    return tuple(replace(person, positions=p) for person, p in zip(people, (a, b), strict=True))


def only(track: JointTrack, rows: np.ndarray) -> JointTrack:
    return replace(track, frames=track.frames[rows], positions=track.positions[rows])


def test_people_in_another_order_are_matched_without_switches() -> None:
    truth = crossing_apart()
    noisy = [replace(t, positions=t.positions + RNG.normal(scale=0.02, size=t.positions.shape)) for t in truth]
    found = evaluate_people(noisy[::-1], truth)
    assert [person.matched_with for person in found.people] == [(1,), (0,)]
    assert (found.mota, found.idf1, found.switches, found.misses, found.false_positives) == (1.0, 1.0, 0, 0, 0)
    for person in found.people:
        assert person.errors is not None and 2.5 < person.errors.raw.limbs.mean_cm < 4.0
    assert 2.5 < found.mean_distance_cm < 4.0


def test_exchanged_people_are_one_switch_each_and_halve_idf1() -> None:
    truth = crossing_apart()
    found = evaluate_people(swapped(truth, COUNT // 2, COUNT), truth)
    assert [person.switches for person in found.people] == [1, 1]
    assert [person.matched_with for person in found.people] == [(0, 1), (1, 0)]
    assert found.mota == pytest.approx(1 - 2 / (2 * COUNT))
    assert found.idf1 == pytest.approx(0.5)
    assert found.mean_distance_cm == 0.0


def test_exchange_that_is_undone_is_two_switches_each() -> None:
    truth = crossing_apart()
    found = evaluate_people(swapped(truth, 10, 14), truth)
    assert [person.switches for person in found.people] == [2, 2]
    assert found.idf1 == pytest.approx(36 / 40)


def test_missing_lost_and_far_people_are_misses_and_false_positives() -> None:
    truth = crossing_apart()
    status = np.zeros(COUNT, np.uint8)
    status[:4] = Status.LOST
    lost = replace(truth[0], status=status)
    gone = only(truth[1], np.arange(COUNT) >= 10)
    found = evaluate_people((lost, gone, FAR), truth)
    assert [person.matches for person in found.people] == [COUNT - 4, COUNT - 10]
    assert (found.misses, found.false_positives, found.switches) == (14, COUNT, 0)
    assert found.mota == pytest.approx(1 - (14 + COUNT) / (2 * COUNT))
    assert found.idf1 == pytest.approx(2 * (2 * COUNT - 14) / (2 * COUNT + 3 * COUNT - 14))


def test_person_is_judged_only_while_in_the_ground_truth() -> None:
    truth = (TRUTH[0], only(FAR, np.arange(COUNT) < 15))
    found = evaluate_people((TRUTH[0], only(FAR, np.arange(COUNT) < 15)), truth)
    assert [person.frames for person in found.people] == [COUNT, 15]
    assert found.mota == found.idf1 == 1.0


def test_false_positives_count_also_while_nobody_is_there() -> None:
    positions = TRUTH[0].positions.copy()
    positions[COUNT // 2 :] = np.nan
    found = evaluate_people((TRUTH[0],), (replace(TRUTH[0], positions=positions),))
    assert (found.frames, found.people[0].frames, found.false_positives) == (COUNT, COUNT // 2, COUNT // 2)
    assert found.mota == 0 and found.idf1 == pytest.approx(2 / 3)
    nobody = evaluate_people((TRUTH[0],), (replace(TRUTH[0], positions=np.full_like(positions, np.nan)),))
    assert nobody.false_positives == COUNT and np.isnan([nobody.mota, nobody.idf1]).all()
    assert nobody.to_dict()["mota"] is None and "MOTA nan" in nobody.format_table()


def test_one_tracked_person_among_two_leaves_the_other_missed() -> None:
    found = evaluate_people((only(TRUTH[1], np.arange(COUNT) < 12),), (FAR, TRUTH[1]))
    first, second = found.people
    assert first.errors is None and first.matches == 0 and first.frames == second.frames == second.matches == 12
    assert "person 0" in found.format_table() and max(map(len, found.format_table().splitlines())) <= 100
    json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert second.errors is not None and second.errors.raw.all.mean_cm == 0, "to_dict leaves the scores as they are"


def test_files_without_common_frames_are_refused() -> None:
    later = [replace(person, frames=person.frames + 100) for person in TRUTH]
    with pytest.raises(ResultError, match="no frame in common"):
        evaluate_people(later, TRUTH)


def test_command_prints_people_if_a_file_has_several(tk: Tk, tmp_path: Path) -> None:
    for name, people in (("r.h5", TRUTH[::-1]), ("truth.h5", TRUTH)):
        with h5py.File(tmp_path / name, "w") as file:
            file["frames"] = np.arange(COUNT)
            for number, person in enumerate(people):
                file[f"people/{number}/joints/position"] = person.positions
                file[f"people/{number}/joints/position"].attrs["names"] = list(JOINTS)
    ran = tk("evaluate", tmp_path / "r.h5", tmp_path / "truth.h5")
    assert "MOTA" in ran.out and "person 1" in ran.out
    found = json.loads(tk("evaluate", tmp_path / "r.h5", tmp_path / "truth.h5", "--json").out)
    assert found["people_in_result"] == 2 and found["people"][0]["errors"]["raw"]["limbs"]["mean_cm"] == 0.0
