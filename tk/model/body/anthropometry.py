"""Body proportions: dimensions of the average body of a given stature.

The paper (section 6.3) takes its ratios from Dreyfuss, *The Measure of Man* (1959-67), and prints none of them. The
table here stands on two sources of distances between joint centres as fractions of the stature: Drillis & Contini
(1966; in Winter, *Biomechanics and Motor Control of Human Movement*, fig. 4.1) and de Leva (J. Biomech. 29, 1996, table
4; men and women averaged). They measure shoulder, hip and neck at different points; where they disagree, the value lies
between them. The body fit then changes each length within its scatter (:mod:`tk.model.body.body_parameters`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.model.setup import AVERAGE_STATURE_M

#: each of the :class:`BodyDimensions` as a fraction of the stature; radii and half widths are over light clothes
FRACTIONS = {
    "trunk": 0.328,  # hip centres to C7/T1
    "head": 0.142,  # C7/T1 to the crown
    "shoulder_drop": 0.044,  # shoulder centres below C7/T1, the arms level
    "shoulder_half_width": 0.106,  # glenohumeral centre to the median plane
    "hip_half_width": 0.060,  # hip centre to the median plane
    "upper_arm": 0.160,  # de Leva; Drillis & Contini have 0.186, from the acromion
    "forearm": 0.149,
    "hand": 0.100,  # wrist to the tip of the middle finger; Drillis & Contini have 0.108, fingers straight
    "thigh": 0.245,
    "calf": 0.246,
    "ankle_height": 0.049,  # ankle centre above the sole of a shoe; 0.039 barefoot
    "foot": 0.150,
    "chest_half_width": 0.098,
    "chest_half_depth": 0.070,
    "hips_half_width": 0.100,
    "hips_half_depth": 0.072,
    "head_radius": 0.049,
    "neck_radius": 0.036,
    "upper_arm_radius": 0.032,
    "elbow_radius": 0.026,
    "wrist_radius": 0.019,
    "thigh_radius": 0.050,
    "knee_radius": 0.036,
    "ankle_radius": 0.025,
}

#: dimensions that add up to the stature
UPRIGHT = ("head", "trunk", "thigh", "calf", "ankle_height")

# Rise of a shoulder when its arm goes from hanging to level, as a fraction of the stature: the collar bone then points
# up by 5 to 10° more (Ludewig et al., J. Bone Joint Surg. Am. 91, 2009, 378-389), 2 to 3 cm at its end.
RAISED_SHOULDERS = 0.016

# Where the surface lies off the lines between joint centres, as fractions of the stature.
CROTCH_DROP = 0.070  # lowest point of the trunk below the hip centres, in trousers
PELVIS_FORWARD = 0.016  # middle of the pelvis in front of the line from the hip centres to C7/T1
KNEE_BACK = 0.007  # middle of the knee behind the line from hip to ankle: its hollow and the calf's muscle
ELBOW_FRONT = 0.003  # middle of the elbow on the side of its flexors
ANKLE_OUTWARD = 0.006  # middle of the ankle on the outer side of its centre
HAIR = 0.008  # above the crown


@dataclass(frozen=True)
class BodyDimensions:
    """Lengths and radii of one person's body, metres. Left and right are alike.

    Lengths are between joint centres; radii are those of the clothed surface about a segment's axis. A function of
    dimensions alone also takes those of N bodies, (N, 1) each.
    """

    trunk: float
    head: float
    shoulder_drop: float
    shoulder_half_width: float
    hip_half_width: float
    upper_arm: float
    forearm: float
    hand: float
    thigh: float
    calf: float
    ankle_height: float
    foot: float
    chest_half_width: float
    chest_half_depth: float
    hips_half_width: float
    hips_half_depth: float
    head_radius: float
    neck_radius: float
    upper_arm_radius: float
    elbow_radius: float
    wrist_radius: float
    thigh_radius: float
    knee_radius: float
    ankle_radius: float

    def __post_init__(self) -> None:
        wrong = ~((self.values > 0) & (self.values < 3))
        if wrong.any():
            name, value = DIMENSIONS[int(wrong.nonzero()[-1][0])], self.values[wrong][0]
            raise ConfigError(f"body dimension {name} = {value} m must lie between 0 and 3 m")

    @property
    def values(self) -> NDArray[np.float64]:
        """(24,) or (N, 24) the dimensions in the order of :data:`DIMENSIONS`."""
        return np.hstack([getattr(self, name) for name in DIMENSIONS])

    @staticmethod
    def of(values: NDArray[np.float64]) -> BodyDimensions:
        """Return the dimensions of one body from :attr:`values` (24,), or of N bodies from (N, 24)."""
        return BodyDimensions(*(values.tolist() if values.ndim == 1 else values.T[:, :, None]))

    @staticmethod
    def from_stature(stature_m: float) -> BodyDimensions:
        """Return the dimensions of the average body of a stature (crown to floor without shoes), metres."""
        return BodyDimensions(**{name: fraction * stature_m for name, fraction in FRACTIONS.items()})

    @property
    def stature(self) -> float:
        """Crown to the sole of the shoes when standing, metres."""
        return self.head + self.trunk + self.thigh + self.calf + self.ankle_height

    @property
    def barefoot(self) -> float:
        """Crown to floor when standing without shoes, metres: the average body's with this :attr:`stature`."""
        return self.stature / sum(FRACTIONS[name] for name in UPRIGHT)


#: names of the dimensions
DIMENSIONS = tuple(field.name for field in fields(BodyDimensions))

#: the average body, for a person of whom nothing is known, and where only the names of a skeleton matter
AVERAGE_BODY = BodyDimensions.from_stature(AVERAGE_STATURE_M)
