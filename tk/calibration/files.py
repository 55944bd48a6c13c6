"""Read known intrinsics, and write the calibration file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tomli_w

from tk.calibration.rig import Calibrated
from tk.calibration.verdict import Verdict
from tk.errors import CalibrationError
from tk.io.captures.calibration import CALIBRATION, camera_table, read_calibration
from tk.io.paths import check_output, replacing
from tk.model.cameras.camera import Camera


def read_intrinsics(path: Path | None) -> dict[str, Camera] | None:
    """Return the cameras of an earlier calibration by name; None without one.

    Raises:
        CalibrationError: the file cannot be read.
    """
    return None if path is None else {camera.name: camera for camera in read_calibration(path).rig}


def check_calibration(path: Path, force: bool, inputs: list[Path | None]) -> None:
    """Raise an error if the calibration cannot be written there."""
    check_output(path, CALIBRATION, force, inputs, error=CalibrationError)


def write_calibration(path: Path, done: Calibrated, verdict: Verdict) -> None:
    """Write the cameras, and under `[metadata]` how they were found."""
    tables: dict[str, Any] = {camera.name: camera_table(camera) for camera in done.rig}
    metadata: dict[str, Any] = {
        "units": "m",
        "board": f"{done.board.title}, {done.board.square_m:g} m",
        "verdict": verdict.word,
        "error": float(max(one.rms_px for one in verdict.cameras)),
        "world": verdict.world,
    }
    if verdict.error_m == verdict.error_m:
        metadata["error_at_person_mm"] = round(1000 * verdict.error_m, 2)
    with replacing(path, CalibrationError) as part:
        part.write_text(tomli_w.dumps({**tables, "metadata": metadata}), encoding="utf-8")
