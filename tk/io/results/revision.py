"""Change a finished result: the columns of a second pass, smoothed copies, body, cameras, notes.

At any time the name refers to the complete old file or to the complete new one, see :mod:`tk.io.hdf5_writer`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike, NDArray

from tk.errors import ResultError
from tk.io.hdf5_writer import Hdf5Writer, writing
from tk.io.paths import check_output
from tk.io.results.data import ResultMeta, UsedCameras, Value
from tk.io.results.files import ANY_HDF5
from tk.io.results.layout import Layout, put_attributes
from tk.io.results.reader import open_result
from tk.io.results.schema import Column, columns_of, smoothed_columns


@dataclass(frozen=True)
class Revision:
    """What replaces parts of a person's result; other parts stay as they are.

    Attributes:
        columns: new values of the person's datasets with one row per frame, by dataset name, for all F frames:
            ``{"pose": (F, D), "joints/position": (F, J, 3)}``. The result must have these datasets: a tracker that
            fills them in a second pass declares them in its :class:`ResultMeta`, and the first pass writes NaN.
            New columns delete `/smoothed`, unless ``smoothed`` is given.
        smoothed: all of `/smoothed`, by the names of the unsmoothed datasets; ``bridged`` (F,) bool is required.
        model: all of `/model`.
    """

    columns: Mapping[str, ArrayLike] = field(default_factory=dict)
    smoothed: Mapping[str, ArrayLike] | None = None
    model: Mapping[str, Value] | None = None


def revise_people(
    path: str | os.PathLike[str],
    revisions: Mapping[int, Revision],
    cameras: UsedCameras | None = None,
    notes: Sequence[str] | None = None,
) -> ResultMeta:
    """Replace parts of a finished result in one step.

    Args:
        path: the result; no run may be writing it.
        revisions: by number of the person.
        cameras: all of `/cameras`.
        notes: messages of the run, one line each.

    Returns:
        the result's metadata.

    Raises:
        ResultError: the file is no result, another run is writing it, or it cannot be written. It is unchanged.
        ValueError: a dataset or a person is unknown, or a dataset has the wrong shape.
    """
    target = check_output(Path(path), ANY_HDF5, force=True, error=ResultError)
    with open_result(target, to_change=True) as (_, people):
        if unknown := revisions.keys() - set(range(len(people))):
            raise ValueError(f"{path}: has no person {min(unknown)}")
        meta, rows = people[0].meta, people[0].count
    known = {name: column for name, column in columns_of(meta).items() if not column.entry.of_run}
    checked = {}
    for person, revision in revisions.items():
        if revision.smoothed is not None and "bridged" not in revision.smoothed:
            raise ValueError("/smoothed needs bridged, which is missing")
        changed = _checked(known, revision.columns, rows)
        checked[person] = changed, _checked(smoothed_columns(known), revision.smoothed or {}, rows)
    with writing(target), Hdf5Writer(target, target) as disk:
        layout = Layout(disk.file, meta)
        for person, revision in revisions.items():
            layout.replace(person, *checked[person])
            if revision.model is not None:
                layout.put_model(person, revision.model)
        if cameras is not None:
            layout.put_cameras(cameras)
        if notes is not None:
            put_attributes(disk.file, {"notes": notes})
    return meta


def _checked(known: Mapping[str, Column], values: Mapping[str, ArrayLike], rows: int) -> dict[str, NDArray[Any]]:
    """Return the values of datasets in their types; refuse unknown datasets and wrong shapes."""
    unknown = sorted(values.keys() - known.keys())
    if unknown:
        raise ValueError(f"/{unknown[0]} is not in this result")
    return {name: known[name].checked(name, array, rows) for name, array in values.items()}
