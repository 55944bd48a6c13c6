"""What the residuals of the region tracker say about its cameras: which is wrong, and whether a pose can be right.

If a camera's residual is an outlier of its baseline (:class:`~tk.trackers.residual.ResidualBaseline`), the frame is
tracked again without it. If the other cameras then have a normal residual and the camera still has an outlier, the
camera was wrong and not the pose. It is included again when its residual, at the pose that the others give, is normal.
This is the iteratively reweighted fit of robust statistics with weights of 0 and 1 and the camera as the unit.

A poor mask is not a wrong camera. Uncertain pixels contradict nothing. A camera that is turned, moved or late has
missing area on one side of the body and surplus area on the other; a torn mask has only missing area. A torn mask would
still pull limbs out of the missing area, so its camera is excluded until its masks have been whole for some frames, but
the pose is not rejected because of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.cameras.camera import Rig
from tk.model.cameras.common_view import determine_depth
from tk.model.cues.ray_costs import residual_of
from tk.model.stateful import Stateful
from tk.trackers.protocol import Estimate, Frame, shows_person, without_cameras
from tk.trackers.region import RegionTracker
from tk.trackers.residual import OUTLIER

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# A camera with a residual (E_S) above this is excluded whatever its baseline: its mask is unrelated to the body.
_UNRELATED = 0.75
# Missing area on uncertain pixels is ignored, unless it is more than this share of the mask: then too little is left.
_TOO_LITTLE = 0.5
# A mask is torn if its surplus area is at most this share of its missing area.
_TORN = 0.5
# Consecutive frames after which a camera whose mask was torn is included again, because such masks come and go; and
# after which a camera is tested again that was found right. With half and twice the value no mean error of dance and
# cube (50 frames) changes; their cameras are right.
_WHOLE = _PAUSE = 6


@dataclass(frozen=True)
class JudgeState:
    """Of C cameras.

    Attributes:
        torn: (C,) whether a camera is excluded because of a torn mask.
        normal_for: (C,) consecutive frames with a normal residual.
        since_test: (C,) frames since the last test.
        at_test: (C,) excess at the last test.
    """

    torn: Bool
    normal_for: NDArray[np.int64]
    since_test: NDArray[np.int64]
    at_test: Float


class ResidualJudge(Stateful[JudgeState]):
    """Steps a tracker; judges cameras and poses by their residuals.

    Args:
        tracker: the tracker.
        rig: its C cameras.

    Attributes:
        torn: (C,) whether a camera is excluded because of a torn mask.
    """

    State = JudgeState

    def __init__(self, tracker: RegionTracker, rig: Rig) -> None:
        C = len(rig)
        self.tracker, self._rig = tracker, rig
        self.torn = np.zeros(C, bool)
        self._normal_for = np.zeros(C, np.int64)
        self._since_test = np.full(C, _PAUSE)
        self._at_test = np.zeros(C)

    def step(self, frame: Frame, used: Frame, bad: Bool, excluded: Bool) -> tuple[Estimate, Frame, float]:
        """Step the tracker; exclude a camera that is wrong, and include those again that are right.

        Args:
            frame: the observation with all cameras.
            used: without the cameras that are bad or excluded.
            bad: (C,) cameras whose image excludes them.
            excluded: (C,) cameras that are wrong; this method changes it.

        Returns:
            The estimate; the observation without the excluded cameras; the excess of the residual, mean over the
            cameras used, 0 if none shows anybody.
        """
        tracker = self.tracker
        before = tracker.state
        first = tracker.step(used)
        if first.residual is None or not shows_person(used.masks).any():
            return first, used, 0.0
        baseline = tracker.residuals
        error = first.residual.sum(axis=1)
        if excluded.any() or np.nanmax(baseline.excess(error), initial=0.0) > OUTLIER:
            error = self._residual(frame, first).sum(axis=1)
        excess = baseline.excess(error)
        usable = ~bad & np.isfinite(error)
        self._normal_for = np.where(usable & (excess < self.normal), self._normal_for + 1, 0)
        back = excluded & (self._normal_for >= np.where(self.torn, _WHOLE, 1))
        kept = usable & ~excluded
        self._since_test += 1
        suspects = kept & (excess > OUTLIER)
        suspects &= (self._since_test > _PAUSE) | (excess > self._at_test + baseline.threshold)
        estimate = first
        if suspects.any() and kept.sum() >= 3:
            worst = int(np.argmax(np.where(suspects, excess, -np.inf)))
            others = kept.copy()
            others[worst] = False
            after = tracker.state
            fewer = without_cameras(used, ~others)
            tracker.state = before
            second = tracker.step(fewer)
            residual = self._residual(frame, second)
            if self._is_wrong(worst, residual, error, others, second.joints):
                excluded[worst] = True
                self.torn[worst] = residual[worst, 1] < _TORN * residual[worst, 0]
                estimate, used, kept = replace(second, status=first.status), fewer, others
                error = residual.sum(axis=1)
            else:
                tracker.state = after
                self._since_test[worst], self._at_test[worst] = 0, excess[worst]
        excluded &= ~back
        return estimate, used, tracker.residuals.mean_excess(np.where(kept, error, np.nan))

    def _is_wrong(self, camera: int, residual: Float, before: Float, others: Bool, joints: Float) -> bool:
        """Return whether a camera is wrong, by the joints (J, 3) and the residual (C, 2) of the pose without it.

        Cameras that see the person from the same or from opposite sides contradict no other camera, because they do not
        determine a pose. If the other cameras have a high residual too, the pose is wrong instead. Surplus area alone,
        such as a second person in the mask, hardly misleads contours: it counts only if the others' E_S falls without
        the camera, from ``before`` (C,), by one spread. A pose from two cameras is uncertain, so a third must have
        twice the excess.
        """
        if not determine_depth(self._rig.centers, joints.mean(axis=0), others):
            return False
        baseline, error = self.tracker.residuals, residual.sum(axis=1)
        excess_of_others = baseline.mean_excess(np.where(others, error, np.nan))
        if excess_of_others > baseline.threshold:
            return False
        many = others.sum() >= 3
        missing = baseline.excess(residual[:, 0])[camera] > (OUTLIER if many else 2 * OUTLIER)
        relief = baseline.mean_excess(np.where(others, before, np.nan)) - excess_of_others
        surplus = many and baseline.excess(error)[camera] > OUTLIER and relief > 1.0
        return bool(missing or surplus or error[camera] > _UNRELATED)

    def _residual(self, frame: Frame, estimate: Estimate) -> Float:
        """Return (C, 2) missing and surplus area at the estimate's pose, of excluded cameras, too. Missing area on
        uncertain pixels is not counted if enough of the mask is left. NaN where a camera sees nobody, or no body was
        fitted.
        """
        tracker, drawn = self.tracker, estimate.drawn
        if drawn is None or estimate.masks is None:
            return np.full((len(frame.masks), 2), np.nan)
        masks, used = estimate.masks, shows_person(estimate.masks)
        if not used.all():
            masks = masks.copy()
            masks[~used] = tracker.cleaned(frame.masks[~used])
        sampled = tracker.screen.sample(masks)
        person, others = sampled >= PERSON, sampled == OTHERS
        residual = residual_of(drawn, person, others)
        if frame.uncertain is not None:
            excused = residual_of(drawn & tracker.screen.sample(frame.uncertain), person, others)[:, 0]
            residual[:, 0] -= np.where(excused < _TOO_LITTLE, excused, 0.0)
        return residual

    @property
    def normal(self) -> float:
        """The excess below which a residual is normal again: halfway between a high one and an outlier."""
        return (self.tracker.residuals.threshold + OUTLIER) / 2
