"""What the window shows, as Open3D's meshes, clouds and lines."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.io.results.data import HullPoints
from tk.model.body.joints import BONE_ENDS, SEGMENTS
from tk.model.cameras.camera import Rig
from tk.render.figure import Figure
from tk.render.palette import BONE, sigma_colors, unit_rgb
from tk.render.people import Stage
from tk.render.scene import PYRAMID_EDGES, camera_pyramid

Float = NDArray[np.float64]

_BALL_M = 0.02  # radius of the spheres, metres; appearance only


def body_mesh(figure: Figure, row: int) -> Any:
    """Return the body in a frame in the colours of its segments, grey if lost; empty without a body.

    The faces are turned inwards, so that only the far side is drawn, and joints and bones inside stay visible. The flat
    ends of the solids are left out: they would hide what is behind them.
    """
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh()
    if not figure.solids or not np.isfinite(figure.transforms[row]).all():
        return mesh
    bgr = [figure.color(row, SEGMENTS[solid.segment]) for solid in figure.solids]
    counts = np.diff(figure.starts)
    faces = np.concatenate(
        [solid.mantle + start for solid, start in zip(figure.solids, figure.starts[:-1], strict=True)]
    )
    mesh.vertices = o3d.utility.Vector3dVector(figure.placed(row))
    mesh.triangles = o3d.utility.Vector3iVector(faces[:, ::-1].astype(np.int32))
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.repeat(np.array(bgr)[:, ::-1] / 255, counts, axis=0))
    mesh.compute_vertex_normals()
    return mesh


def skeleton_lines(joints: Float) -> Any:
    """Return the bones between joints (15, 3), without bones to a joint that is NaN."""
    return _lines(joints, BONE_ENDS[np.isfinite(joints[BONE_ENDS]).all(axis=(1, 2))])


def joint_spheres(joints: Float, sigma: Float | None) -> Any:
    """Return a mesh of one sphere per joint (15, 3), coloured by the standard deviation (15,), metres."""
    known = np.isfinite(joints).all(axis=1)
    colors = np.tile(unit_rgb(BONE), (len(joints), 1))
    if sigma is not None:
        finite = np.isfinite(sigma)
        colors[finite] = sigma_colors(sigma[finite])[:, ::-1] / 255
    return _spheres(joints[known], colors[known], _BALL_M)


def truth_spheres(joints: Float) -> Any:
    """Return white spheres at the ground-truth joints (15, 3)."""
    known = joints[np.isfinite(joints).all(axis=1)]
    return _spheres(known, np.ones((len(known), 3)), _BALL_M)


def hull_cloud(points: HullPoints) -> Any:
    """Return the coloured surface voxels of a hull."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points.positions, np.float64)))
    cloud.colors = o3d.utility.Vector3dVector(np.asarray(points.colors, np.float64) / 255)
    return cloud


def camera_lines(rig: Rig) -> Any:
    """Return each camera as a pyramid that opens in viewing direction."""
    pairs = [5 * c + np.array(PYRAMID_EDGES) for c in range(len(rig))]
    return _lines(np.concatenate([camera_pyramid(camera) for camera in rig]), np.concatenate(pairs))


def floor_lines(stage: Stage) -> Any:
    """Return the squares of the floor."""
    ends = stage.floor_lines()
    return _lines(ends.reshape(-1, 3), np.arange(2 * len(ends)).reshape(-1, 2))


def _lines(points: Float, pairs: NDArray[np.integer]) -> Any:
    import open3d as o3d

    return o3d.geometry.LineSet(o3d.utility.Vector3dVector(points), o3d.utility.Vector2iVector(pairs))


def _spheres(centers: Float, colors: Float, radius: float) -> Any:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh()
    for center, color in zip(centers, colors, strict=True):
        ball = o3d.geometry.TriangleMesh.create_sphere(radius, 12)
        ball.paint_uniform_color(color)
        ball.translate(center)
        mesh += ball
    mesh.compute_vertex_normals()
    return mesh
