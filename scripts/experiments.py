"""The experiments of Kehl & Van Gool 2006, section 7: a figure and a table each, beside the paper's figures.

    python -m scripts.experiments NAME CAPTURE [--frames N] [--seeds N] [--out DIR]

Captures have a ``truth.h5``: ``python -m scripts.make_capture --motion MOTION --masks --out DIR`` makes them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from scripts.paper import cues, motion, optimisers, resolution, sampling, views
from scripts.paper.common import Options
from tk.errors import TkError


@dataclass(frozen=True)
class Experiment:
    """run: writes a figure, gives a table; paper: what the paper found; seeds: by default."""

    run: Callable[[Options], str]
    section: str
    paper: str
    seeds: int = 3


EXPERIMENTS = {
    "sampling": Experiment(
        sampling.run,
        "7.1",
        "one run each: stochastic 5.0° and 1.6° left, 15 iterations; deterministic 17.7° and 10.6°, 12",
        seeds=50,
    ),
    "cues": Experiment(
        cues.run, "7.2", "surface alone: the left arm stuck to the body for some frames; not with edges"
    ),
    "optimisers": Experiment(
        optimisers.run,
        "7.3",
        "SMD 2.89 cm, 793 ms, 6 iterations; LM lost after 25 frames; at 5× points 4.27 cm, 1374.5 ms, 9",
    ),
    "motion": Experiment(motion.run, "7.4", "tracked, changes of up to 31° a frame, 4.1° on average; no error given"),
    "resolution": Experiment(resolution.run, "7.5", "128³: tracked, 1131 ms a frame; no error given"),
    "views": Experiment(views.run, "table 1", "times only", seeds=2),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one experiment."""
    parser = argparse.ArgumentParser(prog="python -m scripts.experiments", description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=list(EXPERIMENTS))
    parser.add_argument("capture", type=Path)
    parser.add_argument("--frames", type=int, help="how many from the start [default: all]")
    parser.add_argument("--seeds", type=int, help="how many [default: the experiment's own]")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder of the figure")
    given = parser.parse_args(arguments)
    experiment = EXPERIMENTS[given.name]
    seeds = given.seeds or experiment.seeds
    try:
        found = experiment.run(Options(given.capture, given.frames, seeds, given.out / f"{given.name}.png"))
    except TkError as error:
        raise SystemExit(str(error)) from None
    print(f"{experiment.section}, {given.capture.name}, {seeds} seeds. The paper: {experiment.paper}.\n\n{found}")


if __name__ == "__main__":
    main()
