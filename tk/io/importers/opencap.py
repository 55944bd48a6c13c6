"""OpenCap: camera parameters as Python pickles. They are refused: reading a pickle can run any program.

SESSION/Videos/Cam0/cameraIntrinsicsExtrinsics.pickle
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tk.errors import CalibrationError
from tk.io.importers.project import Format, Tables

_FILE = "cameraIntrinsicsExtrinsics.pickle"


def _refuse(files: Sequence[Path]) -> Tables:
    raise CalibrationError(
        f"{files[0]}: is a Python pickle, which can run any program when it is opened, so tk does not open it; if you "
        "trust its author, convert it as docs/import.md shows, or with Pose2Sim (convert_from = 'opencap'), and "
        "import the TOML file"
    )


FORMAT = Format("OpenCap", (f"Videos/*/{_FILE}", f"*/{_FILE}", "*.pickle", "calibration/*.pickle"), _refuse, videos=())
