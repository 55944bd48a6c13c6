"""Fits a cone body to the silhouettes of several frames: dimensions, shapes of the parts and poses together.

The contours' equations of :mod:`tk.model.cameras.bundle` with known cameras. Dimensions and shapes are fitted together
because one compensates for the other: thighs that taper unlike the average move the knee by centimetres if only the
dimensions may change. (The silhouette paper leaves the adaptation of the body to future work.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.line_search import SearchSettings
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.body_parameters import BodyFamily
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.bundle import (
    BUNDLE_INFORMATION,
    LONGEST_STEP,
    SEGMENT_M,
    SPACING_PX,
    BundleFrame,
    BundleState,
    ContourBundle,
)
from tk.model.masks.silhouettes import Pyramid, Views
from tk.optim.trajectory import minimise

Float = NDArray[np.float64]

# More frames than this do not make the body more certain: shapes that no cone has err alike in all frames.
INFORMATIVE_FRAMES = 8
# Prior standard deviation of the logarithm of the stature about a given height: 2.5 cm, of shoes, hair, posture and the
# measurement.
STATURE_DEVIATION = 0.015
# Gauss-Newton iterations from an average body, and from one that was fitted to other frames of the person.
ROUNDS, ROUNDS_AGAIN = 6, 3


class FittedBody(NamedTuple):
    """A body fitted to F frames.

    Attributes:
        body: the body.
        poses: (F, D) in the frames.
        variance: computes (J,) variance of the joints' positions along an axis, metres², that the body's uncertainty
            causes, mean over the frames.
    """

    body: ConeBody
    poses: Float
    variance: Callable[[], Float]


def fit_body(
    views: Views,
    pyramids: Sequence[Pyramid],
    poses: Float,
    settings: SearchSettings,
    stature_m: float,
    stature_deviation: float = STATURE_DEVIATION,
    body: ConeBody | None = None,
) -> FittedBody:
    """Fit a body and poses to several frames.

    Args:
        views: the cameras.
        pyramids: silhouettes of F frames.
        poses: (F, D) initial poses, close enough for the edge search to find the right edges.
        settings: of the edge search.
        stature_m: the subject's height without shoes, given or estimated, metres.
        stature_deviation: prior standard deviation of the logarithm of the stature about ``stature_m``.
        body: the person's body, which other frames have shown, to which the poses belong; None: the average one.
    """
    family = BodyFamily(BodyDimensions.from_stature(stature_m), stature_deviation)
    if body is not None:
        family.begun_at(body)

    def bundle(segment_m: float | None) -> ContourBundle:
        return ContourBundle(
            family,
            views.rig,
            [BundleFrame(pyramid, pose, np.zeros_like(pose)) for pyramid, pose in zip(pyramids, poses, strict=True)],
            replace(settings, spacing_px=SPACING_PX),
            {},
            BUNDLE_INFORMATION / max(len(poses) / INFORMATIVE_FRAMES, 1.0),
            segment_m=segment_m,
        )

    stiff = bundle(None)
    rounds = ROUNDS if body is None else ROUNDS_AGAIN
    state = minimise(stiff.start, stiff.linearise, stiff.move, [0] * rounds, LONGEST_STEP).state
    return FittedBody(family.build(state.body), state.poses, lambda: _joint_variance(bundle(SEGMENT_M), state))


def _joint_variance(bundle: ContourBundle, state: BundleState) -> Float:
    """Return (J,) variance of the joints' positions along an axis, metres², that the uncertainty of the body causes.

    The pose adapts to the body: another thigh moves the knee, and hip and shank with it. Segments are free by SEGMENT_M
    in each frame, because no joint is a hinge and clothes hide the bones: without that the contours of one frame would
    determine the body to millimetres.
    """
    family, reduced = bundle.family, bundle.linearise(state, 0).reduced()
    skeleton = family.build(state.body).skeleton
    by_pose = skeleton.joint_jacobian(state.poses)  # (F, J, 3, D)
    response = reduced.response[:, : by_pose.shape[-1]]
    moved = family.joint_rows(state.body, state.poses) - by_pose @ response[:, None]
    spread = moved @ np.linalg.inv(reduced.hessian)
    return np.asarray((spread * moved).sum(axis=(-1, -2)).mean(axis=0) / 3)
