"""Cameras, their clocks, the body and its poses, all adjusted at once to the contours of some frames.

Gauss-Newton on the equations of :mod:`tk.model.cameras.bundle`. What no picture tells is held: a rigid motion of the
world and
its scale by aligning the cameras with those that were given, the common delay of all cameras by calling one camera's
clock right. A prior about the given calibration decides what the pictures tell badly: a camera that is turned and moved
such that the person stays where he or she is in the picture shows it only by the person's depth. The body's dimensions
and shapes take part: a body too thin for its clothes would otherwise push every camera back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.kernels.line_search import SearchSettings
from tk.model.body.body_parameters import Family
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.agreement import ROBUST_PX, SPACING_PX, residual_px
from tk.model.cameras.bundle import KINDS, Moment, equations, look
from tk.model.cameras.camera import Camera, Rig

Float = NDArray[np.float64]

# One standard deviation of a calibration about the truth: of a turn about an axis, of a centre along one, of the
# logarithm of a focal length; of a video's delay in frames.
TURN_DEG, MOVE_M, FOCAL, OFFSET_FRAMES = 0.18, 0.007, 0.01, 2.0
# A step is small when it is below this share of those.
_SMALL = 0.04
# Where a standard deviation is more than this share of the one beforehand, the pictures tell little.
_TELLING = 0.7


@dataclass(frozen=True)
class RefinementSettings:
    """How it is done.

    Attributes:
        focal: whether focal lengths change, too.
        offsets: whether the videos' delays are sought.
        rounds: most iterations at the finest scale.
        scales: of the search; the coarsest comes first, two iterations each.
        trust: standard deviations of the calibration beforehand, as multiples of :data:`TURN_DEG` and :data:`MOVE_M`;
            more for cameras that are far off.
    """

    focal: bool = False
    offsets: bool = True
    rounds: int = 8
    scales: int = 2
    trust: float = 1.0

    def __post_init__(self) -> None:
        if not 1 <= self.rounds <= 100 or not 1 <= self.scales <= 5 or not 0 < self.trust <= 1000:
            raise ConfigError(
                f"refinement: rounds = {self.rounds} must lie in [1, 100], scales = {self.scales} in [1, 5], trust = "
                f"{self.trust} in (0, 1000]"
            )


@dataclass(frozen=True)
class Refined:
    """What came out.

    Attributes:
        rig: the C cameras.
        offset_frames: (C,) by how many frames a camera's pictures are taken later than the reference camera's, the
            middle one's.
        turn_deg, move_m, focal: (C,) how far each camera was turned, its centre moved, and by which factor its focal
            lengths were multiplied.
        turn_sigma_deg, move_sigma_m, focal_sigma, offset_sigma_frames: (C,) one standard deviation; of turn and move
            the length of the vector's.
        told: (C,) bool, whether the pictures tell a camera's place better than the prior.
        before_px, after_px: (C,) root of the mean squared distance of contours from the mask's edges.
        rounds: iterations that were made.
        settled: whether the last step was small.
    """

    rig: Rig
    offset_frames: Float
    turn_deg: Float
    move_m: Float
    focal: Float
    turn_sigma_deg: Float
    move_sigma_m: Float
    focal_sigma: Float
    offset_sigma_frames: Float
    told: NDArray[np.bool_]
    before_px: Float
    after_px: Float
    rounds: int
    settled: bool


def refine_cameras(
    body: ConeBody,
    rig: Rig,
    moments: Sequence[Moment],
    settings: SearchSettings,
    config: RefinementSettings | None = None,
) -> Refined:
    """Adjust C cameras to F frames; see the module.

    Args:
        body: that was tracked, in a world in which z is up.
        rig: the cameras as calibrated.
        moments: the frames, with pyramids of at least ``config.scales`` scales.
        settings: of the search.
        config: see :class:`RefinementSettings`.
    """
    config = config or RefinementSettings()
    settings = replace(settings, spacing_px=SPACING_PX, robust_px=ROBUST_PX)
    kinds = ("turn", "move", *(("focal",) if config.focal else ()), *(("offset",) if config.offsets else ()))
    sigmas = {"turn": np.radians(TURN_DEG) * config.trust, "move": MOVE_M * config.trust}
    sigmas |= {"focal": FOCAL, "offset": OFFSET_FRAMES}
    sigma = np.concatenate([np.full(KINDS[kind], sigmas[kind]) for kind in kinds])
    C, k = len(rig), len(sigma)
    cameras = slice(0, C * k)
    family = Family(body)
    shared = family.start
    # what the cameras have changed by, to first order: the prior looks at it
    change, offsets = np.zeros((C, k)), np.zeros(C)
    poses = np.array([moment.pose for moment in moments])
    precision = np.tile(sigma**-2.0, C)
    before = residual_px(look(body, rig, offsets, moments, poses, 0, settings), C)
    now, settled, count = rig, False, 0
    H = np.eye(C * k)
    schedule = [scale for scale in range(config.scales - 1, 0, -1) for _ in range(2)] + [0] * config.rounds
    for scale in schedule:
        count += 1
        here = family.build(shared)
        seen = look(here, now, offsets, moments, poses, scale, settings)
        rows = family.rows(shared, seen)
        found = equations(here, now, moments, poses, seen, kinds, rows)
        H, g = found.hessian, found.gradient
        H[cameras, cameras] += np.diag(precision)
        g[cameras] -= precision * change.ravel()
        family.add_prior(shared, H[C * k :, C * k :], g[C * k :])
        step = np.linalg.solve(H, g)
        for f, (a, B) in enumerate(found.steps):
            poses[f] += np.clip(a - B @ step, -0.3, 0.3)
        shared = shared + np.clip(step[C * k :], -0.1, 0.1)
        by_camera = step[cameras].reshape(C, k)
        change += by_camera
        now = Rig(
            tuple(
                _moved(camera, kinds, np.asarray(row, np.float64)) for camera, row in zip(now, by_camera, strict=True)
            )
        )
        if config.offsets:
            offsets = change[:, -1].copy()
        settled = scale == 0 and bool((np.abs(by_camera) < _SMALL * sigma).all())
        if settled:
            break
    after = residual_px(look(family.build(shared), now, offsets, moments, poses, 0, settings), C)
    now = aligned(now, rig, sigmas["turn"], sigmas["move"])
    covariance = np.asarray(np.linalg.inv(H)[cameras, cameras], np.float64)
    told, held = _relative(covariance, rig, kinds, sigmas), _relative(np.diag(1 / precision), rig, kinds, sigmas)
    reference = np.argsort(offsets, kind="stable")[(C - 1) // 2]
    nothing = np.zeros(C)
    return Refined(
        rig=now,
        offset_frames=offsets - offsets[reference],
        turn_deg=np.array([turn_between(n, o) for n, o in zip(now, rig, strict=True)]),
        move_m=np.linalg.norm(now.centers - rig.centers, axis=1),
        focal=np.array([n.matrix[0, 0] / o.matrix[0, 0] for n, o in zip(now, rig, strict=True)]),
        turn_sigma_deg=np.degrees(told["turn"]),
        move_sigma_m=told["move"],
        focal_sigma=told.get("focal", nothing),
        offset_sigma_frames=told.get("offset", nothing),
        told=(told["turn"] < _TELLING * held["turn"]) & (told["move"] < _TELLING * held["move"]),
        before_px=before,
        after_px=after,
        rounds=count,
        settled=settled,
    )


def turn_between(one: Camera, other: Camera) -> float:
    """Angle between the orientations of two cameras, degrees."""
    return float(np.degrees(np.linalg.norm(cv2.Rodrigues(one.rotation @ other.rotation.T)[0])))


def aligned(rig: Rig, target: Rig, turn: float, move: float, scaling: bool = True) -> Rig:
    """The rig after the motion of the world, and its scaling unless that is held, that brings it closest to the target.

    Args:
        rig, target: the same C cameras.
        turn, move: standard deviations, radians and metres, that turns and places of cameras are weighed by.
        scaling: whether the world may grow, too.
    """
    free = 7 if scaling else 6
    weight = np.tile(np.repeat([1 / turn, 1 / move], 3), len(rig))
    for _ in range(5):
        away = np.concatenate([_twist(c, t) for c, t in zip(rig, target, strict=True)])
        modes = world_motions(rig)[:, :free]
        s = np.zeros(7)
        s[:free] = np.linalg.lstsq(modes * weight[:, None], -away * weight, rcond=None)[0]
        Q, scale = np.asarray(cv2.Rodrigues(s[:3])[0]), float(np.exp(s[6]))
        cameras = []
        for c in rig:
            rotation = c.rotation @ Q.T
            center = scale * Q @ c.center + s[3:6]
            cameras.append(replace(c, rotation=rotation, translation=-rotation @ center))
        rig = Rig(tuple(cameras))
    return rig


def _twist(camera: Camera, other: Camera) -> Float:
    """(6,) the turn and the move of the centre, both in the camera frame, from another camera to this one."""
    turn = np.asarray(cv2.Rodrigues(camera.rotation @ other.rotation.T)[0]).ravel()
    return np.concatenate([turn, -camera.rotation @ (camera.center - other.center)])


def world_motions(rig: Rig) -> Float:
    """(6 C, 7) by what turns, moves and a growth of the world change the cameras' twists (ω, v).

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


def _relative(covariance: Float, rig: Rig, kinds: Sequence[str], sigmas: dict[str, float]) -> dict[str, Float]:
    """(C,) standard deviations of each kind, the world's motion and growth and the common delay taken off."""
    C = len(rig)
    k = sum(KINDS[kind] for kind in kinds)
    modes = np.zeros((C * k, 7 + ("offset" in kinds)))
    modes.reshape(C, k, -1)[:, :6, :7] = world_motions(rig).reshape(C, 6, 7)
    if "offset" in kinds:
        modes.reshape(C, k, -1)[:, -1, 7] = 1.0
    W = np.tile(np.concatenate([np.full(KINDS[kind], sigmas[kind] ** -2.0) for kind in kinds]), C)
    weighted = modes.T * W
    project = np.eye(C * k) - modes @ np.linalg.solve(weighted @ modes, weighted)
    variance = np.diag(project @ covariance @ project.T).reshape(C, k)
    result, at = {}, 0
    for kind in kinds:
        result[kind] = np.sqrt(np.maximum(variance[:, at : at + KINDS[kind]].sum(axis=1), 0.0))
        at += KINDS[kind]
    return result


def _moved(camera: Camera, kinds: Sequence[str], row: Float) -> Camera:
    """The camera after a step (k,): points of its frame move by the twist."""
    turn = np.asarray(cv2.Rodrigues(row[:3])[0])
    moved = replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation + row[3:6])
    if "focal" in kinds:
        matrix = camera.matrix.copy()
        matrix[[0, 1], [0, 1]] *= np.exp(row[6])
        moved = replace(moved, matrix=matrix)
    return moved
