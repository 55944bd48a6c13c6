"""Single stages of both trackers on a frame in memory, for :mod:`scripts.bench`: contour cues, silhouette solver."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tk.io.captures.capture import Capture
from tk.io.captures.frames import FrameSet
from tk.io.results.data import Result
from tk.kernels.edge_search import search_edges
from tk.kernels.nearest import SurfaceIndex
from tk.kernels.raycast import Cast
from tk.kernels.silhouette import descend, normal_equations
from tk.model.body.limb_candidates import limbs_of
from tk.model.cues.edge_term import THRESHOLD, ContourTerm
from tk.model.cues.objective import COVERAGE_VOXELS, BodyObjective
from tk.model.cues.ray_costs import Evidence, RayGrid
from tk.model.masks.silhouettes import Pyramid, Views
from tk.optim import gauss_newton
from tk.settings import Settings
from tk.trackers.bodies import body_and_poses
from tk.trackers.contour_finder import COARSE_ROWS, LINE_SEARCH, SOLVER
from tk.trackers.proposals.limbs import NEARBY

Float = np.ndarray


@dataclass(frozen=True)
class Stage:
    """Milliseconds of one piece of work, and of the same work by ``peers``: name → milliseconds."""

    name: str
    ms: float
    peers: dict[str, float]

    @property
    def ratios(self) -> dict[str, float]:
        """How many times longer each peer takes."""
        return {name: ms / self.ms for name, ms in self.peers.items()}


def median_ms(call: Callable[[], object], repeats: int = 20) -> float:
    """Median milliseconds of a call, after one that does not count."""
    call()
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - started)
    return 1e3 * statistics.median(seconds)


def contour_stages(
    objective: BodyObjective,
    capture: Capture,
    config: Settings,
    frame: FrameSet,
    pose: Float,
    index: SurfaceIndex,
) -> Iterator[Stage]:
    """The volumetric tracker's edge term at a pose (D,): contours, search, and what its entries cost."""
    poses = pose[None]
    images = frame.images
    term = ContourTerm(objective.body, capture.rig, config.volumetric.edge_weight)
    chosen = term.draw(None)
    chosen = chosen[chosen >= 0][None]
    views = len(capture.rig)
    yield Stage(
        f"contours: {chosen.size} strips in {views} views, one launch",
        median_ms(lambda: term.kernel(poses, chosen)),
        {},
    )
    *_, lines = term.pairs(term.kernel(poses, chosen))
    search = partial(search_edges, images, term.sizes, lines, THRESHOLD)
    yield Stage(f"colour edges: search on demand along {len(lines)} lines", median_ms(search), {})
    yield Stage(
        "colour edges: contours, pairs, search and entries", median_ms(lambda: term.assign(images, poses, chosen)), {}
    )
    entries = term.assign(images, poses, chosen)
    rng = np.random.default_rng(0)
    samples, voxels = objective.draw(rng), rng.integers(len(index.positions), size=COVERAGE_VOXELS)
    rows = samples[None].astype(np.int32), voxels[None].astype(np.int32)
    settings = objective.settings
    for text, given in (("without entries", None), (f"and {entries.shape[1]} alignment entries", entries)):
        *_, held = objective.kernel.evaluate(index, *rows, poses, poses, settings, entries=given)
        evaluate = partial(objective.kernel.evaluate, index, *rows, poses, poses, settings, entries=given)
        linearise = partial(
            objective.kernel.linearise, index, rows[0][0], rows[1][0], pose, held, settings,
            entries=given,
        )  # fmt: skip
        yield Stage(f"objective {text}: value, gradient, H·v", median_ms(evaluate), {})
        yield Stage(f"objective {text}: Gauss-Newton Hessian", median_ms(linearise), {})


def silhouette_stages(
    capture: Capture, frames: Sequence[FrameSet], masks: Sequence[np.ndarray], result: Result
) -> list[Stage]:
    """The silhouette tracker's work on consecutive frames with masks (V, H, W) each, two frames at least.

    Every frame but the first starts where the tracker would: at the pose before it.
    """
    found_body = body_and_poses(result)
    assert found_body is not None
    body, tracked = found_body
    views = Views(capture.rig)
    scales = SOLVER.scales
    pyramids = [views.pyramid(frame, scales, True) for frame in masks[1:]]
    row_of = {int(index): row for row, index in enumerate(result.frames)}
    poses = tracked[[row_of[frame.index] for frame in frames[:-1]]]
    last, pose = pyramids[-1], poses[-1][None]
    limb = limbs_of(body)[0]
    variants = limb.candidates(pose[0], NEARBY, np.random.default_rng(0))
    evidence = Evidence.of(RayGrid(capture.rig, COARSE_ROWS), last.masks[0])
    drawn = np.setdiff1d(np.arange(len(body.parts), dtype=np.int32), limb.parts)
    _, rest = evidence.cast(body, pose, drawn)
    others = Cast(rest.label[0], rest.depth[0])
    limits = None, body.skeleton.lower, body.skeleton.upper

    def fit(start: Float, pyramid: Pyramid) -> Float:
        return gauss_newton.minimise(
            lambda states, scale, steps: descend(body.arrays, views.at(pyramid, scale), states, LINE_SEARCH, steps),
            start[None], *limits, SOLVER,
        )  # fmt: skip

    def equations(scale: int, window_px: float) -> float:
        search = replace(LINE_SEARCH, window_px=window_px)
        return median_ms(lambda: normal_equations(body.arrays, views.at(last, scale), pose, search))

    window = LINE_SEARCH.window_px
    found = [Stage("masks cleaned, scales", median_ms(lambda: views.pyramid(masks[-1], scales, True)), {})]
    found += [
        Stage(f"contours, search, equations: 1/{2**scale} scale, one launch", equations(scale, window), {})
        for scale in reversed(range(scales))
    ]
    found += [
        Stage("the same in full scale, search one pixel far", equations(0, 1.0), {}),
        Stage(
            f"fit: {scales} scales of {SOLVER.iterations} iterations",
            statistics.median(median_ms(partial(fit, *frame), 3) for frame in zip(poses, pyramids, strict=True)),
            {},
        ),
        Stage("E_S of a pose", median_ms(lambda: evidence.mismatch(body, pose)), {}),
        Stage(
            f"E_S of {len(variants)} places of an arm",
            median_ms(lambda: evidence.mismatch(body, variants, limb.parts, others)),
            {},
        ),
    ]
    return found
