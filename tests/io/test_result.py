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
from tk.io.result import ResultMeta, ResultWriter, Value, read_joints, read_result
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
        ]:
            assert (file[name].shape, file[name].dtype) == (shape, dtype), name
        assert tuple(file["joints/position"].attrs["names"]) == JOINTS
        assert tuple(file["pose"].attrs["names"]) == META.pose_names
        assert tuple(file["pose"].attrs["units"]) == META.pose_units
        assert tuple(file["iterations"].attrs["stages"]) == META.stages
        assert file["status"].attrs["meaning"][3] == "3: lost"
        attributes = dict(file.attrs)
    assert attributes.pop("software").startswith("tk-mocap")
    assert attributes.pop("created").endswith("+00:00")
    assert attributes == {
        "format": "tk-result",
        "format_version": 1,
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
                replace(frame, pose=np.zeros(0), joints=np.zeros((0, 3)), iterations=np.zeros(0, dtype=np.int32))
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
        ({"fps": 30.0}, "fps is 15.0, not 30.0"),
        ({"pose_names": ("x",), "pose_units": ("m",)}, "the pose has 24 entries, not 1"),
        ({"stages": ("all",)}, "stages are all, chains; not all"),
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


# --- files that cannot be used ----------------------------------------------------------------------------------------


def other_software(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["data"] = np.arange(3)


def not_hdf5(path: Path) -> None:
    path.write_text("frame,x,y,z\n")


def newer_version(path: Path) -> None:
    write(path, 1)
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 2


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
        (newer_version, "format_version is 2"),
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
