from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.io.conftest import MakeCapture
from tests.io.result_files import fail_after
from tk.errors import CaptureError, DiskFullError, ResultError
from tk.io.captures.capture import Capture, open_capture
from tk.io.point_cloud import write_hulls, write_ply
from tk.io.results.data import HullPoints
from tk.model.cameras.volume import VoxelGrid


def points(count: int, seed: int = 0) -> HullPoints:
    rng = np.random.default_rng(seed)
    return HullPoints(rng.normal(size=(count, 3)), rng.integers(0, 256, (count, 3), dtype=np.uint8))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=20)
@given(count=st.integers(0, 40), faces=st.integers(0, 30), seed=st.integers(0, 1000))
def test_open3d_reads_points_and_meshes(tmp_path: Path, count: int, faces: int, seed: int) -> None:
    import open3d  # takes seconds, which each worker that collects the tests would need

    expected = points(count, seed)
    triangles = np.random.default_rng(seed).integers(0, max(count, 1), (faces if count else 0, 3))
    for path, corners in ((tmp_path / "a" / "points.ply", None), (tmp_path / "a" / "mesh.ply", triangles)):
        write_ply(path, expected.positions, expected.colors, corners)
    cloud = open3d.io.read_point_cloud(tmp_path / "a" / "points.ply")
    np.testing.assert_array_equal(np.asarray(cloud.points).reshape(-1, 3), expected.positions)
    np.testing.assert_allclose(np.asarray(cloud.colors).reshape(-1, 3) * 255, expected.colors, atol=1e-6)
    mesh = open3d.io.read_triangle_mesh(tmp_path / "a" / "mesh.ply")
    np.testing.assert_array_equal(np.asarray(mesh.triangles).reshape(-1, 3), triangles)
    if len(triangles):
        np.testing.assert_array_equal(np.asarray(mesh.vertices), expected.positions)
        np.testing.assert_allclose(np.asarray(mesh.vertex_colors) * 255, expected.colors, atol=0.51)


def test_unwritable_ply_is_refused(tmp_path: Path) -> None:
    cloud = points(2)
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / "file" / "a.ply", tmp_path):
        with pytest.raises(ResultError, match="cannot be written"):
            write_ply(path, cloud.positions, cloud.colors)


@pytest.fixture
def capture(make_capture: MakeCapture) -> Capture:
    return open_capture(make_capture())


def grid(capture: Capture) -> VoxelGrid:
    return VoxelGrid.cover(capture.volume, 16)


def test_hulls_are_ragged(capture: Capture, tmp_path: Path) -> None:
    frames = [(3, points(5)), (4, points(0)), (7, points(2, 1))]
    path = tmp_path / "h.h5"
    assert write_hulls(path, capture, grid(capture), frames) == 3
    with h5py.File(path, "r") as file:
        np.testing.assert_array_equal(file["frames"], [3, 4, 7])
        np.testing.assert_allclose(file["time"], np.array([3, 4, 7]) / capture.fps)
        np.testing.assert_array_equal(file["hull/offsets"], [0, 5, 5, 7])
        np.testing.assert_array_equal(file["hull/positions"], np.vstack([p.positions for _, p in frames]).astype("f4"))
        np.testing.assert_array_equal(file["hull/colors"], np.vstack([p.colors for _, p in frames]))
        assert file.attrs["voxel_m"] == pytest.approx(1 / 16)


@pytest.mark.parametrize("error", [CaptureError("frame 2 is broken"), KeyboardInterrupt()])
def test_finished_frames_are_kept(capture: Capture, tmp_path: Path, error: BaseException) -> None:
    def frames() -> Iterator[tuple[int, HullPoints]]:
        yield 0, points(4)
        yield 1, points(3)
        raise error

    with pytest.raises(type(error)):
        write_hulls(tmp_path / "h.h5", capture, grid(capture), frames())
    with h5py.File(tmp_path / "h.h5", "r") as file:
        np.testing.assert_array_equal(file["hull/offsets"], [0, 4, 7])
        assert len(file["frames"]) == len(file["time"]) == 2


def test_older_file_stays_until_a_frame_is_finished(capture: Capture, tmp_path: Path) -> None:
    def none() -> Iterator[tuple[int, HullPoints]]:
        raise CaptureError("frame 0 is broken")
        yield

    path = tmp_path / "h.h5"
    write_hulls(path, capture, grid(capture), [(0, points(4))])
    before = path.read_bytes()
    with pytest.raises(CaptureError):
        write_hulls(path, capture, grid(capture), none())
    assert path.read_bytes() == before
    assert not [file for file in tmp_path.iterdir() if file.name.endswith(".tmp")]


def test_full_disk_gives_one_line_and_leaves_the_older_file(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "h.h5"
    write_hulls(path, capture, grid(capture), [(0, points(4))])
    before = path.read_bytes()
    fail_after(0, monkeypatch)
    with pytest.raises(DiskFullError, match=r"h\.h5: cannot be written: No space left on device$"):
        write_hulls(path, capture, grid(capture), ((k, points(4000, k)) for k in range(9)))
    assert path.read_bytes() == before
    assert [file for file in tmp_path.iterdir() if file.suffix != ""] == [path]


def test_files_of_others_are_left_alone(capture: Capture, tmp_path: Path) -> None:
    path = tmp_path / "notes.h5"
    path.write_text("mine")
    with pytest.raises(ResultError, match=r"notes\.h5: exists and is not a tk-hull"):
        write_hulls(path, capture, grid(capture), [(0, points(4))])
    assert path.read_text() == "mine"
    with pytest.raises(ResultError, match="is a folder"):
        write_hulls(tmp_path, capture, grid(capture), [])
    with pytest.raises(ResultError, match="does not exist; make it first"):
        write_hulls(tmp_path / "nowhere" / "h.h5", capture, grid(capture), [])
