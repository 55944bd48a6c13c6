"""Check probabilities: of the choices to which the program gives a probability p, a share p should be right.

    python -m scripts.probabilities CAPTURE… [--every 5] [--views 2 3 4]

Each capture has a ``truth.h5``; one without an empty scene has masks of the network. It is tracked. In every fifth
frame, if the tracked pose is right, wrong ones are made from it: with exchanged arms, with exchanged legs, with the
opposite heading, and with a limb elsewhere (the four cheapest candidates of each limb). Both settle, with the first
two, three, or all cameras. The probability of the likelier pose is 1 / (1 + exp -d), where d is the difference of the
costs in nats. The choice is right if its joints are nearer to the ground truth. Poses that differ by less than 10 cm
in a joint are no choice. The table shows, by kind and bin of probability, the share that is right, and the number of
choices.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np

from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_joints
from tk.model.body.limb_candidates import exchanged_limbs, pairs, turned
from tk.run.plan import recording_task
from tk.run.session import estimates
from tk.run.task import RecordingOptions
from tk.trackers.protocol import Estimate, Frame, without_cameras
from tk.trackers.region import RegionTracker
from tk.trackers.registry import METHODS

BINS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.97, 1.0)
# Largest distance of a joint, metres: of a pose that is right, and least one between the poses of a choice.
RIGHT_M, CHOICE_M = 0.10, 0.10
ELSEWHERE = 4
"""Candidates of each limb."""


class Made(NamedTuple):
    """A choice between two poses."""

    kind: str
    probability: float
    right: bool


def choices(tracker: RegionTracker, frame: Frame, views: Sequence[int], truth: np.ndarray) -> Iterator[Made]:
    """Yield choices between the last pose, which has tracked ``frame``, and wrong ones; ``truth`` (J, 3) metres."""
    skeleton, pose = tracker.body.skeleton, tracker.last_poses()[0]

    def off(poses: np.ndarray) -> np.ndarray:
        return np.linalg.norm(tracker.world.points_out(skeleton.joints(poses)) - truth, axis=-1)

    if off(pose).max() > RIGHT_M:
        return
    arms, legs = exchanged_limbs(pose, pairs(tracker.limbs))
    wrong = [("arms exchanged", arms), ("legs exchanged", legs), ("opposite heading", turned(pose, tracker.limbs))]
    rng = np.random.default_rng(frame.index)
    for limb in tracker.limbs:
        tried = limb.candidates(pose, 0, rng)
        cost = tracker.see(frame).evidence.cost(tracker.body, tried)
        cost[skeleton.apart(tried, skeleton.joints(pose)) < CHOICE_M] = np.inf
        wrong += [("limb elsewhere", one) for one in limb.distinct(tried, cost, ELSEWHERE)]
    for count in views:
        out = np.arange(len(frame.masks)) >= count
        seen = tracker.see(without_cameras(frame, out), None if out.any() else frame.images)
        starts = np.array([pose, *(one for _, one in wrong)])
        settled = tracker.settle(seen.pyramid, starts, (1, 0), seen.images).states
        cost = tracker.evidence(tracker.fine_grid, seen.frame, seen.pyramid).cost(tracker.body, settled)
        error = off(settled).mean(axis=1)
        apart = skeleton.apart(settled, skeleton.joints(settled[0]))
        for (kind, _), more, worse, far in zip(wrong, cost[1:] - cost[0], error[1:] > error[0], apart[1:], strict=True):
            if far > CHOICE_M:
                probability = 1.0 / (1.0 + np.exp(-min(abs(float(more)), 50.0)))
                yield Made(kind, probability, bool((more > 0) == worse))


def measured(path: Path, every: int, views: Sequence[int]) -> list[Made]:
    """Return the choices in every ``every``-th frame of a capture."""
    truth, made = read_joints(path / "truth.h5"), []
    rows = {int(frame): row for row, frame in enumerate(truth.frames)}

    class Watched(RegionTracker):
        def step(self, frame: Frame) -> Estimate:
            estimate = super().step(frame)
            if frame.index % every == 0 and frame.index in rows:
                cameras = [count for count in views if count <= len(frame.masks)]
                made.extend(choices(self, self.without_foreign(frame), cameras, truth.positions[rows[frame.index]]))
            return estimate

    with mock.patch.dict(METHODS, {"region": Watched}):
        for _ in estimates(recording_task(open_capture(path), RecordingOptions(causal=True))):
            pass
    return made


def table(made: Sequence[Made]) -> Iterator[str]:
    """Yield the lines of the table."""
    bins = list(pairwise(BINS))
    yield f"| choice | {' | '.join(f'{low:g}–{high:g}' for low, high in bins)} |"
    yield "|---" * (1 + len(bins)) + "|"
    for kind in [*dict.fromkeys(one.kind for one in made), "all"]:
        cells = []
        for low, high in bins:
            right = [
                one.right for one in made if kind in (one.kind, "all") and low <= one.probability < high + (high == 1)
            ]
            cells.append(f"{np.mean(right):.2f} of {len(right)}" if right else "–")
        yield f"| {kind} | {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=5, metavar="N")
    parser.add_argument("--views", type=int, nargs="+", default=[2, 3, 4])
    args = parser.parse_args(arguments)
    print("\n".join(table([one for path in args.captures for one in measured(path, args.every, args.views)])))


if __name__ == "__main__":
    main()
