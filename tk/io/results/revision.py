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

from numpy.typing import ArrayLike, NDArray

from tk.errors import ResultError
from tk.io.hdf5 import open_hdf5
from tk.io.paths import check_output
from tk.io.results.data import ResultMeta, UsedCameras, Value
from tk.io.results.files import ANY_HDF5, SafeFile, TwinFolder, writing
from tk.io.results.layout import link_first_person, put_attributes, put_cameras, put_model
from tk.io.results.reader import check_format, count_people, count_rows, read_meta
from tk.io.results.schema import Column, columns_of, prefix_of, smoothed_columns


def revise_result(
    path: str | os.PathLike[str],
    columns: Mapping[str, ArrayLike] | None = None,
    *,
    smoothed: Mapping[str, ArrayLike] | None = None,
    model: Mapping[str, Value] | None = None,
    cameras: UsedCameras | None = None,
    notes: Sequence[str] | None = None,
    person: int = 0,
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
        person: the person to whom ``columns``, ``smoothed`` and ``model`` belong.

    Returns:
        the result's metadata.

    Raises:
        ResultError: the file is no result, another run is writing it, or it cannot be written. It is unchanged.
        ValueError: a dataset or the person is unknown, or a dataset has the wrong shape.
    """
    target = check_output(Path(path), ANY_HDF5, force=True, error=ResultError)
    prefix = prefix_of(person)
    with open_hdf5(target) as file:
        check_format(file)
        if not 0 <= person < count_people(file):
            raise ValueError(f"{path}: has no person {person}")
        meta = read_meta(file, prefix)
        rows = count_rows(file, meta, prefix)
    known = columns_of(meta)
    copies = smoothed_columns(known)
    changed = _checked(known, columns or {}, rows)
    if smoothed is not None and "bridged" not in smoothed:
        raise ValueError("/smoothed needs bridged, which is missing")
    filtered = _checked(copies, smoothed or {}, rows)
    with writing(target), TwinFolder(target) as twin_folder:
        revised = twin_folder.twin_paths[0]
        shutil.copyfile(target, revised)
        with SafeFile(revised, "r+") as disk:
            copy = disk.file
            for name, values in changed.items():
                copy[prefix + name][...] = values
            if (changed or filtered) and f"{prefix}smoothed" in copy:
                del copy[f"{prefix}smoothed"]
            for name, values in filtered.items():
                dataset = copy.create_dataset(f"{prefix}smoothed/{name}", data=values)
                put_attributes(dataset, copies[name].attributes)
            if model is not None:
                put_model(copy, model, person)
            if cameras is not None:
                put_cameras(copy, cameras)
            if notes is not None:
                put_attributes(copy, {"notes": notes})
            link_first_person(copy)
        with revised.open("rb") as stream:
            os.fsync(stream.fileno())
        twin_folder.publish(revised)
    return meta


def _checked(known: Mapping[str, Column], values: Mapping[str, ArrayLike], rows: int) -> dict[str, NDArray[Any]]:
    """Return the values of datasets in their types; refuse unknown datasets and wrong shapes."""
    unknown = sorted(values.keys() - known.keys())
    if unknown:
        raise ValueError(f"/{unknown[0]} is not in this result")
    return {name: known[name].checked(name, array, rows) for name, array in values.items()}
