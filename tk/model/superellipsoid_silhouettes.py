"""Silhouettes of a body of superellipsoids, drawn piece by piece as convex polygons.

A piece with exponents in (0, 2) is convex, and so is its picture: the convex hull of its surface points' pixels. (Lens
distortion bends straight lines by far less than a pixel over one piece.) A pixel is covered if its centre is, as a
viewing ray through it would say.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.model.body import Body
from tk.model.camera import Rig
from tk.model.skeleton import SEGMENTS
from tk.model.superellipsoid import Superellipsoid

Float = NDArray[np.float64]

# Circles of latitude and points on each. A circle's polygon of 48 corners lies at most 0.2 % of its radius inside it.
_CIRCLES, _POINTS = 24, 48


def draw_body(body: Body, rig: Rig, pose: Float) -> NDArray[np.uint8]:
    """(V, H, W) silhouettes of the body at a pose (D,), 0 or 255; pieces behind a camera are left out.

    Raises:
        ConfigError: a pose of another skeleton.
    """
    if len(pose) != len(body.skeleton.names):
        raise ConfigError(f"a pose of {len(pose)} numbers for a body of {len(body.skeleton.names)} degrees of freedom")
    B = np.eye(4)
    B[:3, :3] = body.skeleton.T_world_body
    T_world_segment = body.skeleton.segment_transforms(pose)
    surfaces = []
    for piece in body.pieces:
        T = T_world_segment[SEGMENTS.index(piece.segment)] @ B @ piece.T_body_piece
        surfaces.append(_surface(piece) @ T[:3, :3].T + T[:3, 3])
    height, width = rig.frame_shape
    pictures = np.zeros((len(rig), height, width), np.uint8)
    for picture, camera in zip(pictures, rig, strict=True):
        for points in surfaces:
            pixels, _ = camera.project(points)
            if np.isfinite(pixels).all():
                corners = cv2.convexHull(pixels.astype(np.float32))[:, 0].astype(np.float64)
                fill_convex(picture[: camera.height, : camera.width], corners)
    return pictures


def fill_convex(picture: NDArray[np.uint8], corners: Float) -> None:
    """Set the pixels (H, W) whose centres lie in a convex polygon (N, 2) to 255.

    OpenCV's fillConvexPoly also paints what the outline touches, which makes a person thicker by half a pixel all
    round.
    """
    top, bottom = corners[:, 1].argmin(), corners[:, 1].argmax()
    rows = np.arange(
        max(np.ceil(corners[top, 1]), 0), min(np.floor(corners[bottom, 1]), len(picture) - 1) + 1, dtype=int
    )
    turned = np.roll(corners, -int(top), axis=0)
    last = (bottom - top) % len(corners)
    down, up = turned[: last + 1], np.vstack([turned[last:], turned[:1]])[::-1]
    sides = [np.interp(rows, chain[:, 1], chain[:, 0]) for chain in (down, up)]
    first = np.maximum(np.ceil(np.minimum(*sides)), 0).astype(int)
    behind = np.minimum(np.floor(np.maximum(*sides)), picture.shape[1] - 1).astype(int) + 1
    for row, a, b in zip(rows, first, behind, strict=True):
        picture[row, a : max(a, b)] = 255


def _surface(piece: Superellipsoid) -> Float:
    """(N, 3) points of a piece's surface in its frame, the rims of its cuts included."""
    eta, omega = np.meshgrid(
        np.linspace(*piece.eta_range, _CIRCLES), np.linspace(-np.pi, np.pi, _POINTS, endpoint=False), indexing="ij"
    )
    return piece.point(eta.ravel(), omega.ravel())
