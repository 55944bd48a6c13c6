"""Figure 6 of Kehl & Van Gool 2006: the model's occluding contours in a few views, and the strips they are found on.

Visible contour green, occluded contour red and thin; white bars join the symmetric pairs that tracking uses by default.
The last panel shows circles of latitude and meridians with each piece's bounding box, one of each on each limb in bold.
Without a capture: a made-up pose in three made-up views on a blank picture.

    python -m scripts.figure6_contours -o figure6.png [--capture DIR --result FILE.h5 --frame N] [--cameras cam1 cam5]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import TkError
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_result
from tk.kernels.contour import ContourKernel, ContourPoints
from tk.kernels.projection import pack_cameras
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import build_cone_body
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.skeleton import SEGMENTS
from tk.model.body.strips import Strips, build_strips, limb_pieces
from tk.model.body.superellipsoid_body import SuperellipsoidBody, build_superellipsoid_body
from tk.model.cameras.camera import Camera, Rig
from tk.model.cues.edge_term import ContourTerm
from tk.settings import VolumetricSettings
from tk.trackers.bodies import body_and_poses

Float = NDArray[np.float64]
Image = NDArray[np.uint8]

SCALE = 2  # of a panel over its picture
SUBPIXEL = 4  # bits of a fraction of a pixel that OpenCV draws with
VISIBLE, HIDDEN, PAIR = (90, 230, 60), (70, 70, 210), (255, 255, 255)  # BGR
STRIP, BOLD, BOX = (150, 150, 150), (40, 40, 230), (200, 160, 90)
BLANK = 40  # grey level


def example_pose(body: SuperellipsoidBody) -> Float:
    """A walking step with one arm before the trunk: every kind of occlusion."""
    pose = neutral_pose(body.skeleton)
    for name, degrees in {
        "shoulder_l_yaw": -10, "shoulder_l_pitch": -35, "elbow_l_flexion": 95, "shoulder_r_pitch": 60,
        "elbow_r_flexion": 30, "hip_l_pitch": -35, "knee_l_flexion": 40, "hip_r_pitch": 15, "torso_yaw": 25,
        "hip_l_yaw": 4, "hip_r_yaw": 4,
    }.items():  # fmt: skip
        pose[body.skeleton.index(name)] = np.radians(degrees)
    pose[body.skeleton.index("torso_z")] = 0.9
    return pose


def example_camera(name: str, position: Sequence[float], target: Sequence[float] = (0.0, 0.0, 0.95)) -> Camera:
    """A camera of 640×480 pixels that looks at a point, upright."""
    z = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    x = np.cross(z, [0.0, 0.1, 1.0])
    x /= np.linalg.norm(x)
    R = np.array([x, np.cross(z, x), z])
    matrix = np.array([[560.0, 0, 319.5], [0, 560.0, 239.5], [0, 0, 1]])
    return Camera(name, 640, 480, matrix, np.zeros(5), R, -R @ np.asarray(position, float))


def panel(image: Image) -> Image:
    """The picture, darker and larger, to draw on."""
    return np.asarray(cv2.resize(image // 5 * 3, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_LINEAR), np.uint8)


def polyline(canvas: Image, xy: Float, color: tuple[int, int, int], thickness: int) -> None:
    """A line through points (N, 2) of the picture, pixels; cut where one is not finite."""
    placed = (xy + 0.5) * SCALE - 0.5
    for a, b in pairwise(placed):
        if np.isfinite(a).all() and np.isfinite(b).all() and max(np.abs(a).max(), np.abs(b).max()) < 1e5:
            start, end = (np.rint(p * 2**SUBPIXEL).astype(int).tolist() for p in (a, b))
            cv2.line(canvas, start, end, color, thickness, cv2.LINE_AA, SUBPIXEL)


def draw_contours(canvas: Image, strips: Strips, points: ContourPoints, view: int) -> None:
    """The contours of all pieces: the ``points`` of all strips at one pose, joined from circle to circle."""
    pixels, found, visible = points.pixels[0, view], points.found[0, view] == 1, points.visible[0, view] == 1
    for seen in (False, True):  # what is visible goes on top
        color, thickness = (VISIBLE, 2) if seen else (HIDDEN, 1)
        wanted = found & (visible == seen)
        for i in range(strips.piece.max() + 1):
            circles = strips.piece == i
            for slot in (0, 1):
                polyline(canvas, np.where(wanted[circles, slot, None], pixels[circles, slot], np.nan), color, thickness)


def draw_pairs(canvas: Image, points: ContourPoints, view: int) -> None:
    """The pairs of which both points are visible."""
    for k in np.flatnonzero((points.visible[0, view] == 1).all(axis=1)):
        polyline(canvas, points.pixels[0, view, k].astype(float), PAIR, 1)


def draw_strips(canvas: Image, body: SuperellipsoidBody, pose: Float, camera: Camera) -> None:
    """The panel on the right of figure 6: sampling, bounding boxes, one line of each kind in bold on each limb."""
    T, limbs = body.skeleton.segment_transforms(pose), limb_pieces(body)
    around = np.linspace(-np.pi, np.pi, 65)
    for i, piece in enumerate(body.pieces):
        M = T[SEGMENTS.index(piece.segment)] @ body.skeleton.in_world(piece.T_body_piece)
        a1, a2, _ = piece.radii
        corners = np.array([[x, y, z] for x in (-a1, a1) for y in (-a2, a2) for z in (piece.z_lower, piece.z_upper)])
        xy, _ = camera.project(corners @ M[:3, :3].T + M[:3, 3])
        for a in range(8):
            for b in (a ^ 1, a ^ 2, a ^ 4):
                if a < b:
                    polyline(canvas, xy[[a, b]], BOX, 1)
        along = np.linspace(*piece.eta_range, 33)
        circles = [(np.full_like(around, eta), around) for eta in along[2:-1:3]]
        meridians = [(along, np.full_like(along, omega)) for omega in around[::5]]
        for lines in (circles, meridians):
            for n, (eta, omega) in enumerate(lines):
                bold = i in limbs and n == len(lines) // 2
                xy, _ = camera.project(piece.point(eta, omega) @ M[:3, :3].T + M[:3, 3])
                polyline(canvas, xy, BOLD if bold else STRIP, 3 if bold else 1)


def figure(body: SuperellipsoidBody, pose: Float, rig: Rig, images: Sequence[Image]) -> Image:
    """All panels side by side: a view each, then the strips in the first view."""
    strips = build_strips(body, range(len(body.pieces)))
    kernel = ContourKernel(body.arrays, strips.angles, strips.normals, strips.piece, pack_cameras(rig))
    contours = kernel(pose[None], np.arange(len(strips.piece))[None])
    term = ContourTerm(body, rig, VolumetricSettings.edge_weight)
    drawn = term.draw(None)
    pairs = term.kernel(pose[None], drawn[drawn >= 0][None])
    canvases = [panel(image) for image in images] + [np.full_like(panel(images[0]), BLANK)]
    for view, (camera, canvas) in enumerate(zip(rig, canvases, strict=False)):
        draw_pairs(canvas, pairs, view)
        draw_contours(canvas, strips, contours, view)
        hidden, count = np.sum(pairs.found[0, view] != pairs.visible[0, view]), pairs.found[0, view].sum()
        text = f"{camera.name}: {hidden} of {count} contour points occluded"
        cv2.putText(canvas, text, (12, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 1, cv2.LINE_AA)
    draw_strips(canvases[-1], body, pose, rig[0])
    height = max(len(canvas) for canvas in canvases)
    padded = [cv2.copyMakeBorder(c, 0, height - len(c), 0, 0, cv2.BORDER_CONSTANT) for c in canvases]
    return np.asarray(np.concatenate(padded, axis=1), np.uint8)


def from_capture(capture: Path, result: Path, frame: int, cameras: Sequence[str] | None) -> Image:
    """The figure of a tracked frame, over its pictures.

    Raises:
        TkError: the capture or the result cannot serve.
    """
    opened, tracked = open_capture(capture, cameras), read_result(result)
    restored = body_and_poses(tracked)
    if restored is None:
        raise TkError(f"{result}: holds no body")
    body = build_superellipsoid_body(restored[0], tracked.meta.up)
    row = np.flatnonzero(tracked.frames == frame)
    if not len(row):
        raise TkError(f"{result}: has no frame {frame}; it has {tracked.frames.min()} to {tracked.frames.max()}")
    with opened.frames(frame, frame + 1) as reader:
        (frame_set,) = reader
    images = [image[: c.height, : c.width] for c, image in zip(opened.rig, frame_set.images, strict=True)]
    return figure(body, tracked.pose[row[0]], opened.rig, images)


def from_example() -> Image:
    """The figure of a made-up pose in three views, one of them overhead."""
    body = build_superellipsoid_body(build_cone_body(BodyDimensions.from_stature(1.78)))
    rig = Rig(
        (
            example_camera("front", (2.6, -1.0, 1.3)),
            example_camera("side", (0.3, 2.6, 1.5)),
            example_camera("overhead", (0.4, 0.2, 2.9)),
        )
    )
    return figure(body, example_pose(body), rig, [np.full((480, 640, 3), BLANK, np.uint8)] * 3)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Occluding contours of the posed body (figure 6)")
    parser.add_argument("-o", "--out", type=Path, required=True, help="PNG to write")
    parser.add_argument("--capture", type=Path, help="folder of the pictures")
    parser.add_argument("--result", type=Path, help="its tracking result, HDF5")
    parser.add_argument("--frame", type=int, default=0, help="frame number")
    parser.add_argument("--cameras", nargs="+", help="names; all of them by default")
    arguments = parser.parse_args(argv)
    if (arguments.capture is None) != (arguments.result is None):
        parser.error("--capture and --result go together")
    try:
        if arguments.capture is None:
            sheet = from_example()
        else:
            sheet = from_capture(arguments.capture, arguments.result, arguments.frame, arguments.cameras)
    except TkError as error:
        raise SystemExit(str(error)) from None
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    ok, png = cv2.imencode(".png", sheet)
    assert ok
    arguments.out.write_bytes(png.tobytes())


if __name__ == "__main__":
    main()
