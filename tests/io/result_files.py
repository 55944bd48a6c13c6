"""Write and compare results with the frames of :mod:`tests.io.result_victim`."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.io.result_victim import META, make_frame, make_run, make_state
from tk.io.results.data import ResultMeta, UsedCameras, Value
from tk.io.results.reader import read_result
from tk.io.results.revision import Revision, revise_people
from tk.io.results.schema import checked_row, columns_of
from tk.io.results.writer import ResultWriter
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.camera import Camera, Rig


def append(writer: ResultWriter, *indices: int, state: bool = True, flush: bool = True) -> None:
    """Append frames of one person."""
    for index in indices:
        writer.append(make_run(index), {0: make_frame(index)}, make_state(index) if state else None, flush)


def write(path: Path, count: int, meta: ResultMeta = META) -> None:
    with ResultWriter.create(path, meta) as writer:
        append(writer, *range(count))


def revise_result(
    path: Path,
    columns: Mapping[str, Any] | None = None,
    *,
    smoothed: Mapping[str, Any] | None = None,
    model: Mapping[str, Value] | None = None,
    person: int = 0,
    **run: Any,
) -> ResultMeta:
    """Replace parts of the result of one person, and ``cameras`` and ``notes`` of the run."""
    return revise_people(path, {person: Revision(columns or {}, smoothed, model)}, **run)


def resume(path: Path, stop: int) -> int:
    """Continue a result up to frame ``stop``; return the number of frames that it had."""
    writer, done = ResultWriter.resume(path, META)
    with writer:
        append(writer, *range(done, stop))
    return done


def assert_complete(path: Path, at_least: int) -> int:
    """Check that the file has all values of its frames and the state of the last one; return the number of frames."""
    columns = columns_of(META)
    with h5py.File(path, "r") as file:  # as any user would open it
        count = len(file["frames"])
        assert count >= at_least
        rows = [checked_row(make_run(index) | make_frame(index), columns) for index in range(count)]
        for name, column in columns.items():
            np.testing.assert_array_equal(file[name][()], np.reshape([row[name] for row in rows], (-1, *column.shape)))
        if count > 1:
            voxels = [row for row in rows if "hull/positions" in row]
            counts = [len(row.get("hull/positions", ())) for row in rows]
            np.testing.assert_array_equal(np.diff(file["hull/offsets"][()]), counts)
            for name in ("hull/positions", "hull/colors"):
                np.testing.assert_array_equal(file[name][()], np.concatenate([row[name] for row in voxels]))
    if count:
        assert_equal_values(read_result(path).state, make_state(count - 1))
    return count


def assert_equal_values(found: Mapping[str, Value], expected: Mapping[str, Value]) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value)


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


def make_smoothed(count: int) -> dict[str, np.ndarray]:
    return {
        "pose": np.full((count, 24), 0.5),
        "joints/position": np.full((count, 15, 3), 0.25),
        "angles/knee_l": np.full((count, 1), 30.0),
        "bridged": np.arange(count) % 2 == 0,
    }


def write_truth(path: Path, frames: list[int], names: tuple[str, ...] = JOINTS, units: str = "m") -> None:
    with h5py.File(path, "w") as file:
        file.attrs["units"] = units
        file["frames"] = frames
        values = np.arange(len(frames) * len(names) * 3, dtype=float).reshape(len(frames), len(names), 3)
        file["joints/position"] = values
        file["joints/position"].attrs["names"] = list(names)


def fail_after(writes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the disk be full after this number of writes."""
    left = [writes]

    class File(io.FileIO):
        def write(self, data: Any) -> int:
            left[0] -= 1
            if left[0] < 0:
                raise OSError(28, "No space left on device")
            return super().write(data)

    monkeypatch.setattr(io, "FileIO", File)
