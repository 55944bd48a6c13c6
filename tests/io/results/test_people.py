"""Results with several people: `/people`, links to person 0, resuming and revising."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.io.result_files import assert_equal_values, make_cameras, make_smoothed, revise_result, write
from tests.io.result_victim import META, make_frame, make_run, make_state
from tk.errors import ResultError
from tk.io.results.reader import read_joints, read_people, read_result
from tk.io.results.schema import columns_of
from tk.io.results.status import Status
from tk.io.results.writer import ResultWriter
from tk.model.body.joints import JOINTS


def people_at(index: int) -> dict[int, dict[str, Any]]:
    """Return person 0 in every frame, person 1 in frames 2 to 5, and nobody in frame 7."""
    if index == 7:
        return {}
    frame = make_frame(index)
    other = frame | {name: frame[name] + 1.0 for name in ("joints/position", "pose")}
    return {0: frame, 1: other} if 2 <= index <= 5 else {0: frame}


def write_two(path: Path, count: int, with_state: int | None = None) -> None:
    with ResultWriter.create(path, META) as writer:
        writer.write_model({"height_m": 1.7})
        writer.write_model({"height_m": 1.9}, person=1)
        for index in range(count):
            state = make_state(index) if with_state is None or index < with_state else None
            writer.append(make_run(index), people_at(index), state, flush=index % 3 == 0)


def assert_linked(path: Path) -> None:
    """Check that the top level has links to all that `/people/0` holds."""
    with h5py.File(path) as file:
        first = file["people/0"]
        assert set(first) == set(file) - {"people", "resume", "cameras", "frames", "time", "timing"}
        assert all(file.get(name, getlink=True).path == f"/people/0/{name}" for name in first)


def test_each_person_has_a_row_for_every_frame(path: Path) -> None:
    write_two(path, 10)
    result = read_result(path)
    first, second = result.people
    assert (first.person, second.person) == (0, 1) and first is result and second.people == (second,)
    there = [2, 3, 4, 5]
    for person, present in ((first, [0, 1, 2, 3, 4, 5, 6, 8, 9]), (second, there)):
        np.testing.assert_array_equal(person.frames - 3, np.arange(10))
        assert np.flatnonzero(person.status != Status.ABSENT).tolist() == present
        assert np.flatnonzero(np.isfinite(person.joints).any(axis=(1, 2))).tolist() == present
        assert person.origin is not None and (person.origin[person.status == Status.ABSENT] == Status.ABSENT).all()
    np.testing.assert_array_equal(second.joints[2], make_frame(2)["joints/position"] + 1.0)
    np.testing.assert_array_equal(second.pose[5], make_frame(5)["pose"] + 1.0)
    assert first.model == {"height_m": 1.7} and second.model == {"height_m": 1.9}
    assert second.meta == META and second.hull is not None and len(second.hull[2].positions) == 202
    assert not len(second.hull[0].positions) and not len(second.hull[7].positions)
    np.testing.assert_array_equal(second.timing["total"], 0.05 + np.arange(10))
    assert_linked(path)


def test_file_of_one_person_has_the_layout_of_several(path: Path) -> None:
    write(path, 3)
    result = read_result(path)
    assert result.people == (result,) and len(read_people(path)) == 1
    assert_linked(path)
    with h5py.File(path) as file:
        assert list(file["people"]) == ["0"]
        file.visititems(lambda name, _: pytest.fail(name) if name.split("/")[0] in file["people/0"] else None)


def as_version_3(path: Path) -> None:
    """Rewrite a result of two people as version 3 stored it: person 0 at the top level, and rows of present people."""
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 3
        for person in (1, 0):
            group = file[f"people/{person}"]
            there = np.flatnonzero(group["status"][()] != Status.ABSENT)
            for name in [*columns_of(META)]:
                holder = file if columns_of(META)[name].entry.of_run else group
                values, attributes = holder[name][()][there], dict(holder[name].attrs)
                target = (f"people/{person}/" if person else "old/") + name
                if target in file:
                    del file[target]
                file[target] = values
                file[target].attrs.update(attributes)
            for name, attribute in (("timing", "stages"), ("angles", "joints")):
                holder = file if name == "timing" else group
                file[f"people/{person}/{name}" if person else f"old/{name}"].attrs[attribute] = holder[name].attrs[
                    attribute
                ]
            del group["hull"]
        for name in [*file["people/0"], "frames", "time", "timing", "hull", "resume"]:
            if file.get(name, getlink=True) is not None:
                del file[name]
        del file["people/0"]
        for name in file["old"]:
            file.move(f"old/{name}", name)
        del file["old"]
        for name in file:
            if name != "people":
                file[f"people/0/{name}"] = file[name]


def test_files_of_version_3_are_read_and_not_changed(path: Path) -> None:
    write_two(path, 10)
    new = read_result(path).people
    as_version_3(path)
    old = read_result(path).people
    for a, b in zip(new, old, strict=True):
        for name in ("frames", "time", "status", "joints", "pose", "sigma"):
            found = getattr(a, name)[np.arange(10) != 7]  # nobody was there
            np.testing.assert_array_equal(found, getattr(b, name), name)
    with pytest.raises(ResultError, match=r"format_version is 3.*continues version 4: track the capture again"):
        revise_result(path, notes=["a note"])
    with pytest.raises(ResultError, match="format_version is 3"):
        ResultWriter.resume(path, META)


def test_run_with_several_people_is_resumed_after_the_last_state(tmp_path: Path) -> None:
    whole, path = tmp_path / "whole.h5", tmp_path / "result.h5"
    write_two(whole, 12)
    write_two(path, 9, with_state=5)  # frames 5 to 8 have no state
    writer, done = ResultWriter.resume(path, META)
    with writer:
        assert done == 5
        assert_equal_values(writer.state, make_state(4))
        assert [model["height_m"] for model in writer.models] == [1.7, 1.9]
        for index in range(done, 12):
            writer.append(make_run(index), people_at(index), make_state(index))
    assert_linked(path)
    for a, b in zip(read_result(whole).people, read_result(path).people, strict=True):
        np.testing.assert_array_equal(a.frames, b.frames)
        np.testing.assert_array_equal(a.joints, b.joints)
        assert a.hull is not None and b.hull is not None
        np.testing.assert_array_equal(a.hull.offsets, b.hull.offsets)


def test_frames_without_anybody_count_as_finished(path: Path) -> None:
    write_two(path, 8)
    writer, done = ResultWriter.resume(path, META)
    writer.close()
    assert done == 8 and len(read_result(path)) == 8


def test_person_added_after_the_last_state_is_added_again_by_the_resumed_run(path: Path) -> None:
    with ResultWriter.create(path, META) as writer:
        writer.append(make_run(0), people_at(0), make_state(0))
        writer.append(make_run(2), people_at(2))
    writer, done = ResultWriter.resume(path, META)
    with writer:
        assert done == 1
        assert len(writer.models) == 1
        writer.append(make_run(3), people_at(3), make_state(1))
    first, second = read_result(path).people
    assert first.frames.tolist() == second.frames.tolist() == [3, 6]
    assert second.status.tolist() == [Status.ABSENT, Status.TRACKED]


def test_person_can_be_added_during_the_run(path: Path) -> None:
    with ResultWriter.create(path, META) as writer:
        for index in range(4):
            writer.append(make_run(index), people_at(index), make_state(index))
        with pytest.raises(ValueError, match="person 3 is not the next one"):
            writer.append(make_run(4), {3: make_frame(4)})
        writer.append(make_run(4), people_at(4), make_state(4))
        writer.write_model({"height_m": 1.8}, person=2)
    people = read_result(path).people
    assert [len(person) for person in people] == [5, 5, 5] and (people[2].status == Status.ABSENT).all()
    assert people[2].model == {"height_m": 1.8}
    assert_linked(path)


@pytest.mark.parametrize("person", [0, 1])
def test_revision_changes_one_person_and_renews_the_links(path: Path, person: int) -> None:
    write_two(path, 7)
    before = read_result(path).people
    count = len(before[person])
    revise_result(
        path,
        {"pose": np.zeros((count, 24))},
        smoothed=make_smoothed(count),
        model={"height_m": 1.5},
        cameras=make_cameras(),
        notes=["a note"],
        person=person,
    )
    after = read_result(path).people
    assert after[person].model == {"height_m": 1.5} and not after[person].pose.any()
    assert after[person].smoothed is not None and after[person].with_smoothed().joints.max() == 0.25
    other = 1 - person
    assert after[other].model == before[other].model and after[other].smoothed is None
    np.testing.assert_array_equal(after[other].pose, before[other].pose)
    assert all(found.cameras is not None and found.notes == ("a note",) for found in after)
    assert_linked(path)
    with pytest.raises(ValueError, match="no person 2"):
        revise_result(path, model={}, person=2)


def test_joints_of_several_people_are_read_from_results_and_ground_truth(tmp_path: Path) -> None:
    path, truth = tmp_path / "result.h5", tmp_path / "truth.h5"
    write_two(path, 6)
    found = read_people(path)
    assert [track.frames.tolist() for track in found] == [[3, 4, 5, 6, 7, 8]] * 2
    assert found[1].status is not None and found[1].sigma is not None and found[1].seconds is not None
    with h5py.File(truth, "w") as file:  # frames for all people, nothing at the top level
        file["frames"] = [4, 5]
        for person in range(2):
            file[f"people/{person}/joints/position"] = np.full((2, 15, 3), float(person))
            file[f"people/{person}/joints/position"].attrs["names"] = list(JOINTS)
    expected = read_people(truth)
    assert [float(track.positions[0, 0, 0]) for track in expected] == [0.0, 1.0]
    np.testing.assert_array_equal(read_joints(truth).frames, [4, 5])


@pytest.mark.parametrize("name", ["2", "left"])
def test_people_must_be_numbered_without_gaps(path: Path, name: str) -> None:
    write_two(path, 4)
    with h5py.File(path, "r+") as file:
        file.move("people/1", f"people/{name}")
    for read in (read_result, read_people):
        with pytest.raises(ResultError, match=r"result\.h5: /people does not hold groups 0, 1"):
            read(path)
