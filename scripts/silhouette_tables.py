"""Tables 1 and 2 and figure 6 of the silhouette paper, on a treadmill capture with masks and truth.

Table 1: E_S and the ankles' error with 2, 3 and 4 views, with 2, 3 and 5 iterations, without ambiguity weights, and
with a single scale. E_S is the mean over all views, used or not; the ankles' error over the used ones, pixels. Rows
"paper" also search contours inside the outline, with plain least squares, without prediction and limb search; rows "tk"
are the defaults. Table 2: milliseconds per frame. Figure 6: the ankles' x in one view and in the ground truth.

    python -m scripts.silhouette_tables CAPTURE [--cameras a,b,c,d] [--frames 340] [--every 1] [--figure FILE.png]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_joints
from tk.kernels.line_search import SearchSettings
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.camera import Rig
from tk.model.cues.ray_costs import Evidence, RayGrid
from tk.model.setup import Subject
from tk.optim.gauss_newton import GaussNewtonSettings
from tk.settings import SilhouetteSettings
from tk.trackers.contour_finder import LINE_SEARCH, SOLVER
from tk.trackers.protocol import Frame
from tk.trackers.silhouette import SilhouetteTracker

Float = NDArray[np.float64]

# side, front, and two oblique views: as vr03, vr13, vr05 and vr07 are spread in the paper's figure 5
CAMERAS = ("cam3", "cam6", "cam1", "cam4")
ANKLES = [JOINTS.index("ankle_l"), JOINTS.index("ankle_r")]


@dataclass(frozen=True)
class Variant:
    """Settings of a tracker, its line search and its solver."""

    settings: SilhouetteSettings
    line_search: SearchSettings
    solver: GaussNewtonSettings


OURS = Variant(SilhouetteSettings(), LINE_SEARCH, SOLVER)
PAPER = Variant(
    SilhouetteSettings(prediction=0.0, search_every=0.0),
    SearchSettings(interior=True, ambiguous_px=8.0, tangential=1.0, spacing_px=1.0, robust_px=0.0),
    GaussNewtonSettings(scales=2),
)


@dataclass(frozen=True)
class Sequence3D:
    """A capture in memory: ``masks`` (F, V, H, W) uint8, ``truth`` (F, 15, 3) metres."""

    rig: Rig
    up: str
    masks: NDArray[np.uint8]
    truth: Float
    height_m: float | None


@dataclass(frozen=True)
class Row:
    """A row of the tables: errors in %, pixels and cm; milliseconds per frame of the fit and in total."""

    name: str
    views: int
    iterations: int
    scales: int
    error_share: float
    ankle_px: float
    ankle_share: float
    joints_cm: float
    swaps: int
    fit_ms: float
    all_ms: float


def load(folder: Path, cameras: Sequence[str], frames: int, every: int = 1) -> Sequence3D:
    """Return masks and ground truth of every ``every``-th of the first frames, views in the order of ``cameras``."""
    capture = open_capture(folder, cameras=list(cameras))
    order = [capture.rig.names.index(name) for name in cameras]
    with capture.frames(0, frames) as reader:
        masks = np.array([frame.masks[order] for frame in reader if frame.masks is not None][::every])
    truth = read_joints(folder / "truth.h5")
    rig = Rig(tuple(capture.rig[i] for i in order))
    return Sequence3D(rig, capture.up, masks, truth.positions[:frames:every], capture.subject_height_m)


def variants() -> list[tuple[str, int, Variant]]:
    """Return names, views and settings of table 1, then the defaults."""

    def iterations(n: int) -> Variant:
        return replace(PAPER, solver=replace(PAPER.solver, iterations=n))

    blind = replace(PAPER, line_search=replace(PAPER.line_search, ambiguous_px=0.0))
    single = replace(PAPER, solver=replace(PAPER.solver, scales=1, iterations=6))
    return [
        ("paper, no ambiguity weights", 2, blind),
        ("paper", 2, PAPER),
        ("paper", 3, PAPER),
        ("paper", 4, iterations(2)),
        ("paper", 4, PAPER),
        ("paper", 4, iterations(5)),
        ("paper, no ambiguity weights", 4, blind),
        ("paper, single scale", 4, single),
        ("tk", 2, OURS),
        ("tk", 3, OURS),
        ("tk", 4, OURS),
    ]


def track(data: Sequence3D, name: str, views: int, config: Variant) -> tuple[Row, Float]:
    """Track with the first views; return a row of the tables and the joints (F, 15, 3)."""
    rig = Rig(data.rig.cameras[:views])
    empty = np.zeros(0, np.uint8)
    frames = [Frame(i, empty, np.ascontiguousarray(m[:views])) for i, m in enumerate(data.masks)]
    tracker = SilhouetteTracker(rig, data.up, config.settings, config.line_search, config.solver)
    tracker.start(frames[: config.settings.init_frames], Subject(data.height_m))
    estimates = [tracker.step(frame) for frame in frames]
    joints = np.array([e.joints for e in estimates])
    every = max(1, len(frames) // 68)
    grid = RayGrid(data.rig, data.rig.frame_shape[0] // 2)
    body = tracker.body.standing(data.up)
    error = []
    for i in range(0, len(frames), every):
        pose = estimates[i].pose
        error.append(Evidence.of(grid, data.masks[i]).mismatch(body, pose[None])[0])
    found, true = joints[:, ANKLES], data.truth[:, ANKLES]
    off, height = [], []
    for camera in rig:
        pixels = [camera.project(p.reshape(-1, 3))[0] for p in (found, true)]
        off.append(np.linalg.norm(pixels[0] - pixels[1], axis=1).mean())
        crown, ankle = (camera.project(p)[0] for p in (data.truth[:, JOINTS.index("head_top")], true.mean(axis=1)))
        height.append(np.linalg.norm(crown - ankle, axis=1).mean())
    straight = np.linalg.norm(found - true, axis=2).sum(axis=1)
    crossed = np.linalg.norm(found[:, ::-1] - true, axis=2).sum(axis=1)
    # the first step is not typical
    timing = [e.timing for e in estimates[1:]]
    row = Row(
        name=name,
        views=views,
        iterations=config.solver.iterations,
        scales=config.solver.scales,
        error_share=100 * float(np.mean(error)),
        ankle_px=float(np.mean(off)),
        ankle_share=100 * float(np.mean(off) / np.mean(height)),
        joints_cm=100 * float(np.linalg.norm(joints - data.truth, axis=2).mean()),
        swaps=int((crossed < straight).sum()),
        fit_ms=1e3 * float(np.mean([t["optimise"] for t in timing])),
        all_ms=1e3 * float(np.mean([sum(t.values()) for t in timing])),
    )
    return row, joints


def table(rows: Sequence[Row]) -> str:
    """Return the rows as a Markdown table."""
    lines = [
        "| settings | views | iterations × scales | E_S % | ankles px (% of height) | joints cm | swaps "
        "| fit ms | all ms |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.name} | {r.views} | {r.iterations} × {r.scales} | {r.error_share:.1f} | {r.ankle_px:.2f} "
        f"({r.ankle_share:.2f}) | {r.joints_cm:.2f} | {r.swaps} | {r.fit_ms:.1f} | {r.all_ms:.1f} |"
        for r in rows
    ]
    return "\n".join(lines)


def draw_figure(data: Sequence3D, joints: Float, file: Path) -> None:
    """Draw figure 6: the ankles' x in the first view, tracked and ground truth."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    camera = data.rig[0]
    figure, axes = pyplot.subplots(figsize=(9, 3.2), layout="constrained")
    for joint, color in zip(ANKLES, ("tab:red", "tab:blue"), strict=True):
        axes.plot(camera.project(joints[:, joint])[0][:, 0], color=color, label=JOINTS[joint])
        axes.plot(camera.project(data.truth[:, joint])[0][:, 0], ":", color="black", linewidth=1)
    axes.set(xlabel="frame", ylabel=f"x in {camera.name}, pixels")
    axes.legend(loc="upper right")
    figure.savefig(file, dpi=110)
    pyplot.close(figure)


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, help="a capture with masks and truth.h5")
    parser.add_argument(
        "--cameras", default=",".join(CAMERAS), help="four cameras, in the order in which they are added"
    )
    parser.add_argument("--frames", type=int, default=340)
    parser.add_argument("--every", type=int, default=1, help="only every so many frames: faster motion")
    parser.add_argument("--only", help="rows whose name begins with this")
    parser.add_argument("--figure", type=Path, help="write figure 6 here")
    parser.add_argument("--json", type=Path, help="write the rows here too")
    options = parser.parse_args(arguments)
    data = load(options.capture, options.cameras.split(","), options.frames, options.every)
    rows = []
    for name, views, config in variants():
        if options.only is None or name.startswith(options.only):
            row, joints = track(data, name, min(views, len(data.rig)), config)
            rows.append(row)
    print(table(rows))
    if options.figure is not None:
        draw_figure(data, joints, options.figure)
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    return rows


if __name__ == "__main__":
    main()
