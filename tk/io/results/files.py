"""Where a result file may be written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tk.errors import ConfigError, ResultError
from tk.io.hdf5 import open_hdf5
from tk.io.paths import Kind, check_output
from tk.io.results.schema import FORMAT


def hdf5_kind(format_name: str) -> Kind:
    """Return the kind of HDF5 files with this value of the attribute `format`, of any version."""

    def is_one(path: Path) -> bool:
        try:
            with open_hdf5(path) as file:
                return file.is_format(format_name)
        except ResultError:
            return False

    return Kind(f"a {format_name}", (".h5", ".hdf5"), is_one)


RESULT = hdf5_kind(FORMAT)
#: for files whose content is checked later
ANY_HDF5 = replace(RESULT, is_one=lambda _: True)


def check_result_path(
    path: Path, force: bool, resume: bool = False, inputs: Sequence[Path | None] = (), capture: Path | None = None
) -> None:
    """Check that a result may be written to the path.

    Args:
        path: path of the result.
        force: replace an existing result.
        resume: continue an existing result.
        inputs, capture: see :func:`tk.io.paths.check_output`.

    Raises:
        ResultError: the path cannot be used; the message says what to do.
        ConfigError: ``force`` and ``resume`` are both set, or the path is an input.
    """
    if force and resume:
        raise ConfigError("force replaces a result and resume continues it: choose one of them")
    try:
        check_output(path, ANY_HDF5 if resume else RESULT, force or resume, inputs, capture, ResultError)
    except ResultError as error:
        if error.hint:
            error.hint = "continue it with --resume, or replace it with --force"
        raise
