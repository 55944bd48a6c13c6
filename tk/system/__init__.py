"""What differs between operating systems: files without a name, locks, processes, signals, folders, the machine.

No other module uses what only some systems have; a test checks it. What differs has two variants: that of Linux, and
a portable one for all other systems. The environment variable ``TK_PORTABLE=1`` chooses the portable one on Linux, too,
where the tests run it.
"""

from __future__ import annotations

import os
import sys

LINUX, WINDOWS = sys.platform == "linux", sys.platform == "win32"


def portable() -> bool:
    """Return whether to use only what all systems have."""
    return not LINUX or os.environ.get("TK_PORTABLE") == "1"
