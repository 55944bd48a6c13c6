"""Results written frame by frame and read back; optional values; joints of results and of ground truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.io.result_files import (
    append,
    assert_complete,
    assert_equal_values,
    assert_same_cameras,
    make_cameras,
    resume,
    revise_result,
    write,
    write_truth,
)
from tests.io.result_victim import META, make_frame, make_run, make_state
from tk.errors import ResultError
from tk.io.results.data import JointAngles, UsedCameras, Value
from tk.io.results.reader import read_joints, read_result
from tk.io.results.status import Status
from tk.io.results.writer import ResultWriter
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.skeleton import JOINTS, build_skeleton, paper_poses


def test_written_values_are_read_back(path: Path, tmp_path: Path) -> None:
    model = {"torso/radii_m": np.array([0.1, 0.2]), "height_m": 1.78, "sex": "any"}
    with ResultWriter.create(path, META) as writer:
        writer.write_model(model)
        append(writer, *range(60))
    assert assert_complete(path, 60) == 60
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.h5"]
    result = read_result(path)
    assert result.meta == META
    assert_equal_values(result.model, model)
    fields = {
        "frames": "frames", "time": "time", "pose": "pose", "joints/position": "joints", "status": "status",
        "objective": "objective", "iterations": "iterations", "joints/sigma": "sigma", "residual": "residual",
        "mask_source": "mask_source", "segments/rotation": "segments_rotation", "feet/position": "feet",
        "landmarks": "landmarks",
        "landmark_depth": "landmark_depth",
    }  # fmt: skip
    for name, field in fields.items():
        np.testing.assert_array_equal(getattr(result, field)[6], (make_run(6) | make_frame(6))[name], err_msg=name)
    np.testing.assert_array_equal(result.angles["hip_l"][6], make_frame(6)["angles/hip_l"])
    np.testing.assert_array_equal(result.timing["total"][6], make_run(6)["timing/total"])
    assert list(result.angles) == ["knee_l", "hip_l"] and result.timing["optimise"][6] == 0
    assert result.sigma is not None and np.isnan(result.sigma[7]).all()
    assert result.landmarks is not None and np.isnan(result.landmarks[5]).all()
    assert result.silhouette_error is not None and result.silhouette_error[4].tolist() == [0.1, 0.2, 4]
    assert result.hull is not None and len(result.hull[5].positions) == 0
    np.testing.assert_array_equal(result.hull[7].positions, make_frame(7)["hull/positions"])
    np.testing.assert_array_equal(result.hull[7].colors, make_frame(7)["hull/colors"])
    assert result.cameras is None and result.smoothed is None


def test_layout_is_the_contract(path: Path) -> None:
    write(path, 2)
    expected: dict[str, tuple[tuple[int, ...], str, dict[str, Any]]] = {
        "frames": ((2,), "int64", {}),
        "time": ((2,), "float64", {}),
        "pose": ((2, 24), "float64", {"names": META.pose_names, "units": META.pose_units}),
        "joints/position": ((2, 15, 3), "float64", {"names": JOINTS}),
        "joints/sigma": ((2, 15), "float64", {"names": JOINTS}),
        "segments/rotation": ((2, 2, 4), "float64", {"names": META.segment_names}),
        "angles/knee_l": ((2, 1), "float64", {"names": ("flexion",)}),
        "angles/hip_l": ((2, 3), "float64", {"names": ("flexion", "abduction", "rotation")}),
        "feet/position": ((2, 4, 3), "float64", {"names": ("heel_l", "toe_l", "heel_r", "toe_r")}),
        "status": ((2,), "uint8", {"meaning": (
            "0: tracked", "1: initialised", "2: recovered after loss", "3: lost", "4: suspect", "5: absent",
        )}),
        "objective": ((2,), "float64", {}),
        "residual": ((2, 3, 2), "float64", {"cameras": META.residual_cameras, "areas": ("missing", "surplus")}),
        "mask_source": ((2, 3), "uint8", {"cameras": META.residual_cameras}),
        "landmarks": ((2, 3, 2, 3), "float32", {"names": META.landmark_names, "cameras": META.residual_cameras}),
        "landmark_depth": ((2, 3, 2), "float32", {"names": META.landmark_names, "cameras": META.residual_cameras}),
        "iterations": ((2, 2), "int32", {"stages": META.stages}),
        "timing/optimise": ((2,), "float64", {}),
    }  # fmt: skip
    with h5py.File(path, "r") as file:
        for name, (shape, dtype, lists) in expected.items():
            assert (file[name].shape, file[name].dtype) == (shape, dtype), name
            assert {key: tuple(file[name].attrs[key]) for key in lists} == lists, name
        assert file["angles/hip_l"].attrs["convention"] == "Grood and Suntay"
        assert file["objective"].attrs["kind"] == "negative log-likelihood"
        attributes = dict(file.attrs)
    assert attributes.pop("software").startswith("tk-mocap")
    assert attributes.pop("created").endswith("+00:00")
    assert attributes == {
        "format": "tk-result", "format_version": 4, "fps": 15.0, "units": "m", "up": "z", "capture": "walk",
        "method": "volumetric", "seed": 7, "config": META.config_toml,
    }  # fmt: skip
    # version 3 of the superblock has a flag "open for writing" that a kill leaves set; such a file does not open
    assert path.read_bytes()[8] < 3


def test_appended_frame_is_in_the_file_immediately(path: Path, tmp_path: Path) -> None:
    with ResultWriter.create(path, META) as writer:
        for index in range(5):
            append(writer, index)
            snapshot = tmp_path / "snapshot.h5"  # HDF5 would serve the writer's own memory for the same file
            snapshot.write_bytes(path.read_bytes())
            assert assert_complete(snapshot, index + 1) == index + 1


@pytest.mark.parametrize("done", [0, 2])
def test_frames_not_yet_flushed_are_kept_when_the_run_ends(path: Path, done: int) -> None:
    """Whether one is in the file already, or an older result is still there."""
    write(path, 1)
    older = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), ResultWriter.create(path, META) as writer:
        append(writer, *range(done))
        append(writer, *range(done, done + 3), flush=False)
        assert (path.read_bytes() == older) == (done == 0)
        raise KeyboardInterrupt
    assert assert_complete(path, done + 3) == done + 3


def test_arrays_may_be_reused_after_append(path: Path) -> None:
    pose, mean = np.zeros(24), np.zeros(3)
    with ResultWriter.create(path, META) as writer:
        for index in range(4):
            pose[:] = index
            mean[:] = index
            writer.append(make_run(index), {0: make_frame(index) | {"pose": pose}}, {"mean": mean}, flush=False)
        pose[:] = mean[:] = -1
    np.testing.assert_array_equal(read_result(path).pose[:, 0], range(4))
    np.testing.assert_array_equal(read_result(path).state["mean"], np.full(3, 3.0))


def test_model_can_be_replaced_during_the_run(path: Path) -> None:
    with ResultWriter.create(path, META) as writer:
        writer.write_model({"height_m": 1.7, "guess": 1.0})
        append(writer, 0, 1)
        writer.write_model({"height_m": 1.8})
        append(writer, 2)
    assert read_result(path).model == {"height_m": 1.8}


def test_state_may_change_its_shape_and_names(path: Path) -> None:
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
                writer.append(make_run(index), {0: make_frame(index)}, state)
        assert_equal_values(read_result(path).state, states[count - 1])


@pytest.mark.parametrize(
    "change",
    [
        {"pose": np.zeros(23)},
        {"joints/position": np.zeros((14, 3))},
        {"iterations": np.zeros(3, dtype=np.int32)},
        {"status": 6},
        {"timing/nonsense": 1.0},
        {"joints/sigma": np.zeros(14)},
        {"angles/elbow_l": np.zeros(1)},
        {"hull/positions": np.zeros((4, 3)), "hull/colors": np.zeros((5, 3))},
    ],
)
def test_wrong_frame_is_refused_and_earlier_frames_are_kept(path: Path, change: dict[str, Any]) -> None:
    with ResultWriter.create(path, META) as writer:
        append(writer, 0)
        with pytest.raises(ValueError, match=list(change)[-1]):
            writer.append(make_run(1), {0: make_frame(1) | change}, make_state(1))
        with pytest.raises(ValueError, match="pose is missing"):
            writer.append(make_run(1), {0: {name: value for name, value in make_frame(1).items() if name != "pose"}})
        append(writer, 1)
    assert assert_complete(path, 2) == 2


# --- optional values --------------------------------------------------------------------------------------------------


def test_undeclared_datasets_are_absent(path: Path) -> None:
    """Also those of pose and joints have no columns in a result that has only a hull."""
    plain = replace(
        META, sigma=False, residual_cameras=(), mask_sources=(),
        reasons=(), judged=False, deviation=False, camera_states=(), landmark_names=(), depth=False, segment_names=(),
        feet=False, angles=(), objective_kind="", pose_names=(), pose_units=(), joint_names=(), stages=(),
    )  # fmt: skip
    empty = {"pose": (), "joints/position": np.zeros((0, 3)), "iterations": ()}
    optional = ("joints/sigma", "residual", "mask_source", "landmarks", "landmark_depth", "segments", "feet", "angles")
    with ResultWriter.create(path, plain) as writer:
        for index in range(3):
            frame = make_frame(index) | empty
            person = {name: value for name, value in frame.items() if not name.startswith(optional)}
            writer.append(make_run(index), {0: person})
    result = read_result(path)
    assert result.meta == plain and result.sigma is None and result.feet is None and result.angles == {}
    assert result.pose.shape == (3, 0) and result.joints.shape == (3, 0, 3) and result.hull is not None
    with pytest.raises(ResultError, match="no joint pelvis"):
        read_joints(path)


def test_suspect_frames_have_a_pose_and_absent_frames_have_none(path: Path) -> None:
    with ResultWriter.create(path, META) as writer:
        for status in Status:
            writer.append(make_run(int(status)), {0: make_frame(int(status)) | {"status": status}})
    assert read_result(path).has_pose.tolist() == [True, True, True, False, True, False]


def test_paper_pose_is_derived_from_the_names_of_the_pose(path: Path) -> None:
    skeleton = build_skeleton(BodyDimensions.from_stature(1.7))
    pose = skeleton.clip(np.linspace(-0.3, 0.3, len(skeleton.names)))
    with ResultWriter.create(path, replace(META, pose_names=skeleton.names, pose_units=skeleton.units)) as writer:
        writer.append(make_run(0), {0: make_frame(0) | {"pose": pose}})
    np.testing.assert_array_equal(read_result(path).paper_pose(), [paper_poses(skeleton, pose)])
    write(path, 1)
    with pytest.raises(ResultError, match="/pose"):
        read_result(path).paper_pose()


def test_metadata_that_contradict_themselves_are_refused() -> None:
    with pytest.raises(ValueError, match="same name"):
        replace(META, angles=META.angles * 2)
    with pytest.raises(ValueError, match="slash"):
        JointAngles("a/b", ("flexion",), "")
    with pytest.raises(ValueError, match="2 finite numbers"):
        UsedCameras(make_cameras().rig, np.zeros(3))


def test_cameras_can_be_replaced_and_are_kept_by_a_resumed_run(path: Path) -> None:
    write(path, 1)
    for shift_m in (0.0, 0.5):
        revise_result(path, cameras=make_cameras(shift_m))
        assert_same_cameras(read_result(path).cameras, make_cameras(shift_m))
    resume(path, 2)
    assert assert_complete(path, 2) == 2
    assert_same_cameras(read_result(path).cameras, make_cameras(shift_m=0.5))
    with h5py.File(path) as file:
        assert list(file["cameras"].attrs["names"]) == ["cam1", "cam2"]
        assert file["cameras/rotation"].shape == (2, 3) and file["cameras/distortions"].shape == (2, 8)


# --- joints -----------------------------------------------------------------------------------------------------------


def test_joints_of_a_result(path: Path) -> None:
    write(path, 3)
    track, result = read_joints(path), read_result(path)
    np.testing.assert_array_equal(track.frames, [3, 4, 5])
    np.testing.assert_array_equal(track.positions, result.joints)
    np.testing.assert_array_equal(track.sigma, result.sigma)
    assert track.status is not None and track.status.tolist() == [1, 0, 0]
    assert track.seconds is not None and track.seconds.tolist() == [0.05, 1.05, 2.05]


def test_joints_of_ground_truth_are_returned_in_the_order_of_the_contract(tmp_path: Path) -> None:
    path = tmp_path / "truth.h5"
    write_truth(path, [4, 2], names=(*reversed(JOINTS), "nose"))
    track = read_joints(path)
    assert track.positions.shape == (2, 15, 3)
    np.testing.assert_array_equal(track.positions[0, 0], [42, 43, 44])
    assert track.status is None and track.seconds is None


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
