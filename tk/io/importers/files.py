"""Find and read files of other tools with care: a project's folder may hold anything."""

from __future__ import annotations

import math
import re
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from tk.errors import CalibrationError
from tk.io.toml import load_toml

#: largest calibration file, bytes. Files of hundreds of cameras have 1 MB; the limit only stops endless reading.
LARGEST = 16 * 2**20


def check_file(path: Path, largest: int = LARGEST) -> None:
    """Check that reading ``path`` ends soon.

    Raises:
        CalibrationError: it is missing, no regular file (a pipe never ends), or larger than ``largest`` bytes.
    """
    try:
        status = path.stat()
    except OSError as reason:
        raise CalibrationError(f"{path}: cannot be read ({reason.strerror or reason})") from None
    if not stat.S_ISREG(status.st_mode):
        raise CalibrationError(f"{path}: is no regular file; replace it by the calibration file itself")
    if status.st_size > largest:
        raise CalibrationError(
            f"{path}: has {status.st_size / 2**20:.0f} MiB, too large for a calibration file (at most "
            f"{largest / 2**20:.0f} MiB); move it out of the folder"
        )


def read_text(path: Path) -> str:
    """Return the text of a calibration file.

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
    """Return a TOML document. Raises CalibrationError as :func:`read_text` does, and when it is not TOML."""
    check_file(path)
    return load_toml(path, CalibrationError)


def read_xml(path: Path) -> ElementTree.Element:
    """Return the root of an XML document. Entities are refused: they can make a small file endless.

    Raises:
        CalibrationError: see :func:`read_text`; or it is not XML.
    """
    text = read_text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise CalibrationError(f"{path}: declares a document type, which calibrations do not; remove the declaration")
    # the text is decoded already, so the encoding that the file declares does not apply
    text = re.sub(r"^\s*<\?xml.*?\?>", "", text, count=1, flags=re.S)
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as reason:
        raise CalibrationError(f"{path}: invalid XML: {reason}") from None


def matching(folder: Path, *patterns: str) -> list[Path]:
    """Return the folder's files that match these glob patterns, sorted, without folders and hidden files."""
    found = {path for pattern in patterns for path in folder.glob(pattern)}
    return sorted(path for path in found if not path.is_dir() and not path.name.startswith("."))


def only(files: Sequence[Path]) -> Path:
    """Return the one file.

    Raises:
        CalibrationError: there are several.
    """
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise CalibrationError(f"{files[0].parent}: holds several calibrations: {names}; keep only the right one")
    return files[0]


@dataclass(frozen=True)
class Attributes:
    """An element's attributes; ``where`` is the beginning of every error message."""

    element: ElementTree.Element
    where: str

    @staticmethod
    def child(parent: ElementTree.Element, path: str, where: str) -> Attributes:
        """Return the first child at ``path``. Raises CalibrationError if there is none."""
        found = parent.find(path)
        if found is None:
            raise CalibrationError(f"{where}: has no <{path.rpartition('/')[2]}>")
        return Attributes(found, f"{where}: <{found.tag}>")

    def numbers(self, key: str, count: int, default: list[float] | None = None, skip: int = 0) -> list[float]:
        """Return the finite numbers of an attribute after ``skip`` words: ``count`` or more; ``default`` if missing.

        Raises:
            CalibrationError: it is missing without a default, or does not hold such numbers.
        """
        text = self.element.get(key)
        if text is None:
            if default is not None:
                return default
            raise CalibrationError(f"{self.where}: {key} is missing")
        try:
            values = [float(word) for word in text.split()[skip:]]
        except ValueError:
            values = []
        if len(values) < count or not all(math.isfinite(value) for value in values):
            wanted = "a finite number" if count == 1 else f"{count} finite numbers"
            raise CalibrationError(f"{self.where}: {key} = {text[:60]!r} must be {wanted}")
        return values

    def number(self, key: str, default: float | None = None) -> float:
        """Return the one finite number of an attribute. Raises as :meth:`numbers` does."""
        return self.numbers(key, 1, None if default is None else [default])[0]
