"""Where the time goes: every stage, end to end, kernel launches, memory; and the same work by other libraries.

Three kinds of figures, all medians:

* *end to end*: `tk track` from the video files to the HDF5 file, each repetition in a process of its own. "loop" is the
  time from one finished frame to the next, everything included; the stages are what the tracker's own clock says.
  Pictures are decoded and segmented in a process of their own; the loop has only what it had to wait for them.
* *alone*: one stage on frames in memory, beside Open3D's `VoxelGrid.carve_silhouette` and a plain NumPy projection for
  the hull, SciPy's cKDTree for the nearest neighbours. All in one process, so that they share the machine's mood.
* *growth* (with `--growth`): the hull from 4, 5 and 9 cameras, as table 1 of Kehl & Van Gool 2006.

With ``--method silhouette`` the same of the other tracker, which has no voxels. ``--pictures`` only reports what the
overlay video and the report cost beside a default run.

    python -m scripts.bench [CAPTURE] [--voxels 64 128] [--repeat 3] [--growth CAPTURE] [--json FILE]
    python -m scripts.bench CAPTURE --method silhouette --masks auto --cameras a,b,c
    python -m scripts.bench [CAPTURE] --pictures
    python -m scripts.bench [CAPTURE] --speed
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import resource
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from scripts import bench_hull, bench_pictures, bench_speed, bench_start
from scripts.bench_stages import Stage, contour_stages, median_ms, silhouette_stages
from tk import __version__
from tk.errors import TkError
from tk.io.captures.capture import Capture, open_capture
from tk.io.captures.frames import FrameSet
from tk.io.results.data import Result
from tk.io.results.reader import read_result
from tk.kernels.nearest import SurfaceIndex, nearest
from tk.kernels.runtime import ti
from tk.kernels.taichi_internals import Launcher
from tk.model.body.skeleton import CHAINS, convert_poses
from tk.model.body.superellipsoid_body import build_superellipsoid_body
from tk.model.cameras.volume import VoxelGrid
from tk.model.cues.appearance import Appearance
from tk.model.cues.objective import CHAIN_SAMPLES, COVERAGE_VOXELS, BodyObjective
from tk.model.hull.hull import VisualHull
from tk.run import session
from tk.run.reporter import Silent
from tk.run.segmentation import make_labeller
from tk.run.task import RecordingOptions, Task
from tk.settings import Settings
from tk.trackers.bodies import body_and_poses
from tk.trackers.protocol import Estimate
from tk.trackers.silhouette import SilhouetteTracker
from tk.trackers.volumetric import CELL_VOXELS

DEMO = Path(__file__).resolve().parents[1] / "tk" / "data" / "demo"
WINDOW = 12  # frames that the stages alone are measured on


@dataclass(frozen=True)
class Options:
    """What to measure. ``frames``: how many from the start, all with None."""

    capture: Path = DEMO
    voxels: int = 64
    frames: int | None = None
    repeat: int = 3
    masks: str = "none"
    init_pose: Path | None = None
    method: str = "volumetric"
    cameras: tuple[str, ...] | None = None

    def open(self) -> Capture:
        """The capture with the cameras and masks that were asked for."""
        return open_capture(self.capture, self.cameras, self.masks)

    @property
    def config(self) -> Settings:
        return Settings(voxels=self.voxels) if self.voxels else Settings()

    @property
    def title(self) -> str:
        volumetric = self.method != SilhouetteTracker.method
        return f"{self.capture.name} at {self.voxels}³" if volumetric else f"{self.capture.name}, silhouettes"


# --- end to end ---------------------------------------------------------------------------------------------------


@contextmanager
def counted_launches() -> Iterator[Counter[str]]:
    """Kernel launches by name while the block runs. Reaches into Taichi, which has no such count of its own."""
    kernel_class = ti.lang.kernel_impl.Kernel
    ordinary, remembered = kernel_class.launch_kernel, Launcher._launch
    counts: Counter[str] = Counter()

    def count_ordinary(self: Any, *args: Any, **kwargs: Any) -> Any:
        counts[self.func.__name__.strip("_")] += 1
        return ordinary(self, *args, **kwargs)

    def count_remembered(self: Any, *args: Any) -> None:
        counts[self._kernel.__name__.strip("_")] += 1
        remembered(self, *args)

    with (
        mock.patch.object(kernel_class, "launch_kernel", count_ordinary),
        mock.patch.object(Launcher, "_launch", count_remembered),
    ):
        yield counts


class _Clock(Silent):
    """Record the time of each report of frames, the time of each frame and the number of launches."""

    def __init__(self, counts: Counter[str]) -> None:
        self._counts = counts
        self.times: list[float] = []
        self.took: list[float] = []
        self.launches: list[Counter[str]] = []

    def advance(self, frame: int, estimate: Estimate | None) -> None:
        self.times.append(time.perf_counter())
        self.took.append(estimate.timing["total"] if estimate else np.nan)
        self.launches.append(Counter(self._counts))


@dataclass(frozen=True)
class Run:
    """One run of the tracker.

    Attributes:
        frames, lost: frames tracked, and those of them that say lost.
        seconds: from opening the capture to the closed file.
        first_frame_s: from opening the capture to the first finished frame: compiling, tables, background, body.
        loop_ms: a frame, with the wait for it; the median.
        frames_per_second: of the frames after the first, by their mean.
        launches: kernel launches a frame, by kernel; means.
        launches_per_frame: of all kernels; the mean.
        peak_mib: most memory that the process held.
    """

    frames: int
    lost: int
    seconds: float
    first_frame_s: float
    loop_ms: float
    frames_per_second: float
    launches: dict[str, float]
    launches_per_frame: float
    peak_mib: float


def run_once(options: Options, output: Path) -> Run:
    """Track and measure; meant for a process of its own (:func:`end_to_end`)."""
    started = time.perf_counter()
    with counted_launches() as counts:
        clock = _Clock(counts)
        summary = session.track(
            options.open(),
            output,
            RecordingOptions(options.config, options.method, frames=(0, options.frames), init_pose=options.init_pose),
            clock,
            force=True,
        )
    seconds = time.perf_counter() - started
    count = max(summary.frames - 1, 1)
    launches = {name: total / count for name, total in sorted((clock.launches[-1] - clock.launches[0]).items())}
    return Run(
        frames=summary.frames,
        lost=summary.lost,
        seconds=seconds,
        first_frame_s=clock.times[0] - started,
        loop_ms=1e3 * float(np.median(clock.took[1:])),
        frames_per_second=count / (clock.times[-1] - clock.times[0]),
        launches=launches,
        launches_per_frame=sum(launches.values()),
        peak_mib=_peak_mib(),
    )


def _peak_mib() -> float:
    """Most memory that this process held, MiB."""
    status = Path("/proc/self/status")
    if status.is_file():  # what getrusage says may stem from the process that this one was forked from
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def end_to_end(options: Options, folder: Path) -> tuple[Run, dict[str, float], Result]:
    """The median run of several, each in a new process; milliseconds a stage; the last run's result.

    Raises:
        TkError: the capture cannot be tracked.
    """
    runs, timings = [], []
    for repetition in range(options.repeat):
        output = folder / f"{options.voxels}-{repetition}.h5"
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
            runs.append(process.submit(run_once, options, output).result())
        result = read_result(output)
        timings.append(result.timing)
    # the first frame of a run waits for the threads that decode, and fills caches
    stages = {
        stage: 1e3 * statistics.median(float(np.median(timing[stage][1:])) for timing in timings)
        for stage in result.meta.timing_stages
    }
    return sorted(runs, key=lambda run: run.frames_per_second)[(len(runs) - 1) // 2], stages, result


# --- stages alone -------------------------------------------------------------------------------------------------


def stages_alone(options: Options, result: Result) -> tuple[list[Stage], bench_hull.HullTimes | None]:
    """Each stage on frames from the middle of a tracked recording; of the hull none without voxels."""
    capture = options.open()
    config = options.config
    middle = int(result.frames[len(result) // 2])
    stop = min(int(result.frames[-1]) + 1, max(middle, int(result.frames[0]) + WINDOW))
    first = max(stop - WINDOW, int(result.frames[0]))
    with capture.frames(first, stop) as reader:
        frames = list(reader)
    label = make_labeller(Task.of(capture, config), lambda _: None)
    masks = [label(frame).masks for frame in frames]
    decoding = Stage("decode", _decode_ms(capture, first, stop, options.repeat), {})
    masking = Stage("masks", statistics.median(median_ms(partial(label, frame), 1) for frame in frames), {})
    if options.method == SilhouetteTracker.method:
        return [decoding, masking, *silhouette_stages(capture, frames, masks, result)], None
    masked = bench_hull.MaskedCapture(capture.name, capture.rig, capture.volume, np.stack(masks))
    hull_times = bench_hull.measure(masked, options.voxels, options.repeat)
    theirs = {"Open3D carve_silhouette": hull_times.open3d, "NumPy projection": hull_times.numpy}
    peers = {name: ms for name, ms in theirs.items() if ms is not None}
    stages = [
        decoding,
        masking,
        Stage("hull, from scratch", hull_times.scratch, peers),
        Stage("hull, incremental", hull_times.incremental, peers),
        Stage("surface, normals, visibility, colours", hull_times.surface, {}),
        *_search_stages(capture, config, frames[-1], masks[-1], result),
    ]
    return stages, hull_times


def _decode_ms(capture: Capture, first: int, stop: int, repeats: int) -> float:
    """Milliseconds a frame of all cameras, the threads having nothing else to do."""

    def decode() -> None:
        with capture.frames(first, stop) as reader:
            for _ in reader:
                pass

    return median_ms(decode, repeats) / (stop - first)


def _search_stages(
    capture: Capture, config: Settings, frame: FrameSet, masks: np.ndarray, result: Result
) -> Iterator[Stage]:
    """Colour segmentation, nearest neighbours and the objective, at the tracked pose of a frame."""
    restored = body_and_poses(result)
    if restored is None:
        raise SystemExit(f"{result.path}: has no body in /model")
    skin = build_superellipsoid_body(restored[0], capture.up)
    row = np.flatnonzero(result.frames == frame.index)[0]
    pose = convert_poses(restored[1][row], restored[0].skeleton, skin.skeleton)
    hull = VisualHull(capture.rig, VoxelGrid.cover(capture.volume, config.voxels))
    hull.carve(masks)
    surface = hull.surface(frame.images)
    mean, deviation, known = (
        np.asarray(result.model[f"patches/{name}"]) for name in ("mean_yuv", "deviation_yuv", "known")
    )
    colours = Appearance(mean, deviation, known.astype(bool))

    def segmented() -> np.ndarray:
        return colours.segment(surface.colors, surface.seen)

    def built(fits: np.ndarray) -> SurfaceIndex:
        return SurfaceIndex.build(surface.positions, fits, CELL_VOXELS * hull.grid.voxel_m)

    yield Stage("colour segmentation", median_ms(segmented), {})

    # the peer knows no colours, so this comparison leaves them out of ours as well
    objective = BodyObjective(skin, config.volumetric.coverage_weight)
    rng = np.random.default_rng(0)
    samples = objective.draw(rng)
    points = skin.place(pose)[samples].astype(np.float32)
    everything = np.full(len(surface), -1, np.int64)
    patch = skin.patch[samples]
    index, tree = built(everything), cKDTree(surface.positions)
    found = nearest(index, points, patch)
    distance = np.asarray(tree.query(points)[0])
    ours = np.linalg.norm(index.positions[found] - points, axis=1)
    np.testing.assert_allclose(ours[found >= 0], distance[found >= 0], atol=1e-4)  # the two do the same
    build = Stage(
        f"neighbours: build of {len(surface)} voxels",
        median_ms(lambda: built(everything)),
        {"SciPy cKDTree": median_ms(lambda: cKDTree(surface.positions))},
    )
    query = Stage(
        f"neighbours: query of {len(points)} points",
        median_ms(lambda: nearest(index, points, patch)),
        {"SciPy cKDTree": median_ms(lambda: tree.query(points))},
    )
    yield build
    yield query
    both = {name: ms + query.peers[name] for name, ms in build.peers.items()}
    yield Stage("neighbours: build and query", build.ms + query.ms, both)

    index = built(segmented())
    rows = len(CHAINS)
    for name, B, M, Q in (
        ("objective: one launch, whole body", 1, len(samples), COVERAGE_VOXELS),
        (
            "objective: one launch, five chains",
            rows,
            CHAIN_SAMPLES,
            COVERAGE_VOXELS // len(CHAINS),
        ),
    ):
        chosen = np.resize(samples, (B, M)).astype(np.int32)
        voxels = rng.integers(len(surface), size=(B, Q)).astype(np.int32)
        poses = np.repeat(pose[None], B, axis=0)
        call = partial(
            objective.kernel.evaluate,
            index,
            chosen,
            voxels,
            poses,
            np.ones_like(poses),
            objective.settings,
        )
        yield Stage(name, median_ms(call), {})
    yield from contour_stages(objective, capture, config, frame, pose, index)


# --- printing -----------------------------------------------------------------------------------------------------


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    cpu = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = names[0] if names else cpu
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "cpu": cpu,
        "cores": cores,
        "load": os.getloadavg()[0],
        "system": platform.platform(),
        "python": platform.python_version(),
        "taichi": ".".join(map(str, ti.__version__)),
        "numpy": np.__version__,
        "tk": __version__,
    }


def _number(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def print_run(console: Console, options: Options, run: Run, stages: dict[str, float]) -> None:
    table = Table(title=f"{options.title}, end to end: ms a frame", title_justify="left")
    table.add_column("stage")
    table.add_column("ms", justify="right")
    table.add_column("share", justify="right")
    parts = {name: ms for name, ms in stages.items() if name not in ("decode", "masks", "total")}
    for name in ("decode", "masks"):
        table.add_row(f"({name}, ahead of the loop)", _number(stages[name]), "")
    for name, ms in parts.items():
        table.add_row(name, _number(ms), f"{100 * ms / run.loop_ms:.0f} %")
    rest = run.loop_ms - sum(parts.values())
    table.add_row("writing and the rest", _number(max(rest, 0.0)), f"{100 * max(rest, 0.0) / run.loop_ms:.0f} %")
    table.add_row("loop", _number(run.loop_ms), "", style="bold")
    console.print(table)
    if options.method == SilhouetteTracker.method:
        console.print(f"fitting alone: {1e3 / stages['optimise']:.0f} frames/s")
    kernels = ", ".join(f"{name} {count:g}" for name, count in run.launches.items() if count)
    console.print(
        f"{run.frames_per_second:.1f} frames/s over {run.frames} frames ({run.lost} lost) after the first; first frame "
        f"after {run.first_frame_s:.1f} s; {run.seconds:.1f} s in all\n"
        f"{run.launches_per_frame:g} kernel launches a frame: {kernels}\n"
        f"peak memory {run.peak_mib:.0f} MiB\n"
    )


def print_stages(console: Console, options: Options, stages: Sequence[Stage]) -> None:
    table = Table(title=f"{options.title}, stages alone: ms", title_justify="left")
    for heading in ("stage", "tk", "peer", "ms", "peer / tk"):
        table.add_column(heading, justify="left" if heading in ("stage", "peer") else "right")
    for stage in stages:
        rows = [(peer, _number(ms), _number(stage.ratios[peer])) for peer, ms in stage.peers.items()] or [("", "", "")]
        for row, cells in enumerate(rows):
            table.add_row("" if row else stage.name, "" if row else _number(stage.ms), *cells)
    console.print(table)


@dataclass(frozen=True)
class Measurement:
    """All figures of one capture at one resolution; ``stages`` are milliseconds a frame within the tracker."""

    options: Options
    run: Run
    stages: dict[str, float]
    alone: list[Stage]
    hull: bench_hull.HullTimes | None
    cameras: int

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "capture": self.options.capture.name,
            "method": self.options.method,
            "cameras": self.cameras,
            "voxels": self.options.voxels if self.hull else None,
            "repeat": self.options.repeat,
            "masks": self.options.masks,
            "end_to_end": asdict(self.run),
            "stages_ms": self.stages,
            "alone": [asdict(stage) | {"ratios": stage.ratios} for stage in self.alone],
            "hull_ms": asdict(self.hull) if self.hull else None,
        }


def measure(options: Options) -> Measurement:
    """Measure one capture at one resolution.

    Raises:
        TkError: the capture cannot be tracked.
    """
    cameras = len(options.open().rig)  # complains before a process is started
    with tempfile.TemporaryDirectory() as folder:
        run, stages, result = end_to_end(options, Path(folder))
    alone, hull = stages_alone(options, result)
    return Measurement(options, run, stages, alone, hull, cameras)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, nargs="?", default=DEMO, help="the demo's by default")
    parser.add_argument("--voxels", type=int, nargs="+", default=[64, 128])
    parser.add_argument("--repeat", type=int, default=3, help="runs; medians are taken over them")
    parser.add_argument("--frames", type=int, help="only so many frames")
    parser.add_argument("--masks", default="none", help="as of tk track, but none (segment the videos) by default")
    parser.add_argument("--method", default="volumetric", help="the tracker: as of tk track")
    parser.add_argument("--cameras", type=_names, metavar="A,B,C", help="only these")
    parser.add_argument("--init-pose", type=Path, metavar="FILE", help="as of tk track")
    parser.add_argument("--growth", type=Path, metavar="CAPTURE", help="with masks of up to nine cameras: table 1")
    parser.add_argument("--speed", action="store_true", help="only a whole run of the default beside decoding alone")
    parser.add_argument("--start", action="store_true", help="only what the first pose takes, piece by piece")
    parser.add_argument("--pictures", action="store_true", help="only what the overlay video and the report cost")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here too")
    given = parser.parse_args(arguments)
    if given.repeat < 1 or (given.frames is not None and given.frames < 3):
        parser.error("--repeat must be at least 1, --frames at least 3")
    console = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 120)
    options = Options(
        given.capture, 0, given.frames, given.repeat, given.masks, given.init_pose, given.method, given.cameras
    )
    if given.speed:
        console.print(bench_speed.measure(given.capture, given.masks, given.repeat))
        return
    if given.start:
        console.print(bench_start.measure(given.capture, given.masks))
        return
    if given.pictures:
        console.print(bench_pictures.measure(given.capture, given.masks, given.frames, given.repeat))
        return
    resolutions = given.voxels if given.method != SilhouetteTracker.method else [0]  # it has no voxels
    report: dict[str, Any] = {"machine": machine(), "runs": [], "growth": []}
    console.print(
        "{cpu}, {cores} cores (load {load:.1f}), Python {python}, Taichi {taichi}".format(**report["machine"])
    )
    try:
        for voxels in resolutions:
            one = replace(options, voxels=voxels)
            found = measure(one)
            print_run(console, one, found.run, found.stages)
            print_stages(console, one, found.alone)
            report["runs"].append(found.to_dict())
    except TkError as error:
        raise SystemExit(str(error)) from None
    if given.growth is not None:
        rows = bench_hull.growth(
            bench_hull.load_masks(given.growth, range(20, 20 + WINDOW)), given.voxels, given.repeat
        )
        console.print(f"hull of {rows[0].capture} with more cameras\n{bench_hull.table(rows)}")
        report["growth"] = [asdict(row) for row in rows]
    if given.json is not None:
        given.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
