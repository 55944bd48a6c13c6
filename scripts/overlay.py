"""Draw a tracked body over the pictures of all cameras: the way to see whether a result is right.

A sheet has a row a frame and a column a camera. Filled outlines are the fitted body (left limbs warm, right limbs cool,
trunk and head green), dots and lines its joints; white crosses are the capture's truth, where it has one. The body is
built anew from the result's `/model`; a result without one shows joints only.

    python -m scripts.overlay CAPTURE RESULT.h5 -o DIR [--frames 0 20 40] [--cameras cam1 cam2] [--full]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import TkError
from tk.io.capture import Capture, open_capture
from tk.io.result import Result, Status, read_joints, read_result
from tk.kernels.cones import ELLIPSOID
from tk.model.body import Body
from tk.model.camera import Camera
from tk.model.cone_body import ConeBody, ConePart
from tk.model.skeleton import JOINTS, SEGMENTS
from tk.model.superellipsoid import Superellipsoid
from tk.trackers.bodies import body_and_poses
from tk.trackers.volumetric import restore_body

Float = NDArray[np.float64]
Image = NDArray[np.uint8]
Color = tuple[int, int, int]

BONES = (
    ("pelvis", "neck"), ("neck", "head_top"),
    ("neck", "shoulder_l"), ("shoulder_l", "elbow_l"), ("elbow_l", "wrist_l"),
    ("neck", "shoulder_r"), ("shoulder_r", "elbow_r"), ("elbow_r", "wrist_r"),
    ("pelvis", "hip_l"), ("hip_l", "knee_l"), ("knee_l", "ankle_l"),
    ("pelvis", "hip_r"), ("hip_r", "knee_r"), ("knee_r", "ankle_r"),
)  # fmt: skip

# BGR; the far half of a limb is the lighter one
_COLORS: dict[str, Color] = {
    "torso": (90, 170, 60),
    "pelvis": (60, 140, 40),
    "head": (120, 210, 120),
    "upper_arm_l": (30, 110, 240),
    "forearm_l": (70, 190, 250),
    "upper_arm_r": (220, 90, 40),
    "forearm_r": (245, 190, 90),
    "thigh_l": (40, 60, 215),
    "calf_l": (130, 140, 250),
    "thigh_r": (190, 50, 140),
    "calf_r": (240, 140, 210),
    "foot_l": (90, 100, 235),
    "foot_r": (215, 95, 175),
}
_OPACITY = 0.35
_SUBPIXEL = 4  # bits of a fraction of a pixel that OpenCV draws with
_GAP = 6  # pixels between tiles


@dataclass(frozen=True)
class View:
    """A tile: what part of a picture it shows, ``origin`` (2,) being its upper left corner, pixels, and its scale."""

    origin: Float
    scale: float
    width: int
    height: int

    @staticmethod
    def around(xy: Float, camera: Camera, width: int, height: int) -> View:
        """A tile of this size that holds the points (N, 2), kept within the picture as far as it goes."""
        xy = xy[np.isfinite(xy).all(axis=1)]
        if not len(xy):
            return View.whole(camera, height)
        low, high = xy.min(axis=0), xy.max(axis=0)
        span = (high - low) * 1.2  # room for what the body misses
        scale = float(min(width / span[0], height / span[1], 4.0))
        size = np.array([width, height]) / scale
        most = np.maximum(np.array([camera.width, camera.height]) - size, 0)
        return View(np.clip((low + high) / 2 - size / 2, 0, most), scale, width, height)

    @staticmethod
    def whole(camera: Camera, height: int) -> View:
        """The whole picture at this height."""
        return View(np.zeros(2), height / camera.height, round(camera.width * height / camera.height), height)

    def cut(self, picture: Image) -> Image:
        """(height, width, 3) the tile's part of a picture."""
        shift = 0.5 * self.scale - 0.5 - self.scale * self.origin
        M = np.column_stack([self.scale * np.eye(2), shift])
        return np.asarray(cv2.warpAffine(picture, M, (self.width, self.height), flags=cv2.INTER_LINEAR), np.uint8)

    def place(self, xy: Float) -> Float:
        """(N, 2) pixels of the picture as pixels of the tile."""
        return np.asarray((xy + 0.5 - self.origin) * self.scale - 0.5)


def piece_points(piece: Superellipsoid) -> Float:
    """(N, 3) points over the whole surface of a piece, its own frame, metres: enough for its outline."""
    eta, omega = np.meshgrid(np.linspace(*piece.eta_range, 13), np.linspace(-np.pi, np.pi, 32, endpoint=False))
    return piece.point(eta.ravel(), omega.ravel())


def part_points(part: ConePart) -> Float:
    """(N, 3) points over the whole surface of a frustum or an ellipsoid, its own frame, metres."""
    angle, z = np.meshgrid(np.linspace(-np.pi, np.pi, 32, endpoint=False), np.linspace(0, 1, 13))
    radius = np.ones_like(z)
    if part.kind == ELLIPSOID:
        radius, z = np.sin(np.pi * z), np.cos(np.pi * z)
    unscaled = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    return part.surface(unscaled.reshape(-1, 3))


def solids(body: Body | ConeBody) -> list[tuple[str, Float, Float]]:
    """Of each of the body's solids: its segment, (4, 4) its frame in the segment's, and points (N, 3) in its frame."""
    if isinstance(body, ConeBody):
        return [(part.segment, part.T_body_part, part_points(part)) for part in body.parts]
    return [(piece.segment, piece.T_body_piece, piece_points(piece)) for piece in body.pieces]


def outlines(body: Body | ConeBody, pose: Float, camera: Camera) -> list[tuple[str, float, list[Float]]]:
    """What a camera sees of the body, farthest segment first.

    Returns:
        segment, depth in metres, and the outlines (N, 2) of its solids, pixels. Solids are convex, so each outline is
        the convex hull of the projected surface (lens distortion bends it by less than a pixel over a limb).
    """
    skeleton = body.skeleton
    T_body = np.eye(4)
    T_body[:3, :3] = skeleton.T_world_body
    T_world = skeleton.segment_transforms(pose)
    seen: dict[str, tuple[list[float], list[Float]]] = {}
    for segment, T_body_solid, points in solids(body):
        T = T_world[SEGMENTS.index(segment)] @ T_body @ T_body_solid
        xy, depth = camera.project(points @ T[:3, :3].T + T[:3, 3])
        if not np.isfinite(xy).all():
            continue  # behind the camera, in part
        depths, polygons = seen.setdefault(segment, ([], []))
        depths.append(float(depth.mean()))
        polygons.append(cv2.convexHull(xy.astype(np.float32))[:, 0].astype(np.float64))
    found = [(segment, float(np.mean(depths)), polygons) for segment, (depths, polygons) in seen.items()]
    return sorted(found, key=lambda item: -item[1])


def draw_body(tile: Image, view: View, segments: list[tuple[str, float, list[Float]]]) -> None:
    """Fill each segment's outline, translucent, far ones first."""
    for segment, _, polygons in segments:
        mask = np.zeros(tile.shape[:2], np.uint8)
        for polygon in polygons:
            cv2.fillConvexPoly(mask, _fixed(view.place(polygon)), 255, cv2.LINE_8, _SUBPIXEL)
        inside = mask > 0
        tile[inside] = ((1 - _OPACITY) * tile[inside] + _OPACITY * np.array(_COLORS[segment])).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(tile, contours, -1, _COLORS[segment], 1, cv2.LINE_AA)


def draw_joints(tile: Image, xy: Float) -> None:
    """Bones as lines, joints as dots; ``xy`` (15, 2) tile pixels."""
    for a, b in BONES:
        ends = xy[[JOINTS.index(a), JOINTS.index(b)]]
        if np.isfinite(ends).all():
            start, stop = _fixed(ends)
            cv2.line(tile, start, stop, (20, 20, 20), 3, cv2.LINE_AA, _SUBPIXEL)
            cv2.line(tile, start, stop, (0, 235, 255), 1, cv2.LINE_AA, _SUBPIXEL)
    for point in _fixed(xy[np.isfinite(xy).all(axis=1)]):
        cv2.circle(tile, point, 3 << _SUBPIXEL, (0, 235, 255), cv2.FILLED, cv2.LINE_AA, _SUBPIXEL)
        cv2.circle(tile, point, 3 << _SUBPIXEL, (20, 20, 20), 1, cv2.LINE_AA, _SUBPIXEL)


def draw_truth(tile: Image, xy: Float) -> None:
    """Small crosses at the true joints, ``xy`` (15, 2) tile pixels."""
    for x, y in xy[np.isfinite(xy).all(axis=1)]:
        for color, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            for dx, dy in ((3.5, 3.5), (3.5, -3.5)):
                a, b = _fixed(np.array([[x - dx, y - dy], [x + dx, y + dy]]))
                cv2.line(tile, a, b, color, width, cv2.LINE_AA, _SUBPIXEL)


def _fixed(xy: Float) -> NDArray[np.int32]:
    return np.rint(np.asarray(xy) * (1 << _SUBPIXEL)).astype(np.int32)


def _label(tile: Image, text: str, color: Color) -> None:
    """A line of text on a dark strip along the top."""
    tile[:20] = tile[:20] // 3
    cv2.putText(tile, text, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, 1, cv2.LINE_AA)


def overlay_rows(
    capture: Capture, result: Result, frames: Sequence[int], tile_height: int = 360, full: bool = False
) -> Iterator[tuple[int, Image]]:
    """A row of tiles for each of the frames, ascending.

    Args:
        capture: the pictures.
        result: what was tracked.
        frames: source frames; each must be in the result.
        tile_height: pixels.
        full: whole pictures, not the person cut out.
    """
    restored = body_and_poses(result) or restore_body(result)
    truth_file = capture.path / "truth.h5"
    truth = read_joints(truth_file) if truth_file.is_file() else None
    row_of = {int(frame): row for row, frame in enumerate(result.frames)}
    for index, images in _pictures(capture, frames):
        row = row_of[index]
        marks = [] if truth is None else [truth.positions[i] for i in np.flatnonzero(truth.frames == index)]
        lost = result.status[row] == Status.LOST
        tiles = []
        for camera, image in zip(capture.rig, images, strict=True):
            joints, _ = camera.project(result.joints[row])
            segments = [] if restored is None else outlines(restored[0], restored[1][row], camera)
            true = [camera.project(positions)[0] for positions in marks]
            points = np.concatenate([joints, *true, *(polygon for _, _, polygons in segments for polygon in polygons)])
            width = round(0.75 * tile_height)
            view = View.whole(camera, tile_height) if full else View.around(points, camera, width, tile_height)
            tile = view.cut(image[: camera.height, : camera.width])
            draw_body(tile, view, segments)
            draw_joints(tile, view.place(joints))
            for xy in true:
                draw_truth(tile, view.place(xy))
            state = Status(int(result.status[row])).name.lower()
            _label(tile, f"{camera.name}  {index}  {state}", (80, 80, 255) if lost else (255, 255, 255))
            tiles.append(tile)
        yield index, _joined(tiles, axis=1)


def _pictures(capture: Capture, frames: Sequence[int]) -> Iterator[tuple[int, Image]]:
    """The chosen frames and their pictures (C, H, W, 3)."""
    wanted = set(frames)
    with capture.frames(min(wanted), max(wanted) + 1) as reader:
        for frame in reader:
            if frame.index in wanted:
                yield frame.index, frame.images


def _joined(tiles: Sequence[Image], axis: int) -> Image:
    """Tiles beside (axis 1) or below (axis 0) each other, on white."""
    across = max(tile.shape[1 - axis] for tile in tiles)
    parts: list[Image] = []
    for tile in tiles:
        pad = [(0, 0), (0, 0), (0, 0)]
        pad[1 - axis] = (0, across - tile.shape[1 - axis])
        if parts:
            pad[axis] = (_GAP, 0)
        parts.append(np.pad(tile, pad, constant_values=255))
    return np.concatenate(parts, axis=axis)


def write_sheets(
    capture: Capture,
    result: Result,
    folder: Path,
    frames: Sequence[int] = (),
    rows: int = 4,
    tile_height: int = 360,
    full: bool = False,
) -> list[Path]:
    """Write contact sheets of ``rows`` frames each; by default of eight frames spread over the result.

    Raises:
        SystemExit: a frame is not in the result.
    """
    known = [int(frame) for frame in result.frames]
    if not known:
        raise SystemExit(f"{result.path}: has no frames")
    chosen = sorted(set(frames)) or [known[i] for i in np.unique(np.linspace(0, len(known) - 1, 8).astype(int))]
    missing = [frame for frame in chosen if frame not in known or frame >= capture.frame_count]
    if missing:
        raise SystemExit(f"{result.path}: frame {missing[0]} is not there; it has frames {known[0]} to {known[-1]}")
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    sheet: list[tuple[int, Image]] = []
    for row in overlay_rows(capture, result, chosen, tile_height, full):
        sheet.append(row)
        if len(sheet) == rows or row[0] == chosen[-1]:
            path = folder / f"overlay-{sheet[0][0]:06d}-{sheet[-1][0]:06d}.png"
            if not cv2.imwrite(str(path), _joined([image for _, image in sheet], axis=0)):
                raise SystemExit(f"{path}: cannot be written")
            written.append(path)
            sheet = []
    return written


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--frames", type=int, nargs="+", default=[], help="eight, spread over the result, by default")
    parser.add_argument("--cameras", nargs="+", help="all by default")
    parser.add_argument("--rows", type=int, default=4, help="frames a sheet")
    parser.add_argument("--height", type=int, default=360, help="of a tile, pixels")
    parser.add_argument("--full", action="store_true", help="whole pictures, not the person cut out")
    options = parser.parse_args(arguments)
    try:
        capture = open_capture(options.capture, options.cameras, masks="none")
        result = read_result(options.result)
        for path in write_sheets(
            capture, result, options.output, options.frames, max(options.rows, 1), options.height, options.full
        ):
            print(path)
    except TkError as error:
        raise SystemExit(str(error)) from None


if __name__ == "__main__":
    main()
