"""What each part of the volumetric tracker is worth: mean joint error with one thing changed at a time.

    python -m scripts.ablation CAPTURE [CAPTURE ...] --seeds 2

The masks are made once a capture, from the videos; every row then tracks the whole capture, body fit
included, with each seed. Prints a Markdown table.
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

from tk.config import Config
from tk.io.capture import Capture, open_capture
from tk.io.result import read_joints
from tk.model.objective import BARRED
from tk.segmentation import make_labeller
from tk.tracker import Observation
from tk.volumetric import VolumetricTracker

Changes = dict[str, dict[str, Any]]

# label, settings that differ from the defaults
ROWS: tuple[tuple[str, Changes], ...] = (
    ("defaults", {}),
    ("no outline of the masks", {"contours": {"outline_weight": 0.0}}),
    ("colour edges too, w_e 0.3, hidden 0.3", {"contours": {"edge_weight": 0.3, "hidden": 0.3}}),
    ("colour edges too, as in the paper, w_e 1", {"contours": {"edge_weight": 1.0, "hidden": 1.0, "pairs": 5}}),
    ("no coverage (data to model)", {"objective": {"coverage_weight": 0.0}}),
    ("normals ignored", {"objective": {"min_cosine": -1.0, "coverage_cosine": -1.0}}),
    ("colours ignored", {"appearance": {"enabled": False}}),
    ("no camera is overruled", {"tracking": {"overrule": -1, "overrule_doubt": -1}}),
    ("a camera in doubt carves", {"tracking": {"overrule_doubt": -1}}),
    ("no waist", {"body": {"waist": False}}),
    ("no outline of hands and feet", {"contours": {"extremity_circles": 0}}),
    ("limbs compared by the contour points of an iteration", {"": {"compared": 1}}),
    ("no Gauss-Newton steps at the end", {"schedule": {"newton_iterations": 0}}),
    ("no last pass and no Gauss-Newton steps", {"schedule": {"newton_iterations": 0, "polish_iterations": 0}}),
    ("limbs searched in every frame", {"tracking": {"settled_ratio": 0.0}}),
    ("limbs searched in unusual frames only", {"schedule": {"searched": 0}}),
    ("2 limbs searched in usual frames, 4 hypotheses", {"schedule": {"searched": 2, "hypotheses": 4}}),
    ("no hypotheses at all", {"schedule": {"hypotheses": 1, "wide_hypotheses": 1}}),
    ("no search anew", {"schedule": {"retries": 0}}),
    ("no prediction", {"tracking": {"prediction": 0.0}}),
    ("SMD not whitened", {"schedule": {"whiten": False}}),
    ("shoulders do not rise with the arms", {"": {"rise": False}}),
    ("parts may enter each other", {"": {"exclusion": False}}),
)


class Recorded:
    """A capture in memory: pictures, masks from the videos, truth."""

    def __init__(self, path: Path) -> None:
        self.capture: Capture = open_capture(path, None, "none")
        label = make_labeller(self.capture, Config(), lambda _: None)
        with self.capture.frames() as frames:
            self.frames = [
                Observation(frame.index, np.array(frame.images), *(np.array(layer) for layer in label(frame)))
                for frame in frames
            ]
        self.truth = read_joints(path / "truth.h5").positions

    def error(self, config: Config) -> tuple[NDArray[np.float64], int]:
        """(F, 15) distances from the truth, metres, and how many frames said lost."""
        tracker = VolumetricTracker(self.capture.rig, self.capture.volume, self.capture.up, config)
        tracker.start(self.frames[: config.tracking.init_frames], self.capture.subject_height_m, None)
        found = [tracker.step(frame) for frame in self.frames]
        distance = np.linalg.norm(np.array([estimate.joints for estimate in found]) - self.truth, axis=2)
        return distance, sum(estimate.status == "lost" for estimate in found)


@contextmanager
def changed(changes: Changes) -> Iterator[Config]:
    """The configuration with changes; and, for the row, what no setting switches off."""
    other = changes.get("", {})
    config = Config()
    config = replace(config, **{k: replace(getattr(config, k), **v) for k, v in changes.items() if k})
    with ExitStack() as stack:
        if "rise" in other:
            stack.enter_context(mock.patch("tk.model.skeleton.RAISED_SHOULDERS", 0.0))
        if "exclusion" in other:
            stack.enter_context(mock.patch("tk.model.objective.BARRED", np.zeros_like(BARRED)))
        if "compared" in other:
            stack.enter_context(mock.patch("tk.model.objective.COMPARED", other["compared"]))
        yield config


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--rows", nargs="*", type=int, help="numbers of the rows to run; all by default")
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
