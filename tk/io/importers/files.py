"""Files of other tools: found and read with care, since a project's folder may hold anything."""

from __future__ import annotations

import re
import stat
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

from tk.errors import CalibrationError
from tk.io.toml import load_toml

#: bytes of a calibration file; those of hundreds of cameras take 1 MB
LARGEST = 16 * 2**20


def check_file(path: Path, largest: int = LARGEST) -> None:
    """Make sure that reading ``path`` comes to an end, and soon.

    Raises:
        CalibrationError: it is missing, no regular file (a pipe would wait for ever), or larger than ``largest`` bytes.
    """
    try:
        status = path.stat()
    except OSError as reason:
        raise CalibrationError(f"{path}: cannot be read ({reason.strerror or reason})") from None
    if not stat.S_ISREG(status.st_mode):
        raise CalibrationError(f"{path}: is no regular file; put the calibration file itself in its place")
    if status.st_size > largest:
        raise CalibrationError(
            f"{path}: has {status.st_size / 2**20:.0f} MiB, which is too large for a calibration file "
            f"({largest / 2**20:.0f} MiB at most); move it out of the folder"
        )


def read_text(path: Path) -> str:
    """The text of a calibration file.

    Raises:
        CalibrationError: see :func:`check_file`; or it is not UTF-8.
    """
    check_file(path)
    try:
        return path.read_bytes().decode("utf-8-sig")
    except OSError as reason:
        raise CalibrationError(f"{path}: cannot be read ({reason.strerror or reason})") from None
    except UnicodeDecodeError:
        raise CalibrationError(f"{path}: is not UTF-8 text") from None


def read_toml(path: Path) -> dict[str, object]:
    """A TOML document. Raises CalibrationError as :func:`read_text` does, and when it is not TOML."""
    check_file(path)
    return load_toml(path, CalibrationError)


def read_xml(path: Path) -> ElementTree.Element:
    """The root of an XML document. Entities of its own are refused: they can make a small file endless.

    Raises:
        CalibrationError: see :func:`read_text`; or it is not XML.
    """
    text = read_text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise CalibrationError(f"{path}: declares a document type, which no calibration does; remove the declaration")
    # the text has been decoded: an encoding that the file declares is no longer true
    text = re.sub(r"^\s*<\?xml.*?\?>", "", text, count=1, flags=re.S)
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as reason:
        raise CalibrationError(f"{path}: invalid XML: {reason}") from None


def matching(folder: Path, *patterns: str) -> list[Path]:
    """What the folder holds for these glob patterns, folders and hidden files left out, sorted."""
    found = {path for pattern in patterns for path in folder.glob(pattern)}
    return sorted(path for path in found if not path.is_dir() and not path.name.startswith("."))


def only(found: Iterable[Path], what: str) -> Path:
    """The one file that was found.

    Raises:
        CalibrationError: there are several.
    """
    files = list(found)
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise CalibrationError(f"{files[0].parent}: holds several {what}: {names}; leave the one that is meant")
    return files[0]
