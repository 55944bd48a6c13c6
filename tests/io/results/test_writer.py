"""Results written frame by frame and read back; what a tracker may have or not; joints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.io.result_files import (
    assert_complete,
    assert_equal_values,
    assert_same_cameras,
    make_cameras,
    write,
    write_truth,
)
from tests.io.result_victim import META, make_frame, make_state
from tk.errors import ResultError
from tk.io.results.data import FrameResult, JointAngles, UsedCameras, Value
from tk.io.results.reader import read_joints, read_result
from tk.io.results.revision import revise_result
from tk.io.results.status import Status
from tk.io.results.writer import ResultWriter
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import OPTIONAL
from tk.model.body.skeleton import JOINTS, build_skeleton, paper_poses


def test_written_values_are_read_back(tmp_path: Path) -> None:
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
            ("joints/sigma", (2, 15), "float64"),
            ("residual", (2, 3, 2), "float64"),
            ("mask_source", (2, 3), "uint8"),
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
        assert list(file["status"].attrs["meaning"]) == [
            "0: tracked", "1: initialised", "2: recovered after loss", "3: lost", "4: suspect", "5: absent"
        ]  # fmt: skip
        assert tuple(file["joints/sigma"].attrs["names"]) == JOINTS
        assert tuple(file["residual"].attrs["cameras"]) == META.residual_cameras
        assert tuple(file["residual"].attrs["areas"]) == ("missing", "surplus")
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
        "format_version": 3,
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


def test_appended_frame_is_in_the_file_immediately(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        for index in range(5):
            writer.append(make_frame(index), make_state(index))
            snapshot = tmp_path / "snapshot.h5"  # HDF5 would serve the writer's own memory for the same file
            snapshot.write_bytes(path.read_bytes())
            assert assert_complete(snapshot, index + 1) == index + 1


@pytest.mark.parametrize("done", [0, 2])
def test_frames_not_yet_flushed_are_kept_when_the_run_ends(tmp_path: Path, done: int) -> None:
    """Whether one is in the file already, or an older result is still there."""
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        writer.append(make_frame(9), make_state(9))
    with pytest.raises(KeyboardInterrupt), ResultWriter.create(path, META) as writer:
        for index in range(done):
            writer.append(make_frame(index), make_state(index))
        for index in range(done, done + 3):
            writer.append(make_frame(index), make_state(index), flush=False)
        waiting = tmp_path / "waiting.h5"
        waiting.write_bytes(path.read_bytes())
        assert list(read_result(waiting).frames) == [make_frame(index).frame for index in range(done) or [9]]
        raise KeyboardInterrupt
    assert assert_complete(path, done + 3) == done + 3


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


def test_model_can_be_replaced_during_the_run(tmp_path: Path) -> None:
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
        {"status": 6},
        {"timing": {"nonsense": 1.0}},
        {"sigma": np.zeros(14)},
        {"residual": np.zeros(3)},
        {"angles": {"elbow_l": np.zeros(1)}},
        {"angles": {"knee_l": np.zeros(2)}},
    ],
)
def test_frame_of_wrong_shape_is_refused_and_earlier_frames_are_kept(tmp_path: Path, change: dict[str, Any]) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        writer.append(make_frame(0), make_state(0))
        with pytest.raises(ValueError):
            writer.append(replace(make_frame(1), **change))
        writer.append(make_frame(1), make_state(1))
    assert assert_complete(path, 2) == 2


# --- what a tracker may have or not -----------------------------------------------------------------------------------

PLAIN = replace(
    META, sigma=False, residual_cameras=(), mask_sources=(), segment_names=(), feet=False, angles=(), objective_kind=""
)


def plain_frame(index: int) -> FrameResult:
    return replace(
        make_frame(index), sigma=None, residual=None, mask_source=None, segments_rotation=None, feet=None, angles={}
    )


def test_optional_values_are_read_back(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 5)
    result = read_result(path)
    assert result.meta == META
    assert result.sigma is not None and result.residual is not None and result.silhouette_error is not None
    assert result.segments_rotation is not None and result.feet is not None
    assert result.sigma.shape == (5, 15) and np.isnan(result.sigma).all(axis=1).tolist() == [False] * 3 + [True, False]
    np.testing.assert_array_equal(result.residual[:, 2, 1], range(5))
    assert result.mask_source is not None and result.mask_source.dtype == np.uint8
    assert result.meta.mask_sources == ("scene", "segmenter") and result.mask_source[3].tolist() == [0, 1, 1]
    np.testing.assert_array_equal(result.silhouette_error[:, 2], range(5))
    np.testing.assert_array_equal(result.segments_rotation[4], make_frame(4).segments_rotation)
    np.testing.assert_array_equal(result.feet[1], make_frame(1).feet)
    assert list(result.angles) == ["knee_l", "hip_l"]
    np.testing.assert_array_equal(result.angles["knee_l"][:, 0], 5.0 * np.arange(5))
    assert result.cameras is None and result.smoothed is None
    track = read_joints(path)
    np.testing.assert_array_equal(track.sigma, result.sigma)


def test_undeclared_datasets_are_absent(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, PLAIN) as writer:
        writer.append(plain_frame(0), make_state(0))
    result = read_result(path)
    assert result.meta == PLAIN and result.sigma is None and result.feet is None and result.angles == {}
    assert read_joints(path).sigma is None


def test_suspect_frames_have_a_pose_and_absent_frames_have_none(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        for status in Status:
            writer.append(replace(make_frame(int(status)), status=status))
    assert read_result(path).has_pose.tolist() == [True, True, True, False, True, False]


def test_paper_pose_is_derived_from_the_names_of_the_pose(tmp_path: Path) -> None:
    skeleton = build_skeleton(BodyDimensions.from_stature(1.7), optional=OPTIONAL)
    path = tmp_path / "result.h5"
    pose = skeleton.clip(np.linspace(-0.3, 0.3, 31))
    with ResultWriter.create(path, replace(META, pose_names=skeleton.names, pose_units=skeleton.units)) as writer:
        writer.append(replace(make_frame(0), pose=pose))
    np.testing.assert_array_equal(read_result(path).paper_pose(), [paper_poses(skeleton, pose)])
    write(path, 1)
    with pytest.raises(ResultError, match="/pose"):
        read_result(path).paper_pose()


def test_repeated_angles_are_refused() -> None:
    with pytest.raises(ValueError, match="same name"):
        replace(META, angles=META.angles * 2)
    with pytest.raises(ValueError, match="slash"):
        JointAngles("a/b", ("flexion",), "")


def test_cameras_can_be_replaced_and_are_kept_by_a_resumed_run(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    with ResultWriter.create(path, META) as writer:
        writer.append(make_frame(0), make_state(0))
    revise_result(path, cameras=make_cameras())
    assert_same_cameras(read_result(path).cameras, make_cameras())
    revise_result(path, cameras=make_cameras(shift_m=0.5))
    with ResultWriter.resume(path, META)[0] as writer:
        writer.append(make_frame(1), make_state(1))
    assert assert_complete(path, 2) == 2
    assert_same_cameras(read_result(path).cameras, make_cameras(shift_m=0.5))
    with h5py.File(path) as file:
        assert list(file["cameras"].attrs["names"]) == ["cam1", "cam2"]
        assert file["cameras/rotation"].shape == (2, 3) and file["cameras/distortions"].shape == (2, 5)


def test_time_offsets_that_do_not_fit_the_cameras_are_refused() -> None:
    with pytest.raises(ValueError, match="2 finite numbers"):
        UsedCameras(make_cameras().rig, np.zeros(3))


# --- joints -----------------------------------------------------------------------------------------------------------


def test_joints_of_a_result(tmp_path: Path) -> None:
    path = tmp_path / "result.h5"
    write(path, 3)
    track = read_joints(path)
    np.testing.assert_array_equal(track.frames, [3, 4, 5])
    assert track.status is not None
    assert track.seconds is not None
    np.testing.assert_array_equal(track.status, [1, 0, 0])
    np.testing.assert_array_equal(track.seconds, [0.05, 1.05, 2.05])


def test_joints_of_ground_truth_are_returned_in_the_order_of_the_contract(tmp_path: Path) -> None:
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
        ({"frames": [1, 2, 1]}, "frame 1 is listed twice"),
        ({"frames": [1], "names": JOINTS[1:]}, "no joint pelvis"),
        ({"frames": [1], "units": "mm"}, "units = mm"),
    ],
)
def test_joints_that_cannot_be_compared(tmp_path: Path, arguments: dict, message: str) -> None:
    path = tmp_path / "truth.h5"
    write_truth(path, **arguments)
    with pytest.raises(ResultError, match=rf"truth\.h5: .*{message}"):
        read_joints(path)
