"""TOML tables, with errors that name the file and the key. Every number has a bound."""

from __future__ import annotations

import codecs
import importlib
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, TkError

# the standard library has a reader from Python 3.11 on; tomli is the same code for 3.10
_toml = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")


#: largest number in a TOML file, in any unit: 10⁶ km in mm. A larger one is taken for a mistake.
LARGE = 1e9

#: most bytes of a TOML file. A calibration has some hundred a camera; a larger file was not written by a person.
MOST_BYTES = 16_777_216


def load_toml(path: Path, error: type[TkError] = CaptureError) -> dict[str, Any]:
    """Return the document in ``path``. Raises ``error`` when it cannot be read or is not TOML."""
    return parse_toml(read_text(path, error), str(path), error)


def read_text(path: Path, error: type[TkError] = CaptureError) -> str:
    """Return the text of a small file. Raises ``error`` if it cannot be read, is large, or is not a file (a pipe would
    never end).

    A byte order mark, which Windows editors write, is skipped; with that of UTF-16 the text is read as such.
    """
    try:
        if path.exists() and not path.is_file():
            raise error(f"{path}: cannot be read (it is not a file)")
        if path.stat().st_size > MOST_BYTES:
            raise error(f"{path}: has more than {MOST_BYTES // 2**20} MiB; it is not a file that a person wrote")
        content = path.read_bytes()
        return content.decode("utf-16" if content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig")
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror or reason})") from None
    except UnicodeDecodeError:
        raise error(f"{path}: is not UTF-8 text") from None


def parse_toml(text: str, where: str, error: type[TkError] = CaptureError) -> dict[str, Any]:
    """Return the document in ``text``. Raises ``error``, whose message begins with ``where``, if it is not TOML."""
    try:
        return _toml.loads(text)
    except ValueError as reason:  # TOMLDecodeError, or Python's own for a number of thousands of digits
        raise error(f"{where}: invalid TOML: {' '.join(str(reason).split())}") from None
    except RecursionError:
        raise error(f"{where}: invalid TOML: lists or tables lie too deep within each other") from None


def shown(value: object) -> str:
    """Return a value as a short text for a message."""
    try:
        text = repr(value)
    except ValueError:  # Python writes no numbers of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) <= 60 else f"{text[:57]}..."


class Table:
    """One TOML table: typed access; each error names the place of the value.

    Args:
        values: the parsed table.
        where: how messages name it, e.g. ``"…/calibration.toml: camera 'cam1'"``.
        error: the exception class to raise.
    """

    def __init__(self, values: Mapping[str, Any], where: str, error: type[TkError] = CaptureError) -> None:
        self.values = values
        self.where = where
        self.error = error

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def fail(self, message: str) -> NoReturn:
        """Raise this table's error about ``message``."""
        raise self.error(f"{self.where}: {message}")

    def table(self, key: str) -> Table:
        """Return the sub-table ``key``; an empty one if it is absent."""
        value = self.values.get(key, {})
        if not isinstance(value, Mapping):
            self.fail(f"{key} must be a table [{key}]")
        return Table(value, f"{self.where}: [{key}]", self.error)

    def text(self, key: str, default: str) -> str:
        """Return the string ``key``, which must not be empty."""
        value = self.values.get(key, default)
        if not isinstance(value, str) or not value.strip():
            self.fail(f"{key} = {shown(value)} must be a text that is not empty")
        return value

    def flag(self, key: str, default: bool) -> bool:
        value = self.values.get(key, default)
        if not isinstance(value, bool):
            self.fail(f"{key} = {shown(value)} must be true or false")
        return value

    def integer(self, key: str, default: int) -> int:
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            self.fail(f"{key} = {shown(value)} must be a whole number")
        if abs(value) > LARGE:
            self.fail(f"{key} = {shown(value)} is too large; give {LARGE:.0e} at most")
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """Return the number ``key``, at most :data:`LARGE`. Without a ``default`` the key is required."""
        value = self.values.get(key, default)
        if value is None:
            self.fail(f"{key} is missing")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or _is_endless(value):
            self.fail(f"{key} = {shown(value)} must be a finite number")
        if abs(value) > LARGE:
            self.fail(f"{key} = {shown(value)} is too large; give {LARGE:.0e} at most")
        return float(value)

    def array(self, key: str, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
        """Return the numbers ``key``, each at most :data:`LARGE`, as an array of one of these shapes.

        A row (1, N) or a column (N, 1), as OpenCV returns vectors, counts as a list (N,).
        """
        if key not in self.values:
            self.fail(f"{key} is missing")
        value = self.values[key]
        wanted = " or ".join("×".join(map(str, shape)) or "1" for shape in shapes)
        shape = _shape(value)
        if shape is not None and shape not in shapes and len(shape) == 2 and 1 in shape:
            value, shape = list(_flat(value)), (max(shape),)
        if shape is None or shape not in shapes:
            found = "something else" if shape is None else "×".join(map(str, shape)) or "one number"
            self.fail(f"{key} must be {wanted} numbers, and is {found}")
        for number in _flat(value):
            if _is_endless(number):
                self.fail(f"{key} holds {number}; every number must be finite")
            if abs(number) > LARGE:
                self.fail(f"{key} holds {shown(number)}, which is too large; give {LARGE:.0e} at most")
        return np.array(value, dtype=np.float64)


def _is_endless(value: float) -> bool:
    """Return whether a value is infinite or NaN; an integer never is."""
    return isinstance(value, float) and not math.isfinite(value)


def _flat(value: Any) -> Iterator[float]:
    """Yield the numbers in nested lists."""
    if isinstance(value, (int, float)):
        yield value
    else:
        for item in value:
            yield from _flat(item)


def _shape(value: object) -> tuple[int, ...] | None:
    """Return the shape of nested lists of numbers; None if they are ragged or contain anything else."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return ()
    if not isinstance(value, Sequence) or isinstance(value, str):
        return None
    inner = {_shape(item) for item in value}
    if not inner:
        return (0,)
    if len(inner) > 1 or None in inner:
        return None
    (rest,) = inner
    assert rest is not None
    return (len(value), *rest)
