"""Draw a result in 3D from a camera that turns around the people: bodies or hull, skeleton, cameras, floor."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import scipy  # its packages are imported when they are first used
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.io.results.data import Result
from tk.model.body.skeleton import SEGMENTS
from tk.model.cameras.camera import Camera, Rig
from tk.render.canvas import SUBPIXEL_BITS, Image, dots, draw_joints, draw_lost, fixed, write
from tk.render.figure import Figure
from tk.render.legend import LEGEND_HEIGHT, Legend
from tk.render.palette import BACKGROUND, ELEVATION_DEG, FLOOR, WIRE
from tk.render.people import People

Float = NDArray[np.float64]

# Appearance only; no measurement depends on these values.
WIDTH, HEIGHT = 960, 720  # pixels
FIELD_OF_VIEW_DEG = 38.0
_TURN_S = 16.0  # duration of a whole turn
_PYRAMID_M = 0.25  # height of a camera's pyramid
_NEAREST_M = 0.05  # near clipping plane
_FOLLOW_S = 0.5  # standard deviation of the smoothing of the point that the camera follows
_MARGIN_M = 0.15  # from the joints to the outline of hands, feet and head

#: lines between the points of :func:`camera_pyramid`
PYRAMID_EDGES = [edge for k in range(1, 5) for edge in ((0, k), (k, k % 4 + 1))]  # apex 0, corners 1 to 4


def camera_pyramid(camera: Camera) -> Float:
    """Return the centre of a camera and the corners of its image plane, (5, 3) metres, world frame."""
    w, h = camera.width, camera.height
    rays = np.column_stack([camera.undistort([[0, 0], [w, 0], [w, h], [0, h]]), np.ones(4)]) @ camera.rotation
    return np.vstack([camera.center, camera.center + _PYRAMID_M * rays])


def camera_towards(center: Float, forward: Float, up: Float, size: tuple[int, int], view_deg: float) -> Camera:
    """Return a camera at ``center`` (3,) that looks along the unit vector ``forward`` (3,); field of view: vertical."""
    width, height = size
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    focal = 0.5 * height / np.tan(np.radians(view_deg / 2))
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera("view", width, height, matrix, np.zeros(5), R, -R @ center)


class Scene:
    """Draws a result in 3D.

    Args:
        result: the result.
        rig: the cameras; those of the result by default, if it has them.
        hull: draw the stored hull instead of the body.
    """

    def __init__(self, result: Result, rig: Rig | None = None, hull: bool = False) -> None:
        if hull and result.hull is None:
            raise ResultError(f"{result.path}: holds no hull", hint="track with --method volumetric --store-hull")
        self.hull = result.hull if hull else None
        self.people = People((result,) if hull else result.people)
        self._legend = Legend(self.people, WIDTH)
        self.rig = rig or (result.cameras.rig if result.cameras else None)
        self._middles, reach = _followed(self.people.figures, result.meta.fps)
        self._distance = reach / np.sin(np.radians(FIELD_OF_VIEW_DEG / 2))

    def rows(self, frames: Sequence[int] = ()) -> list[int]:
        """Return the rows of these frames; all rows by default."""
        return np.flatnonzero(np.isin(self.people.first.frames, self.people.chosen(frames))).tolist()

    def picture(self, row: int) -> Image:
        """Return an image (HEIGHT + LEGEND_HEIGHT, WIDTH, 3).

        The camera follows the people and turns once in 16 s of the recording.
        """
        canvas = np.full((HEIGHT + LEGEND_HEIGHT, WIDTH, 3), BACKGROUND, np.uint8)
        tile = canvas[:HEIGHT]
        eye = self._camera(row)
        self._draw_floor(tile, eye)
        self._draw_cameras(tile, eye)
        if self.hull is not None:
            positions, colors = self.hull[row].positions, self.hull[row].colors
            _splat(tile, eye, positions.astype(np.float64), colors[:, ::-1])
        else:
            self._draw_bodies(tile, eye, row)
        for figure in self.people.figures:
            draw_joints(tile, eye.project(figure.joints[row])[0], dots(figure, row), figure.lost(row))
        if self.people.lost(row):
            draw_lost(tile)
        self._legend.draw(canvas[HEIGHT:], row)
        return canvas

    def _camera(self, row: int) -> Camera:
        """Return the camera, which turns about the vertical with time and looks at the middle of the people."""
        time, axes = self.people.first.time, self.people.stage.axes
        turn = 2 * np.pi * (time[row] - time[0]) / _TURN_S
        up = axes[:, 2]
        elevation = np.radians(ELEVATION_DEG)
        level = axes @ np.array([np.cos(turn), np.sin(turn), 0.0])
        forward = -(np.cos(elevation) * level + np.sin(elevation) * up)
        return camera_towards(
            self._middles[row] - self._distance * forward, forward, up, (WIDTH, HEIGHT), FIELD_OF_VIEW_DEG
        )

    def _draw_floor(self, tile: Image, eye: Camera) -> None:
        for a, b in self.people.stage.floor_lines():
            _line(tile, eye, a, b, FLOOR)

    def _draw_cameras(self, tile: Image, eye: Camera) -> None:
        for camera in self.rig or ():
            points = camera_pyramid(camera)
            if (eye.to_camera(points)[:, 2] < self._distance / 2).any():
                continue  # so near to the eye that it would hide the person
            for a, b in PYRAMID_EDGES:
                _line(tile, eye, points[a], points[b], WIRE)
            xy, depth = eye.project(camera.center)
            if depth[0] > _NEAREST_M and np.isfinite(xy).all() and (np.abs(xy[0]) < 4 * WIDTH).all():
                write(tile, camera.name, int(xy[0, 0]) + 8, int(xy[0, 1]) - 8, WIRE)

    def _draw_bodies(self, tile: Image, eye: Camera, row: int) -> None:
        """Draw the bodies, lit from the viewer: each pixel is the mean of rays through its quarters."""
        shown = [f for f in self.people.figures if f.solids and np.isfinite(f.transforms[row]).all()]
        if not shown:
            return
        xy, depth = eye.project(np.concatenate([figure.placed(row) for figure in shown]))
        low = np.clip(np.floor(np.nanmin(xy, axis=0)), 0, (WIDTH, HEIGHT)).astype(int)
        high = np.clip(np.ceil(np.nanmax(xy, axis=0)) + 1, 0, (WIDTH, HEIGHT)).astype(int)
        if (depth < _NEAREST_M).any() or (low >= high).any():
            return
        from open3d.core import Tensor
        from open3d.t.geometry import RaycastingScene

        tensor, scene = Tensor.from_numpy, RaycastingScene()
        colors = []
        for figure in shown:
            for solid, own in zip(figure.solids, np.split(figure.placed(row), figure.starts[1:-1]), strict=True):
                scene.add_triangles(tensor(own.astype(np.float32)), tensor(solid.triangles.astype(np.uint32)))
                colors.append(figure.color(row, SEGMENTS[solid.segment]))
        columns, rows = (np.arange(2 * a, 2 * b) / 2 - 0.25 for a, b in zip(low, high, strict=True))
        pixels = np.stack([*np.meshgrid(columns, rows), np.ones((len(rows), len(columns)))], axis=-1)
        rays = pixels @ np.linalg.inv(eye.matrix).T @ eye.rotation
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        cast = np.concatenate([np.broadcast_to(eye.center, rays.shape), rays], axis=-1)
        hit = scene.cast_rays(tensor(cast.astype(np.float32)))
        facing = np.abs((hit["primitive_normals"].numpy() * rays).sum(axis=-1))
        solids = hit["geometry_ids"].numpy().astype(np.int64)
        seen = solids < len(colors)
        base = np.array(colors)
        part = tile[low[1] : high[1], low[0] : high[0]]
        drawn = np.repeat(np.repeat(part, 2, axis=0), 2, axis=1).astype(np.float64)
        drawn[seen] = base[solids[seen]] * (0.35 + 0.65 * facing[seen, None])
        part[...] = drawn.reshape(len(part), 2, -1, 2, 3).mean(axis=(1, 3)).round()


def _followed(figures: Sequence[Figure], fps: float) -> tuple[Float, float]:
    """Return the point (F, 3) that the camera looks at in each frame, and the radius of a ball around it, metres.

    The point is the middle of the joints, smoothed over time. The ball contains the people in every frame.
    """
    joints = np.concatenate([figure.joints for figure in figures], axis=1)
    known = np.isfinite(joints).any(axis=(1, 2))
    if not known.any():
        return np.zeros((len(joints), 3)), 1.0
    frames = np.arange(len(joints))
    middles = (np.nanmin(joints[known], axis=1) + np.nanmax(joints[known], axis=1)) / 2
    filled = np.stack([np.interp(frames, frames[known], axis) for axis in middles.T], axis=1)
    smooth = scipy.ndimage.gaussian_filter1d(filled, _FOLLOW_S * fps, axis=0, mode="nearest")
    reach = np.nanmax(np.linalg.norm(joints[known] - smooth[known, None], axis=-1))
    return smooth, float(reach) + _MARGIN_M


def _line(tile: Image, eye: Camera, a: Float, b: Float, color: tuple[int, int, int]) -> None:
    """Draw a line between two points of the world, clipped in front of the camera."""
    ends = eye.to_camera(np.stack([a, b]))
    behind = ends[:, 2] < _NEAREST_M
    if behind.all():
        return
    if behind.any():
        share = (_NEAREST_M - ends[0, 2]) / (ends[1, 2] - ends[0, 2])
        ends[int(np.flatnonzero(behind)[0])] = ends[0] + share * (ends[1] - ends[0])
    pixels = ends @ eye.matrix.T
    start, stop = fixed(pixels[:, :2] / pixels[:, 2:])
    cv2.line(tile, start, stop, color, 1, cv2.LINE_AA, SUBPIXEL_BITS)


def _splat(tile: Image, eye: Camera, points: Float, colors: NDArray[np.uint8]) -> None:
    """Draw points as squares of the size of a voxel, near ones over far ones."""
    if not len(points):
        return
    xy, depth = eye.project(points)
    shown = np.flatnonzero(np.isfinite(xy).all(axis=1) & (depth > _NEAREST_M))
    order = shown[np.argsort(-depth[shown])]
    spacing = _spacing(points)
    size = int(np.clip(np.ceil(spacing * eye.matrix[0, 0] / np.median(depth)), 1, 15))
    x, y = np.rint(xy[order]).astype(int).T
    for dy in range(-(size // 2), size - size // 2):
        for dx in range(-(size // 2), size - size // 2):
            inside = (x + dx >= 0) & (x + dx < tile.shape[1]) & (y + dy >= 0) & (y + dy < tile.shape[0])
            tile[y[inside] + dy, x[inside] + dx] = colors[order[inside]]


def _spacing(points: Float) -> float:
    """Return the spacing of the voxels of a grid, metres."""
    steps = np.concatenate([np.diff(np.unique(points[:, axis].round(5))) for axis in range(3)])
    steps = steps[steps > 1e-4]
    return float(np.median(steps)) if len(steps) else 0.02
