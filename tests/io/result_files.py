"""Results as :mod:`tests.io.result_victim` makes them: written, looked at, compared."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.io.result_victim import META, make_frame, make_state
from tk.io import hdf5_writer
from tk.io.results.data import ResultMeta, UsedCameras, Value
from tk.io.results.reader import read_result
from tk.io.results.writer import ResultWriter
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.camera import Camera, Rig


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
        for name, field in (("residual", "residual"), ("feet/position", "feet")):
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
    left, original = [writes], hdf5_writer._write

    def write(file: io.FileIO | io.BytesIO, place: int, data: bytes) -> None:
        if isinstance(file, io.FileIO):
            left[0] -= 1
            if left[0] < 0:
                raise OSError(28, "No space left on device")
        original(file, place, data)

    monkeypatch.setattr(hdf5_writer, "_write", write)
