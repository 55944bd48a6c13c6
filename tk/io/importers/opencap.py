"""OpenCap: camera parameters as Python pickles, which are refused without being opened.

    SESSION/Videos/Cam0/cameraIntrinsicsExtrinsics.pickle

Reading a pickle runs whatever program its author put into it.
"""

from __future__ import annotations

from pathlib import Path

from tk.errors import CalibrationError
from tk.io.importers.files import matching
from tk.io.importers.project import Project, Request

TOOL = "OpenCap"
LOOKS_FOR = "Videos/*/cameraIntrinsicsExtrinsics.pickle or another pickle (which is refused, with a way to convert it)"
NESTS = False


def detect(root: Path) -> bool:
    return bool(_pickles(root))


def read(root: Path, request: Request) -> Project:
    raise CalibrationError(
        f"{_pickles(root)[0]}: is a Python pickle, which can run any program when it is opened, so tk does not open "
        "it; if you trust where it comes from, convert it as docs/import.md shows, or with Pose2Sim (convert_from = "
        "'opencap'), and import the TOML file"
    )


def _pickles(root: Path) -> list[Path]:
    return matching(
        root,
        "Videos/*/cameraIntrinsicsExtrinsics.pickle",
        "*/cameraIntrinsicsExtrinsics.pickle",
        "*.pickle",
        "calibration/*.pickle",
    )
