"""Read TOML tables with errors that name the file and the key."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError

# the standard library has a reader from Python 3.11 on; tomli is the same code for 3.10
_toml = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")


def load_toml(path: Path, error: type[CaptureError] = CaptureError) -> dict[str, Any]:
    """The document in ``path``. Raises ``error`` when it cannot be read or is not TOML."""
    try:
        text = path.read_bytes().decode("utf-8-sig")  # Windows editors leave a byte order mark
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror or reason})") from None
    except UnicodeDecodeError:
        raise error(f"{path}: is not UTF-8 text") from None
    try:
        return _toml.loads(text)
    except _toml.TOMLDecodeError as reason:
        raise error(f"{path}: invalid TOML: {' '.join(str(reason).split())}") from None


class Table:
    """One TOML table: typed access, and every complaint carries where the value stands.

    Args:
        values: the parsed table.
        where: how messages name it, e.g. ``"…/calibration.toml: camera 'cam1'"``.
        error: the exception class to raise.
    """

    def __init__(self, values: Mapping[str, Any], where: str, error: type[CaptureError] = CaptureError) -> None:
        self.values = values
        self.where = where
        self.error = error

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def fail(self, message: str) -> NoReturn:
        """Raise this table's error about ``message``."""
        raise self.error(f"{self.where}: {message}")

    def table(self, key: str) -> Table:
        """The sub-table ``key``, empty when it is absent."""
        value = self.values.get(key, {})
        if not isinstance(value, Mapping):
            self.fail(f"{key} must be a table [{key}]")
        return Table(value, f"{self.where}: [{key}]", self.error)

    def text(self, key: str, default: str) -> str:
        """The string ``key``, not empty."""
        value = self.values.get(key, default)
        if not isinstance(value, str) or not value.strip():
            self.fail(f"{key} = {value!r} must be a text that is not empty")
        return value

    def flag(self, key: str, default: bool) -> bool:
        value = self.values.get(key, default)
        if not isinstance(value, bool):
            self.fail(f"{key} = {value!r} must be true or false")
        return value

    def integer(self, key: str, default: int) -> int:
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            self.fail(f"{key} = {value!r} must be a whole number")
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """The finite number ``key``; it must be there when no ``default`` is given."""
        value = self.values.get(key, default)
        if value is None:
            self.fail(f"{key} is missing")
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            self.fail(f"{key} = {value!r} must be a finite number")
        try:
            number = float(value)
        except OverflowError:  # a whole number of more than 308 digits
            self.fail(f"{key} has {len(str(value))} digits, too many for a number")
        if not math.isfinite(number):
            self.fail(f"{key} = {value!r} must be a finite number")
        return number

    def array(self, key: str, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
        """The finite numbers ``key`` as an array of one of these shapes."""
        if key not in self.values:
            self.fail(f"{key} is missing")
        value = self.values[key]
        wanted = " or ".join("×".join(map(str, shape)) for shape in shapes)
        shape = _shape(value)
        if shape is None or shape not in shapes:
            found = "something else" if shape is None else "×".join(map(str, shape)) or "one number"
            self.fail(f"{key} must be {wanted} numbers, and is {found}")
        try:
            result = np.array(value, dtype=np.float64)
        except OverflowError:  # a whole number of more than 308 digits
            self.fail(f"{key} holds a number that is too large")
        if not np.isfinite(result).all():
            bad = result[~np.isfinite(result)][0]
            self.fail(f"{key} holds {bad}; every number must be finite")
        return result


def _shape(value: object) -> tuple[int, ...] | None:
    """The shape of nested lists of numbers, None when they are ragged or hold anything else."""
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
