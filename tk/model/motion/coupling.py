"""How much a pose may differ from what the motion of the neighbouring frames expects: a term of the solver over time.

Each degree of freedom continues at the speed that it has about a step, up to a random change of speed. How much people
change it is measured in the recording itself, so that a kick is not smoothed because another person stands still. The
change has a heavy tail (Student's t): a cut or a sudden movement breaks the term, by itself and where it happens.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.skeleton import Skeleton
from tk.optim.trajectory import Equations

Float = NDArray[np.float64]

# Degrees of freedom of the t distribution.
_TAIL = 4.0
# Least standard deviation of a change of speed, radians or metres a frame.
_LEAST = 0.001
# Iterations that estimate it.
_ROUNDS = 10


class MotionTerm:
    """The term for poses of a recording.

    Args:
        skeleton: of D degrees of freedom.
        poses: (F, D) of which the changes of speed are measured.
        frames: (F,) numbers of the frames, ascending; the term connects consecutive ones.
    """

    def __init__(self, skeleton: Skeleton, poses: Float, frames: NDArray[np.int64]) -> None:
        self._skeleton = skeleton
        changes = np.diff(skeleton.steps(poses), axis=0)[_between_steps(frames)] ** 2
        # With white acceleration of variance q, two steps in turn differ by 2/3 q in the mean square.
        self._variance = np.full(poses.shape[1], np.inf)
        if len(changes):
            found = changes.mean(axis=0)
            for _ in range(_ROUNDS):
                found = (_tail(changes, found + _LEAST**2) * changes).mean(axis=0)
            self._variance = 1.5 * found + _LEAST**2

    def add(self, equations: Equations, poses: Float, frames: NDArray[np.int64]) -> None:
        """Add the term at poses (N, D) of frames (N,) to the equations of N blocks. The speeds are those of the
        poses."""
        if not np.isfinite(self._variance).all():
            return
        steps = self._skeleton.steps(poses)
        total, count = 2.0 * steps, np.full((len(steps), 1), 2.0)
        both = np.flatnonzero(_between_steps(frames))
        for here, beside in ((both + 1, both), (both, both + 1)):
            total[here] += steps[beside]
            count[here] += 1.0
        rows = np.flatnonzero(np.diff(frames) == 1)
        missing, one = (total / count - steps)[rows], np.eye(poses.shape[1])
        # by a third of q a step differs from the speed before it
        variance = self._variance / 3.0
        equations.couple(rows, -one, one, _tail(missing**2, variance) / variance, missing)


def _between_steps(frames: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return (F - 2,) whether the two steps beside a frame lead from frame to frame."""
    follows = np.diff(frames) == 1
    return np.asarray(follows[1:] & follows[:-1])


def _tail(square: Float, variance: Float) -> Float:
    """Return the weights of squared deviations from a t distribution, relative to a normal one."""
    return np.asarray((_TAIL + 1.0) / (_TAIL + square / variance))
