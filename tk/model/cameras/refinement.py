"""Refines cameras, their clocks, bodies and their poses together on the contours of several frames.

Gauss-Newton on the equations of :mod:`tk.model.cameras.people_bundle`. Three gauges cannot be observed: a rigid motion
of the world and its scale, fixed by aligning the cameras with the given ones, and the common delay of all cameras,
fixed by calling one camera's clock right. A prior about the given calibration decides what is badly observed: if a
camera is turned and moved so that the person stays in place in its image, only the person's depth shows it. The body's
dimensions and shapes are unknowns, too: a body too thin for its clothes would otherwise push every camera back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.model.cameras.agreement import OFFSET_FRAMES
from tk.model.cameras.bundle import CAMERA_PARAMETERS, LONGEST_STEP, residual_px
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.people_bundle import Filmed, PeopleBundle, States
from tk.optim.trajectory import gauge_projection, minimise

Float = NDArray[np.float64]

# Prior standard deviations of a calibration: of a turn about an axis, of a centre's place along one, of the logarithm
# of a focal length. For calibrations with errors of about 0.25° and 10 mm; `trust` scales the first two.
TURN_DEG, MOVE_M, FOCAL = 0.18, 0.007, 0.01
# The iteration has converged when all steps are below this share of the prior standard deviations: a change of 0.007°.
_SMALL = 0.04
# A camera's placement counts as observed if its standard deviation is below this share of the prior one.
_OBSERVED = 0.7
# Scales of the edge search, and the largest number of iterations at the coarse and at the fine one. Most recordings
# converge in fewer.
SCALES, COARSE_ROUNDS, ROUNDS = 2, 2, 8


@dataclass(frozen=True)
class RefinementSettings:
    """What `tk calibrate --refine` may change."""

    focal: bool = False  # whether focal lengths change, too
    offsets: bool = True  # whether the videos' delays are estimated
    # factor of the prior standard deviations `TURN_DEG` and `MOVE_M`; larger for cameras with larger errors
    trust: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.trust <= 1000:
            raise ConfigError(f"refinement: trust = {self.trust} must lie in (0, 1000]")


@dataclass(frozen=True)
class Refined:
    """Result of :func:`refine_cameras`."""

    rig: Rig  # the C cameras
    # (C,) frames by which a camera's images are taken later than those of the reference camera, the median one
    offset_frames: Float
    # turn_deg, move_m, focal: (C,) degrees, metres and a factor: the change of each camera's orientation, centre and
    # focal lengths
    turn_deg: Float
    move_m: Float
    focal: Float
    # turn_sigma_deg, move_sigma_m, focal_sigma, offset_sigma_frames: (C,) one standard deviation; of turn and move the
    # vector's length
    turn_sigma_deg: Float
    move_sigma_m: Float
    focal_sigma: Float
    offset_sigma_frames: Float
    # (C,) bool, whether the recording determines a camera's placement better than the prior
    observed: NDArray[np.bool_]
    # before_px, after_px: (C,) pixels of the recorded image, root mean square distance of contours from the mask's
    # edges
    before_px: Float
    after_px: Float
    converged: bool  # whether the last steps were small
    frame_count: int  # number of frames used
    present: tuple[bool, ...]  # which of the people have frames
    states: States  # the estimate of each of these


def refine_cameras(
    people: Sequence[Filmed],
    rig: Rig,
    config: RefinementSettings | None = None,
    begun: Refined | None = None,
    late: NDArray[np.int64] | None = None,
) -> Refined:
    """Adjust C cameras to frames of tracked bodies; see the module.

    Args:
        people: the bodies, in a world in which z is up, with frames whose pyramids have :data:`SCALES` scales.
        rig: the cameras as calibrated.
        config: see :class:`RefinementSettings`.
        begun: a result of the same bodies, whose cameras and bodies are the first estimate; None: the given ones.
        late: (C,) delays, whole frames, that the choice of the images has removed since ``begun``.
    """
    config = config or RefinementSettings()
    sigmas = {"turn": np.radians(TURN_DEG) * config.trust, "move": MOVE_M * config.trust}
    sigmas |= ({"focal": FOCAL} if config.focal else {}) | ({"offset": OFFSET_FRAMES} if config.offsets else {})
    present = tuple(bool(frames) for _, frames in people)
    people = [(body, frames) for body, frames in people if frames]
    bundle = PeopleBundle(people, rig, sigmas)
    C, sigma = len(rig), np.tile(bundle.sigma, len(rig))
    others = np.full(bundle.size - len(sigma), np.inf)
    start, coarse = bundle.start, COARSE_ROUNDS
    if begun is not None and late is not None and begun.present == present:
        start, coarse = bundle.begun_at(begun.states, late), 0
    solution = minimise(
        start,
        bundle.linearise,
        bundle.move,
        [1] * coarse + [0] * ROUNDS,
        (LONGEST_STEP[0], np.concatenate([np.full(len(sigma), np.inf), np.full(len(others), LONGEST_STEP[1])])),
        np.concatenate([_SMALL * sigma, others]),
    )
    assert solution.reduced is not None
    final, offsets = solution.state, bundle.offsets(solution.state)
    now = aligned(final[0].rig, rig, sigmas["turn"], sigmas["move"])
    covariance = np.asarray(np.linalg.inv(solution.reduced.hessian), np.float64)[bundle.cameras, bundle.cameras]
    posterior, prior = _deviations(covariance, bundle), _deviations(np.diag(sigma**2), bundle)
    reference = np.argsort(offsets, kind="stable")[(C - 1) // 2]
    return Refined(
        rig=now,
        offset_frames=offsets - offsets[reference],
        turn_deg=np.array([turn_between(n, o) for n, o in zip(now, rig, strict=True)]),
        move_m=np.linalg.norm(now.centers - rig.centers, axis=1),
        focal=np.array([n.matrix[0, 0] / o.matrix[0, 0] for n, o in zip(now, rig, strict=True)]),
        turn_sigma_deg=np.degrees(posterior["turn"]),
        move_sigma_m=posterior["move"],
        focal_sigma=posterior.get("focal", np.zeros(C)),
        offset_sigma_frames=posterior.get("offset", np.zeros(C)),
        observed=(posterior["turn"] < _OBSERVED * prior["turn"]) & (posterior["move"] < _OBSERVED * prior["move"]),
        before_px=residual_px(bundle.contours(bundle.start, 0), C) * rig.reductions,
        after_px=residual_px(bundle.contours(final, 0), C) * rig.reductions,
        converged=solution.converged,
        frame_count=sum(len(frames) for _, frames in people),
        present=present,
        states=final,
    )


def turn_between(one: Camera, other: Camera) -> float:
    """Return the angle between the orientations of two cameras, degrees."""
    return float(np.degrees(np.linalg.norm(cv2.Rodrigues(one.rotation @ other.rotation.T)[0])))


def aligned(rig: Rig, target: Rig, turn: float, move: float, scaling: bool = True) -> Rig:
    """Return the rig after the motion of the world, and its scaling unless ``scaling`` is False, that brings it closest
    to the target.

    Args:
        rig, target: the same C cameras.
        turn, move: standard deviations, radians and metres, that weight the cameras' turns and places.
        scaling: whether the world's scale is free.
    """
    free = 7 if scaling else 6
    weight = np.tile(np.repeat([1 / turn, 1 / move], 3), len(rig))
    for _ in range(5):
        difference = np.concatenate([_twist(c, t) for c, t in zip(rig, target, strict=True)])
        modes = world_motions(rig)[:, :free]
        s = np.zeros(7)
        s[:free] = np.linalg.lstsq(modes * weight[:, None], -difference * weight, rcond=None)[0]
        Q, scale = np.asarray(cv2.Rodrigues(s[:3])[0]), float(np.exp(s[6]))
        cameras = []
        for c in rig:
            rotation = c.rotation @ Q.T
            center = scale * Q @ c.center + s[3:6]
            cameras.append(replace(c, rotation=rotation, translation=-rotation @ center))
        rig = Rig(tuple(cameras))
    return rig


def _twist(camera: Camera, other: Camera) -> Float:
    """Return (6,) turn, radians, and move of the centre, metres, from another camera to this one, camera frame."""
    turn = np.asarray(cv2.Rodrigues(camera.rotation @ other.rotation.T)[0]).ravel()
    return np.concatenate([turn, -camera.rotation @ (camera.center - other.center)])


def world_motions(rig: Rig) -> Float:
    """Return (6 C, 7) derivatives of the cameras' twists (ω, v) by turns, moves and a scaling of the world.

    A twist turns a camera about its centre and moves the centre by -v in the camera frame.
    """
    blocks = []
    for c in rig:
        block = np.zeros((6, 7))
        block[:3, :3] = -c.rotation
        block[3:, :3] = -c.rotation @ -_cross(c.center)
        block[3:, 3:6] = -c.rotation
        block[3:, 6] = -c.rotation @ c.center
        blocks.append(block)
    return np.concatenate(blocks)


def _cross(a: Float) -> Float:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def _deviations(covariance: Float, bundle: PeopleBundle) -> dict[str, Float]:
    """Return (C,) standard deviations of each camera parameter, after the gauges are projected out."""
    C, k, timed = len(bundle.rig), len(bundle.sigma), "offset" in bundle.parameters
    modes = np.zeros((C, k, 7 + timed))
    modes[:, :6, :7] = world_motions(bundle.rig).reshape(C, 6, 7)
    if timed:
        modes[:, -1, 7] = 1.0
    project = gauge_projection(modes.reshape(C * k, -1), np.tile(bundle.sigma**-2.0, C))
    variance = np.diag(project @ covariance @ project.T).reshape(C, k)
    ends = np.cumsum([CAMERA_PARAMETERS[name] for name in bundle.parameters])
    parts = np.split(variance, ends[:-1], axis=1)
    return {
        name: np.sqrt(np.maximum(part.sum(axis=1), 0.0)) for name, part in zip(bundle.parameters, parts, strict=True)
    }
