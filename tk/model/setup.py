"""What is known before the first frame: the cameras, the working volume, and the subjects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # the process that decodes and segments needs no body
    from tk.model.body.cone_body import ConeBody
    from tk.model.cameras.camera import Rig
    from tk.model.cameras.volume import Volume

#: stature of a person of whom nothing is known, metres: the mean of adults
AVERAGE_STATURE_M = 1.7

#: entries of the pose vector that place the pelvis, metres
TRANSLATIONS = ("torso_x", "torso_y", "torso_z")


@dataclass(frozen=True)
class InitPose:
    """A rough pose given by a person, in the setup's world. Either ``joints`` or ``angles`` is empty."""

    joints: dict[str, NDArray[np.float64]]  # name → (3,) metres
    angles: dict[str, float]  # name → metres or radians
    frame: int | None = None  # frame of the pose; None if not given
    height_m: float | None = None  # height of the subject, metres; None if not given

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) metres, rough position of the body: the mean of the joints, or the pelvis."""
        if self.joints:
            return np.mean(list(self.joints.values()), axis=0)
        return np.array([self.angles[name] for name in TRANSLATIONS])


@dataclass(frozen=True)
class Subject:
    """What is known of a person before tracking."""

    height_m: float | None = None  # height without shoes, metres; None if unknown
    init_frame: int = 0  # frame of the initialisation
    init: InitPose | None = None  # rough pose in that frame; None if the tracker finds the person by itself
    body: ConeBody | None = None  # the body, from an earlier recording; None if it is to be fitted
    # whether the subject stands in the initialisation pose in that frame, so that every limb is visible. If not, any
    # frame may serve, and the body is fitted again at the end.
    in_init_pose: bool = True
    # (3,) m, rough position in that frame, to choose among several people; None if unknown
    position: NDArray[np.float64] | None = None
    hull_m: float | None = None  # height of the visual hull in the first frame; an unknown height is at most that


@dataclass(frozen=True)
class Setup:
    """The scene of a run. It says nothing about where the images come from."""

    rig: Rig
    volume: Volume  # the working volume, metres
    up: str  # axis that points up in the world, see `tk.model.cameras.up.up_vector`
    fps: float  # frame rate, 1/s
    subjects: tuple[Subject, ...] = (Subject(),)  # the persons to be tracked, at least one

    def __post_init__(self) -> None:
        if not self.subjects:
            raise ValueError("a setup has at least one subject")

    def person_pixels(self) -> NDArray[np.float64]:
        """Return (C,) the first subject's height in pixels of each camera's image, across the view at the volume's
        centre."""
        height_m = self.subjects[0].height_m or AVERAGE_STATURE_M
        return np.array([height_m * camera.pixels_per_metre(self.volume.center) for camera in self.rig])
