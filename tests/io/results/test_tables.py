"""Results as tables of pandas and datasets of xarray."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from tk.errors import ExportError
from tk.io.results.data import Result
from tk.io.results.reader import read_result
from tk.model.body.joints import FOOT_POINTS


@pytest.fixture(scope="module")
def result(causal: Path) -> Result:
    return read_result(causal).at_rows(np.arange(2, 5))


def test_table_has_one_row_per_frame_and_all_values_of_the_file(result: Result) -> None:
    pytest.importorskip("pandas")
    table = result.to_pandas()
    assert list(table.index) == [2, 3, 4] and table.index.name == "frame"
    assert table.columns.is_unique and list(table.columns[table.isna().any()]) == ["neck_rotation_deg"]
    elbow = result.meta.joint_names.index("elbow_l")
    np.testing.assert_array_equal(table[["elbow_l_x", "elbow_l_y", "elbow_l_z"]], result.joints[:, elbow])
    np.testing.assert_array_equal(table["toe_r_z"], result.feet[:, FOOT_POINTS.index("toe_r"), 2])
    np.testing.assert_array_equal(table["knee_l_flexion_deg"], result.angles["knee_l"][:, 0])
    assert set(table["status"]) == {"tracked"}
    expected = 3 + 15 * 3 + 15 + 4 * 3 + sum(len(a.names) for a in result.meta.angles)
    assert len(table.columns) == expected + 2 * len(result.meta.residual_cameras)


def test_xarray_dataset_has_named_dimensions(result: Result) -> None:
    pytest.importorskip("xarray")
    data = result.to_xarray()
    assert data.sizes["frame"] == 3 and data.sizes["dof"] == 32
    np.testing.assert_array_equal(
        data["joints"].sel(joint="knee_r", axis="z"),
        result.joints[:, result.meta.joint_names.index("knee_r"), 2],
    )
    np.testing.assert_array_equal(data["time"], result.time)
    np.testing.assert_array_equal(data["angles"].sel(angle="knee_l flexion"), result.angles["knee_l"][:, 0])
    np.testing.assert_array_equal(data["pose"].sel(dof=result.meta.pose_names[5]), result.pose[:, 5])
    assert data["joints"].attrs["units"] == "m" and data.attrs["fps"] == 15.0


def test_values_that_the_file_does_not_have_are_omitted(tracked: Path) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    volumetric = read_result(tracked)
    assert volumetric.sigma is None and not [c for c in volumetric.to_pandas().columns if c.endswith("_sigma")]
    assert not {"sigma", "feet", "angles"} & set(volumetric.to_xarray())


def test_table_has_each_angle_once(result: Result, tracked: Path) -> None:
    """In degrees; a result without joint angles has its pose, whose columns name their unit."""
    pytest.importorskip("pandas")
    assert not [name for name in result.to_pandas().columns if name.endswith("_rad") or name in result.meta.pose_names]
    volumetric = read_result(tracked)
    table = volumetric.to_pandas()
    meta = volumetric.meta
    columns = [f"{name}_{unit}" for name, unit in zip(meta.pose_names, meta.pose_units, strict=True)]
    np.testing.assert_array_equal(table[columns], volumetric.pose)


@pytest.mark.parametrize("package", ["pandas", "xarray"])
def test_missing_package_gives_an_error_of_one_line(
    tracked: Path, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ExportError, match=f"pip install {package}"):
        getattr(read_result(tracked), f"to_{package}")()
