"""Normal equations of cameras, poses and a body from the residuals of contours: bundle adjustment without points.

An edgel means that the contour of frame f in camera c should move by d pixels along its normal n. To first order it
moves by n·Jπ·∂x/∂δ, where x is the material point of the contour: the surface slides along its contour in the image's
tangent only. This holds for the pose, for the body (:mod:`tk.model.body.body_parameters`) and for a moving camera. A
camera's frame k is taken ``offset`` frames later than k, so the body is rendered for it at θ_k + offset · dθ/dk.

The poses are the blocks of :mod:`tk.optim.trajectory`; cameras and body are the unknowns that frames share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, starmap

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.line_search import SearchSettings
from tk.kernels.silhouette import Edgels, find_edgels
from tk.model.body.body_parameters import BodyFamily
from tk.model.body.cone_body import ConeBody
from tk.model.body.skeleton import SEGMENTS
from tk.model.cameras.camera import Camera, Rig
from tk.model.cues.cue import information
from tk.model.cues.landmarks import NAME as MARKED
from tk.model.cues.landmarks import LandmarkCue
from tk.model.masks.silhouettes import Pyramid, Views
from tk.optim.trajectory import Equations

Float = NDArray[np.float64]

# Standard deviation of an edgel's distance, pixels: ragged masks, and shapes that no cone has.
SHAPE_NOISE_PX = 3.0
#: information of one pixel of contour
BUNDLE_INFORMATION = information(SHAPE_NOISE_PX)
# Between samples of a contour, pixels: no more than these are independent, by CORRELATION_PX.
SPACING_PX = 6.0
# Standard deviation of a degree of freedom about the given pose, radians or metres; of waist and ankles about zero,
# because a bent waist and another trunk look alike.
POSE_DEVIATION = 0.3
# Standard deviation, metres, of a segment's position along an axis in one frame about that of skeleton and pose: no
# human joint is a hinge, and clothes stand off by 1 to 3 cm. Without this freedom the cameras bend to suit the
# skeleton.
SEGMENT_M = 0.02
# Precision that pulls a joint back from beyond its limit: 0.03 rad.
_LIMIT = 1e3
# Largest change in one iteration of a pose's entry (radians or metres) and of a body parameter: the linearisation holds
# for about these.
LONGEST_STEP = (0.3, 0.1)

#: parameters of a camera that may change, and how many numbers each has
CAMERA_PARAMETERS = {"shift": 2, "turn": 3, "move": 3, "focal": 1, "offset": 1}


@dataclass(frozen=True)
class TrackedPerson:
    """A person who was tracked in some frames of a recording, in a world in which z is up."""

    body: ConeBody
    masks: Callable[[int], NDArray[np.uint8]]  # (C, H, W) of a frame
    frames: NDArray[np.int64]  # (F,) number of each frame, ascending
    poses: Float  # (F, D)
    usable: NDArray[np.bool_]  # (F,) whether the pose is reliable


@dataclass(frozen=True)
class BundleFrame:
    """One frame of a bundle."""

    pyramid: Pyramid  # its silhouettes
    pose: Float  # (D,) the given pose
    velocity: Float  # (D,) its change from frame to frame


@dataclass(frozen=True)
class Contours:
    """The edgels of F frames in C cameras.

    Attributes:
        edgels: N of them, in the order of parts, then of frames; their view is the camera.
        frame: (N,) index of each one's frame.
        poses: (M, D) at which the body was rendered: those of the frames, or, if cameras have delays, of each frame at
            each camera's own time.
    """

    edgels: Edgels
    frame: NDArray[np.integer]
    poses: Float


@dataclass(frozen=True)
class BundleState:
    """Estimate of a bundle."""

    rig: Rig  # the C cameras
    change: Float  # (C, k) sum of the cameras' steps so far; the cameras' prior is about zero
    poses: Float  # (F, D)
    body: Float  # (K,) parameters of the body


class ContourBundle:
    """Least-squares problem of F frames' contours: poses, camera parameters and body parameters.

    Attributes:
        family: of the body.
        rig: the C cameras as given.
        frames: the frames.
        parameters: names of :data:`CAMERA_PARAMETERS`, in the order of a camera's k unknowns; "offset" comes last.
        sigma: (k,) standard deviation of each about the given camera.
        cameras: where the cameras' C k unknowns stand among the shared ones; the body's K follow.
    """

    def __init__(
        self,
        family: BodyFamily,
        rig: Rig,
        frames: Sequence[BundleFrame],
        settings: SearchSettings,
        sigmas: Mapping[str, float],
        information: float = BUNDLE_INFORMATION,
        segment_m: float | None = SEGMENT_M,
    ) -> None:
        """See the attributes.

        Args:
            family, rig, frames: as above.
            settings: of the edge search.
            sigmas: standard deviation of each camera parameter that may change; empty if the cameras are known.
            information: see :func:`~tk.model.cues.cue.information`.
            segment_m: standard deviation of a segment's position about the skeleton's, metres; None: it is fixed.
        """
        self.family, self.rig, self.frames = family, rig, frames
        self.parameters = tuple(sigmas)
        self.sigma = np.concatenate(
            [np.zeros(0), *(np.full(CAMERA_PARAMETERS[name], value) for name, value in sigmas.items())]
        )
        self.cameras = slice(0, len(rig) * len(self.sigma))
        self._settings, self._information, self._segment_m = settings, information, segment_m

    @property
    def start(self) -> BundleState:
        """The given cameras and poses, and the family's first body."""
        poses = np.array([frame.pose for frame in self.frames])
        return BundleState(self.rig, np.zeros((len(self.rig), len(self.sigma))), poses, self.family.start)

    def offsets(self, state: BundleState) -> Float:
        """Return the time offset (C,) of each camera, frames."""
        return state.change[:, -1] if "offset" in self.parameters else np.zeros(len(self.rig))

    @cached_property
    def _masks(self) -> list[NDArray[np.uint8]]:
        """(C, F, H, W) of each scale."""
        scales = zip(*(frame.pyramid.masks for frame in self.frames), strict=True)
        return [np.stack(masks, axis=1) for masks in scales]

    def contours(self, state: BundleState, scale: int) -> Contours:
        """Find the edgels at an estimate and a scale's index."""
        arrays, offsets, F = self.family.build(state.body).arrays, self.offsets(state), len(self.frames)
        whole, masks = Views(state.rig).at(self.frames[0].pyramid, scale), self._masks[scale]
        velocity = np.array([frame.velocity for frame in self.frames])
        delayed = offsets.any()  # cameras with delays show different poses
        poses = state.poses + (offsets if delayed else np.zeros(1))[:, None, None] * velocity
        found = []
        for c, shown in enumerate(masks):
            k, own = c * delayed, slice(c, c + 1)
            seen = whole._replace(cameras=whole.cameras[own], sizes=whole.sizes[own], masks=shown)
            edgels = find_edgels(arrays, seen, poses[k], self._settings)
            found.append(edgels._replace(pose=k * F + edgels.pose, view=edgels.view + np.int32(c)))
        every = Edgels._make(map(np.concatenate, zip(*found, strict=True)))
        order = np.lexsort([every.pose % F, every.part])
        return Contours(every.of(order), every.pose[order] % F, poses.reshape(-1, poses.shape[-1]))

    def linearise(self, state: BundleState, scale: int) -> Equations:
        """Return the equations at an estimate and a scale's index, priors included."""
        return self.equations(state, self.contours(state, scale))

    def equations(self, state: BundleState, contours: Contours) -> Equations:
        """Return the equations of contours at an estimate, priors included.

        A block holds a frame's pose and, unless segments are fixed, the displacement (3,) of every segment.
        """
        linear, edgels = self.family.linearised(state.body, contours.poses), contours.edgels
        s, segments = linear.body.skeleton, linear.body.frames[0]
        P, L, K = len(s.names), 0 if self._segment_m is None else 3 * len(SEGMENTS), len(state.body)
        D, S = P + L, self.cameras.stop + K
        found = Equations(len(self.frames), D, S)
        x = linear.points(edgels)
        by_camera, weight = self._camera_rows(state.rig, x, edgels), self._information * edgels.weight
        velocity = np.array([frame.velocity for frame in self.frames])
        ends = np.searchsorted(edgels.part, np.arange(len(segments) + 1)).tolist()
        for part, own in enumerate(starmap(slice, pairwise(ends))):  # a part depends on few of the unknowns
            some, at = edgels.of(own), contours.frame[own]
            dofs, by_pose = linear.pose_rows(part, some, x[own])
            parameters, by_parameter = linear.parameter_rows(part, some)
            rows, columns = [by_pose, by_parameter], [dofs, D + self.cameras.stop + parameters]
            if L:
                rows.append(some.row)
                columns.append(P + 3 * segments[part] + np.arange(3))
            if self.parameters:
                if "offset" in self.parameters:
                    by_delay = (by_pose * velocity[at][:, dofs]).sum(axis=1)
                    by_camera[own][np.arange(len(at)), some.view, -1] = by_delay
                rows.append(by_camera[own].reshape(len(at), self.cameras.stop))
                columns.append(D + np.arange(self.cameras.stop))
            found.add(at, np.concatenate(columns), np.hstack(rows), weight[own], some.distance)
        marked = [f for f, frame in enumerate(self.frames) if MARKED in frame.pyramid.measured]
        if marked:
            # a network's depth is too cautious, by an unknown share: it says nothing about the body's lengths
            seen = np.array([self.frames[f].pyramid.measured[MARKED] for f in marked])
            seen[..., 3] = np.nan
            said = LandmarkCue(state.rig, linear.body, seen).rows(state.poses[marked])
            by_body = self.family.landmark_rows(state.body, state.poses[marked])
            unknowns = np.concatenate([np.arange(P), np.arange(D + S - K, D + S)])
            # offsets of landmarks are the same in all frames, so that many frames say as much as one
            normal = said.normal_equations(np.concatenate([said.jacobian, by_body], axis=-1))
            for f, hessian, gradient in zip(marked, *normal, strict=True):
                found.add_normal(f, unknowns, hessian / len(marked), gradient / len(marked))
        precision = np.full(D, POSE_DEVIATION**-2.0)
        precision[P:] = (self._segment_m or 1.0) ** -2.0
        for f, (frame, pose) in enumerate(zip(self.frames, state.poses, strict=True)):
            difference, excess = np.zeros(D), np.zeros(D)
            difference[:P] = np.where(s.is_straight, 0.0, frame.pose) - pose
            excess[:P] = s.clip(pose) - pose
            found.add_block_prior(f, precision, difference)
            found.add_block_prior(f, np.where(excess != 0, _LIMIT, 0.0), excess)
        H, g, cameras = found.prior_hessian, found.prior_gradient, self.cameras
        camera_precision = np.tile(self.sigma**-2.0, len(self.rig))
        H[cameras, cameras] += np.diag(camera_precision)
        g[cameras] -= camera_precision * state.change.ravel()
        self.family.add_prior(state.body, H[cameras.stop :, cameras.stop :], g[cameras.stop :])
        return found

    def _camera_rows(self, rig: Rig, x_world: Float, edgels: Edgels) -> Float:
        """Return the derivatives (N, C, k) of the contours' positions by the parameters of the cameras, those by
        "offset" zero, at the points (N, 3) of edgels."""
        result, names = (
            np.zeros((len(x_world), len(rig), len(self.sigma))),
            [p for p in self.parameters if p != "offset"],
        )
        for c, camera in enumerate(rig) if names else ():
            own = np.flatnonzero(edgels.view == c)
            rows = np.hstack([camera_rows(camera, x_world[own], edgels.of(own), name) for name in names])
            result[own, c, : rows.shape[1]] = rows
        return result

    def move(self, state: BundleState, poses: Float, shared: Float) -> BundleState:
        """Return the estimate after steps of the blocks (F, D or more; poses come first) and of the shared unknowns."""
        step = shared[self.cameras].reshape(state.change.shape)
        moved = (_moved(camera, self.parameters, row) for camera, row in zip(state.rig, step, strict=True))
        return BundleState(
            rig=Rig(tuple(moved)) if self.parameters else state.rig,
            change=state.change + step,
            poses=state.poses + poses[:, : state.poses.shape[1]],
            body=state.body + shared[self.cameras.stop :],
        )


def camera_rows(camera: Camera, x_world: Float, edgels: Edgels, name: str) -> Float:
    """Return (N, k) derivatives of the contour's position along its normal by a camera parameter, pixels.

    Args:
        camera: of the edgels.
        x_world: (N, 3) the edgels' points on the surface, metres.
        edgels: N of them.
        name: "shift", of the image (pixels); "turn" and "move", the twist (ω, v) by which a point of the camera frame
            moves, p + ω × p + v (radians, metres); "focal", the logarithm of the focal lengths.
    """
    row = edgels.row @ camera.rotation.T  # n·Jπ in the camera frame
    if name == "move":
        return row
    if name == "turn":
        return np.cross(camera.to_camera(x_world), row)
    if name == "shift":
        return edgels.normal
    return np.einsum("ni,ni->n", edgels.normal, edgels.pixel - camera.matrix[:2, 2])[:, None]


def _moved(camera: Camera, parameters: Sequence[str], row: Float) -> Camera:
    """Return the camera after a step (k,) of "turn", "move" and, if it is a parameter, "focal"."""
    turn = np.asarray(cv2.Rodrigues(row[:3])[0])
    moved = replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation + row[3:6])
    if "focal" in parameters:
        matrix = camera.matrix.copy()
        matrix[:2, :2] *= np.exp(row[6])
        moved = replace(moved, matrix=matrix)
    return moved


def residual_px(contours: Sequence[Contours], count: int) -> Float:
    """Return (C,) the weighted root mean square distance of people's contours from edges in ``count`` cameras, pixels;
    NaN without edgels."""
    square, weight = np.zeros(count), np.zeros(count)
    for edgels in (one.edgels for one in contours):
        square += np.bincount(edgels.view, edgels.weight * edgels.distance**2, count)
        weight += np.bincount(edgels.view, edgels.weight, count)
    return np.sqrt(square / np.where(weight > 0, weight, np.nan))


def bundle_frames(
    person: TrackedPerson,
    views: Views,
    count: int,
    scales: int,
    cleaning: bool,
    late: NDArray[np.int64] | None = None,
) -> list[BundleFrame]:
    """Choose frames whose joints lie as far apart as possible and whose neighbours are also usable: velocities need
    them.

    Args:
        person: with the frames to choose from.
        views: the C cameras.
        count: largest number of frames.
        scales: of the pyramids.
        cleaning: whether the masks are cleaned first.
        late: (C,) whole frames by which a camera's video is late: its frame k - late goes with frame k of the other
            cameras. None: by none.
    """
    frames, poses, usable = person.frames, person.poses, person.usable
    delays = [0] * len(views.rig) if late is None else late.tolist()
    known = set(frames.tolist())
    inner = np.zeros(len(frames), bool)
    inner[1:-1] = usable[:-2] & usable[1:-1] & usable[2:] & (frames[2:] - frames[:-2] == 2)
    inner &= [all(frame - n in known for n in delays) for frame in frames.tolist()]
    rows = np.flatnonzero(inner)
    rows = rows[farthest(person.body.skeleton.joints(poses[rows]), count)]
    chosen = []
    for i in rows:
        frame_set = np.stack([person.masks(int(frames[i]) - n)[c] for c, n in enumerate(delays)])
        velocity = person.body.skeleton.steps(poses[i - 1 : i + 2]).mean(axis=0)
        chosen.append(BundleFrame(views.pyramid(frame_set, scales, cleaning), poses[i], velocity))
    return chosen


def farthest(joints: Float, count: int) -> NDArray[np.intp]:
    """Return the indices, ascending, of at most ``count`` of the joints (N, J, 3) that cover all of them: first those
    nearest to the median, then always those farthest from the chosen ones (Gonzalez 1985)."""
    if not len(joints):
        return np.zeros(0, np.intp)
    chosen = [int(np.argmin(np.linalg.norm(joints - np.median(joints, axis=0), axis=(1, 2))))]
    distance = np.linalg.norm(joints - joints[chosen[0]], axis=(1, 2))
    while len(chosen) < count and distance.max() > 0:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(joints - joints[chosen[-1]], axis=(1, 2)))
    return np.sort(chosen)
