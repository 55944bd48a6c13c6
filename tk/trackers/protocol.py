"""The protocol of the trackers, and what goes in and out of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from tk.io.results.status import Status
from tk.kernels.mask_values import PERSON
from tk.trackers.reason import Reason, known_sigma, status_of

if TYPE_CHECKING:  # the process that decodes and segments needs no parts of a tracker
    from tk.model.body.cone_body import ConeBody
    from tk.model.hull.hull import HullSurface
    from tk.model.setup import Setup, Subject
    from tk.settings import Settings
    from tk.trackers.contour_tracker import ContourTracker
    from tk.trackers.region import RegionTracker

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """One time index: images, masks and landmarks of all cameras, for one subject.

    Attributes:
        index: number of the frame in its source.
        images: (C, h, w, 3) uint8 BGR: of the masks' size, or reduced; see :attr:`Tracker.image_step`.
        masks: (C, H, W) uint8, 255 where the subject is, :data:`~tk.kernels.mask_values.OTHERS` where another person
            is who may hide the subject, else 0. A body part on another person costs nothing.
        uncertain: (C, H, W) bool, pixels whose mask is 0 although they may show the subject: a shadow, or clothes of
            the scene's colour. A body part there costs half. None if unknown.
        time: time stamp of the source, seconds.
        sources: (C,) uint8, where a segmenter's masks come from, see :mod:`tk.run.learned_masks`; None for others.
        landmarks: (N, C, L, 4) x, y, pixels, visibility and depth of the landmarks of N people in view, see
            :mod:`tk.model.cues.landmarks`; NaN where they are unknown. None if no network saw this frame.
        people: (C, H, W) uint8, bit n: the network's mask of person n of ``landmarks`` shows the pixel. None if no
            network saw this frame.
        ask: returns the landmarks (C, L, 4) of the person whose landmarks are expected at places (L, 3), world frame,
            metres, or None; None if no network can be asked.
        doubt: (C, h, w) in [0, 1], on the tracker's ``fine_grid``: by how much likelier, by its colour, a pixel is
            another person's than its owner's (see :func:`~tk.model.cues.part_colors.deficit`): of a pixel of the
            subject any other person's, of other pixels the subject's. None if nothing is in doubt.
    """

    index: int
    images: NDArray[np.uint8]
    masks: NDArray[np.uint8]
    uncertain: NDArray[np.bool_] | None = None
    time: float = 0.0
    sources: NDArray[np.uint8] | None = None
    landmarks: NDArray[np.float64] | None = None
    people: NDArray[np.uint8] | None = None
    ask: Callable[[Float], Float | None] | None = None
    doubt: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Estimate:
    """A tracker's answer for one frame.

    Attributes:
        pose: (D,) pose vector, radians and metres, in the order of the tracker's ``pose_names``.
        joints: (J, 3) joint centres, metres. Pose and joints are NaN before anybody is tracked.
        origin: how the tracker came to the pose: TRACKED, INITIALISED or RECOVERED; ABSENT (by the run) if nobody is
            there.
        objective: the objective's final value; of contour trackers E_S, mean over the views.
        iterations: (S,) optimiser iterations by stage; for ``search`` 1 if limbs were searched, else 0.
        timing: seconds by stage.
        surface: the hull's surface, if the tracker made one.
        deviation: (J,) m, standard deviation of each joint position along one axis, as computed: also where the reason
            says that it is not known. None if the tracker does not report it.
        modes: (M, D) other poses of the limbs that the frame leaves open, see
            :func:`tk.trackers.proposals.limbs.others`; None if no limb was searched for.
        residual: (C, 2) missing area (body outside the mask) and surplus area (mask outside the body) by camera, shares
            of the person's pixels, NaN for a camera that was not used; their sum is E_S. None if not measured.
        masks: (C, H, W) uint8, what the tracker took for the person, cleaned; None where that is the observation's, and
            in what :func:`tk.track` hands out. drawn: (C, h, w) bool, where the body is on the tracker's grid of rays,
            cameras left out included; colors: (C, h, w) what the masks show there, see
            :meth:`tk.model.cues.ray_costs.Evidence.packed_colors`; None likewise.
        mask_source: (C,) uint8, as ``Frame.sources``.
        landmarks: (C, L, 4) those of this person among ``Frame.landmarks``; None if there are none.
        found: the reason that the frame itself shows.
        judged: the reason by the last frames, too; None before the frame is judged.
        cameras: (C,) uint8, which cameras were left out, and why: indices in :data:`~tk.trackers.judgement.STATES`.
            None before anybody is tracked.
        shift: (C,) by which share of its longer side each image has moved since the first frame; NaN if unknown. None
            before anybody is tracked.
        frame, time: the frame's number in the capture, and seconds; whoever steps the tracker knows them.
        person: the person's number in the run.
    """

    pose: Float
    joints: Float
    origin: Status
    objective: float
    iterations: NDArray[np.int32]
    timing: Mapping[str, float]
    surface: HullSurface | None = None
    deviation: Float | None = None
    modes: Float | None = None
    residual: Float | None = None
    masks: NDArray[np.uint8] | None = None
    drawn: NDArray[np.bool_] | None = None
    colors: NDArray[np.uint16] | None = None
    mask_source: NDArray[np.uint8] | None = None
    landmarks: Float | None = None
    found: Reason = Reason.NONE
    judged: Reason | None = None
    cameras: NDArray[np.uint8] | None = None
    shift: Float | None = None
    frame: int = -1
    time: float = 0.0
    person: int = 0

    @property
    def light(self) -> Estimate:
        """The estimate without what is large, or a view into the ring of frames."""
        return replace(self, masks=None, drawn=None, colors=None)

    @property
    def reason(self) -> Reason:
        """Why the frame is lost, suspect or without sigma; NONE if it is not."""
        return self.found if self.judged is None else self.judged

    @property
    def status(self) -> str:
        """The name of its status: "tracked", "initialised", "recovered", "lost", "suspect" or "absent"."""
        return Status(int(status_of(self.origin, self.reason))).name.lower()

    @property
    def sigma(self) -> Float | None:
        """(J,) m, standard deviation of each joint position along one axis; NaN if it is not known, None if the tracker
        does not report it."""
        return None if self.deviation is None else known_sigma(self.deviation, self.reason)


class Tracker(Protocol):
    """Tracks one subject from frame to frame. Poses are those of the setup's world, except in :attr:`state`.

    Attributes:
        State, state: a frozen dataclass, and what changes from frame to frame, see :class:`tk.model.stateful.Stateful`.
        method: name in :data:`tk.trackers.registry.METHODS`.
        stages, timing_stages: names of the entries of ``Estimate.iterations``, and of ``Estimate.timing``.
        pose_names, pose_units: (D,) names and units of the entries of the pose vector.
        objective_kind: meaning of ``Estimate.objective``.
        image_step: pixels of the cameras along an edge of a pixel of the images that it looks at, 1 or 2; 0: it looks
            at masks alone.
        reports_sigma: whether estimates have sigma and residual.
        has_segments: whether segments, feet, joint angles and a smoothed copy are derived from its poses.
        has_second_pass: whether it goes over the frames a second time when all of them are known, as
            :class:`~tk.trackers.region.RegionTracker`.
        tracks_among_others: whether it does without the pixels of other people, see :class:`Frame`, as
            :class:`~tk.trackers.contour_tracker.ContourTracker`. A visual hull needs whole masks.
    """

    State: ClassVar[type[Any]]
    state: Any
    method: str
    stages: tuple[str, ...]
    timing_stages: tuple[str, ...]
    pose_names: tuple[str, ...]
    pose_units: tuple[str, ...]
    objective_kind: str
    image_step: int
    reports_sigma: bool
    has_segments: bool
    has_second_pass: bool
    tracks_among_others: bool

    @classmethod
    def of(cls, setup: Setup, settings: Settings) -> Tracker:
        """Return a new tracker with the settings of this method."""
        ...

    @property
    def opening_frames(self) -> int:
        """Number of frames for :meth:`start`."""
        ...

    @property
    def body(self) -> ConeBody:
        """The subject's body; only after :meth:`start` or :meth:`take_model`."""
        ...

    def prepare(self, with_landmarks: bool) -> None:
        """Compile kernels while there is nothing else to do; ``with_landmarks``: the frames will have some."""
        ...

    def anticipate(self, frame: Frame, subject: Subject) -> None:
        """Search for the subject in a frame before those after it are there. If :meth:`start` begins with this frame,
        it takes what is found."""
        ...

    def start(self, frames: Sequence[Frame], subject: Subject) -> None:
        """Find the subject in the first of ``frames`` and fit the body. The first :meth:`step` is for that frame, too.

        Args:
            frames: consecutive observations.
            subject: what is known of the person.
        """
        ...

    def step(self, frame: Frame) -> Estimate:
        """Estimate the pose in the next frame."""
        ...

    def model(self) -> Mapping[str, Any]:
        """Return the fitted body, for `/model` of the result."""
        ...

    def take_model(self, model: Mapping[str, Any]) -> None:
        """Take the body of a run; the caller then sets the state."""
        ...


def two_pass(tracker: Tracker) -> RegionTracker | None:
    """Return the tracker if it has a second pass, else None."""
    return cast("RegionTracker", tracker) if tracker.has_second_pass else None


def sharing(tracker: Tracker) -> ContourTracker[Any] | None:
    """Return the tracker if it can track a person among others, else None."""
    return cast("ContourTracker[Any]", tracker) if tracker.tracks_among_others else None


def shows_person(masks: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return (C,) whether each mask (C, H, W) shows the subject."""
    return np.asarray(masks.reshape(len(masks), -1).max(axis=1) >= PERSON)


def without_cameras(frame: Frame, out: NDArray[np.bool_]) -> Frame:
    """Return the frame with empty masks in some cameras (C,)."""
    if not out.any():
        return frame
    masks = frame.masks.copy()
    masks[out] = 0
    uncertain = frame.uncertain
    if uncertain is not None:
        uncertain = uncertain.copy()
        uncertain[out] = False
    images = frame.images
    if images.size:  # a single colour has no edges
        images = images.copy()
        images[out] = 0
    return replace(frame, images=images, masks=masks, uncertain=uncertain)


class Stopwatch:
    """Seconds a stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """What passed since the last lap belongs to ``stage``."""
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + now - self._last
        self._last = now


def usable(frame: Frame, out: NDArray[np.bool_]) -> Frame:
    """Return the frame for a tracker that goes without some cameras (C,): with empty masks in all of them if fewer than
    two others show the subject, because one view does not determine depth."""
    left = without_cameras(frame, out)
    if np.count_nonzero(shows_person(left.masks)) < 2:
        return without_cameras(left, np.ones(len(out), np.bool_))
    return left
