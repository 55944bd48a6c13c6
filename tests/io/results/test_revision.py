"""Finished results changed as a whole: a second pass, a smoothed copy."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.io.result_files import (
    append,
    assert_equal_values,
    assert_same_cameras,
    make_cameras,
    make_smoothed,
    resume,
    revise_result,
    write,
)
from tests.io.result_victim import META, make_frame
from tk.errors import ResultError
from tk.io.results.reader import read_result
from tk.io.results.writer import ResultWriter
from tk.model.body.skeleton import JOINTS


def test_second_pass_replaces_only_the_given_datasets(path: Path, tmp_path: Path) -> None:
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
    resume(path, 7)
    np.testing.assert_array_equal(read_result(path).pose[:6], pose)


def test_smoothed_copy_is_stored_separately_and_can_replace_the_raw_values(path: Path) -> None:
    write(path, 6)
    smoothed = make_smoothed(6)
    revise_result(path, smoothed=smoothed)
    result = read_result(path)
    assert result.smoothed is not None and result.smoothed.keys() == smoothed.keys()
    for name, values in smoothed.items():
        np.testing.assert_array_equal(result.smoothed[name], values)
    assert result.smoothed["bridged"].dtype == bool
    np.testing.assert_array_equal(result.joints[0], make_frame(0)["joints/position"])
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


def test_smoothed_copy_is_deleted_when_its_source_changes(path: Path) -> None:
    write(path, 4)
    revise_result(path, smoothed=make_smoothed(4))
    resume(path, 4)
    assert read_result(path).smoothed is not None  # no frame was added
    resume(path, 5)
    assert read_result(path).smoothed is None
    revise_result(path, smoothed=make_smoothed(5))
    revise_result(path, {"pose": np.zeros((5, 24))})
    assert read_result(path).smoothed is None


@pytest.mark.parametrize(
    "change",
    [
        {"columns": {"pose": np.zeros((3, 24))}},
        {"columns": {"nonsense": np.zeros((4, 3))}},
        {"smoothed": {"pose": np.zeros((4, 24))}},
        {"smoothed": {"pose": np.zeros((5, 24)), "bridged": np.zeros(4)}},
        {"smoothed": {"status": np.zeros(4), "bridged": np.zeros(4)}},
    ],
)
def test_second_pass_of_wrong_shape_changes_nothing(path: Path, change: dict[str, Any]) -> None:
    write(path, 4)
    before = path.read_bytes()
    with pytest.raises(ValueError):
        revise_result(path, **change)
    assert path.read_bytes() == before


def test_failed_second_pass_changes_nothing(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(path, 4)
    before = path.read_bytes()

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(ResultError, match=r"result\.h5: cannot be written: No space left on device"):
        revise_result(path, {"pose": np.zeros((4, 24))})
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.h5"]


def test_second_pass_refuses_a_result_that_is_being_written(path: Path, tmp_path: Path) -> None:
    with ResultWriter.create(path, META) as writer:
        append(writer, 0)
        with pytest.raises(ResultError, match="another run"):
            revise_result(path, {"pose": np.zeros((1, 24))})
    with pytest.raises(ResultError, match="no such file"):
        revise_result(tmp_path / "other.h5", {})
