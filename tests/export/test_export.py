"""What export takes and refuses; CSV; versions of the result; the smoothed copy."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.conftest import Tk
from tests.export.conftest import FIRST, FPS, FRAMES, LOST, SKELETON, Write, poses, status
from tests.export.test_opensim import read_trc
from tk.errors import ConfigError, ExportError, ResultError
from tk.export import FORMATS, Motion, export, read_motion
from tk.io.results.reader import read_result
from tk.io.results.status import Status
from tk.model.body.angles import standing_rotations
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import FOOT_POINTS
from tk.model.body.rotations import to_quaternions
from tk.model.body.skeleton import JOINTS, SEGMENTS, build_skeleton


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_csv_of_points(write: Write) -> None:
    sigma = np.full(15, 0.02)
    points, _ = export(write(meta={"sigma": True}, rows=lambda f: {"joints/sigma": sigma}), ["csv"]).files
    rows = rows_of(points)
    joints = [f"{name}_{part}" for name in JOINTS for part in ("x", "y", "z", "sigma")]
    feet = [f"{name}_{axis}" for name in FOOT_POINTS for axis in "xyz"]
    assert list(rows[0]) == ["frame", "time", "status", *joints, *feet]
    assert [int(row["frame"]) for row in rows] == list(range(FIRST, FIRST + FRAMES))
    for f, row in enumerate(rows):
        assert float(row["time"]) == pytest.approx((FIRST + f) / FPS, abs=1e-6)
        assert row["status"] == {0: "initialised"}.get(f, "lost" if f in LOST else "tracked")
        if f in LOST:
            assert {row[name] for name in joints + feet} == {""}
            continue
        for name, place in zip(JOINTS, SKELETON.joints(poses()[f]), strict=True):
            np.testing.assert_allclose([float(row[f"{name}_{axis}"]) for axis in "xyz"], place, atol=1e-6)
            assert float(row[f"{name}_sigma"]) == 0.02


def test_csv_of_angles(write: Write) -> None:
    written = export(write(), ["csv"])
    angles = written.files[1]
    assert written.notes[-1] == f"{angles}: blank: neck rotation: only landmarks show it, and none were used"
    assert angles.name == "walk_angles.csv"
    rows = rows_of(angles)
    assert len(rows) == FRAMES and {row["neck_rotation_deg"] for row in rows} == {""}
    assert {value for name, value in rows[LOST[0]].items() if name.endswith("_deg")} == {""}
    expected = np.degrees(poses()[3, SKELETON.index("knee_l_flexion")])
    assert float(rows[3]["knee_l_flexion_deg"]) == pytest.approx(expected, abs=1e-4)


def test_csv_has_the_names_of_the_pandas_table(write: Write) -> None:
    pytest.importorskip("pandas")
    path = write(meta={"sigma": True})
    table = {"frame", *read_result(path).to_pandas().columns}
    points, _ = export(path, ["csv"]).files
    assert set(rows_of(points)[0]) - {f"{foot}_{axis}" for foot in FOOT_POINTS for axis in "xyz"} <= table


def test_without_a_waist(write: Write) -> None:
    skeleton = build_skeleton(BodyDimensions.from_stature(1.75), paper=True)
    motion, _ = read_motion(write(skeleton=skeleton))
    np.testing.assert_allclose(motion.rotation("pelvis"), motion.rotation("torso"), atol=1e-12)


def test_stored_quantities_are_exported_rather_than_recomputed(write: Write) -> None:
    """Rotations and feet are the file's, in the order of its names."""
    q = to_quaternions(standing_rotations(SKELETON, SKELETON.segment_transforms(poses())))[:, ::-1]
    feet = np.arange(12.0).reshape(4, 3)
    meta = {"segment_names": SEGMENTS[::-1], "feet": True}

    q[4, 2] = 0  # no rotation

    def rows(f: int) -> dict[str, np.ndarray]:
        return {} if f in LOST else {"segments/rotation": q[f], "feet/position": feet}

    motion, _ = read_motion(write("new.h5", meta=meta, rows=rows))
    old, _ = read_motion(write("old.h5"))
    assert motion.segments == SEGMENTS[::-1]
    both = motion.known & old.known
    np.testing.assert_allclose(motion.rotation("calf_r")[both], old.rotation("calf_r")[both], atol=1e-9)
    np.testing.assert_array_equal(motion.point("heel_l")[0], feet[0])
    assert old.point("heel_l")[0, 2] < old.point("knee_l")[0, 2]
    assert set(np.flatnonzero(~motion.known)) == {4, *LOST}


def test_smoothed_copy_of_the_result(write: Write) -> None:
    """`/smoothed` where there is one; what it bridged counts as known."""
    path = write()
    joints = np.array([SKELETON.joints(pose) for pose in poses()]) + 0.01
    with h5py.File(path, "r+") as file:
        file["people/0/smoothed/joints/position"] = joints
        file["people/0/smoothed/bridged"] = status() == Status.LOST
    motion, notes = read_motion(path, smoothed=True)
    assert notes == () and motion.known.all()
    np.testing.assert_allclose(motion.points[:, : len(JOINTS)], joints)
    assert [motion.status_word(f) for f in (0, LOST[0])] == ["initialised", "bridged"]


def test_smoothed_here_where_the_result_has_no_copy(write: Write) -> None:
    path = write()
    written = export(path, ["csv", "bvh"], smoothed=True)
    assert written.files[0].name == "walk_smoothed.csv"
    assert "smoothed for this export" in written.notes[0]
    assert not any("held" in note for note in written.notes)
    motion, _ = read_motion(path, smoothed=True)
    assert motion.known.all() and motion.bridged.sum() == len(LOST)
    true = np.array([SKELETON.joints(pose) for pose in poses()])
    assert np.linalg.norm(motion.points[:, :15] - true, axis=2).max() < 0.06


def test_all_formats_and_a_format_that_fails(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write()
    written = export(path, ["all"])
    names = {file.name for file in written.files}
    assert {f"walk{ending}" for form in FORMATS.values() for ending, _ in form.outputs} == names and not written.failed

    def fail(motion: Motion, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(FORMATS, "mot", replace(FORMATS["mot"], outputs=((".mot", fail),)))
    written = export(path, ["mot", "trc"], force=True)
    assert [file.name for file in written.files] == ["walk.trc"]
    assert written.failed == (f"mot: {path.with_suffix('.mot')}: cannot be written: No space left on device",)


def test_each_person_has_files_with_a_number(write: Write) -> None:
    """Person 1 enters later and is away for two frames, which the files mark as lost."""
    away, first = (8, 9), 3
    single = write(second=sorted({*range(first, FRAMES)} - {*away}))
    written = export(single, ["trc", "bvh"])
    assert [file.name for file in written.files] == ["walk_0.trc", "walk_0.bvh", "walk_1.trc", "walk_1.bvh"]
    zero, one = (read_trc(path).points for path in written.files[::2])
    assert len(one) == FRAMES, "the files of all people have the same frames"
    unknown = np.isnan(one).all(axis=(1, 2))
    assert {*np.flatnonzero(unknown)} == {*range(first), *away, *LOST}
    np.testing.assert_array_equal(one[~unknown], zero[~unknown])
    with h5py.File(single, "r+") as file:
        for person in file["people"].values():
            person["smoothed/joints/position"] = person["joints/position"][()]
            person["smoothed/bridged"] = np.ones(FRAMES, dtype=bool)
    smoothed = read_trc(export(single, ["trc"], smoothed=True).files[1]).points
    assert {*np.flatnonzero(np.isnan(smoothed).all(axis=(1, 2)))} == {*range(first), *away}


def test_unusable_requests_are_refused(write: Write, tmp_path: Path) -> None:
    path = write()
    with pytest.raises(ExportError, match=r"fbx.*trc, mot, c3d, bvh, csv, gltf"):
        export(path, ["trc", "fbx"])
    with pytest.raises(ExportError, match="formats"):
        export(path, [])
    first = export(path, ["trc"]).files[0]
    text = first.read_text()
    with pytest.raises(ExportError, match="exists; choose another name"):
        export(path, ["csv", "trc"])
    assert not (tmp_path / "walk.csv").exists()  # all or nothing
    first.write_text("PathFileType\told")
    export(path, ["trc"], force=True)
    assert first.read_text() == text
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match="cannot be written"):
        export(path, ["trc"], tmp_path / "file")
    with pytest.raises(ResultError, match="lost in every frame"):
        export(write("lost.h5", lost=np.full(FRAMES, Status.LOST)), ["bvh"])
    with pytest.raises(ResultError, match="not consecutive"):
        export(write("gaps.h5", frames=np.arange(FRAMES) * 2), ["bvh"])
    with h5py.File(path, "r+") as file:
        del file["people/0/model/dimensions/thigh"]
    with pytest.raises(ResultError, match="/model/dimensions/thigh"):
        export(path, ["csv"])


@pytest.mark.parametrize("kind", ["csv", "ply"])
def test_nothing_is_written_into_a_captures_own_folders(write: Write, tmp_path: Path, kind: str) -> None:
    path, capture = write(), tmp_path / "capture"
    (capture / "videos").mkdir(parents=True)
    (capture / "calibration.toml").write_text("")
    with pytest.raises(ConfigError, match=r"lies in .*videos, an input"):
        export(path, [kind], capture / "videos", force=True)
    assert not list((capture / "videos").iterdir())
    assert export(path, [kind], capture).files


def test_frames_without_numbers_are_not_known(write: Write) -> None:
    path = write()
    with h5py.File(path, "r+") as file:
        file["pose"][3] = np.nan
        file["joints/position"][7, 2] = np.nan
    motion, _ = read_motion(path)
    assert set(np.flatnonzero(~motion.known)) == {3, 7, *LOST} and np.isfinite(motion.points).all()
    with h5py.File(path, "r+") as file:
        file["status"][5] = 9
    with pytest.raises(ResultError, match="/status"):
        read_motion(path)


def test_frames_lost_at_the_start_repeat_the_first_known_pose(write: Write) -> None:
    states = np.zeros(FRAMES, dtype=np.uint8)
    states[:3] = Status.LOST
    motion, _ = read_motion(write(lost=states))
    np.testing.assert_array_equal(motion.points[0], motion.points[3])
    assert not motion.known[:3].any() and motion.known[3:].all()


def test_command(tk: Tk, write: Write, tmp_path: Path) -> None:
    path = write()
    ran = tk("export", path, "--to", ",".join(FORMATS), "-o", tmp_path / "out" / "deep")
    assert ran.code == 0 and ran.out == "", ran.err
    names = {"walk.trc", "walk.mot", "walk.c3d", "walk.bvh", "walk.csv", "walk_angles.csv", "walk.glb", "walk_ply"}
    assert {file.name for file in (tmp_path / "out" / "deep").iterdir()} == names
    assert "note: bvh, gltf, ply: in 2 lost frames the pose before is held" in ran.err
    tk("export", path, "--to", "trc", "-o", tmp_path / "out" / "deep").complaint("walk.trc", "--force")
    tk("export", path, "--to", "fbx").complaint("formats fbx", "gltf")
    tk("export", tmp_path / "none.h5", "--to", "trc").complaint("none.h5", "no such file")
    assert tk("export", path, "--to", "trc", "--smoothed").code == 0
    assert (tmp_path / "walk_smoothed.trc").exists()


def test_tracked_result_is_exported_in_all_formats(tracked: Path, tmp_path: Path) -> None:
    """What the tracker writes goes through every format."""
    written = export(tracked, list(FORMATS), tmp_path)
    assert all(file.stat().st_size > 1000 for file in written.files)
