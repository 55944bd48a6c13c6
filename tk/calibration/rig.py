"""Calibrate all cameras: intrinsics, connection, bundle adjustment, world frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tk.calibration.boards import Board
from tk.calibration.bundle import UNSYNCHRONISED, Lens, Solved, State, View, adjust
from tk.calibration.connect import Link, connect, find_links
from tk.calibration.footage import FEWEST_SEEN, Footage, choose
from tk.calibration.intrinsics import Fitted, board_poses, fit_lens
from tk.calibration.lens import CHOICE, MODELS
from tk.calibration.misses import explain_miss
from tk.calibration.world import World, place_world
from tk.errors import CalibrationError
from tk.model.cameras.camera import Camera, Rig

Float = NDArray[np.float64]

#: a view contradicts the others if its median error exceeds this many standard deviations, and this many pixels
_CONTRADICTS, _CONTRADICTS_PX = 5.0, 0.7
#: images of two cameras in which the board is less apart are copies, pixels: encoding again moves points by less
_COPY_PX = 1.0
#: default for the largest number of instants
MOST_INSTANTS = 120


@dataclass(frozen=True)
class Options:
    """What the user chooses.

    Attributes:
        model: name of the lens model; None: chosen by held-out views.
        instants: largest number of instants.
        floor: instant in which the board lies on the floor; None: recognise it.
        intrinsics: known cameras, by name.
    """

    model: str | None = None
    instants: int = MOST_INSTANTS
    floor: int | None = None
    intrinsics: Mapping[str, Camera] | None = None


@dataclass(frozen=True)
class Calibrated:
    """Calibrated cameras and what is needed to judge them.

    Attributes:
        board: the board.
        footages: of the cameras.
        fitted: intrinsics of each camera on its own.
        links: pairs of cameras with shared instants.
        solved: the bundle adjustment, in the first camera's frame.
        world: the estimate in the world.
        views: views that were used.
        dropped: views that contradict the others.
        notes: lines for the user.
    """

    board: Board
    footages: tuple[Footage, ...]
    fitted: tuple[Fitted, ...]
    links: tuple[Link, ...]
    solved: Solved
    world: World
    views: tuple[View, ...]
    dropped: tuple[View, ...]
    notes: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(footage.name for footage in self.footages)

    @property
    def rig(self) -> Rig:
        """The cameras in the world."""
        return rig_of(self.world.state, self.footages)


def rig_of(state: State, footages: Sequence[Footage]) -> Rig:
    """Return an estimate's cameras."""
    cameras = []
    for footage, lens, pose in zip(footages, state.lenses, state.cameras, strict=True):
        fx, fy, cx, cy = lens.values[:4]
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        camera = Camera(
            footage.name, footage.width, footage.height, matrix, lens.values[4:].copy(), pose.rotation,
            pose.translation, lens.model.fisheye,
        )  # fmt: skip
        cameras.append(camera)
    return Rig(tuple(cameras))


def calibrate(
    footages: Sequence[Footage], board: Board, options: Options, progress: Callable[[str], None]
) -> Calibrated:
    """Calibrate the cameras.

    Raises:
        CalibrationError: the images determine no calibration; the message names the camera and the remedy.
    """
    for footage in footages:
        if not footage.instants:
            raise CalibrationError(f"{footage.path}: camera {footage.name} has no images")
    missing = [footage for footage in footages if len(footage.seen) < FEWEST_SEEN]
    if missing:
        raise CalibrationError(explain_miss(missing[0], board, [other.name for other in missing[1:]]))
    chosen, notes = choose(footages, options.instants, options.floor)
    views = [_view(c, instant, board, footages[c]) for instant, cameras in chosen.items() for c in cameras]
    _check_copies(views, footages)
    fitted = []
    for c, footage in enumerate(footages):
        progress(f"estimating the intrinsics of camera {footage.name}")
        own = [view for view in views if view.camera == c]
        if len(own) < FEWEST_SEEN:
            raise CalibrationError(
                f"camera {footage.name}: too few views: {len(own)} sharp and different ones; show the board at ten "
                "places and more, tilted, near and far, and hold it still"
            )
        given = None if options.intrinsics is None else _given(options.intrinsics, footage)
        models = [MODELS[options.model]] if options.model else list(CHOICE)
        fitted.append(fit_lens(own, (footage.width, footage.height), models, given))
    for c, one in enumerate(fitted):  # a fit of one camera uses some of its views only
        own = [view for view in views if view.camera == c and view.instant not in one.poses]
        fitted[c] = replace(one, poses={**board_poses(one.lens, own), **one.poses})
    progress("connecting the cameras")
    links = find_links(fitted) if len(footages) > 1 else []
    names = [footage.name for footage in footages]
    state = connect(names, fitted, links)
    views = [view for view in views if view.instant in state.boards]
    progress("adjusting all cameras and boards")
    solved, kept, dropped = _adjust(state, views)
    _check_still_connected(names, kept, dropped)
    _check_sides(names, solved.state, kept)
    world = place_world(solved.state, board, options.floor)
    return Calibrated(
        board, tuple(footages), tuple(fitted), tuple(links), solved, world, tuple(kept), tuple(dropped), tuple(notes)
    )


def _check_copies(views: Sequence[View], footages: Sequence[Footage]) -> None:
    """Refuse two cameras with the same images, as they are after a file was copied under another name.

    Raises:
        CalibrationError: the board's points are at the same pixels in both.
    """
    own: list[dict[int, View]] = [{v.instant: v for v in views if v.camera == c} for c in range(len(footages))]
    for b in range(len(own)):
        for a in range(b):
            shared = own[a].keys() & own[b].keys()
            apart = [_apart_px(own[a][instant], own[b][instant]) for instant in shared]
            if len(apart) > 1 and np.median(apart) < _COPY_PX:
                raise CalibrationError(
                    f"camera {footages[b].name}: has the same images as camera {footages[a].name}: the board is at the "
                    f"same pixels in {len(shared)} instants; was a file copied? Give {footages[b].path} its own images"
                )


def _apart_px(a: View, b: View) -> float:
    """Return the median distance of the points that two images show, pixels; infinite without any."""
    _, of_a, of_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    return float(np.median(np.linalg.norm(a.pixels[of_a] - b.pixels[of_b], axis=1))) if len(of_a) else np.inf


def _view(c: int, instant: int, board: Board, footage: Footage) -> View:
    seen = footage.seen[instant]
    ids = seen.detection.ids
    return View(c, instant, board.points[ids], seen.detection.pixels, ids, seen.motion_px)


def _given(known: Mapping[str, Camera], footage: Footage) -> Lens:
    """Return the lens of a known camera, scaled to the images' size.

    Raises:
        CalibrationError: the camera is unknown, or its images have another shape.
    """
    if footage.name not in known:
        raise CalibrationError(f"--intrinsics: has no camera {footage.name}; it has {', '.join(known)}")
    camera = known[footage.name]
    scale = footage.width / camera.width
    if abs(camera.height * scale - footage.height) > 1:
        raise CalibrationError(
            f"--intrinsics: camera {footage.name} has images of {camera.width}×{camera.height}; those in "
            f"{footage.path} are {footage.width}×{footage.height}, another shape: calibrate its intrinsics again"
        )
    if camera.matrix[0, 1] != 0.0:
        raise CalibrationError(
            f"--intrinsics: camera {footage.name} has a skew of {camera.matrix[0, 1]:.3g} pixels, which tk calibrate "
            "does not estimate: calibrate its intrinsics again"
        )
    model = MODELS["fisheye" if camera.fisheye else "pinhole8" if len(camera.distortions) == 8 else "pinhole5"]
    distortion = np.zeros(model.size - 4)
    distortion[: len(camera.distortions)] = camera.distortions
    fx, fy, (cx, cy) = camera.matrix[0, 0], camera.matrix[1, 1], camera.matrix[:2, 2] + 0.5
    values = np.concatenate([scale * np.array([fx, fy, cx, cy]) - np.array([0, 0, 0.5, 0.5]), distortion])
    return Lens(model, values, values, footage.width, 1.0, np.ones(model.size, bool))


def _adjust(state: State, views: Sequence[View]) -> tuple[Solved, list[View], list[View]]:
    """Adjust the estimate, without views that contradict the others."""
    kept, dropped = list(views), list[View]()
    solved = adjust(state, kept, noise_px=0.5)
    while True:
        # of one instant the worst view only: it may have moved the board of the others
        worst: dict[int, tuple[float, View]] = {}
        for view in kept:
            blur = UNSYNCHRONISED * view.motion_px
            error = float(np.median(np.linalg.norm(solved.state.errors(view), axis=1)))
            limit = max(_CONTRADICTS * float(np.hypot(solved.noise_px, blur)), _CONTRADICTS_PX)
            if error > limit and error > worst.get(view.instant, (0.0, view))[0]:
                worst[view.instant] = error, view
        if not worst:
            return solved, kept, dropped
        bad = {id(view) for _, view in worst.values()}
        dropped += [view for view in kept if id(view) in bad]
        kept = [view for view in kept if id(view) not in bad]
        instants = {view.instant for view in kept}
        boards = {i: pose for i, pose in solved.state.boards.items() if i in instants}
        solved = adjust(replace(solved.state, boards=boards), kept, solved.noise_px)


def _check_still_connected(names: Sequence[str], kept: Sequence[View], dropped: Sequence[View]) -> None:
    """Refuse cameras that contradict the others in so many views that the rest do not connect them.

    Raises:
        CalibrationError: names the smaller group of cameras.
    """
    groups = [{c} for c in range(len(names))]
    for instant in {view.instant for view in kept}:
        cameras = {view.camera for view in kept if view.instant == instant}
        joined = set[int]().union(*(group for group in groups if group & cameras))
        groups = [*(group for group in groups if not group & cameras), joined]
    apart = sorted(set(range(len(names))) - max(groups, key=len))
    if apart:
        views = (*kept, *dropped)
        others = {view.instant for view in views if view.camera not in apart}
        count = len({view.instant for view in views if view.camera in apart} & others)
        which = ", ".join(names[c] for c in apart)
        raise CalibrationError(
            f"camera {which}: contradicts the others in all {count} instants that they share: the images "
            "are of other instants, another board is in view, or the camera was moved"
        )


def _check_sides(names: Sequence[str], state: State, views: Sequence[View]) -> None:
    """Exclude the mirrored solution, in which boards lie behind a camera or show their back.

    Raises:
        CalibrationError: a camera has such views.
    """
    wrong: dict[int, int] = {}
    for view in views:
        pose = state.pose(view)
        seen = pose.apply(view.points)
        facing = pose.rotation[:, 2] @ seen.mean(axis=0) > 0  # z of the board points into the paper
        if seen[:, 2].min() <= 0 or not facing:
            wrong[view.camera] = wrong.get(view.camera, 0) + 1
    for c, count in wrong.items():
        if 3 * count > sum(view.camera == c for view in views):
            raise CalibrationError(
                f"camera {names[c]}: the solution is mirrored: {count} boards lie behind it or show their back; are "
                "its images mirrored?"
            )
