"""Whether the cameras agree about the person: the residuals that remain when the poses have explained what they can.

A camera that is turned, moved or late shows the body's contours next to where the other cameras expect them, in every
frame alike. Each camera gets an unknown shift of its image and an unknown delay. One Gauss-Newton step over all frames
estimates them with their standard deviations. A motion of the whole world shifts all images and cannot be observed, so
it is projected out of the step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Rig
from tk.model.cameras.people_bundle import Filmed, PeopleBundle
from tk.optim.trajectory import gauge_projection

Float = NDArray[np.float64]

# Prior standard deviation of a video's delay, frames.
OFFSET_FRAMES = 2.0
# Prior standard deviations of a camera's shift, pixels, and of its delay: wide, so that 20 frames outweigh them.
# With two cameras, a sideways turn of one looks like another position of the person, and only the person's size
# contradicts it. So each of two cameras also has an unknown focal length (its logarithm).
_SIGMA = {"shift": 5.0, "offset": OFFSET_FRAMES}
_SIGMA_OF_TWO = {"shift": _SIGMA["shift"], "focal": 0.05, "offset": OFFSET_FRAMES}
# Half the difference of points for a derivative, metres.
_STEP_M = 1e-4
# Cameras disagree if a shift exceeds this angle, degrees, or a delay this part of a frame, and either exceeds this many
# standard deviations (three: one false alarm in 370).
INCONSISTENT_DEG, LATE_FRAMES, SIGNIFICANT = 0.06, 0.2, 3.0
# Two cameras contradict each other if they show the person larger and smaller by more than this share, significantly.
SIZE = 0.005


@dataclass(frozen=True)
class CameraAgreement:
    """How the cameras differ from each other."""

    names: tuple[str, ...]  # of the C cameras
    # (C, 2) pixels, from the place where the other cameras expect the person to the place in this image; x right and y
    # down
    shift_px: Float
    shift_sigma_px: Float  # (C, 2) pixels, one standard deviation
    offset_frames: Float  # (C,) frames by which a camera's images are taken later than the others'; NaN if nobody moves
    offset_sigma_frames: Float  # (C,) frames, one standard deviation
    # (2,) by which share of its size each of two cameras shows the person larger than the other one expects; empty
    # unless there are two
    size: Float
    size_sigma: Float  # (2,) one standard deviation
    focal_px: Float  # (C,) pixels, focal lengths: they turn a shift into an angle

    @property
    def inconsistent(self) -> NDArray[np.bool_]:
        """(C,) cameras whose shift exceeds :data:`INCONSISTENT_DEG` significantly."""
        shift = np.linalg.norm(self.shift_px, axis=1)
        sigma = np.linalg.norm(self.shift_sigma_px, axis=1) / np.sqrt(2)
        return (shift > np.radians(INCONSISTENT_DEG) * self.focal_px) & (shift > SIGNIFICANT * sigma)

    @property
    def late(self) -> NDArray[np.bool_]:
        """(C,) cameras whose images are later or earlier by more than :data:`LATE_FRAMES`, significantly."""
        with np.errstate(invalid="ignore"):
            size = np.abs(self.offset_frames)
            return (size > LATE_FRAMES) & (size > SIGNIFICANT * self.offset_sigma_frames)

    @property
    def size_contradiction(self) -> str:
        """Why two cameras cannot be used together, one line; empty if they can, or if there are more."""
        if not (np.abs(self.size) > np.maximum(SIZE, SIGNIFICANT * self.size_sigma)).any():
            return ""
        large, small = (self.names[i] for i in (int(np.argmax(self.size)), int(np.argmin(self.size))))
        return (
            f"{large} shows the person {np.ptp(self.size):.1%} larger than {small} does at the same place, and two "
            "cameras do not show which one is wrong: one was turned or moved after the calibration"
        )


def camera_agreement(people: Sequence[Filmed], rig: Rig) -> CameraAgreement:
    """Measure how the cameras disagree over frames of tracked bodies, see the module.

    Args:
        people: the bodies, in a world in which z is up, with frames of
            :func:`tk.model.cameras.bundle.bundle_frames`; 20 are enough.
        rig: C cameras.

    Raises:
        ValueError: no frames.
    """
    people = [(body, frames) for body, frames in people if frames]
    if not people:
        raise ValueError("no frames to compare the cameras in")
    C = len(rig)
    bundle = PeopleBundle(people, rig, _SIGMA_OF_TWO if C == 2 else _SIGMA)
    found = bundle.linearise(bundle.start, 0).reduced()
    body, frames = people[0]
    modes = _gauge_modes(rig, body.skeleton.joints(frames[0].pose)[0], len(bundle.sigma))
    project = gauge_projection(modes, np.tile(bundle.sigma**-2, C))
    inverse = project @ np.linalg.inv(found.hessian)[bundle.cameras]
    step = (inverse @ found.gradient).reshape(C, -1)
    # a frame counts as one observation, because errors within a frame are correlated (the sandwich estimator)
    scatter = (found.by_block - found.by_block.mean(axis=0)) @ inverse.T
    curvature = np.diag(inverse[:, bundle.cameras] @ project.T)
    spread = (scatter**2).sum(axis=0)
    deviation = np.sqrt(np.maximum(spread, curvature)).reshape(C, -1)
    moves = any(np.abs(frame.velocity).max() > 0 for _, frames in people for frame in frames)
    return CameraAgreement(
        names=rig.names,
        shift_px=step[:, :2],
        shift_sigma_px=deviation[:, :2],
        offset_frames=step[:, -1] if moves else np.full(C, np.nan),
        offset_sigma_frames=deviation[:, -1] if moves else np.full(C, np.nan),
        size=step[:, 2:-1].ravel(),
        size_sigma=np.sqrt(spread).reshape(C, -1)[:, 2:-1].ravel(),
        focal_px=np.array([camera.matrix[0, 0] for camera in rig]),
    )


def _gauge_modes(rig: Rig, p_world: Float, parameters: int) -> Float:
    """Return the changes (k C, m) of the k parameters of C cameras by each of m motions that no image shows.

    They are motions of the world near a point along x, y, z, a common delay and, of two cameras, another size of the
    person.
    """
    C, more = len(rig), parameters - 3
    modes = np.zeros((C, parameters, 4 + more))
    steps = np.concatenate([_STEP_M * np.eye(3), -_STEP_M * np.eye(3)])
    pixels = np.array([camera.project(p_world + steps)[0] for camera in rig])
    modes[:, :2, :3] = np.nan_to_num(pixels[:, :3] - pixels[:, 3:]).transpose(0, 2, 1) / (2 * _STEP_M)
    modes[:, -1, 3] = 1.0
    modes[:, 2:-1, 4:] = 1.0
    return modes.reshape(parameters * C, -1)
