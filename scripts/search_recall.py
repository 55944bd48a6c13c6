"""Measure how often the limb search recovers a displaced limb.

    python -m scripts.search_recall CAPTURE… [--every 4]

In every few frames of a tracked capture each limb is moved to poses that the silhouettes nearly allow, and the body is
optimised from there. If that ends in another minimum (the limb is 15 cm off and the residual is higher), the search
runs. It has recovered the limb if elbow and wrist, or knee and ankle, are within 8 cm of their tracked positions. No
ground truth is needed, so any recording serves.

Limbs that the tracker itself finds misplaced are counted separately: for them the search refines more candidates.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scripts.ablation import Recorded
from tk.model.body.limb_candidates import Limb
from tk.model.setup import Subject
from tk.trackers.protocol import Frame
from tk.trackers.region import RegionTracker

# Candidate poses of a limb tested per frame.
TRIES = 2
# A candidate is displaced by at least this distance, metres; the residual of nearly allowed candidates is at most this
# much higher, and that of a wrong minimum at least this much, as shares of the person's pixels.
DISPLACED_M, ALLOWED, WORSE = 0.2, 0.12, 0.01
# Distances from the tracked position, metres: a limb is off beyond the first and recovered within the second.
OFF_M, BACK_M = 0.15, 0.08


@dataclass(frozen=True)
class Trial:
    """One displaced limb.

    Attributes:
        misplaced: the tracker found the limb misplaced.
        back: the search recovered it.
        seconds: duration of the search.
    """

    misplaced: bool
    back: bool
    seconds: float


class Trials(RegionTracker):
    """The tracker, with a test of its limb search in the frame that it tracked last."""

    def trials(self, frame: Frame) -> Iterator[Trial]:
        """Displace every limb and yield what the search does."""
        seen = self.see(self.without_foreign(frame), frame.images)
        pyramid, evidence = seen.pyramid, seen.evidence
        pose = self._best.pose
        rng = np.random.default_rng(frame.index)
        own = float(evidence.mismatch(self.body, pose[None])[0])
        for limb in self.limbs:
            places = limb.candidates(pose, 0, rng)
            cost = evidence.mismatch(self.body, places)
            allowed = np.flatnonzero((self._off(limb, places, pose) > DISPLACED_M) & (cost < own + ALLOWED))
            for k in rng.choice(allowed, min(TRIES, len(allowed)), replace=False):
                wrong = self.settle(pyramid, places[k][None], (1, 0), frame.images).states
                worse, met = evidence.cast(self.body, wrong)
                if self._off(limb, wrong, pose)[0] < OFF_M or worse[0] < own + WORSE:
                    continue
                misplaced = self.misplaced(evidence, met.label[0])
                started = time.perf_counter()
                best = self.best(seen, wrong[0], *self.proposed(seen, wrong[0], misplaced))
                seconds = time.perf_counter() - started
                yield Trial(limb in misplaced, bool(self._off(limb, best[None], pose)[0] < BACK_M), seconds)

    def _off(self, limb: Limb, poses: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return the largest distance (B,) of a limb's joints at poses (B, D) from those at a pose (D,), metres."""
        joints = self.body.skeleton.joints
        ends = list(limb.joints)
        return np.asarray(np.linalg.norm(joints(poses)[:, ends] - joints(pose)[ends], axis=2).max(axis=1))


def recall(recorded: Recorded, every: int) -> list[Trial]:
    """Return the trials of a capture, in every ``every``-th frame."""
    capture = recorded.capture
    tracker = Trials(capture.rig, capture.up)
    tracker.start(recorded.frames[: tracker.opening_frames], Subject(capture.subject_height_m))
    done = []
    for frame in recorded.frames:
        tracked = tracker.step(frame).status == "tracked"
        if tracked and frame.index % every == every // 2:
            done += tracker.trials(frame)
    return done


def row(name: str, trials: Sequence[Trial]) -> str:
    """Return a line of the table."""
    cells = [name]
    for kind in (True, False):
        back = [trial.back for trial in trials if trial.misplaced == kind]
        cells.append(f"{sum(back)} of {len(back)}")
    cells.append(f"{1e3 * np.mean([trial.seconds for trial in trials]):.0f}" if trials else "")
    return f"| {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=4, help="frames between trials")
    options = parser.parse_args(arguments)
    print("| recovered | misplaced limbs | other limbs | ms per search |\n|---|---|---|---|")
    everything: list[Trial] = []
    for path in options.captures:
        trials = recall(Recorded(path), options.every)
        everything += trials
        print(row(path.name, trials), flush=True)
    print(row("all", everything))


if __name__ == "__main__":
    main()
