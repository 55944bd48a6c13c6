from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.conftest import FRAMES, QUICK, Silent, Tk
from tests.io.conftest import write_picture
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_result
from tk.run.reconstruction import reconstruct

CONFIG = settings_file.from_toml(QUICK)


def test_reconstructed_hull_equals_the_trackers(tiny: Path, tracked: Path, tmp_path: Path) -> None:
    reporter = Silent()
    assert reconstruct(open_capture(tiny), tmp_path / "h.h5", CONFIG, reporter) == FRAMES
    assert reporter.frames == list(range(FRAMES)) and reporter.total == FRAMES
    kept = read_result(tracked).hull
    assert kept is not None
    with h5py.File(tmp_path / "h.h5", "r") as file:
        assert dict(file.attrs).items() >= {"format": "tk-hull", "fps": 15.0, "units": "m", "up": "z"}.items()
        np.testing.assert_array_equal(file["frames"], np.arange(FRAMES))
        np.testing.assert_allclose(file["time"], np.arange(FRAMES) / 15.0)
        np.testing.assert_array_equal(file["hull/offsets"], kept.offsets)
        np.testing.assert_array_equal(file["hull/positions"], kept.positions)
        np.testing.assert_array_equal(file["hull/colors"], kept.colors)


def test_ply_files_hold_the_same_points(tk: Tk, quick: Path, tiny: Path, tmp_path: Path) -> None:
    import open3d  # takes seconds, which each worker that collects the tests would need

    hull, folder = tmp_path / "h.h5", tmp_path / "ply" / "deeper"
    ran = tk("reconstruct", tiny, "-o", hull, "--ply", folder, "--config", quick, "--frames", "5:7")
    assert ran.code == 0, ran.err
    assert ran.out == ""
    assert ran.err.splitlines()[-1] == f"2 frames in {hull}"
    assert sorted(path.name for path in folder.iterdir()) == ["000005.ply", "000006.ply"]
    with h5py.File(hull, "r") as file:
        for row, frame in enumerate((5, 6)):
            cloud = open3d.io.read_point_cloud(folder / f"{frame:06d}.ply")
            part = slice(*file["hull/offsets"][row : row + 2])
            np.testing.assert_allclose(np.asarray(cloud.points), file["hull/positions"][part], atol=1e-6)
            np.testing.assert_allclose(np.asarray(cloud.colors) * 255, file["hull/colors"][part], atol=0.51)


def test_frames_without_anybody_are_empty(tk: Tk, quick: Path, copy: Path, tmp_path: Path) -> None:
    import open3d

    for camera in (copy / "masks").iterdir():
        write_picture(camera / "000001.png", np.zeros((120, 160), np.uint8))
    ply = tmp_path / "ply"
    ran = tk("reconstruct", copy, "-o", tmp_path / "h.h5", "--ply", ply, "--config", quick, "--frames", ":3")
    assert (ran.code, ran.out) == (0, ""), ran.err
    with h5py.File(tmp_path / "h.h5", "r") as file:
        counts = np.diff(file["hull/offsets"][()])
    assert counts[1] == 0 and (counts[[0, 2]] > 60).all()
    assert len(open3d.io.read_point_cloud(ply / "000001.ply").points) == 0


def test_finished_hulls_are_kept_when_a_mask_is_damaged(tk: Tk, quick: Path, copy: Path, tmp_path: Path) -> None:
    (copy / "masks" / "cam1" / "000003.png").write_text("white")
    ran = tk("reconstruct", copy, "-o", tmp_path / "h.h5", "--config", quick)
    ran.complaint("masks/cam1/000003.png")
    with h5py.File(tmp_path / "h.h5", "r") as file:
        np.testing.assert_array_equal(file["frames"], np.arange(3))
        assert len(file["hull/offsets"]) == 4


@pytest.mark.parametrize(("option", "value"), [("frames", "14:"), ("frames", "3:3"), ("cameras", "cam9")])
def test_bad_options(tk: Tk, quick: Path, tiny: Path, tmp_path: Path, option: str, value: str) -> None:
    ran = tk("reconstruct", tiny, "-o", tmp_path / "h.h5", "--config", quick, f"--{option}", value)
    ran.complaint(option.removesuffix("s"), value)
    assert not list(tmp_path.iterdir())


def test_ply_files_that_cannot_be_written(tk: Tk, quick: Path, tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    command = ["reconstruct", tiny, "-o", tmp_path / "h.h5", "--config", quick, "--frames", ":1", "--ply"]
    tk(*command, tmp_path / "file").complaint(str(tmp_path / "file"))
    assert (tmp_path / "file").read_text() == "mine"


def test_meshes_are_closed_and_lie_where_the_voxels_do(tk: Tk, quick: Path, tiny: Path, tmp_path: Path) -> None:
    import open3d

    hull, folder = tmp_path / "h.h5", tmp_path / "mesh"
    ran = tk("reconstruct", tiny, "-o", hull, "--mesh", folder, "--config", quick, "--frames", "5:7")
    assert ran.code == 0, ran.err
    assert sorted(path.name for path in folder.iterdir()) == ["000005.ply", "000006.ply"]
    with h5py.File(hull, "r") as file:
        voxel = float(file.attrs["voxel_m"])
        positions = file["hull/positions"][: file["hull/offsets"][1]]
    mesh = open3d.io.read_triangle_mesh(folder / "000005.ply")
    assert mesh.is_watertight() and mesh.has_vertex_colors()
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
    distance = scene.compute_distance(open3d.core.Tensor(positions.astype(np.float32))).numpy()
    assert np.median(distance) < 0.6 * voxel and distance.max() < 2 * voxel
    low, high = np.asarray(mesh.vertices).min(axis=0), np.asarray(mesh.vertices).max(axis=0)
    np.testing.assert_allclose(low, positions.min(axis=0), atol=1.1 * voxel)
    np.testing.assert_allclose(high, positions.max(axis=0), atol=1.1 * voxel)
