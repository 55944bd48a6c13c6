"""Names of files that every system accepts."""

from __future__ import annotations

import re
from collections.abc import Collection

#: names that Windows gives to devices, also with a suffix
_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{k}" for port in ("com", "lpt") for k in range(1, 10))}
#: longest name, characters: the systems allow 255 bytes, of which suffixes need some and a character up to four
_LONGEST = 60


def file_name(text: str, default: str, taken: Collection[str] = ()) -> str:
    """Return a text as a file name without suffix: other characters than letters, digits and ``.+-`` become ``_``.

    Args:
        text: the text.
        default: the name of a text without such characters.
        taken: names that other files have; some systems ignore case.
    """
    name = re.sub(r"[^\w.+-]+", "_", text)[:_LONGEST].strip(".") or default
    if name.split(".")[0].lower() in _DEVICES:
        name = f"_{name}"
    while name.lower() in {other.lower() for other in taken}:
        name += "_"
    return name
