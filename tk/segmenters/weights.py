"""The weights of MediaPipe's pose networks, taken out of its wheel.

The package `mediapipe` itself is not needed, and does not go with ours: it wants opencv-contrib-python in the place of
the headless OpenCV, an older protobuf, JAX, and its last version with these networks has no wheel for Python 3.13. So
its wheel is fetched once, with pip, and two files of it (9.4 MB, Apache-2.0) are kept in the user's cache folder.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from tk.errors import ConfigError
from tk.model.hull.tables import default_cache_dir

WHEEL = "mediapipe==0.10.14"

#: file: its place in the wheel, and its SHA-256
FILES = {
    "pose_detection.tflite": (
        "mediapipe/modules/pose_detection/pose_detection.tflite",
        "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
    ),
    "pose_landmark_full.tflite": (
        "mediapipe/modules/pose_landmark/pose_landmark_full.tflite",
        "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
    ),
}

# any wheel of this version holds the same files
_PLATFORM = ("--platform", "manylinux2014_x86_64", "--implementation", "cp", "--python-version", "3.11")
_PATIENCE_S = 600


def weights() -> dict[str, Path]:
    """The networks' files, fetched where they are not there yet.

    Raises:
        ConfigError: they cannot be fetched, or are not those that are meant.
    """
    folder = default_cache_dir() / "segmenter"
    found = {name: _installed(name) or folder / name for name in FILES}
    if not all(path.is_file() for path in found.values()):
        _fetch(folder)
    for name, path in found.items():
        if not _is_right(name, path.read_bytes()):
            raise ConfigError(f"{path}: is not the {name} of {WHEEL}; delete it, and it is fetched again")
    return found


def _is_right(name: str, data: bytes) -> bool:
    return hashlib.sha256(data).hexdigest() == FILES[name][1]


def _installed(name: str) -> Path | None:
    """The file of an installed `mediapipe`, if it is the same."""
    try:
        path = Path(str(distribution("mediapipe").locate_file(FILES[name][0])))
    except PackageNotFoundError:
        return None
    return path if path.is_file() and _is_right(name, path.read_bytes()) else None


def _fetch(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--quiet", "--no-deps"]
        command += ["--only-binary", ":all:", *_PLATFORM, "--dest", scratch, WHEEL]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S)
            why = "" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        except (OSError, subprocess.TimeoutExpired) as error:
            why = str(error)
        wheels = list(Path(scratch).glob("*.whl"))
        if why or not wheels:
            raise ConfigError(
                f"{folder}: the segmenter's weights are not there, and pip could not fetch {WHEEL} ({why}); "
                f"put {' and '.join(FILES)} of its wheel into that folder"
            )
        folder.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(wheels[0]) as wheel:
            for name, (inside, _) in FILES.items():
                part = folder / f"{name}.{os.getpid()}.part"
                part.write_bytes(wheel.read(inside))
                os.replace(part, folder / name)
