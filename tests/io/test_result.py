from __future__ import annotations

import os
import random
import shutil
import signal
import stat
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.io.result_victim import META, make_frame, make_state
from tk.errors import ResultError
from tk.io.result import (
    FrameResult,
    JointAngles,
    ResultMeta,
    ResultWriter,
    UsedCameras,
    Value,
    read_joints,
    read_result,
    revise_result,
)  # fmt: skip
from tk.model.camera import Camera, Rig
from tk.model.skeleton import JOINTS

ROOT = Path(__file__).parents[2]


def write(path: Path, count: int, meta: ResultMeta = META, start: int = 0) -> None:
    with ResultWriter.create(path, meta) as writer:
        for index in range(start, start + count):
            writer.append(make_frame(index), make_state(index))


def assert_complete(path: Path, at_least: int) -> int:
    """The file opens, is of one length throughout, and holds what the victim wrote; returns its frames."""
    with h5py.File(path, "r") as file:  # as any user would open it
        count = len(file["frames"])
        assert count >= at_least
        expected = [make_frame(index) for index in range(count)]
        for name in ("frame", "time", "status", "objective", "pose", "iterations"):
            dataset = file["frames" if name == "frame" else name]
            np.testing.assert_array_equal(dataset[()], [getattr(frame, name) for frame in expected])
        np.testing.assert_array_equal(file["joints/position"][()], [frame.joints for frame in expected])
        np.testing.assert_array_equal(file["timing/total"][()], [frame.timing["total"] for frame in expected])
        for name, field in (("ankles", "ankles"), ("fit_error", "fit_error"), ("feet/position", "feet")):
            np.testing.assert_array_equal(file[name][()], [getattr(frame, field) for frame in expected])
        sigma = [np.full(15, np.nan) if frame.sigma is None else frame.sigma for frame in expected]
        np.testing.assert_array_equal(file["joints/sigma"][()], np.reshape(sigma, (count, 15)))
        np.testing.assert_array_equal(file["angles/hip_l"][()], [frame.angles["hip_l"] for frame in expected])
        assert file["segments/rotation"].shape == (count, 2, 4)
        assert file["timing/hull"].shape == file["timing/optimise"].shape == (count,)
        if count > 1:
            offsets = file["hull/offsets"][()]
            counts = [0 if frame.hull is None else len(frame.hull.positions) for frame in expected]
            np.testing.assert_array_equal(np.diff(offsets), counts)
            np.testing.assert_array_equal(
                file["hull/positions"][()], np.concatenate([f.hull.positions for f in expected if f.hull])
            )
            np.testing.assert_array_equal(
                file["hull/colors"][()], np.concatenate([f.hull.colors for f in expected if f.hull])
            )
    if count:
        assert_equal_values(read_result(path).state, make_state(count - 1))
    return count


def assert_equal_values(found: Mapping[str, Value], expected: Mapping[str, Value]) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    model = {"torso/radii_m": np.array([0.1, 0.2]), "height_m": 1.78, "sex": "any"}
    with ResultWriter.create(path, META) as writer:
        writer.write_model(model)
        for index in range(60):
            writer.append(make_frame(index), make_state(index))
    assert assert_complete(path, 60) == 60
    result = read_result(path)
    assert result.meta == META
    assert_equal_values(result.model, model)
    assert result.hull is not None
    expected = make_frame(7).hull
    assert expected is not None
    np.testing.assert_array_equal(result.hull[7].positions, expected.positions)
    np.testing.assert_array_equal(result.hull[7].colors, expected.colors)
    assert len(result.hull[5].positions) == 0
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.h5"]


def test_layout_is_the_contract(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 2)
    with h5py.File(path, "r") as file:
        for name, shape, dtype in [
            ("frames", (2,), "int64"),
            ("time", (2,), "float64"),
            ("pose", (2, 24), "float64"),
            ("joints/position", (2, 15, 3), "float64"),
            ("status", (2,), "uint8"),
            ("objective", (2,), "float64"),
            ("iterations", (2, 2), "int32"),
            ("timing/optimise", (2,), "float64"),
            ("ankles", (2, 4), "float64"),
            ("joints/sigma", (2, 15), "float64"),
            ("fit_error", (2, 3), "float64"),
            ("segments/rotation", (2, 2, 4), "float64"),
            ("feet/position", (2, 4, 3), "float64"),
            ("angles/knee_l", (2, 1), "float64"),
            ("angles/hip_l", (2, 3), "float64"),
        ]:
            assert (file[name].shape, file[name].dtype) == (shape, dtype), name
        assert tuple(file["joints/position"].attrs["names"]) == JOINTS
        assert tuple(file["pose"].attrs["names"]) == META.pose_names
        assert tuple(file["pose"].attrs["units"]) == META.pose_units
        assert tuple(file["iterations"].attrs["stages"]) == META.stages
        assert file["status"].attrs["meaning"][3] == "3: lost"
        assert tuple(file["ankles"].attrs["names"]) == META.ankle_names
        assert tuple(file["ankles"].attrs["units"]) == ("rad",) * 4
        assert tuple(file["joints/sigma"].attrs["names"]) == JOINTS
        assert tuple(file["fit_error"].attrs["cameras"]) == META.fit_cameras
        assert tuple(file["segments/rotation"].attrs["names"]) == META.segment_names
        assert tuple(file["feet/position"].attrs["names"]) == ("heel_l", "toe_l", "heel_r", "toe_r")
        assert tuple(file["angles/hip_l"].attrs["names"]) == ("flexion", "abduction", "rotation")
        assert file["angles/hip_l"].attrs["convention"] == "Grood and Suntay"
        assert file["objective"].attrs["kind"] == "negative log-likelihood"
        attributes = dict(file.attrs)
    assert attributes.pop("software").startswith("tk-mocap")
    assert attributes.pop("created").endswith("+00:00")
    assert attributes == {
        "format": "tk-result",
        "format_version": 2,
        "fps": 15.0,
        "units": "m",
        "up": "z",
        "capture": "walk",
        "method": "volumetric",
        "seed": 7,
        "config": META.config_toml,
    }
    # version 3 of the superblock has a flag "open for writing" that a kill leaves set, and the file then stays shut
    assert path.read_bytes()[8] < 3


def test_an_appended_frame_is_in_the_file_at_once(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        for index in range(5):
            writer.append(make_frame(index), make_state(index))
            snapshot = tmp_path / "snapshot.h5"  # HDF5 would serve the writer's own memory for the same file
            snapshot.write_bytes(path.read_bytes())
            assert assert_complete(snapshot, index + 1) == index + 1


def test_arrays_may_be_reused_after_append(tmp_path: Path) -> None:
    """Each frame is written twice, the second time after the next one was computed."""
    path = tmp_path / "result.h5"
    pose, mean = np.zeros(24), np.zeros(3)
    with ResultWriter.create(path, META) as writer:
        for index in range(4):
            pose[:] = index
            mean[:] = index
            writer.append(replace(make_frame(index), pose=pose), {"mean": mean})
        pose[:] = mean[:] = -1
    np.testing.assert_array_equal(read_result(path).pose[:, 0], range(4))
    np.testing.assert_array_equal(read_result(path).state["mean"], np.full(3, 3.0))


def test_model_can_be_refined_on_the_way(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        writer.write_model({"height_m": 1.7, "guess": 1.0})
        writer.append(make_frame(0))
        writer.append(make_frame(1))
        writer.write_model({"height_m": 1.8})
        writer.append(make_frame(2))
    assert read_result(path).model == {"height_m": 1.8}


def test_state_may_change_its_shape_and_names(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    states: list[dict[str, Value]] = [
        {"a": np.zeros(3), "b": "text"},
        {"a": np.ones((2, 2), dtype=np.float32), "b": "a longer text", "c": 5},
        {"b": np.arange(4, dtype=np.uint8)},
        {"b": ""},
        {"b": "zählt 5 °"},
    ]
    for count in range(1, len(states) + 1):
        with ResultWriter.create(path, META) as writer:
            for index, state in enumerate(states[:count]):
                writer.append(make_frame(index), state)
        assert_equal_values(read_result(path).state, states[count - 1])


def test_result_without_pose_or_joints(tmp_path: Path) -> None:
    """A reconstruction has a hull only."""
    path = tmp_path / "hull.h5"
    meta = replace(META, pose_names=(), pose_units=(), joint_names=(), stages=())
    with ResultWriter.create(path, meta) as writer:
        for index in range(3):
            frame = make_frame(index)
            writer.append(
                replace(
                    frame, pose=np.zeros(0), joints=np.zeros((0, 3)), iterations=np.zeros(0, dtype=np.int32), sigma=None
                )
            )
    result = read_result(path)
    assert result.meta == meta
    assert result.pose.shape == (3, 0)
    assert result.joints.shape == (3, 0, 3)
    with pytest.raises(ResultError, match="no joint pelvis"):
        read_joints(path)


@pytest.mark.parametrize(
    "change",
    [
        {"pose": np.zeros(23)},
        {"joints": np.zeros((14, 3))},
        {"iterations": np.zeros(3, dtype=np.int32)},
        {"status": 4},
        {"timing": {"nonsense": 1.0}},
        {"sigma": np.zeros(14)},
        {"fit_error": np.zeros(2)},
        {"angles": {"elbow_l": np.zeros(1)}},
        {"angles": {"knee_l": np.zeros(2)}},
    ],
)
def test_a_frame_of_the_wrong_shape_is_refused_and_the_rest_kept(tmp_path: Path, change: dict[str, object]) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        writer.append(make_frame(0), make_state(0))
        with pytest.raises(ValueError):
            writer.append(replace(make_frame(1), **change))  # type: ignore[arg-type]
        writer.append(make_frame(1), make_state(1))
    assert assert_complete(path, 2) == 2


# --- kill -9 ----------------------------------------------------------------------------------------------------------


def kill_at_random(path: Path, frames: int, delay_s: float) -> int:
    """Run the victim, kill it some time after its first frame; returns the frames that it had reported."""
    with subprocess.Popen(
        [sys.executable, "-m", "tests.io.result_victim", str(path), str(frames)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    ) as victim:
        assert victim.stdout is not None
        reported = [victim.stdout.readline()]
        try:
            victim.wait(delay_s)
        except subprocess.TimeoutExpired:
            os.kill(victim.pid, signal.SIGKILL)
        reported += victim.stdout.read().splitlines()
    assert victim.returncode in (0, -signal.SIGKILL)
    return int([line for line in reported if line.strip()][-1])


def survive_kills(path: Path, kills: int, seed: int) -> None:
    generator = random.Random(seed)
    done = 0
    for _ in range(kills):
        reported = kill_at_random(path, done + 2000, generator.uniform(0.0, 0.05))
        assert reported > done  # the next run took up where the last one stopped
        done = assert_complete(path, reported)
        assert done <= reported + 1
        if done > 600:
            path.unlink()
            done = 0


def test_a_killed_run_leaves_every_finished_frame_and_is_resumed(tmp_path: Path) -> None:
    survive_kills(tmp_path / "result.h5", kills=4, seed=1)


@pytest.mark.slow
def test_a_hundred_and_twenty_kills(tmp_path: Path) -> None:
    survive_kills(tmp_path / "result.h5", kills=120, seed=2)


# --- resuming ---------------------------------------------------------------------------------------------------------


def test_resumed_equals_uninterrupted(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 7)
    created = read_result(path).created
    writer, done = ResultWriter.resume(path, META)
    with writer:
        assert done == 7
        assert_equal_values(writer.state, make_state(6))
        for index in range(done, 12):
            writer.append(make_frame(index), make_state(index))
    assert assert_complete(path, 12) == 12
    assert read_result(path).created == created


def test_a_resumed_writer_knows_the_model(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    model = {"height_m": 1.7, "torso/radii_m": np.arange(3.0), "names": '["torso"]'}
    with ResultWriter.create(path, META) as writer:
        writer.write_model(model)
        writer.append(make_frame(0), make_state(0))
    with ResultWriter.resume(path, META)[0] as writer:
        assert_equal_values(writer.model, model)
    assert_equal_values(read_result(path).model, model)


def test_resume_without_a_file_starts_one(tmp_path: Path) -> None:
    writer, done = ResultWriter.resume(tmp_path / "result.h5", META)
    with writer:
        assert done == 0
        assert writer.state == {}


def test_frames_after_the_last_state_are_done_again(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        for index in range(9):
            writer.append(make_frame(index), make_state(index) if index <= 5 else None)
    writer, done = ResultWriter.resume(path, META)
    with writer:
        assert done == 6
        assert_equal_values(writer.state, make_state(5))
        for index in range(6, 10):
            writer.append(make_frame(index), make_state(index))
    assert assert_complete(path, 10) == 10


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"capture": "dance"}, "capture is walk, not dance"),
        ({"method": "silhouette"}, "method is volumetric, not silhouette"),
        ({"seed": 8}, "seed is 7, not 8"),
        ({"seed": 0}, "seed is 7, not 0"),
        ({"fps": 30.0}, "fps is 15.0, not 30.0"),
        ({"pose_names": ("x",), "pose_units": ("m",)}, "the pose has 24 entries, not 1"),
        ({"stages": ("all",)}, "stages are all, chains; not all"),
        ({"ankle_names": ()}, "ankle_names are ankle_pitch_l, .*; not none"),
        ({"sigma": False}, "sigma is True, not False"),
        ({"objective_kind": ""}, "objective_kind is negative log-likelihood, not none"),
        ({"angles": ()}, "angles are knee_l, hip_l; not none"),
        ({"angles": (replace(META.angles[0], convention="other"), META.angles[1])}, "differ in their convention"),
        ({"config_toml": META.config_toml.replace("0.1", "0.2")}, r"config smd\.mu is 0\.1, not 0\.2"),
        ({"config_toml": META.config_toml + "[hull]\nvoxels = 64\n"}, "config hull is not set"),
    ],
)
def test_resuming_another_run_is_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    path = tmp_path / "result.h5"
    write(path, 2)
    before = path.read_bytes()
    with pytest.raises(ResultError, match=rf"result\.h5: .*{message}.*--resume"):
        ResultWriter.resume(path, replace(META, **change))  # type: ignore[arg-type]
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.h5"]


def test_config_that_only_looks_different_is_the_same(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 1)
    same = '# a comment\nmethod = "volumetric"\nsmd = { mu = 0.10 }\n'
    writer, done = ResultWriter.resume(path, replace(META, config_toml=same))
    writer.close()
    assert done == 1


# --- what a tracker may have or not -----------------------------------------------------------------------------------

PLAIN = replace(
    META, ankle_names=(), sigma=False, fit_cameras=(), segment_names=(), feet=False, angles=(), objective_kind=""
)


def plain_frame(index: int) -> FrameResult:
    return replace(
        make_frame(index), ankles=None, sigma=None, fit_error=None, segments_rotation=None, feet=None, angles={}
    )


def write_version_1(path: Path, count: int) -> None:
    """As tk 0.1 wrote it: none of what is new, and the old number."""
    with ResultWriter.create(path, PLAIN) as writer:
        for index in range(count):
            writer.append(plain_frame(index), make_state(index))
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 1


def test_what_is_optional_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 5)
    result = read_result(path)
    assert result.meta == META
    assert result.ankles is not None and result.sigma is not None and result.fit_error is not None
    assert result.segments_rotation is not None and result.feet is not None
    assert result.sigma.shape == (5, 15) and np.isnan(result.sigma).all(axis=1).tolist() == [False] * 3 + [True, False]
    np.testing.assert_array_equal(result.ankles[2], make_frame(2).ankles)
    np.testing.assert_array_equal(result.fit_error[:, 2], range(5))
    np.testing.assert_array_equal(result.segments_rotation[4], make_frame(4).segments_rotation)
    np.testing.assert_array_equal(result.feet[1], make_frame(1).feet)
    assert list(result.angles) == ["knee_l", "hip_l"]
    np.testing.assert_array_equal(result.angles["knee_l"][:, 0], 5.0 * np.arange(5))
    assert result.cameras is None and result.smoothed is None
    track = read_joints(path)
    np.testing.assert_array_equal(track.sigma, result.sigma)


def test_version_1_is_read_and_resumed(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write_version_1(path, 4)
    result = read_result(path)
    assert result.meta == PLAIN and len(result) == 4
    assert result.ankles is None and result.sigma is None and result.feet is None and result.angles == {}
    assert read_joints(path).sigma is None
    writer, done = ResultWriter.resume(path, PLAIN)
    with writer:
        assert done == 4
        writer.append(plain_frame(4), make_state(4))
    with h5py.File(path) as file:
        assert (file.attrs["format_version"], len(file["frames"])) == (2, 5)


def test_the_same_angles_twice_are_refused() -> None:
    with pytest.raises(ValueError, match="same name"):
        replace(META, angles=META.angles * 2)
    with pytest.raises(ValueError, match="slash"):
        JointAngles("a/b", ("flexion",), "")


def make_cameras(shift_m: float = 0.0) -> UsedCameras:
    matrix = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
    rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    return UsedCameras(
        Rig(
            (
                Camera("cam1", 640, 480, matrix, np.array([0.1, 0.0, 0.01, 0.0, 0.2]), rotation, np.full(3, shift_m)),
                Camera("cam2", 320, 240, matrix, np.array([0.1, 0.2, 0.3, 0.4]), np.eye(3), np.arange(3.0), True),
            )
        ),
        np.array([0.0, -0.04]),
    )


def assert_same_cameras(found: UsedCameras | None, expected: UsedCameras) -> None:
    assert found is not None and found.rig.names == expected.rig.names
    np.testing.assert_array_equal(found.time_offset_s, expected.time_offset_s)
    for a, b in zip(found.rig, expected.rig, strict=True):
        assert (a.width, a.height, a.fisheye) == (b.width, b.height, b.fisheye)
        np.testing.assert_array_equal(a.matrix, b.matrix)
        np.testing.assert_array_equal(a.distortions, b.distortions)
        np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-12)
        np.testing.assert_array_equal(a.translation, b.translation)


def test_cameras_as_used_are_kept_and_may_be_refined(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        writer.write_cameras(make_cameras())
        writer.append(make_frame(0), make_state(0))
        assert_same_cameras(read_result(path).cameras, make_cameras())
        writer.append(make_frame(1), make_state(1))
        writer.write_cameras(make_cameras(shift_m=0.5))
        writer.append(make_frame(2), make_state(2))
    with ResultWriter.resume(path, META)[0] as writer:
        writer.append(make_frame(3), make_state(3))
    assert assert_complete(path, 4) == 4
    assert_same_cameras(read_result(path).cameras, make_cameras(shift_m=0.5))
    with h5py.File(path) as file:
        assert list(file["cameras"].attrs["names"]) == ["cam1", "cam2"]
        assert file["cameras/rotation"].shape == (2, 3) and file["cameras/distortions"].shape == (2, 5)


def test_time_offsets_that_do_not_fit_the_cameras_are_refused() -> None:
    with pytest.raises(ValueError, match="2 finite numbers"):
        UsedCameras(make_cameras().rig, np.zeros(3))


# --- a second pass ----------------------------------------------------------------------------------------------------


def make_smoothed(count: int) -> dict[str, np.ndarray]:
    return {
        "pose": np.full((count, 24), 0.5),
        "joints/position": np.full((count, 15, 3), 0.25),
        "angles/knee_l": np.full((count, 1), 30.0),
        "bridged": np.arange(count) % 2 == 0,
    }


def test_a_second_pass_replaces_what_it_names_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 6)
    before = read_result(path)
    pose, sigma = np.random.default_rng(0).normal(size=(6, 24)), np.full((6, 15), 0.02)
    meta = revise_result(path, {"pose": pose, "joints/sigma": sigma}, model={"height_m": 1.8}, cameras=make_cameras())
    after = read_result(path)
    assert meta == META == after.meta
    np.testing.assert_array_equal(after.pose, pose)
    np.testing.assert_array_equal(after.sigma, sigma)
    np.testing.assert_array_equal(after.joints, before.joints)
    np.testing.assert_array_equal(after.angles["hip_l"], before.angles["hip_l"])
    assert after.model == {"height_m": 1.8}
    assert_same_cameras(after.cameras, make_cameras())
    assert_equal_values(after.state, before.state)
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.h5"]
    with ResultWriter.resume(path, META)[0] as writer:
        writer.append(make_frame(6), make_state(6))
    np.testing.assert_array_equal(read_result(path).pose[:6], pose)


def test_what_is_smoothed_stands_beside_and_can_take_its_place(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 6)
    smoothed = make_smoothed(6)
    revise_result(path, smoothed=smoothed)
    result = read_result(path)
    assert result.smoothed is not None and result.smoothed.keys() == smoothed.keys()
    for name, values in smoothed.items():
        np.testing.assert_array_equal(result.smoothed[name], values)
    assert result.smoothed["bridged"].dtype == bool
    np.testing.assert_array_equal(result.joints[0], make_frame(0).joints)
    shown = result.with_smoothed()
    np.testing.assert_array_equal(shown.joints, smoothed["joints/position"])
    np.testing.assert_array_equal(shown.angles["knee_l"], smoothed["angles/knee_l"])
    np.testing.assert_array_equal(shown.angles["hip_l"], result.angles["hip_l"])
    assert shown.smoothed is None and shown.with_smoothed() is not result
    with h5py.File(path) as file:
        assert tuple(file["smoothed/joints/position"].attrs["names"]) == JOINTS
    revise_result(path, smoothed={"bridged": np.zeros(6)})
    again = read_result(path).smoothed
    assert again is not None and again.keys() == {"bridged"}


def test_what_was_smoothed_does_not_outlive_what_it_was_made_of(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 4)
    revise_result(path, smoothed=make_smoothed(4))
    with ResultWriter.resume(path, META)[0]:
        pass
    assert read_result(path).smoothed is not None  # no frame was added
    with ResultWriter.resume(path, META)[0] as writer:
        writer.append(make_frame(4), make_state(4))
    assert read_result(path).smoothed is None
    revise_result(path, smoothed=make_smoothed(5))
    revise_result(path, {"pose": np.zeros((5, 24))})
    assert read_result(path).smoothed is None


@pytest.mark.parametrize(
    "change",
    [
        {"columns": {"pose": np.zeros((3, 24))}},
        {"columns": {"waist": np.zeros((4, 3))}},
        {"smoothed": {"pose": np.zeros((4, 24))}},
        {"smoothed": {"pose": np.zeros((5, 24)), "bridged": np.zeros(4)}},
        {"smoothed": {"status": np.zeros(4), "bridged": np.zeros(4)}},
    ],
)
def test_a_second_pass_of_the_wrong_shape_changes_nothing(tmp_path: Path, change: dict[str, object]) -> None:
    path = tmp_path / "result.h5"
    write(path, 4)
    before = path.read_bytes()
    with pytest.raises(ValueError):
        revise_result(path, **change)  # type: ignore[arg-type]
    assert path.read_bytes() == before


def test_a_second_pass_that_fails_on_the_way_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "result.h5"
    write(path, 4)
    before = path.read_bytes()

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(ResultError, match=r"result\.h5: cannot be written: No space left on device"):
        revise_result(path, {"pose": np.zeros((4, 24))})
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.h5"]


def test_a_second_pass_keeps_off_a_result_that_is_being_written(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        writer.append(make_frame(0), make_state(0))
        with pytest.raises(ResultError, match="another run"):
            revise_result(path, {"pose": np.zeros((1, 24))})
    with pytest.raises(ResultError, match="no such file"):
        revise_result(tmp_path / "other.h5", {})


# --- files that cannot be used ----------------------------------------------------------------------------------------


def other_software(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["data"] = np.arange(3)


def not_hdf5(path: Path) -> None:
    path.write_text("frame,x,y,z\n")


def newer_version(path: Path) -> None:
    write(path, 1)
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 3


def truncated(path: Path) -> None:
    write(path, 1)
    path.write_bytes(path.read_bytes()[:3000])


def incomplete(path: Path) -> None:
    write(path, 1)
    with h5py.File(path, "r+") as file:
        del file["frames"]


def missing(path: Path) -> None:
    pass


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (other_software, "other software|neither"),
        (not_hdf5, "not an HDF5 file"),
        (newer_version, "format_version is 3"),
        (truncated, "damaged"),
        (incomplete, "no /frames"),
        (missing, "no such file"),
        (Path.mkdir, "is a folder"),
    ],
)
@pytest.mark.parametrize("read", [read_result, read_joints])
def test_unusable_files_are_named(tmp_path: Path, make, message: str, read) -> None:
    path = tmp_path / "some.h5"
    make(path)
    with pytest.raises(ResultError, match=message) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("make", [other_software, not_hdf5])
def test_files_of_others_are_neither_overwritten_nor_resumed(tmp_path: Path, make) -> None:
    path = tmp_path / "some.h5"
    make(path)
    before = path.read_bytes()
    with pytest.raises(ResultError, match=r"some\.h5: .*not overwritten"):
        ResultWriter.create(path, META)
    with pytest.raises(ResultError, match=r"some\.h5: .*not an? (HDF5|tk-result)"):
        ResultWriter.resume(path, META)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["some.h5"]


def test_paths_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path, message in [
        (tmp_path / "no" / "result.h5", "does not exist"),
        (tmp_path / "file" / "result.h5", "does not exist"),
        (tmp_path, "is a folder"),
        (Path("/dev/null"), "cannot be written"),
    ]:
        for start in (ResultWriter.create, ResultWriter.resume):
            with pytest.raises(ResultError, match=message) as caught:
                start(path, META)
            assert str(path) in str(caught.value)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    with pytest.raises(ResultError, match="Permission denied"):
        ResultWriter.create(tmp_path / "result.h5", META)


def test_an_old_result_stays_until_the_first_new_frame(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 3)
    before = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), ResultWriter.create(path, META):
        raise KeyboardInterrupt
    assert path.read_bytes() == before
    with pytest.raises(KeyboardInterrupt), ResultWriter.create(path, META) as writer:
        writer.append(make_frame(0), make_state(0))
        raise KeyboardInterrupt
    assert assert_complete(path, 1) == 1


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    link = tmp_path / "result.h5"
    link.symlink_to(tmp_path / "disk" / "real.h5")
    write(link, 2)
    assert link.is_symlink()
    assert assert_complete(tmp_path / "disk" / "real.h5", 2) == 2


def test_two_runs_do_not_write_one_file(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        with pytest.raises(ResultError, match=r"result\.h5: another run"):
            ResultWriter.create(path, META)
        writer.append(make_frame(0), make_state(0))
    assert assert_complete(path, 1) == 1


def test_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "result.h5"
    write(path, 5)
    assert assert_complete(path, 5) == 5


def test_a_full_disk_is_one_line_and_keeps_the_finished_frames(tmp_path: Path) -> None:
    """On a real file system of 1 MB, in a process of its own: after a failed write HDF5 likes to crash at exit."""
    disk = tmp_path / "disk"
    disk.mkdir()
    script = f"""
import sys
from tests.io.result_victim import META, make_frame, make_state
from tk.errors import ResultError
from tk.io.result import ResultWriter
try:
    with ResultWriter.create(r"{disk}/result.h5", META) as writer:
        for index in range(2000):
            writer.append(make_frame(index), make_state(index))
            print(index + 1)
except ResultError as error:
    print(error, file=sys.stderr)
    import h5py, shutil
    with h5py.File(r"{disk}/result.h5", "r") as file:
        assert len(file["frames"])
    shutil.copyfile(r"{disk}/result.h5", r"{tmp_path}/kept.h5")
    sys.exit(2)
"""
    mount = f"mount -t tmpfs -o size=1m none '{disk}'"
    isolate = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
    if shutil.which("unshare") is None or subprocess.run([*isolate, mount], capture_output=True).returncode:
        pytest.skip("no permission to mount a small file system")
    done = subprocess.run(
        [*isolate, f'{mount} && exec "$@"', "sh", sys.executable, "-c", script],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr == f"{disk}/result.h5: cannot be written: No space left on device\n"
    appended = int(done.stdout.split()[-1])
    assert assert_complete(tmp_path / "kept.h5", appended) == appended


def test_use_after_close_is_a_defect(tmp_path: Path) -> None:
    writer = ResultWriter.create(tmp_path / "result.h5", META)
    writer.close()
    writer.close()
    with pytest.raises(ValueError, match="closed"):
        writer.append(make_frame(0))


# --- joints -----------------------------------------------------------------------------------------------------------


def write_truth(path: Path, frames: list[int], names: tuple[str, ...] = JOINTS, units: str = "m") -> None:
    with h5py.File(path, "w") as file:
        file.attrs["units"] = units
        file["frames"] = frames
        values = np.arange(len(frames) * len(names) * 3, dtype=float).reshape(len(frames), len(names), 3)
        file["joints/position"] = values
        file["joints/position"].attrs["names"] = list(names)


def test_joints_of_a_result(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 3)
    track = read_joints(path)
    np.testing.assert_array_equal(track.frames, [3, 4, 5])
    assert track.status is not None
    assert track.seconds is not None
    np.testing.assert_array_equal(track.status, [1, 0, 0])
    np.testing.assert_array_equal(track.seconds, [0.05, 1.05, 2.05])


def test_joints_of_a_truth_come_in_the_contracts_order(tmp_path: Path) -> None:
    path = tmp_path / "truth.h5"
    write_truth(path, [4, 2], names=(*reversed(JOINTS), "nose"))
    track = read_joints(path)
    assert track.positions.shape == (2, 15, 3)
    np.testing.assert_array_equal(track.positions[0, 0], [42, 43, 44])
    assert track.status is None
    assert track.seconds is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frames": [1, 2, 1]}, "frame 1 is there twice"),
        ({"frames": [1], "names": JOINTS[1:]}, "no joint pelvis"),
        ({"frames": [1], "units": "mm"}, "units = mm"),
    ],
)
def test_joints_that_cannot_be_compared(tmp_path: Path, arguments: dict, message: str) -> None:
    path = tmp_path / "truth.h5"
    write_truth(path, **arguments)
    with pytest.raises(ResultError, match=rf"truth\.h5: .*{message}"):
        read_joints(path)
