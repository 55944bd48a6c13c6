"""Attributes of XML elements as numbers; errors name the element."""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from tk.errors import CalibrationError


@dataclass(frozen=True)
class Attributes:
    """An element's attributes; ``where`` is the beginning of every error message."""

    element: Element
    where: str

    @staticmethod
    def child(parent: Element, path: str, where: str) -> Attributes:
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
