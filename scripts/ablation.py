"""Ablation of the volumetric tracker: mean joint error with one part changed at a time.

    python -m scripts.ablation CAPTURE [CAPTURE ...] --seeds 2

Each capture is segmented once, from its videos. Every row then tracks the whole capture with each seed, including the
body fit. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from scripts.paper.sampling import diagonal_basis
from tk.io.captures.capture import Capture, open_capture
from tk.io.results.reader import read_joints
from tk.model.cues.objective import BARRED
from tk.model.setup import Subject
from tk.run.segmentation import make_labeller
from tk.run.task import Task
from tk.settings import Settings
from tk.trackers.protocol import Frame
from tk.trackers.volumetric import VolumetricTracker

Changes = dict[str, dict[str, Any]]

SCHEDULE = "tk.optim.schedule"

# label; changes relative to the defaults: settings by their table, constants by their module
ROWS: tuple[tuple[str, Changes], ...] = (
    ("defaults", {}),
    ("no coverage (data to model)", {"volumetric": {"coverage_weight": 0.0}}),
    ("SMD not whitened", {SCHEDULE: {"descent_basis": diagonal_basis}}),
    ("the paper's tolerance, 2° and 2 cm", {SCHEDULE: {"TOLERANCE_DEG": 2.0, "TOLERANCE_M": 0.02}}),
    ("no prediction", {"tk.trackers.volumetric": {"PREDICTIONS": (0.0,)}}),
    ("no limb search", {"silhouette": {"search_every": 0}}),
    ("no colour edges", {"volumetric": {"edge_weight": 0.0}}),
    ("no colours", {"volumetric": {"colors": False}}),
    ("shoulders do not rise with the arms", {"tk.model.body.skeleton": {"RAISED_SHOULDERS": 0.0}}),
    ("no penalty for penetration of parts", {"tk.model.cues.objective": {"BARRED": np.zeros_like(BARRED)}}),
)


class Recorded:
    """A capture in memory: images, masks from the videos, ground truth."""

    def __init__(self, path: Path) -> None:
        self.capture: Capture = open_capture(path, None, "none")
        label = make_labeller(Task.of(self.capture, Settings()), lambda _: None)
        with self.capture.frames() as frames:
            self.frames = [
                Frame(frame.index, np.array(frame.images), *(np.array(layer) for layer in label(frame)[:2]))
                for frame in frames
            ]
        self.truth = read_joints(path / "truth.h5").positions

    def error(self, config: Settings) -> tuple[NDArray[np.float64], int]:
        """Track with these settings; return the joint errors (F, 15), metres, and the number of lost frames."""
        tracker = VolumetricTracker(self.capture.rig, self.capture.volume, self.capture.up, config)
        tracker.start(self.frames[: tracker.opening_frames], Subject(self.capture.subject_height_m))
        found = [tracker.step(frame) for frame in self.frames]
        distance = np.linalg.norm(np.array([estimate.joints for estimate in found]) - self.truth, axis=2)
        return distance, sum(estimate.status == "lost" for estimate in found)


@contextmanager
def changed(changes: Changes) -> Iterator[Settings]:
    """Yield the settings with changes; constants are changed until the end of the block."""
    config = Settings()
    with ExitStack() as stack:
        for place, values in changes.items():
            if "." in place:
                for name, value in values.items():
                    stack.enter_context(mock.patch(f"{place}.{name}", value))
            else:
                config = replace(config, **{place: replace(getattr(config, place), **values)})
        yield config


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--rows", nargs="*", type=int, help="numbers of the rows to run [default: all]")
    options = parser.parse_args(arguments)
    recorded = [Recorded(path) for path in options.captures]
    print("| | " + " | ".join(f"{r.capture.name}: mean (seeds) [cm], lost" for r in recorded) + " | mean |")
    print("|---" * (len(recorded) + 2) + "|")
    for number, (label, changes) in enumerate(ROWS):
        if options.rows and number not in options.rows:
            continue
        cells, means = [], []
        for capture in recorded:
            each, lost = [], 0
            with changed(changes) as config:
                for seed in range(options.seeds):
                    distance, missing = capture.error(replace(config, seed=seed))
                    each.append(100 * distance.mean())
                    lost += missing
            means.append(float(np.mean(each)))
            cells.append(f"{means[-1]:.2f} ({', '.join(f'{e:.2f}' for e in each)}), {lost}")
        print(f"| {label} | " + " | ".join(cells) + f" | {np.mean(means):.2f} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
