"""Silhouettes of superellipsoids against viewing rays, and polygons against points."""

import cv2
import numpy as np
import pytest

from tests.model.ring import ring_of_cameras
from tk.errors import ConfigError
from tk.model.anthropometry import BodyDimensions
from tk.model.body import build_body, neutral_pose
from tk.model.skeleton import SEGMENTS
from tk.model.superellipsoid_silhouettes import draw_body, fill_convex

BODY = build_body(BodyDimensions.from_stature(1.75))


def test_pixels_are_those_whose_rays_meet_a_piece():
    """Slow and obvious: points along each viewing ray, inside a piece or not."""
    rig = ring_of_cameras(2, width=48, height=60)
    pose = neutral_pose(BODY.skeleton)
    pose[:3] = [0.05, 0.02, 0.93]
    drawn = draw_body(BODY, rig, pose) > 0
    B = np.eye(4)
    B[:3, :3] = BODY.skeleton.T_world_body
    transforms = BODY.skeleton.segment_transforms(pose)
    for v, camera in enumerate(rig):
        ys, xs = np.mgrid[: camera.height, : camera.width]
        rays = camera.rays(np.column_stack([xs.ravel(), ys.ravel()]))
        distance = np.linalg.norm(camera.center - [0, 0, 1])
        points = camera.center + rays[:, None] * np.linspace(distance - 1.2, distance + 1.2, 400)[:, None]
        hit = np.zeros(len(rays), bool)
        for piece in BODY.pieces:
            T = transforms[SEGMENTS.index(piece.segment)] @ B @ piece.T_body_piece
            hit |= piece.contains((points - T[:3, 3]) @ T[:3, :3]).any(axis=1)
        hit = hit.reshape(drawn[v].shape)
        assert hit.sum() > 100
        # rays that graze a piece fall between the points tried
        assert (hit & ~drawn[v]).sum() <= 0.01 * hit.sum()
        assert (drawn[v] & ~hit).sum() <= 0.03 * hit.sum()


@pytest.mark.parametrize("seed", range(5))
def test_a_polygon_covers_the_centres_inside_it(seed):
    rng = np.random.default_rng(seed)
    corners = cv2.convexHull(rng.uniform(-8, 40, (9, 2)).astype(np.float32))[:, 0].astype(np.float64)
    picture = np.zeros((30, 25), np.uint8)
    fill_convex(picture, corners)
    inside = [
        [cv2.pointPolygonTest(corners.astype(np.float32), (float(x), float(y)), False) >= 0 for x in range(25)]
        for y in range(30)
    ]
    np.testing.assert_array_equal(picture > 0, inside)


def test_a_polygon_beside_the_picture_or_between_pixels_leaves_it_alone():
    picture = np.zeros((10, 10), np.uint8)
    for corners in ([[-5, 2], [-2, 2], [-2, 6]], [[2.2, 2.2], [2.8, 2.2], [2.5, 2.8]], [[3, 12], [8, 12], [5, 15]]):
        fill_convex(picture, np.array(corners, float))
    assert not picture.any()


def test_another_skeletons_pose_is_told():
    with pytest.raises(ConfigError, match="a pose of 3 numbers"):
        draw_body(BODY, ring_of_cameras(2, width=48, height=60), np.zeros(3))
