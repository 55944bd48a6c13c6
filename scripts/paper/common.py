"""What the experiments share: a capture tracked with a configuration, errors by frame, tables, figures."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import matplotlib
import numpy as np
from numpy.typing import NDArray

from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_joints
from tk.model.body.skeleton import JOINTS
from tk.run import session
from tk.run.reporter import Silent
from tk.run.task import RecordingOptions
from tk.settings import Settings

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

Float = NDArray[np.float64]

ARM_JOINTS = tuple(JOINTS.index(f"{joint}_{side}") for side in "lr" for joint in ("elbow", "wrist"))
# A frame whose mean joint error exceeds this has lost the person, or most of the limbs, cm.
LOST_CM = 10.0


@dataclass(frozen=True)
class Options:
    """What to run an experiment on.

    Attributes:
        capture: with truth.h5.
        frames: how many from the start, all with None.
        seeds: seeds 0 to this, excluded.
        figure: the PNG to write.
    """

    capture: Path
    frames: int | None
    seeds: int
    figure: Path


@dataclass(frozen=True)
class Track:
    """One tracked capture beside its truth.

    Attributes:
        error_cm: (F, 15) distances of the joints.
        pose: (F, D); iterations: (F, S).
        optimise_ms: (F,) time of the optimisation.
        status_lost: (F,) frames that say lost.
    """

    error_cm: Float
    pose: Float
    pose_units: tuple[str, ...]
    iterations: NDArray[np.integer]
    optimise_ms: Float
    status_lost: NDArray[np.bool_]

    @property
    def frame_cm(self) -> Float:
        """(F,) mean joint error."""
        return self.error_cm.mean(axis=1)

    @property
    def mean_cm(self) -> float:
        return float(self.error_cm.mean())

    @property
    def arms_cm(self) -> float:
        """Mean error of elbows and wrists."""
        return float(self.error_cm[:, list(ARM_JOINTS)].mean())

    @property
    def lost_frames(self) -> int:
        """Frames with a mean joint error above :data:`LOST_CM`."""
        return int((self.frame_cm > LOST_CM).sum())


def track(
    capture: Path,
    config: Settings,
    frames: int | None,
    method: str = "volumetric",
    cameras: Sequence[str] | None = None,
) -> Track:
    """Track a capture, with its exact masks where it has some, and compare with its truth.

    Raises:
        TkError: the capture or its truth cannot be read.
    """
    truth = read_joints(capture / "truth.h5")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "result.h5"
        session.track(open_capture(capture, cameras), out, RecordingOptions(config, method, (0, frames)), Silent())
        result = read_joints(out)
        with h5py.File(out) as file:
            pose, units = file["pose"][:], tuple(file["pose"].attrs["units"])
            iterations = file["iterations"][:]
            optimise = 1000 * file["timing/optimise"][:]
            lost = file["status"][:] == 3
    rows = np.searchsorted(truth.frames, result.frames)
    error = 100 * np.linalg.norm(result.positions - truth.positions[rows], axis=2)
    return Track(error, pose, units, iterations, optimise, lost)


def terms(config: Settings, **values: Any) -> Settings:
    """The settings with other weights of the objective's terms."""
    return replace(config, volumetric=replace(config.volumetric, **values))


def over_seeds(
    options: Options, config: Settings, method: str = "volumetric", cameras: Sequence[str] | None = None
) -> list[Track]:
    """A track for every seed."""
    return [
        track(options.capture, replace(config, seed=seed), options.frames, method, cameras)
        for seed in range(options.seeds)
    ]


def spread(values: Sequence[float], digits: int = 2) -> str:
    """Mean and range over seeds."""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ({min(values):.{digits}f}-{max(values):.{digits}f})"


def table(rows: Sequence[Mapping[str, str]]) -> str:
    """A Markdown table."""
    names = list(rows[0])
    lines = [names, ["---"] * len(names), *([row[name] for name in names] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def save(figure: Figure, file: Path) -> None:
    """Write a small PNG."""
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.tight_layout()
    figure.savefig(file, dpi=80)
    plt.close(figure)
