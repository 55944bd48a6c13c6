"""How often the search brings a limb back that is somewhere else.

    python -m scripts.search_recall CAPTURE… [--every 4]

In every few frames of a tracked capture each limb is put to places where the person's silhouettes nearly allow it, and
the body settles there. Where that is another minimum of the descent (the limb is 15 cm off, and the body explains less
than it did), the search is asked. It has brought the limb back if elbow and wrist, or knee and ankle, lie within 8 cm
of where they were tracked. There is no truth in it, so any recording of one's own does.

Misplaced limbs, as the tracker itself calls them, are told apart from others: of those more places are descended from.
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
from tk.model.cues.ray_costs import mean_of_views
from tk.trackers.protocol import Observation
from tk.trackers.region import RegionTracker

# Places of a limb that are tried a frame.
TRIES = 2
# A place farther than this is another one, metres; nearly allowed, and worse: costs as a share of the person's pixels.
ELSEWHERE_M, ALLOWED, WORSE = 0.2, 0.12, 0.01
# After settling: the limb is still off; and it is back, metres.
OFF_M, BACK_M = 0.15, 0.08


@dataclass(frozen=True)
class Trial:
    """One limb that was put elsewhere: was it called misplaced, was it brought back, and in how many seconds."""

    misplaced: bool
    back: bool
    seconds: float


class Trials(RegionTracker):
    """The tracker, which can be asked what its search does in the frame that it has just tracked."""

    def trials(self, frame: Observation) -> Iterator[Trial]:
        """Every limb put elsewhere."""
        frame = self.without_foreign(frame)
        pyramid = self.pyramid(frame)
        evidence = self.evidence(self.screen, frame, pyramid)
        pose, group = self._best.pose, self.colors.group
        rng = np.random.default_rng(frame.index)
        own = float(mean_of_views(evidence.cast(self.body, group, pose[None])[0])[0])
        for limb in self.limbs:
            places = limb.candidates(pose, 0, rng)
            cost = mean_of_views(evidence.cast(self.body, group, places)[0])
            allowed = np.flatnonzero((self._off(limb, places, pose) > ELSEWHERE_M) & (cost < own + ALLOWED))
            for k in rng.choice(allowed, min(TRIES, len(allowed)), replace=False):
                wrong = self.settle(pyramid, places[k][None], (1, 0), frame.images).states
                by_view, met = evidence.cast(self.body, group, wrong, export=True)
                assert met is not None
                if self._off(limb, wrong, pose)[0] < OFF_M or mean_of_views(by_view)[0] < own + WORSE:
                    continue
                misplaced = self.misplaced(evidence, met.label[0])
                started = time.perf_counter()
                found, costs = self.search(frame, pyramid, evidence, wrong[0], frame.images, misplaced)
                seconds = time.perf_counter() - started
                best = found[int(np.argmin(costs))]
                yield Trial(limb in misplaced, bool(self._off(limb, best[None], pose)[0] < BACK_M), seconds)

    def _off(self, limb: Limb, poses: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """(B,) how far a limb's joints at poses (B, D) lie from those at a pose (D,), metres."""
        joints = self.body.skeleton.joints
        ends = list(limb.joints)
        return np.asarray(np.linalg.norm(joints(poses)[:, ends] - joints(pose)[ends], axis=2).max(axis=1))


def recall(recorded: Recorded, every: int) -> list[Trial]:
    """The trials of a capture, in every so many frames."""
    capture = recorded.capture
    tracker = Trials(capture.rig, capture.up)
    tracker.start(recorded.frames[: tracker.opening_frames], capture.subject_height_m, None)
    done = []
    for frame in recorded.frames:
        tracked = tracker.step(frame).status == "tracked"
        if tracked and frame.index % every == every // 2:
            done += tracker.trials(frame)
    return done


def row(name: str, trials: Sequence[Trial]) -> str:
    """A line of the table."""
    cells = [name]
    for kind in (True, False):
        back = [trial.back for trial in trials if trial.misplaced == kind]
        cells.append(f"{sum(back)} of {len(back)}")
    cells.append(f"{1e3 * np.mean([trial.seconds for trial in trials]):.0f}" if trials else "")
    return f"| {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=4, help="frames from one trial to the next")
    options = parser.parse_args(arguments)
    print("| brought back | misplaced limbs | others | ms a search |\n|---|---|---|---|")
    everything: list[Trial] = []
    for path in options.captures:
        trials = recall(Recorded(path), options.every)
        everything += trials
        print(row(path.name, trials), flush=True)
    print(row("all", everything))


if __name__ == "__main__":
    main()
