"""Time the visual hull against Open3D's carving and a plain NumPy projection hull; growth with 4, 5 and 9 cameras.

The counterpart of table 1 of Kehl & Van Gool 2006 (reconstruction and texturing at 64^3 and 128^3). All methods run in
the same process on the same masks; medians over frames and repetitions. ``scripts/bench.py`` calls these functions.

    python scripts/bench_hull.py CAPTURE [--rig9 CAPTURE] [--frames 12] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.io.captures.calibration import read_calibration
from tk.io.toml import load_toml
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume, VoxelGrid
from tk.model.hull.hull import VisualHull

RESOLUTIONS = (64, 128)
GROWTH = (4, 5, 9)  # cameras, as in the paper's table 1


@dataclass(frozen=True)
class MaskedCapture:
    """Frames of a capture with ready masks, in memory: ``masks`` (F, C, H, W) uint8."""

    name: str
    rig: Rig
    volume: Volume
    masks: NDArray[np.uint8]

    def select(self, cameras: Sequence[int]) -> MaskedCapture:
        """The same frames, from these cameras only."""
        rig = Rig(tuple(self.rig[c] for c in cameras))
        return MaskedCapture(self.name, rig, self.volume, np.ascontiguousarray(self.masks[:, list(cameras)]))


@dataclass(frozen=True)
class HullTimes:
    """Milliseconds a frame; medians. Baselines are None where they were not run."""

    capture: str
    cameras: int
    voxels: int
    surface_voxels: int
    scratch: float
    incremental: float
    surface: float
    open3d: float | None
    numpy: float | None

    @property
    def speedup(self) -> float | None:
        """How many times faster than Open3D, from scratch."""
        return None if self.open3d is None else self.open3d / self.scratch


def load_masks(folder: Path, frames: Iterable[int]) -> MaskedCapture:
    """Read the masks of some frames of a capture whose masks are PNG files."""
    rig = read_calibration(folder / "calibration.toml").rig
    table = load_toml(folder / "capture.toml")["volume"]
    volume = Volume(tuple(table["center"]), tuple(table["size"]))
    indices = list(frames)
    masks = np.zeros((len(indices), len(rig), *rig.frame_shape), dtype=np.uint8)
    for row, index in zip(masks, indices, strict=True):
        for mask, camera in zip(row, rig, strict=True):
            path = folder / "masks" / camera.name / f"{index:06d}.png"
            picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if picture is None:
                raise SystemExit(f"{path}: no such mask; give fewer --frames or a capture with masks")
            mask[: camera.height, : camera.width] = picture
    return MaskedCapture(folder.name, rig, volume, masks)


# --- what there is to beat ---------------------------------------------------------------------------------------


def open3d_carver(rig: Rig, grid: VoxelGrid) -> Callable[[NDArray[np.uint8]], float]:
    """Open3D's carving of the same grid; returns a function from masks to the seconds that it takes.

    Open3D takes pinholes only, so distortion is ignored here, and keeps a voxel if any of its corners falls on
    foreground (ours asks its centre): its hull is thicker by up to a voxel. It carves destructively, so each
    frame needs a new dense grid; that is left out of its time.
    """
    import open3d as o3d  # takes seconds to import; the tests need the rest of this module only

    size = np.asarray(grid.shape) * grid.voxel_m
    lower = np.asarray(grid.origin) - grid.voxel_m / 2
    parameters = []
    for camera in rig:
        one = o3d.camera.PinholeCameraParameters()
        one.intrinsic = o3d.camera.PinholeCameraIntrinsic(camera.width, camera.height, camera.matrix)
        extrinsic = np.eye(4)
        extrinsic[:3, :3], extrinsic[:3, 3] = camera.rotation, camera.translation
        one.extrinsic = extrinsic
        parameters.append(one)

    def carve(masks: NDArray[np.uint8]) -> float:
        dense = o3d.geometry.VoxelGrid.create_dense(lower, np.zeros(3), grid.voxel_m, *size)
        started = time.perf_counter()
        for mask, camera, one in zip(masks, rig, parameters, strict=True):
            picture = np.ascontiguousarray(mask[: camera.height, : camera.width]).astype(np.float32)
            dense.carve_silhouette(o3d.geometry.Image(picture), one, keep_voxels_outside_image=True)
        return time.perf_counter() - started

    return carve


def numpy_hull(rig: Rig, grid: VoxelGrid, masks: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The plain way: project every voxel into every picture, every frame. (nx, ny, nz) bool."""
    centers = grid.centers()
    passed = np.ones(grid.count, dtype=bool)
    holders = np.zeros(grid.count, dtype=np.uint8)
    for camera, mask in zip(rig, masks, strict=True):
        xy, _ = camera.project(centers)
        inside = (xy >= -0.5).all(axis=1) & (xy < (camera.width - 0.5, camera.height - 0.5)).all(axis=1)
        cell = np.floor(xy[inside] + 0.5).astype(np.intp)
        passed[inside] &= mask[cell[:, 1], cell[:, 0]] != 0
        holders += inside
    return (passed & (holders >= 2)).reshape(grid.shape)


# --- measuring ---------------------------------------------------------------------------------------------------


def _median_ms(seconds: Sequence[float]) -> float:
    return statistics.median(seconds) * 1e3


def _timed(call: Callable[[], object]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def measure(capture: MaskedCapture, voxels: int, repeats: int = 5, baselines: bool = True) -> HullTimes:
    """Times of ours from scratch, incremental, and surface with colours; of the two baselines on a few frames."""
    grid = VoxelGrid.cover(capture.volume, voxels)
    hull = VisualHull(capture.rig, grid)
    images = np.repeat(capture.masks[0][..., None], 3, axis=-1)
    hull.carve(capture.masks[0])
    hull.surface(images)  # compiled
    scratch, incremental, surface, sizes = [], [], [], []
    for _ in range(repeats):
        for masks in capture.masks:
            scratch.append(_timed(lambda masks=masks: hull.carve(masks)))
            surface.append(_timed(lambda: sizes.append(len(hull.surface(images)))))
        hull.update(capture.masks[0])
        for masks in capture.masks[1:]:
            incremental.append(_timed(lambda masks=masks: hull.update(masks)))
            surface.append(_timed(lambda: sizes.append(len(hull.surface(images)))))
    theirs: float | None = None
    plain: float | None = None
    if baselines:
        few = capture.masks[:: max(1, len(capture.masks) // 3)][:3]
        carver = open3d_carver(capture.rig, grid)
        theirs = _median_ms([carver(masks) for masks in few])
        plain = _median_ms([_timed(lambda masks=masks: numpy_hull(capture.rig, grid, masks)) for masks in few])
    return HullTimes(
        capture=capture.name,
        cameras=len(capture.rig),
        voxels=voxels,
        surface_voxels=int(statistics.median(sizes)),
        scratch=_median_ms(scratch),
        incremental=_median_ms(incremental),
        surface=_median_ms(surface),
        open3d=theirs,
        numpy=plain,
    )


def spread(cameras: int, count: int) -> list[int]:
    """``count`` of so many cameras, evenly spread over the rig's order."""
    return [round(i * (cameras - 1) / max(count - 1, 1)) for i in range(count)]


def growth(capture: MaskedCapture, resolutions: Sequence[int] = RESOLUTIONS, repeats: int = 5) -> list[HullTimes]:
    """The paper's table 1: the same frames from 4, 5 and 9 cameras, as far as the capture has them."""
    return [
        measure(capture.select(spread(len(capture.rig), count)), voxels, repeats, baselines=False)
        for voxels in resolutions
        for count in GROWTH
        if count <= len(capture.rig)
    ]


def table(rows: Sequence[HullTimes]) -> str:
    """The measurements as lines of text."""

    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}" if value < 100 else f"{value:.0f}"

    head = ("capture", "views", "voxels", "surface", "scratch", "increm.", "texture", "Open3D", "NumPy", "x Open3D")
    lines = [" ".join(f"{h:>9}" for h in head)]
    for row in rows:
        times = (row.scratch, row.incremental, row.surface, row.open3d, row.numpy, row.speedup)
        cells = (row.capture, row.cameras, f"{row.voxels}^3", row.surface_voxels, *map(number, times))
        lines.append(" ".join(f"{c!s:>9}" for c in cells))
    return "\n".join([*lines, "times in ms a frame; texture = surface voxels, normals, visibility and colours"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, nargs="+", help="captures with masks")
    parser.add_argument("--rig9", type=Path, help="a capture with many cameras, for the growth with 4, 5, 9 views")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--start", type=int, default=20, help="first frame: after the initialisation pose")
    parser.add_argument("--voxels", type=int, nargs="+", default=list(RESOLUTIONS))
    parser.add_argument("--json", type=Path, help="write the measurements here too")
    options = parser.parse_args()
    frames = range(options.start, options.start + options.frames)
    rows = [measure(load_masks(folder, frames), voxels) for folder in options.capture for voxels in options.voxels]
    if options.rig9 is not None:
        rows += growth(load_masks(options.rig9, frames), options.voxels)
    print(table(rows))
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
