"""Readers of damaged results return a value, or raise an error of one line that names the file."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tk.errors import ResultError, TkError
from tk.export.motion import read_motion
from tk.io.results.reader import read_people, read_result
from tk.render.figure import figure_of
from tk.report.page import build_page

#: limit for all readers of one damaged file, s: far more than they need
LIMIT_S = 30.0


def read_in_every_way(path: Path) -> None:
    """Read a file as a report, a drawing and an export do. Only a TkError of one line that names the file may occur."""

    def drawn() -> None:
        result = read_result(path)
        figure_of(result)
        build_page(result, [], None)

    ways: list[Callable[[], object]] = [drawn, lambda: read_people(path), lambda: read_motion(path, smoothed=True)]
    started = time.perf_counter()
    for way in ways:
        try:
            way()
        except TkError as error:
            assert path.name in str(error) and "\n" not in str(error), error
    assert time.perf_counter() - started < LIMIT_S


def datasets(path: Path) -> list[str]:
    found: list[str] = []
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None)
    return found


def other_values(old: np.ndarray) -> dict[str, Any]:
    """Return other contents of a dataset by the kind of damage."""
    values: dict[str, Any] = {
        "text": "[1, 2]", "json": '{"a": [[]]}', "number": 3, "empty": np.zeros(0), "deep": "[" * 5000,
    }  # fmt: skip
    if old.dtype.kind in "fiu" and old.ndim:
        values |= {"short": old[:-1], "flat": old.ravel(), "negative": -old.astype(float) - 1}
        values |= {
            kind: np.full(old.shape, value) for kind, value in (("nan", np.nan), ("inf", np.inf), ("large", 1e11))
        }
        values["one nan"] = np.where(np.arange(old.size).reshape(old.shape) == old.size // 2, np.nan, old)
    return values


@settings(max_examples=15, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_datasets_give_one_line(complete: Path, tmp_path: Path, data: st.DataObject) -> None:
    path = Path(shutil.copy(complete, tmp_path / "damaged.h5"))
    name = data.draw(st.sampled_from(datasets(complete)))
    with h5py.File(path, "r+") as file:
        attributes = dict(file[name].attrs)
        values = other_values(np.asarray(file[name][()]))
        kind = data.draw(st.sampled_from([*values, "delete", "group", "no attributes"]))
        del file[name]
        if kind == "group":
            file.create_group(name)
        elif kind == "no attributes":
            file[name] = 1.0
        elif kind != "delete":
            file[name] = values[kind]
            file[name].attrs.update(attributes)
    read_in_every_way(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("model/parts/name", None), ("model/parts/segment", None), ("model/parts/kind", None),
        ("model/parts/segment", '["nowhere"]'), ("model/parts/name", "{}"), ("model/parts/name", "[" * 9000),
        ("model/parts/kind", 7.5), ("model/parts/shape", np.nan), ("model/dimensions/trunk", -1.0),
    ],
)  # fmt: skip
def test_damaged_body_is_named(complete: Path, tmp_path: Path, name: str, value: Any) -> None:
    path = Path(shutil.copy(complete, tmp_path / "damaged.h5"))
    with h5py.File(path, "r+") as file:
        old = file[name][()]
        del file[name]
        if value is not None:
            file[name] = np.full(old.shape, value) if isinstance(value, float) else value
    with pytest.raises(ResultError, match=r"damaged\.h5: the body cannot be used; the file is damaged"):
        figure_of(read_result(path))


@pytest.mark.parametrize("name", ["time", "timing/total"])
def test_unknown_time_is_named(complete: Path, tmp_path: Path, name: str) -> None:
    path = Path(shutil.copy(complete, tmp_path / "damaged.h5"))
    with h5py.File(path, "r+") as file:
        file[name][3] = np.nan
    with pytest.raises(ResultError, match=rf"damaged\.h5: /{name} holds NaN"):
        read_result(path)


def test_infinite_pose_is_read_as_unknown(complete: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(complete, tmp_path / "damaged.h5"))
    with h5py.File(path, "r+") as file:
        file["pose"][3, 5] = np.inf
        file["objective"][3] = np.inf
    result = read_result(path)
    assert np.isnan(result.pose[3, 5]) and np.isinf(result.objective[3])
