"""Changing a finished result as a whole: a second pass over all frames, or what was smoothed.

The change is made in a copy beside the result, which is synced to the disk and takes the result's name in one rename:
whatever happens, the name stands for the old file or the new one.
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
from tk.io.results.files import WRITE_ERRORS, Workshop, as_result_error, move_to_memory, open_for_writing, writable
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
    """Replace parts of a finished result in one step; what is not given stays.

    Args:
        path: the result. Nobody may be writing it.
        columns: new values of datasets with one row a frame, by name, all F frames of each:
            ``{"pose": (F, 24), "joints/position": (F, 15, 3)}``. The result must have these datasets: a tracker that
            leaves them to a second pass declares them in its :class:`ResultMeta`, and the first pass fills them with
            NaN. What was smoothed from the old values goes unless ``smoothed`` is given, too.
        smoothed: the whole of `/smoothed`, by the names of the unsmoothed datasets; ``bridged`` (F,) bool must be
            there.
        model: the whole of `/model`.
        cameras: the whole of `/cameras`.
        notes: what the run said, a line each.

    Returns:
        the result's metadata.

    Raises:
        ResultError: it is no result, another run is writing it, or it cannot be written. It is then as it was.
        ValueError: an unknown dataset or a wrong shape.
    """
    target = writable(Path(path))
    with open_hdf5(target) as file:
        check_format(file)
        meta = read_meta(file)
        rows = count_rows(file, meta)
    known = columns_of(meta)
    changed = {name: _column(known, name).checked(name, values, rows) for name, values in (columns or {}).items()}
    filtered = None if smoothed is None else _smoothed_values(known, smoothed, rows)
    with as_result_error(target), Workshop(target) as workshop:
        revised = workshop.twin_paths[0]
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
        workshop.publish(revised)
    return meta


def _column(known: Mapping[str, Column], name: str) -> Column:
    if name not in known:
        raise ValueError(f"/{name} is not in this result")
    return known[name]


def _smoothed_values(known: Mapping[str, Column], smoothed: Mapping[str, ArrayLike], rows: int) -> dict[str, Any]:
    """What goes below `/smoothed`, checked against the unsmoothed datasets."""
    if "bridged" not in smoothed:
        raise ValueError("bridged is missing among what was smoothed")
    columns = {**{name: column for name, column in known.items() if can_be_smoothed(name)}, "bridged": Column((), "?")}
    return {name: _column(columns, name).checked(name, values, rows) for name, values in smoothed.items()}
