"""This script is now the command `tk calibrate`; it prints that and goes with the first release."""

from __future__ import annotations

import sys


def main() -> None:
    """Print the new command, and exit with 2."""
    print(
        "python -m scripts.calibrate_cameras is now: tk calibrate BOARDS --square 0.11 -o CAPTURE/calibration.toml; "
        "the board to print: tk calibrate --print board.pdf",
        file=sys.stderr,
    )
    raise SystemExit(2)


if __name__ == "__main__":
    main()
