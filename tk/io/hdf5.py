"""Opening HDF5 files that others may have made."""

from __future__ import annotations

from pathlib import Path

import h5py

from tk.errors import ResultError


def open_hdf5(path: Path) -> h5py.File:
    """Open for reading. Without locks: a published result is never written to."""
    if not path.is_file():
        raise ResultError(f"{path}: is a folder; name a file" if path.is_dir() else f"{path}: no such file")
    try:
        return h5py.File(path, "r", locking=False)
    except PermissionError:
        raise ResultError(f"{path}: no permission to read it") from None
    except OSError:
        raise ResultError(f"{path}: is not an HDF5 file, or is damaged") from None
