"""What a tracker is: the protocol that :mod:`tk.trackers` share."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # who decodes and segments needs no tracker's parts
    from tk.io.captures.init_pose import InitPose
    from tk.model.body.cone_body import ConeBody
    from tk.model.hull.hull import HullSurface

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Observation:
    """What the cameras saw at one instant.

    Attributes:
        index: the frame's number.
        images: (C, H, W, 3) uint8 BGR.
        masks: (C, H, W) uint8, 0 or 255.
        uncertain: (C, H, W) bool, where a mask is 0 and what is seen may be the person all the same, or a shadow; None
            where nobody says.
    """

    index: int
    images: NDArray[np.uint8]
    masks: NDArray[np.uint8]
    uncertain: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Estimate:
    """A tracker's answer for one frame.

    Attributes:
        pose: (D,) configuration vector; waist: (W,), ankles: (A,) angles beyond it, in the order of the tracker's
            names.
        joints: (15, 3) joint centres, metres.
        status: "tracked", "initialised", "recovered" or "lost".
        objective: the objective's final value.
        iterations: (S,) optimiser iterations a stage.
        timing: seconds a stage.
        surface: the hull's surface, if the tracker made one.
        sigma: (15,) one standard deviation of each joint's position along an axis, metres; None where the tracker does
            not say.
        residual: (C, 2) missing area (body outside the mask) and surplus area (mask outside the body) by camera, shares
            of the person's pixels, NaN for a camera that was not used; their sum is E_S. None if not measured.
        masks: (C, H, W) uint8, what the tracker took for the person, cleaned; None where that is the observation's, and
            in what :func:`tk.track` hands out. drawn: (C, h, w) bool, where the body is on the tracker's grid of rays,
            cameras left out included; None likewise.
        frame, time: the frame's number in the capture, and seconds; whoever steps the tracker knows them.
    """

    pose: Float
    joints: Float
    status: str
    objective: float
    iterations: NDArray[np.int32]
    timing: Mapping[str, float]
    surface: HullSurface | None = None
    waist: Float = field(default_factory=lambda: np.zeros(0))
    ankles: Float = field(default_factory=lambda: np.zeros(0))
    sigma: Float | None = None
    residual: Float | None = None
    masks: NDArray[np.uint8] | None = None
    drawn: NDArray[np.bool_] | None = None
    frame: int = -1
    time: float = 0.0


class Tracker(Protocol):
    """Follows one person from frame to frame. Poses are those of the capture's world, but for the state's."""

    method: str
    stages: tuple[str, ...]
    timing_stages: tuple[str, ...]
    pose_names: tuple[str, ...]
    pose_units: tuple[str, ...]
    waist_names: tuple[str, ...]
    ankle_names: tuple[str, ...]

    @property
    def opening_frames(self) -> int:
        """Frames that :meth:`start` wants to look at."""
        ...

    @property
    def body(self) -> ConeBody:
        """The person's body, once it is known."""
        ...

    def prepare(self) -> None:
        """Have kernels compiled while there is nothing else to do."""
        ...

    def start(
        self,
        frames: Sequence[Observation],
        height_m: float | None,
        init: InitPose | None,
        body: ConeBody | None = None,
    ) -> None:
        """Find the subject in the first of the frames; nothing is returned, :meth:`step` begins with that frame.

        Args:
            frames: consecutive observations.
            height_m: the subject's height, if known.
            init: a rough pose given by a person.
            body: the body, if known; it is not fitted then.
        """
        ...

    def step(self, frame: Observation) -> Estimate:
        """The pose in the next frame."""
        ...

    def model(self) -> Mapping[str, Any]:
        """The fitted body, for `/model` of the result."""
        ...

    def state(self) -> Mapping[str, Any]:
        """All that changes from frame to frame."""
        ...

    def restore(self, model: Mapping[str, Any], state: Mapping[str, Any]) -> None:
        """Take up where a run stopped."""
        ...


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


def drift(usual: Float, now: Float) -> Float:
    """What is usual after one more frame, element by element: quick to learn that it can be better, slow to put up with
    worse; infinite as long as nothing is known."""
    known = np.where(np.isfinite(usual), usual, now)
    return np.asarray(known + np.where(now < known, 0.1, 0.05) * (now - known))
