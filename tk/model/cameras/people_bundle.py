"""The contours of several people in one least-squares problem: the cameras are shared, each body has its own frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tk.kernels.line_search import SearchSettings
from tk.model.body.body_parameters import BodyFamily
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.bundle import SPACING_PX, BundleFrame, BundleState, ContourBundle, Contours
from tk.model.cameras.camera import Rig
from tk.optim.trajectory import Equations

Float = NDArray[np.float64]

# An edge's weight falls to a quarter at robust_px: less than in the tracker's search, because a camera can do without
# the edges of folds, shadows and hands.
CAMERA_SEARCH = SearchSettings(spacing_px=SPACING_PX, robust_px=3.0)

Filmed = tuple[ConeBody, Sequence[BundleFrame]]
"""A tracked body, and frames of it."""
States = tuple[BundleState, ...]
"""The estimate of each person; the cameras are the same in all of them."""


class PeopleBundle:
    """Least-squares problem of the contours of P people: :class:`ContourBundle` for each, with common cameras.

    Args:
        people: P bodies, in a world in which z is up, with their frames.
        rig: the C cameras.
        sigmas: as of :class:`ContourBundle`.

    Attributes:
        bundles: of each person.
        cameras: where the cameras' unknowns stand among the shared ones; the bodies' follow.
        sigma, parameters: as of :class:`ContourBundle`.
    """

    def __init__(self, people: Sequence[Filmed], rig: Rig, sigmas: Mapping[str, float]) -> None:
        self.bundles = [
            ContourBundle(BodyFamily.around(body), rig, frames, CAMERA_SEARCH, sigmas) for body, frames in people
        ]
        first = self.bundles[0]
        self.rig, self.cameras, self.sigma, self.parameters = rig, first.cameras, first.sigma, first.parameters
        ends = self.cameras.stop + np.cumsum([len(bundle.family.start) for bundle in self.bundles])
        #: of each person, the unknowns among the shared ones
        self._shared = [
            np.r_[self.cameras, end - len(bundle.family.start) : end]
            for bundle, end in zip(self.bundles, ends.tolist(), strict=True)
        ]
        self.size = int(ends[-1])
        rows = np.cumsum([0, *(len(bundle.frames) for bundle in self.bundles)]).tolist()
        self._blocks = [slice(a, b) for a, b in pairwise(rows)]

    @property
    def start(self) -> States:
        """The given cameras, poses and bodies."""
        return tuple(bundle.start for bundle in self.bundles)

    def begun_at(self, states: States, late: NDArray[np.int64]) -> States:
        """Return the given poses, with the cameras and bodies of estimates from other images. Delays of ``late`` (C,)
        whole frames, which those had, have been removed from the images here."""
        moved = np.zeros((len(self.sigma), len(self.rig)))
        if "offset" in self.parameters:  # it comes last
            moved[-1] = late
        return tuple(
            replace(new, rig=old.rig, change=old.change - moved.T, body=old.body)
            for new, old in zip(self.start, states, strict=True)
        )

    def offsets(self, states: States) -> Float:
        """Return the time offset (C,) of each camera, frames."""
        return self.bundles[0].offsets(states[0])

    def contours(self, states: States, scale: int) -> list[Contours]:
        """Find the edgels of each person at an estimate and a scale's index."""
        return [bundle.contours(state, scale) for bundle, state in zip(self.bundles, states, strict=True)]

    def linearise(self, states: States, scale: int) -> Equations:
        """Return the equations at an estimate and a scale's index. The blocks are the frames of one person after those
        of the other; the cameras' prior counts once."""
        own = [bundle.linearise(state, scale) for bundle, state in zip(self.bundles, states, strict=True)]
        if len(own) == 1:
            return own[0]
        D = own[0].gradient.shape[1] - len(self._shared[0])
        whole = Equations(self._blocks[-1].stop, D, self.size)
        for one, rows, shared in zip(own, self._blocks, self._shared, strict=True):
            index = np.r_[:D, D + shared]
            whole.hessian[rows][:, index[:, None], index] = one.hessian
            whole.gradient[rows][:, index] = one.gradient
            whole.prior_hessian[np.ix_(shared, shared)] += one.prior_hessian
            whole.prior_gradient[shared] += one.prior_gradient
        whole.prior_hessian[self.cameras, self.cameras] /= len(own)
        whole.prior_gradient[self.cameras] /= len(own)
        return whole

    def move(self, states: States, poses: Float, shared: Float) -> States:
        """Return the estimate after steps of the blocks and of the shared unknowns."""
        parts = zip(self.bundles, states, self._blocks, self._shared, strict=True)
        return tuple(bundle.move(state, poses[rows], shared[own]) for bundle, state, rows, own in parts)
