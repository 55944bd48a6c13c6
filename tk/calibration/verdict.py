"""Judge a calibration: pixels, millimetres at the person, coverage, connections, what the data determine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.calibration.intrinsics import LEAST_RANGE
from tk.calibration.lens import prior, project
from tk.calibration.poses import cross
from tk.calibration.rig import Calibrated
from tk.calibration.zoom import largest_change
from tk.errors import VolumeError
from tk.model.cameras.camera import Rig
from tk.model.cameras.common_view import closest_to_axes, common_boxes, sample_box

Float = NDArray[np.float64]

LEVELS = ("good", "usable", "do not use")

# Thresholds; docs/calibrate.md lists them.
#: root-mean-square error of a camera's points, pixels: good, usable
RMS_PX = (0.5, 2.0)
#: expected error of a triangulated point at the person, metres: good, usable
ERROR_M = (0.010, 0.025)
#: share of a camera's shared views that contradict the others: good, usable
CONTRADICTING = (0.15, 0.35)
#: instants that a camera shares with others: good, usable
SHARED = (4, 2)
#: share of the image with points: good. Outside of it the distortion is extrapolated.
COVERED = 0.35
#: relative standard deviation of a focal length, and its change within a recording: good, usable
FOCAL = (0.005, 0.02)
#: share of the volume with a board nearby that two cameras see: good
FILLED = 0.3
#: a board is near a point within this distance, metres
_NEAR_M = 0.6
#: cells of the image, across and down, in which points are counted
CELLS = (8, 6)
#: an intrinsic is determined by the data if its standard deviation is below this share of its prior's
_DETERMINED = 0.5
#: half the side of the space of a person, metres, where the cameras give no smaller one
_PERSON_M = 1.0


@dataclass(frozen=True)
class CameraVerdict:
    """One camera.

    Attributes:
        name: the camera.
        model: of its lens.
        views, points: used.
        contradicting: views that contradict the others.
        shared: instants that another camera sees, too.
        rms_px: root-mean-square distance of its points from their projections.
        rms_m: the same at the person, metres.
        focal_px, focal_sigma: focal length, and its relative standard deviation.
        covered: share of the image with points.
        near_m, far_m: distance of the nearest and the farthest board.
        how: "free", "held" or "given", see tk.calibration.intrinsics.Fitted.
        by_prior: intrinsics that priors determine, not the data.
        held_out_px: error in held-out views, by lens model.
    """

    name: str
    model: str
    views: int
    points: int
    contradicting: int
    shared: int
    rms_px: float
    rms_m: float
    focal_px: float
    focal_sigma: float
    covered: float
    near_m: float
    far_m: float
    how: str
    by_prior: tuple[str, ...]
    held_out_px: dict[str, float]


@dataclass(frozen=True)
class Verdict:
    """The judgement.

    Attributes:
        level: index in LEVELS.
        reasons: why it is not good, each with its level and camera; empty if good.
        cameras: one entry a camera.
        error_m: expected error of a triangulated point at the person, metres, root mean square.
        filled: share of the person's space with a board nearby that two cameras see.
        pairs: cameras with shared instants: names, instants, those that agree.
        world: how the world frame was found.
        apart_m: two cameras and their distance, to check with a tape.
        heights_m: heights of the cameras above the floor.
        notes: further lines.
    """

    level: int
    reasons: tuple[tuple[int, str], ...]
    cameras: tuple[CameraVerdict, ...]
    error_m: float
    filled: float
    pairs: tuple[tuple[str, str, int, int], ...]
    world: str
    apart_m: tuple[str, str, float] | None
    heights_m: tuple[float, ...]
    notes: tuple[str, ...]

    @property
    def word(self) -> str:
        """The verdict in words."""
        return LEVELS[self.level]

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON; numbers that are unknown are None."""

        def number(x: float) -> float | None:
            return float(x) if np.isfinite(x) else None

        return {
            "verdict": self.word,
            "reasons": [text for _, text in self.reasons],
            "error_mm": number(1000 * self.error_m),
            "volume_filled": number(self.filled),
            "world": self.world,
            "cameras": [
                {
                    "name": one.name, "model": one.model, "views": one.views, "points": one.points,
                    "contradicting": one.contradicting, "shared": one.shared, "rms_px": number(one.rms_px),
                    "rms_mm": number(1000 * one.rms_m), "focal_px": one.focal_px,
                    "focal_sigma": number(one.focal_sigma), "covered": one.covered, "near_m": number(one.near_m),
                    "far_m": number(one.far_m), "intrinsics": one.how, "by_prior": list(one.by_prior),
                    "held_out_px": one.held_out_px,
                }
                for one in self.cameras
            ],
            "pairs": [{"cameras": [a, b], "shared": n, "agree": m} for a, b, n, m in self.pairs],
        }  # fmt: skip


def judge(done: Calibrated) -> Verdict:
    """Judge a calibration."""
    rig, points = done.rig, person_points(done.rig)
    covariance = done.solved.covariance()
    error = _expected_error(done, rig, points, covariance) if len(rig) > 1 else np.nan
    cameras = tuple(_camera(done, c, rig, points, covariance) for c in range(len(rig)))
    filled = _filled(done, points) if len(rig) > 1 else np.nan
    pairs = tuple((done.names[x.one], done.names[x.other], len(x.shared), len(x.agreeing)) for x in done.links)
    centers = rig.centers
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    a, b = np.unravel_index(int(apart.argmax()), apart.shape)
    tape = (done.names[a], done.names[b], float(apart[a, b])) if len(rig) > 1 else None
    reasons = _reasons(cameras, error, filled, centers[:, 2], len(rig) > 1, done)
    level = max((level for level, _ in reasons), default=0)
    return Verdict(
        level, tuple(sorted(reasons, key=lambda r: -r[0])), cameras, float(error), float(filled), pairs, done.world.how,
        tape, tuple(centers[:, 2].tolist()), done.notes,
    )  # fmt: skip


def person_points(rig: Rig) -> Float:
    """Return points (N, 3) of the person's space that two cameras see, metres: where the cameras look, up to 2 m high.

    Empty if no two cameras see a common space.
    """
    if len(rig) < 2:
        depth = rig[0].rotation[2]
        return np.asarray(rig.centers[:1] + 3.0 * depth)
    try:
        middle = closest_to_axes(rig)
        boxes = list(common_boxes(rig))
    except VolumeError:
        middle = rig.centers.mean(axis=0)
        boxes = []
    points = sample_box(boxes[0][1], 7) if boxes else middle + np.array([[0.0, 0.0, 0.0]])
    points = points[(np.abs(points - middle) <= _PERSON_M + 0.25).all(axis=1)]
    low = points[:, 2] < -0.05
    points = points[~low] if (~low).any() else points
    seen = np.sum([camera.sees(points) for camera in rig], axis=0) >= 2
    return points[seen] if seen.any() else np.zeros((0, 3))


def _expected_error(done: Calibrated, rig: Rig, points: Float, covariance: Float) -> float:
    """Return the expected error of points triangulated by all cameras that see them, metres, root mean square.

    The covariance of the cameras is propagated to the points; a common motion of all points is no error.
    """
    if not len(points):
        return float("nan")
    state, solved = done.solved.state, done.solved
    # points in the frame of the bundle adjustment
    back = state.cameras[0].inverse() @ done.world.state.cameras[0]
    there = back.apply(points)
    seen = np.array([camera.sees(points) for camera in rig])
    G = np.zeros((len(points), 3, len(covariance)))
    H = np.zeros((len(points), 3, 3))
    for c, (lens, camera, place) in enumerate(zip(state.lenses, state.cameras, solved.slices, strict=True)):
        turned = there @ camera.rotation.T
        _, by_point, by_lens = project(lens.model, lens.values, turned + camera.translation)
        by_camera = np.concatenate([-by_point @ cross(turned), by_point, by_lens], axis=2)
        by_world = by_point @ camera.rotation
        use = seen[c][:, None, None]
        H += np.where(use, np.einsum("nki,nkj->nij", by_world, by_world), 0.0)
        G[:, :, place] -= np.where(use, np.einsum("nki,nks->nis", by_world, by_camera), 0.0)
    good = np.linalg.cond(H) < 1e6
    if not good.any():
        return float("nan")
    G, there = np.linalg.solve(H[good], G[good]), there[good]
    modes = np.concatenate([np.tile(np.eye(3), (len(there), 1, 1)), -cross(there - there.mean(axis=0))], axis=2)
    flat = modes.reshape(-1, 6)
    moves = G.reshape(len(flat), -1)
    moves = moves - flat @ np.linalg.lstsq(flat, moves, rcond=None)[0]
    return float(np.sqrt(np.einsum("is,st,it->", moves, covariance, moves, optimize=True) / len(there)))


def _blame(done: Calibrated) -> list[list[int]]:
    """Return for each camera the instants whose contradiction it explains.

    Where two cameras and more agree, the other views of the instant are wrong. Two cameras that contradict each other
    do not tell which one is wrong: the camera that takes part in most contradictions explains them, then the one in
    most of the others, and so on.
    """
    agree: dict[int, set[int]] = {}
    for view in done.views:
        agree.setdefault(view.instant, set()).add(view.camera)
    suspects: dict[int, set[int]] = {}  # of the instants where nobody agrees
    cases: list[tuple[int, set[int]]] = []
    for view in done.dropped:
        if len(agree.get(view.instant, ())) > 1:
            cases.append((view.instant, {view.camera}))
        else:
            suspects.setdefault(view.instant, set(agree.get(view.instant, ()))).add(view.camera)
    cases += suspects.items()
    found: list[list[int]] = [[] for _ in done.names]
    taken = [sum(view.camera == c for view in (*done.views, *done.dropped)) for c in range(len(found))]
    while cases:
        counts = [sum(c in cameras for _, cameras in cases) for c in range(len(found))]
        # of two with as many, the one with fewer other views
        worst = max(range(len(found)), key=lambda c: (counts[c], counts[c] / max(taken[c], 1)))
        found[worst] = sorted(instant for instant, cameras in cases if worst in cameras)
        cases = [(instant, cameras) for instant, cameras in cases if worst not in cameras]
    return found


def _camera(done: Calibrated, c: int, rig: Rig, points: Float, covariance: Float) -> CameraVerdict:
    state, fitted, footage = done.solved.state, done.fitted[c], done.footages[c]
    views = [view for view in done.views if view.camera == c]
    errors = [state.errors(view) for view in views]
    inside = np.concatenate([(e**2).sum(axis=1) for e in errors]) if errors else np.full(1, np.nan)
    # a few wrong corners are down-weighted in the adjustment: they must not dominate the figure
    inside = np.sort(inside)[: max(1, round(0.98 * len(inside)))]
    rms = float(np.sqrt(inside.mean()))
    camera, lens = rig[c], state.lenses[c]
    middle = points.mean(axis=0) if len(points) else camera.center + 3 * camera.rotation[2]
    place = done.solved.slices[c]
    own = covariance[place.start + 6 : place.stop, place.start + 6 : place.stop]
    sigma = np.sqrt(np.maximum(np.diag(own), 0.0))
    H, _ = prior(lens.model, lens.values, lens.start, lens.width, lens.focal_sigma)
    before = np.sqrt(np.diag(np.linalg.inv(H)))
    names = ("fx", "fy", "cx", "cy", *lens.model.names)
    undetermined = lens.held | (sigma > _DETERMINED * before)
    given = fitted.how == "given"
    by_prior = () if given else tuple(name for name, bad in zip(names, undetermined, strict=True) if bad)
    others = {view.instant for view in (*done.views, *done.dropped) if view.camera != c}
    shared = {v.instant for v in (*done.views, *done.dropped) if v.camera == c} & others
    blamed = _blame(done)[c]
    pixels = np.concatenate([view.pixels for view in views]) if views else np.zeros((0, 2))
    return CameraVerdict(
        footage.name, lens.model.name, len(views), sum(len(view.points) for view in views),
        len(blamed), len(shared - set(blamed)), rms,
        rms / camera.pixels_per_metre(middle), float(lens.values[0]),
        0.0 if given else float(sigma[0] / lens.values[0]),
        _covered(pixels, footage.width, footage.height), fitted.near_m, fitted.far_m, fitted.how, by_prior,
        fitted.held_out_px,
    )  # fmt: skip


def _covered(pixels: Float, width: int, height: int) -> float:
    """Return the share of the image's cells that hold a point."""
    counts, _, _ = np.histogram2d(pixels[:, 0], pixels[:, 1], bins=CELLS, range=((0, width), (0, height)))
    return float((counts > 0).mean())


def _filled(done: Calibrated, points: Float) -> float:
    if not len(points):
        return 0.0
    number: dict[int, int] = {}
    for view in done.views:
        number[view.instant] = number.get(view.instant, 0) + 1
    boards = [
        done.world.state.boards[i].apply(done.board.corners).mean(axis=0) for i, count in number.items() if count > 1
    ]
    if not boards:
        return 0.0
    apart = np.linalg.norm(points[:, None] - np.array(boards), axis=2).min(axis=1)
    return float((apart < _NEAR_M).mean())


def _reasons(
    cameras: tuple[CameraVerdict, ...], error: float, filled: float, heights: Float, several: bool, done: Calibrated
) -> list[tuple[int, str]]:
    """Return what keeps a calibration from being good: level, and a line with the remedy."""
    found: list[tuple[int, str]] = []

    def check(value: float, limits: tuple[float, float], text: str, upwards: bool = False) -> None:
        bad = [value < limit if upwards else not value <= limit for limit in limits]
        if any(bad):
            found.append((sum(bad), text))

    for one in cameras:
        name = f"camera {one.name}"
        check(
            one.rms_px, RMS_PX, f"{name}: its points are {one.rms_px:.2f} px off; is the board flat, the video sharp?"
        )
        if one.how != "given":
            check(
                one.focal_sigma, FOCAL,
                f"{name}: its focal length is known to {100 * one.focal_sigma:.1f} % only; show the board near "
                "and far, and tilted",
            )  # fmt: skip
            if one.how == "held":
                found.append((1, f"{name}: {_held(one)}"))
            elif one.covered < COVERED:
                found.append((
                    1, f"{name}: points cover {100 * one.covered:.0f} % of its image; show the board in its corners"
                ))  # fmt: skip
        if several:
            check(
                one.shared, SHARED,
                f"{name}: shares {one.shared} instants with others; show the board where another camera sees it, too",
                upwards=True,
            )  # fmt: skip
            all_views = one.shared + one.contradicting
            if all_views:
                check(
                    one.contradicting / all_views, CONTRADICTING,
                    f"{name}: {one.contradicting} of {all_views} views contradict the others{_when(done, one.name)}",
                )  # fmt: skip
    if (change := largest_change(done)) is not None:
        c, share, when = change
        check(
            abs(share), FOCAL,
            f"camera {done.names[c]}: its focal length is {100 * abs(share):.1f} % "
            f"{'larger' if share > 0 else 'smaller'} {when}: was it zoomed or focused? Fix both, and "
            "record the board again",
        )  # fmt: skip
    if several:
        shown = f"{1000 * error:.1f} mm" if np.isfinite(error) else "unknown"
        check(
            error, ERROR_M,
            f"the expected error at the person is {shown}; show the board at more places, larger or nearer",
        )  # fmt: skip
        if not filled >= FILLED:
            found.append((
                1, f"boards fill {100 * filled:.0f} % of the space where the person is; show it in the rest, too"
            ))  # fmt: skip
        low = [one.name for one, height in zip(cameras, heights, strict=True) if height < 0]
        if low and done.world.floor is not None:
            found.append((2, f"camera {', '.join(low)}: would be below the floor: the solution is mirrored"))
    return found


def _held(one: CameraVerdict) -> str:
    if one.far_m < LEAST_RANGE * one.near_m:
        return (
            f"nearest and farthest board are at {one.near_m:.1f} and {one.far_m:.1f} m, less than a factor of "
            f"{LEAST_RANGE:g}: only focal length, k1 and k2 are estimated; show the board close to it, too, or give "
            "--intrinsics"
        )
    return f"{one.views} views: only focal length, k1 and k2 are estimated; show the board at more places"


def _when(done: Calibrated, name: str) -> str:
    """Return a guess at why views contradict the others, from when they were taken."""
    c = done.names.index(name)
    bad = _blame(done)[c]
    others = {view.instant for view in done.views if view.camera != c}
    good = sorted({view.instant for view in done.views if view.camera == c} & others - set(bad))
    asked = "was the camera moved or zoomed there?"
    if bad and good and bad[0] > good[-1]:
        return f", all from instant {bad[0]} on: {asked} Calibrate again with the images after it"
    if bad and good and bad[-1] < good[0]:
        return f", all up to instant {bad[-1]}: {asked} Use the images after it"
    return ": the board was moved, the images are of other instants, or another board is in view"
