"""The sequence of meshes, read back by Open3D."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import Tk
from tests.export.conftest import BODY, FIRST, FRAMES, LOST, SKELETON, Write, poses
from tests.model.figures import skin_of
from tk.errors import ExportError
from tk.export import export


def read(path: Path) -> Any:
    import open3d  # takes seconds, which each worker that collects the tests would need

    return open3d.io.read_triangle_mesh(path)


def test_mesh_of_each_frame_lies_on_the_body(write: Write) -> None:
    import open3d

    path = write()
    (folder,) = export(path, ["ply"]).files
    assert folder.name == "walk_ply"
    files = sorted(folder.iterdir())
    assert [file.name for file in files] == [f"{FIRST + f:06d}.ply" for f in range(FRAMES)]
    body = replace(skin_of(BODY), skeleton=SKELETON)
    for f in (0, 7, FRAMES - 1):
        mesh = read(files[f])
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
        points = body.place(poses()[f])
        distance = scene.compute_distance(open3d.core.Tensor(points.astype(np.float32))).numpy()
        assert np.median(distance) < 0.008 and np.percentile(distance, 99) < 0.04
        assert mesh.has_vertex_colors() and mesh.is_orientable()
    before, lost = (np.asarray(read(files[f]).vertices) for f in (LOST[0] - 1, LOST[1]))
    np.testing.assert_array_equal(lost, before)


def test_every_part_is_closed_and_turned_outwards(write: Write) -> None:
    mesh = read(export(write(), ["ply"]).files[0] / f"{FIRST:06d}.ply")
    labels, counts, _ = mesh.cluster_connected_triangles()
    vertices, triangles, labels = np.asarray(mesh.vertices), np.asarray(mesh.triangles), np.asarray(labels)
    assert len(counts) >= 10
    for part in range(len(counts)):
        own = triangles[labels == part]
        edges = np.sort(np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]]))
        assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
        a, b, c = (vertices[own[:, k]] - vertices[own].mean(axis=(0, 1)) for k in range(3))
        assert (np.cross(a, b) * c).sum() > 0, "the volume inside"


def test_folder_is_replaced_with_force_only(tk: Tk, write: Write) -> None:
    path = write()
    (folder,) = export(path, ["ply"]).files
    (folder / "999999.ply").write_text("old")
    with pytest.raises(ExportError, match="walk_ply: exists"):
        export(path, ["ply"])
    ran = tk("export", path, "--to", "ply", "--force")
    assert ran.code == 0, ran.err
    assert len(list(folder.iterdir())) == FRAMES and not (folder / "999999.ply").exists()
    assert [item.name for item in path.parent.iterdir() if item.name.startswith(".")] == []
    (folder / "thesis.txt").write_text("mine")
    tk("export", path, "--to", "ply", "--force").complaint("thesis.txt", "tk export did not make it")
    assert len(list(folder.iterdir())) == FRAMES + 1
