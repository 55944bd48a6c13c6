"""What the window shows, as Open3D's meshes, clouds and lines."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.io.results.writer import HullPoints
from tk.model.body.skeleton import JOINTS, SEGMENTS
from tk.model.cameras.camera import Rig
from tk.render.figure import BONES, Figure
from tk.render.palette import LOST_BODY, SEGMENT_COLORS, sigma_colors
from tk.render.scene import Stage

Float = NDArray[np.float64]

_JOINT_M, _TRUTH_M = 0.022, 0.018  # radii of the spheres
_SQUARE_M, _SQUARES = 0.5, 6  # of the floor, and how many lie on each side of its middle
_PYRAMID_M = 0.25  # how long a camera is drawn
_PLAIN_JOINT = (0.96, 0.94, 0.65)


def body_mesh(figure: Figure, row: int) -> Any:
    """The body in a frame, segments in their colours, grey where the person is lost; empty where it is not known."""
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh()
    if not figure.solids or not np.isfinite(figure.transforms[row]).all():
        return mesh
    lost = figure.lost(row)
    bgr = [LOST_BODY if lost else SEGMENT_COLORS[SEGMENTS[solid.segment]] for solid in figure.solids]
    counts = [solid.rings.shape[0] * solid.rings.shape[1] for solid in figure.solids]
    starts = np.cumsum([0, *counts[:-1]])
    faces = np.concatenate([solid.triangles + start for solid, start in zip(figure.solids, starts, strict=True)])
    mesh.vertices = o3d.utility.Vector3dVector(figure.placed(row))
    mesh.triangles = o3d.utility.Vector3iVector(faces.astype(np.int32))
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.repeat(np.array(bgr)[:, ::-1] / 255, counts, axis=0))
    mesh.compute_vertex_normals()
    return mesh


def skeleton_lines(joints: Float) -> Any:
    """The bones between joints (15, 3); those without a joint's place are left out."""
    pairs = np.array([[JOINTS.index(a), JOINTS.index(b)] for a, b in BONES])
    return _lines(joints, pairs[np.isfinite(joints[pairs]).all(axis=(1, 2))])


def joint_spheres(joints: Float, sigma: Float | None) -> Any:
    """A sphere a joint (15, 3), its colour telling the standard deviation (15,), metres; one mesh."""
    known = np.isfinite(joints).all(axis=1)
    colors = np.tile(_PLAIN_JOINT, (len(joints), 1))
    if sigma is not None:
        told = np.isfinite(sigma)
        colors[told] = sigma_colors(sigma[told])[:, ::-1] / 255
    return _spheres(joints[known], colors[known], _JOINT_M)


def truth_spheres(joints: Float) -> Any:
    """White spheres at the true joints (15, 3)."""
    known = joints[np.isfinite(joints).all(axis=1)]
    return _spheres(known, np.ones((len(known), 3)), _TRUTH_M)


def hull_cloud(points: HullPoints) -> Any:
    """The surface voxels of a hull with their colours."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points.positions, np.float64)))
    cloud.colors = o3d.utility.Vector3dVector(np.asarray(points.colors, np.float64) / 255)
    return cloud


def camera_lines(rig: Rig) -> Any:
    """Each camera as a pyramid that opens to where it looks."""
    points, pairs = [], []
    for c, camera in enumerate(rig):
        corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], float)
        rays = np.column_stack([camera.undistort(corners), np.ones(4)]) @ camera.rotation
        points += [camera.center[None], camera.center + _PYRAMID_M * rays]
        pairs += [[5 * c + a, 5 * c + b] for a, b in ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))]
    return _lines(np.concatenate(points), np.array(pairs))


def floor_lines(stage: Stage) -> Any:
    """Squares of half a metre where the feet stand."""
    east, north, up = stage.axes.T
    middle = stage.middle + (stage.floor - stage.middle @ up) * up
    reach = _SQUARE_M * _SQUARES
    ends = []
    for k in np.linspace(-reach, reach, 2 * _SQUARES + 1):
        for along, across in ((east, north), (north, east)):
            ends += [middle + k * across - reach * along, middle + k * across + reach * along]
    return _lines(np.array(ends), np.arange(len(ends)).reshape(-1, 2))


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
