"""Change a finished result: the columns of a second pass, smoothed copies, body, cameras, notes.

The change is made in a copy beside the result. The copy is synced to the disk and takes the result's name in one
rename, so at any time the name refers to the complete old file or to the complete new one.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from tk.io.hdf5 import open_hdf5
from tk.io.results.columns import Column, columns_of, put_attributes, strings
from tk.io.results.data import ResultMeta, UsedCameras, Value, can_be_smoothed
from tk.io.results.files import WRITE_ERRORS, TwinFolder, as_result_error, move_to_memory, open_for_writing, writable
from tk.io.results.layout import put_cameras, put_model
from tk.io.results.reader import check_format, count_rows, read_meta


def revise_result(
    path: str | os.PathLike[str],
    columns: Mapping[str, ArrayLike] | None = None,
    *,
    smoothed: Mapping[str, ArrayLike] | None = None,
    model: Mapping[str, Value] | None = None,
    cameras: UsedCameras | None = None,
    notes: Sequence[str] | None = None,
) -> ResultMeta:
    """Replace parts of a finished result in one step; other parts stay as they are.

    Args:
        path: the result; no run may be writing it.
        columns: new values of datasets with one row per frame, by dataset name, for all F frames:
            ``{"pose": (F, D), "joints/position": (F, 15, 3)}``. The result must have these datasets: a tracker that
            fills them in a second pass declares them in its :class:`ResultMeta`, and the first pass writes NaN.
            New columns delete `/smoothed`, unless ``smoothed`` is given.
        smoothed: all of `/smoothed`, by the names of the unsmoothed datasets; ``bridged`` (F,) bool is required.
        model: all of `/model`.
        cameras: all of `/cameras`.
        notes: messages of the run, one line each.

    Returns:
        the result's metadata.

    Raises:
        ResultError: the file is no result, another run is writing it, or it cannot be written. It is unchanged.
        ValueError: a dataset is unknown or has the wrong shape.
    """
    target = writable(Path(path))
    with open_hdf5(target) as file:
        check_format(file)
        meta = read_meta(file)
        rows = count_rows(file, meta)
    known = columns_of(meta)
    changed = {name: _column(known, name).checked(name, values, rows) for name, values in (columns or {}).items()}
    filtered = None if smoothed is None else _smoothed_values(known, smoothed, rows)
    with as_result_error(target), TwinFolder(target) as twin_folder:
        revised = twin_folder.twin_paths[0]
        shutil.copyfile(target, revised)
        with open_for_writing(revised, "r+") as copy:
            try:
                for name, values in changed.items():
                    copy[name][...] = values
                if (changed or filtered is not None) and "smoothed" in copy:
                    del copy["smoothed"]
                for name, values in (filtered or {}).items():
                    dataset = copy.create_dataset(f"smoothed/{name}", data=values)
                    if name in known:
                        put_attributes(dataset, known[name])
                if model is not None:
                    put_model(copy, model)
                if cameras is not None:
                    put_cameras(copy, cameras)
                if notes is not None:
                    copy.attrs["notes"] = strings(notes)
                copy.flush()
            except WRITE_ERRORS:
                move_to_memory(copy)
                raise
        with revised.open("rb") as stream:
            os.fsync(stream.fileno())
        twin_folder.publish(revised)
    return meta


def _column(known: Mapping[str, Column], name: str) -> Column:
    if name not in known:
        raise ValueError(f"/{name} is not in this result")
    return known[name]


def _smoothed_values(known: Mapping[str, Column], smoothed: Mapping[str, ArrayLike], rows: int) -> dict[str, Any]:
    """Return the datasets of `/smoothed`, checked against the unsmoothed ones."""
    if "bridged" not in smoothed:
        raise ValueError("/smoothed needs bridged, which is missing")
    columns = {**{name: column for name, column in known.items() if can_be_smoothed(name)}, "bridged": Column((), "?")}
    return {name: _column(columns, name).checked(name, values, rows) for name, values in smoothed.items()}
