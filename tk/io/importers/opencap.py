"""OpenCap: camera parameters as Python pickles. They are refused: reading a pickle can run any program.

SESSION/Videos/Cam0/cameraIntrinsicsExtrinsics.pickle
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tk.errors import CalibrationError
from tk.io.importers.files import matching
from tk.io.importers.project import Cameras, Format

_FILE = "cameraIntrinsicsExtrinsics.pickle"


def _find(root: Path) -> list[Path]:
    return matching(root, f"Videos/*/{_FILE}", f"*/{_FILE}", "*.pickle", "calibration/*.pickle")


def _refuse(files: Sequence[Path]) -> Cameras:
    raise CalibrationError(
        f"{files[0]}: is a Python pickle, which can run any program when it is opened, so tk does not open it; if you "
        "trust its author, convert it as docs/import.md shows, or with Pose2Sim (convert_from = 'opencap'), and "
        "import the TOML file"
    )


FORMAT = Format(
    tool="OpenCap",
    files=f"Videos/*/{_FILE} or another pickle (tk refuses it and says how to convert it)",
    find=_find,
    read=_refuse,
    videos=(),
)
