"""Body proportions: what the length of a limb is when only the stature is known.

The paper (section 6.3) takes its ratios from Dreyfuss, *The Measure of Man* (1959-67), and prints none of them. The
book is not at hand either, so the table stands on two sources that give distances between joint centres as fractions of
the stature: Drillis & Contini (1966; in Winter, *Biomechanics and Motor Control of Human Movement*, fig. 4.1), de Leva
(J. Biomech. 29, 1996, table 4: men and women averaged). They measure the shoulder, the hip and the neck at different
points; where they disagree the value lies between them. The fit to the hull then moves each length within its scatter.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from tk.errors import ConfigError

# Fractions of the stature.
PELVIS_HEIGHT = 0.525  # floor to the hip centres
TRUNK_LENGTH = 0.328  # hip centres to C7/T1
HEAD_LENGTH = 0.142  # C7/T1 to the crown
SHOULDER_DROP = 0.044  # shoulder centres below C7/T1, the arms level
SHOULDER_HALF_WIDTH = 0.106  # glenohumeral centre to the median plane
HIP_HALF_WIDTH = 0.060  # hip centre to the median plane
UPPER_ARM_LENGTH = 0.149
FOREARM_LENGTH = 0.149
HAND_LENGTH = 0.108  # wrist to the tip of the middle finger
THIGH_LENGTH = 0.245
CALF_LENGTH = 0.246
ANKLE_HEIGHT = 0.049  # ankle centre above the sole of a shoe; 0.039 barefoot
FOOT_LENGTH = 0.150
# How far an arm raised from hanging to level lifts its shoulder: the collar bone points up by 5 to 10° more (Ludewig et
# al., J. Bone Joint Surg. Am. 91, 2009, 378-389), which is 2 to 3 cm at its end. SHOULDER_DROP is that of level arms.
RAISED_SHOULDERS = 0.016
CROTCH_DROP = 0.070  # lowest point of the trunk below the hip centres, in trousers

# The trunk's surface lies forward of the line from the hip centres to C7/T1, which runs nearer to the back: how far the
# middle of the chest and of the pelvis lies ahead of that line. Estimates: neither source gives them; chosen with the
# joints of the rendered development captures in view.
CHEST_FORWARD = 0.014
PELVIS_FORWARD = 0.016
# The same for other parts, and with the same reservation: the spine meets the skull behind its middle; the knee's
# hollow, the calf's muscle and the heel's tendon lie behind the line from knee to ankle; the arm's flexors lie before
# the elbow's axis; hair stands on the crown.
SKULL_FORWARD = 0.007
KNEE_BACK = 0.007
ELBOW_FRONT = 0.003
ANKLE_BACK = 0.013
ANKLE_OUTWARD = 0.006
HAIR = 0.008

# Half widths and girths as radii, fractions of the stature, over light clothes.
CHEST_HALF_WIDTH = 0.098
CHEST_HALF_DEPTH = 0.070
HIPS_HALF_WIDTH = 0.100
HIPS_HALF_DEPTH = 0.072
HEAD_RADIUS = 0.049
NECK_RADIUS = 0.036
UPPER_ARM_RADIUS = 0.032
ELBOW_RADIUS = 0.026
WRIST_RADIUS = 0.019
THIGH_RADIUS = 0.050
KNEE_RADIUS = 0.036
ANKLE_RADIUS = 0.025


@dataclass(frozen=True)
class BodyDimensions:
    """Lengths and radii of one person's body, metres. Left and right are alike.

    Lengths join joint centres; radii are those of the clothed surface about the limb's axis.
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
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0 < value < 3:
                raise ConfigError(f"body dimension {field.name} = {value} m must lie between 0 and 3 m")

    @staticmethod
    def from_stature(stature_m: float) -> BodyDimensions:
        """The average body of this stature (crown to sole, metres)."""
        h = stature_m
        return BodyDimensions(
            trunk=TRUNK_LENGTH * h,
            head=HEAD_LENGTH * h,
            shoulder_drop=SHOULDER_DROP * h,
            shoulder_half_width=SHOULDER_HALF_WIDTH * h,
            hip_half_width=HIP_HALF_WIDTH * h,
            upper_arm=UPPER_ARM_LENGTH * h,
            forearm=FOREARM_LENGTH * h,
            hand=HAND_LENGTH * h,
            thigh=THIGH_LENGTH * h,
            calf=CALF_LENGTH * h,
            ankle_height=ANKLE_HEIGHT * h,
            foot=FOOT_LENGTH * h,
            chest_half_width=CHEST_HALF_WIDTH * h,
            chest_half_depth=CHEST_HALF_DEPTH * h,
            hips_half_width=HIPS_HALF_WIDTH * h,
            hips_half_depth=HIPS_HALF_DEPTH * h,
            head_radius=HEAD_RADIUS * h,
            neck_radius=NECK_RADIUS * h,
            upper_arm_radius=UPPER_ARM_RADIUS * h,
            elbow_radius=ELBOW_RADIUS * h,
            wrist_radius=WRIST_RADIUS * h,
            thigh_radius=THIGH_RADIUS * h,
            knee_radius=KNEE_RADIUS * h,
            ankle_radius=ANKLE_RADIUS * h,
        )

    def scaled(self, **factors: float) -> BodyDimensions:
        """A copy with the named dimensions multiplied by these factors."""
        return replace(self, **{name: getattr(self, name) * factor for name, factor in factors.items()})

    @property
    def stature(self) -> float:
        """Crown to sole when standing, metres."""
        return self.head + self.trunk + self.thigh + self.calf + self.ankle_height
