"""What the trackers that follow contours share: recovery, colours, and what a run stores of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.results.status import Status
from tk.kernels.mask_values import PERSON
from tk.model.body.stored_body import restore_body
from tk.model.cues.part_colors import LearnedColors, PartColors, RenderedBody, color_bins
from tk.model.setup import Subject
from tk.model.stateful import Stateful
from tk.trackers.contour_finder import ContourFinder, Seen
from tk.trackers.proposals import anywhere
from tk.trackers.protocol import Estimate, Frame
from tk.trackers.residual import LEVEL

Float = NDArray[np.float64]
S = TypeVar("S")


class ContourTracker(ContourFinder, Stateful[S], ABC):
    """Base class of the region and the silhouette tracker.

    All poses are in the tracker's own world, except those that go in or out by the protocol
    (:class:`~tk.trackers.protocol.Tracker`), which are in the capture's world.
    """

    objective_kind = "E_S"
    image_step = 0
    reports_sigma = False
    has_segments = True
    has_second_pass = False
    tracks_among_others = True

    _lost_for: int  # consecutive frames, up to the last one, in which the person was lost
    _fresh: bool  # whether no frame has been tracked yet

    @abstractmethod
    def start(self, frames: Sequence[Frame], subject: Subject) -> None:
        """Find the subject in the first frame and fit the body to all of them, see :meth:`ContourFinder.find`."""

    @abstractmethod
    def step(self, frame: Frame) -> Estimate:
        """Return the estimate for the next frame."""

    @abstractmethod
    def last_poses(self) -> tuple[Float, Float]:
        """Return the poses (D,) of the last frame and of the frame before."""

    def take_model(self, model: Mapping[str, Any]) -> None:
        """Take the body of a run."""
        self.take_body(restore_body(model))

    def lose(self) -> None:
        """Take the last frame for lost: the person is searched for in the next one."""
        self._lost_for = max(self._lost_for, 1)

    def _origin(self, cut: bool = False) -> Status:
        """Return how the tracker came to the pose of this frame. ``cut``: the person is elsewhere than before."""
        return Status.INITIALISED if self._fresh else Status.RECOVERED if cut or self._lost_for else Status.TRACKED

    def rendered(self, ahead: bool) -> RenderedBody:
        """Return the body on the grid :attr:`fine_grid`: at the last pose, or at the one expected in the next frame."""
        pose, before = self.last_poses()
        if ahead:
            pose = pose + self.settings.prediction * (pose - before)
        met = self.fine_grid.render(self.body, pose[None])
        return RenderedBody(met.label[0], met.depth[0], self.body.color_group, self.colors.log_likelihood)

    def learned(self) -> LearnedColors | None:
        """Return the learned colours, a part of the state; None before any are known."""
        return self.colors.state if self.colors.known else None

    def likeness(self, frame: Frame, learned: LearnedColors | None = None, pose: Float | None = None) -> float:
        """Return the log-likelihood, mean per pixel, that a frame shows this person; about 0 or less.

        Args:
            frame: the observation of a person.
            learned: colours of this person; None: the present ones.
            pose: (D,) the person's pose, in the tracker's frame. With it, the body counts, too: a pixel is wrong with
                the probability :data:`~tk.trackers.residual.LEVEL`.
        """
        colors = self.colors
        if learned is not None:
            colors = PartColors(self.body)
            colors.state = learned
        by_color = 0.0
        if frame.images.size:
            bins = color_bins(self.fine_grid.sample(frame.images))
            by_color = colors.likeness(bins[self.fine_grid.sample(frame.masks) >= PERSON])
        if pose is None:
            return by_color
        pyramid = self.pyramid(frame)
        residual = self.mean_residual(pyramid, self.settle(pyramid, pose[None]).states, frame.uncertain)[0]
        return by_color - float(np.log(1 / LEVEL - 1) * min(residual, 1.0))

    def cleaned(self, masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return masks (V, H, W) after cleaning."""
        return self.views.pyramid(masks, 1, True).masks[0]

    def anywhere(self, seen: Seen, pose: Float) -> Float:
        """Return proposals (B, D) for a lost person; none if too few cameras see anybody."""
        try:
            return anywhere.propose(self, seen, pose)
        except CaptureError:
            return np.empty((0, len(pose)))

    def pose_fields(self, pose: Float) -> dict[str, Any]:
        """Return the fields of an :class:`~tk.trackers.protocol.Estimate` that follow from a pose (D,)."""
        skeleton, world = self.body.skeleton, self.world
        return {"pose": world.poses_out(pose), "joints": world.points_out(skeleton.joints(pose))}
