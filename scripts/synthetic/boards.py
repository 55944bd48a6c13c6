"""Rigs of cameras with lenses as of phones and action cameras, and pictures of a board in the room, with truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scripts.synthetic.scene import look_at, make_lamps, view_room
from scripts.synthetic.sensor import Sensor
from tk.calibration.boards import Board
from tk.calibration.poses import Pose, exp
from tk.model.cameras.camera import Camera, Rig

Float = NDArray[np.float64]

#: texels along a side of a square: a multiple of the modules of all markers, so that edges lie between texels
_TEXELS = 240
#: area of a board in the image above which two rays along each side of a pixel do
_LARGE_PX = 120_000
#: white plate around the pattern, metres
_MARGIN_M = 0.02
#: reflectance of paper, ink, the plate's back
_WHITE, _BLACK, _BACK = 0.75, 0.035, 0.25

#: lenses: focal length as a share of the image's width, distortion, fisheye
LENSES: dict[str, tuple[float, tuple[float, ...], bool]] = {
    "phone": (0.80, (0.06, -0.12, 0.0008, -0.0005, 0.04), False),
    "webcam": (0.85, (-0.09, 0.05, -0.0006, 0.0010, 0.0), False),
    "action": (0.62, (-0.24, 0.075, 0.0004, -0.0007, -0.012), False),
    "rational": (0.40, (0.6, 0.05, 0.0004, -0.0006, 0.0, 0.85, 0.2, 0.01), False),
    "action wide": (0.50, (0.035, 0.012, -0.012, 0.003), True),
}


@dataclass(frozen=True)
class Recipe:
    """A generated recording of a board.

    Attributes:
        cameras: azimuth in degrees, distance and height in metres, and lens of each camera.
        size: width and height of the images, pixels.
        shared: places of the board all over the volume.
        close: places before each camera.
        seed: of all that is random.
        blur_px, noise: of the sensor, as factors of a common one.
        floor: whether the first instant shows the board on the floor.
    """

    cameras: tuple[tuple[float, float, float, str], ...]
    size: tuple[int, int] = (1280, 720)
    shared: int = 30
    close: int = 10
    seed: int = 0
    blur_px: float = 1.0
    noise: float = 1.0
    floor: bool = True


def make_rig(recipe: Recipe) -> Rig:
    """Return the cameras of a recipe; they look at the middle of the room."""
    rng = np.random.default_rng(recipe.seed)
    width, height = recipe.size
    cameras = []
    for k, (azimuth, far, up, lens) in enumerate(recipe.cameras):
        share, distortion, fisheye = LENSES[lens]
        angle = np.radians(azimuth)
        eye = np.array([far * np.cos(angle), far * np.sin(angle), up])
        target = np.array([0.0, 0.0, 0.95]) + rng.uniform(-0.1, 0.1, 3)
        above = np.array([1.0, 0.0, 0.0]) if far < 1.0 else np.array([0.0, 0.0, 1.0])
        rotation = exp(np.radians(rng.uniform(-2, 2, 3)) * [0, 0, 1]) @ look_at(eye, target, above)
        f = share * width * rng.uniform(0.96, 1.04)
        middle = np.array([(width - 1) / 2, (height - 1) / 2]) + rng.uniform(-0.012, 0.012, 2) * width
        matrix = np.array([[f, 0, middle[0]], [0, f * (1 + rng.uniform(-5e-4, 5e-4)), middle[1]], [0, 0, 1]])
        d = np.array(distortion) * rng.uniform(0.9, 1.1, len(distortion))
        cameras.append(Camera(f"cam{k + 1}", width, height, matrix, d, rotation, -rotation @ eye, fisheye))
    return Rig(tuple(cameras))


def place_boards(recipe: Recipe, rig: Rig, board: Board) -> dict[int, Pose]:
    """Return the board's pose in the world (z up), by instant: the floor, shared places, places close to a camera."""
    rng = np.random.default_rng(recipe.seed + 1)
    middle = board.corners.mean(axis=0)
    poses: dict[int, Pose] = {}

    def put(instant: int, place: Float, toward: Float, tilt_deg: float) -> None:
        """Put the board's middle at a place, its printed side towards a direction, tilted and rolled at random."""
        z = -toward / np.linalg.norm(toward)
        x = np.cross([0.0, 0.0, 1.0], z) + 1e-6 * np.array([1.0, 0, 0])
        x /= np.linalg.norm(x)
        x = -x  # as the camera sees it: x to the right, y down
        y = np.cross(z, x)
        axis = rng.normal(size=3)
        turn = exp(axis / np.linalg.norm(axis) * np.radians(tilt_deg))
        rotation = turn @ np.stack([x, y, z], axis=1) @ exp(np.array([0, 0, rng.uniform(-0.5, 0.5)]))
        poses[instant] = Pose(rotation, place - rotation @ middle)

    if recipe.floor:
        rotation = exp(np.array([0, 0, rng.uniform(-np.pi, np.pi)])) @ np.diag([1.0, -1.0, -1.0])
        poses[0] = Pose(rotation, np.array([*rng.uniform(-0.3, 0.3, 2), 0.0]) - rotation @ (middle * [1, 1, 0]))
    centers = rig.centers
    for k in range(recipe.shared):
        place = np.array([*rng.uniform(-0.9, 0.9, 2), rng.uniform(0.45, 1.7)])
        first = k % len(centers)
        others = [c for c in range(len(centers)) if c != first]
        second = min(others, key=lambda c: np.linalg.norm(centers[c] - centers[first]) * rng.uniform(0.7, 1.3))
        a, b = centers[first] - place, centers[second] - place
        toward = a / np.linalg.norm(a) + b / np.linalg.norm(b)
        put(1 + k, place, toward if np.linalg.norm(toward) > 0.4 else a, rng.uniform(0, 30))
    for c, camera in enumerate(rig):
        reach = np.array([camera.width / 2 / camera.matrix[0, 0], camera.height / 2 / camera.matrix[1, 1]])
        for k in range(recipe.close):
            far = rng.uniform(0.85, 1.5) * board.size_m[0] / 0.77 * camera.matrix[0, 0] / (0.75 * camera.width)
            xy = rng.uniform(-0.75, 0.75, 2) * reach
            place = camera.rotation.T @ (np.array([*xy, 1.0]) * far - camera.translation)
            put(100 + 20 * c + k, place, camera.center - place, rng.uniform(10, 40))
    return poses


def texture(board: Board) -> NDArray[np.float32]:
    """Return the reflectance of the printed side (H, W), :data:`_TEXELS` a square, without the plate's margin."""
    scale = _TEXELS / board.square_m
    width, height = (round(side * scale) for side in board.size_m)
    image = np.full((height, width), _WHITE, np.float32)
    for shape in board.shapes():
        x, y, w, h = (scale * v for v in (shape.x, shape.y, shape.width, shape.height))
        if shape.round:
            center = (round(16 * (x + w / 2 - 0.5)), round(16 * (y + h / 2 - 0.5)))
            cv2.circle(image, center, round(16 * w / 2), _BLACK, -1, cv2.LINE_8, 4)
        else:
            image[round(y) : round(y + h), round(x) : round(x + w)] = _BLACK
    return image


class BoardCamera:
    """Renders one camera's images of a board."""

    def __init__(self, camera: Camera, board: Board, sensor: Sensor, room: Float | bool = True) -> None:
        """``room``: whether the generated room is behind the board; or a picture of one (H, W, 3), linear RGB."""
        self.camera, self.board, self.sensor = camera, board, sensor
        self._texture = texture(board)
        y, x = np.mgrid[: camera.height, : camera.width]
        grid = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
        self._rays = camera.rays(grid).reshape(camera.height, camera.width, 3)
        if isinstance(room, np.ndarray):
            self._background = room.astype(np.float32)
        elif room:
            lamps = make_lamps(np.array([-1.5, -1.5, 0.0]), np.array([1.5, 1.5, 2.2]))
            view = view_room(camera, lamps, 2)
            self._background = (view.indirect + view.direct.sum(axis=0)).astype(np.float32)
        else:
            self._background = np.full((camera.height, camera.width, 3), 0.3, np.float32)

    def render(self, pose: Pose | None, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return the RGB image (H, W, 3) with the board in a pose (board to world), or without it."""
        image = self._background.copy()
        box = None if pose is None else self._box(pose)
        if pose is not None and box is not None:
            x0, y0, x1, y1 = box
            samples = 4 if (x1 - x0) * (y1 - y0) < _LARGE_PX else 2  # modules of several pixels need no more
            shade, cover = np.zeros((y1 - y0, x1 - x0)), np.zeros((y1 - y0, x1 - x0))
            rays = self._rays[y0:y1, x0:x1]
            step_x, step_y = np.gradient(rays, axis=1), np.gradient(rays, axis=0)
            offsets = (np.arange(samples) + 0.5) / samples - 0.5
            for dy in offsets:
                for dx in offsets:
                    value, hit = self._cast(pose, rays + dx * step_x + dy * step_y)
                    shade += value
                    cover += hit
            share = cover[:, :, None] / samples**2
            light = self._light(pose)
            part = image[y0:y1, x0:x1]
            image[y0:y1, x0:x1] = part * (1 - share) + (shade / samples**2 * light)[:, :, None]
        return self.sensor.expose(image, 0, rng)

    def _light(self, pose: Pose) -> float:
        """Return the light on the board: more from above."""
        return float(0.75 + 0.25 * -pose.rotation[2, 2])

    def _box(self, pose: Pose) -> tuple[int, int, int, int] | None:
        """Return the part of the image that may show the board: x0, y0, x1, y1."""
        width, height = self.board.size_m
        u, v = np.meshgrid(np.linspace(-0.05, 1.05, 12) * width, np.linspace(-0.05, 1.05, 12) * height)
        points = pose.apply(np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], axis=1))
        pixels, depth = self.camera.project(points)
        good = np.isfinite(pixels).all(axis=1) & (depth > 0.1)
        if not good.any():
            return None
        low, high = pixels[good].min(axis=0) - 6, pixels[good].max(axis=0) + 6
        x0, y0 = np.clip(low, 0, [self.camera.width, self.camera.height]).astype(int)
        x1, y1 = np.clip(np.ceil(high), 0, [self.camera.width, self.camera.height]).astype(int)
        return (x0, y0, x1, y1) if x1 - x0 > 2 and y1 - y0 > 2 else None

    def _cast(self, pose: Pose, rays: Float) -> tuple[Float, Float]:
        """Return the reflectance (H, W) along rays (H, W, 3), and whether they hit the plate."""
        back = pose.inverse()
        origin, directions = back.apply(self.camera.center), rays @ back.rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -origin[2] / directions[:, :, 2]
        point = origin[:2] + along[:, :, None] * directions[:, :, :2]
        width, height = self.board.size_m
        m = _MARGIN_M
        with np.errstate(invalid="ignore"):
            hit = (along > 0) & (point > -m).all(axis=2) & (point[:, :, 0] < width + m) & (point[:, :, 1] < height + m)
        if origin[2] > 0:  # behind the board, whose z points into the paper
            return np.where(hit, _BACK, 0.0), hit.astype(float)
        texel = (np.where(hit[:, :, None], point, 0.0) * (_TEXELS / self.board.square_m) - 0.5).astype(np.float32)
        value = cv2.remap(
            self._texture, texel[:, :, 0], texel[:, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
            borderValue=_WHITE,
        )  # fmt: skip
        return np.where(hit, value, 0.0), hit.astype(float)


def render_boards(
    folder: Path,
    recipe: Recipe,
    board: Board,
    poses_of: Callable[[int, dict[int, Pose]], dict[int, Pose]] | None = None,
    cameras: Sequence[int] | None = None,
    room: bool = True,
    rig: Rig | None = None,
) -> Rig:
    """Write pictures of the board, `folder/<camera>/<instant>.png`, and return the true rig.

    Args:
        folder: where to write.
        recipe: what to render.
        board: the board.
        poses_of: changes the poses that a camera (by index) sees.
        cameras: render these only.
        room: render the room; else a grey background.
        rig: the cameras instead of the recipe's.
    """
    rig = rig or make_rig(recipe)
    poses = place_boards(recipe, rig, board)
    for c, camera in enumerate(rig):
        if cameras is not None and c not in cameras:
            continue
        rng = np.random.default_rng(1000 * recipe.seed + c)
        sensor = Sensor.draw(rng, recipe.size[0])
        sensor = replace(
            sensor, blur_px=sensor.blur_px * recipe.blur_px, read_noise=sensor.read_noise * recipe.noise,
            shot_noise=sensor.shot_noise * recipe.noise,
        )  # fmt: skip
        renderer = BoardCamera(camera, board, sensor, room)
        own = folder / camera.name
        own.mkdir(parents=True, exist_ok=True)
        for instant, pose in (poses_of(c, poses) if poses_of else poses).items():
            if instant >= 100 and not 100 + 20 * c <= instant < 120 + 20 * c:
                continue  # close to another camera
            image = renderer.render(pose, rng)
            cv2.imwrite(str(own / f"{instant:04d}.png"), image[:, :, ::-1])
    return rig


def true_world(rig: Rig, recipe: Recipe, board: Board) -> Rig:
    """Return the true cameras in the world of the board on the floor."""
    floor = place_boards(recipe, rig, board)[0]
    motion = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)) @ floor.inverse()
    cameras = []
    for camera in rig:
        pose = Pose(camera.rotation, camera.translation) @ motion.inverse()
        cameras.append(replace(camera, rotation=pose.rotation, translation=pose.translation))
    return Rig(tuple(cameras))
