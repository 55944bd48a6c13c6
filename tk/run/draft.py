"""A person's result while it is finished."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.mask_store import MaskStore
from tk.io.results.data import Result
from tk.io.results.revision import Revision
from tk.io.results.status import Status
from tk.people.identity import COLUMNS
from tk.people.person import Person
from tk.run.second_run import TrackerAndMasks
from tk.trackers.protocol import Estimate, Tracker, two_pass


@dataclass
class Draft:
    """A person's result while it is finished.

    Attributes:
        person: whose result it is.
        result: of the first pass.
        tracker: with the body and the cameras as they are now.
        lost: (F,) frames without a pose.
        unclear: (F,) frames that are suspect, whatever their residual is.
        columns: what differs from the file, by dataset.
        masks: of the frames; None without a second pass.
        refined: whether the second pass has changed the poses.
    """

    person: Person
    result: Result
    tracker: Tracker
    lost: NDArray[np.bool_]
    unclear: NDArray[np.bool_]
    columns: dict[str, NDArray[Any]] = field(default_factory=dict)
    masks: MaskStore | None = None
    refined: bool = False

    @property
    def tracker_and_masks(self) -> TrackerAndMasks:
        """The tracker, which has a second pass, and the masks."""
        tracker = two_pass(self.tracker)
        assert tracker is not None and self.masks is not None
        return tracker, self.masks

    def copy(self) -> Draft:
        """Return a draft that can be changed without changing this one."""
        return replace(self, lost=self.lost.copy(), columns=dict(self.columns))

    def current(self, dataset: str) -> Any:
        """Return one of :data:`~tk.people.identity.COLUMNS` as it is now; None if the result has none."""
        return self.columns.get(dataset, getattr(self.result, COLUMNS[dataset]))

    def take(self, rows: NDArray[np.int64], estimates: Sequence[Estimate]) -> None:
        """Take other estimates for some frames; the first frame stays "initialised"."""
        evidence = ("reason", "found", "origin", "sigma", "camera")
        datasets = ("pose", "joints/position", "residual", "objective", *(f"evidence/{name}" for name in evidence))
        columns = {dataset: self.current(dataset).copy() for dataset in datasets}
        if (modes := self.current("evidence/modes")) is not None:
            columns["evidence/modes"] = modes = modes.copy()
            modes[rows] = np.nan
        for row, e in zip(rows, estimates, strict=True):
            columns["pose"][row], columns["joints/position"][row] = e.pose, e.joints
            columns["objective"][row] = e.objective
            columns["evidence/sigma"][row], columns["residual"][row] = e.deviation, e.residual
            columns["evidence/reason"][row], columns["evidence/found"][row] = e.reason, e.found
            if e.modes is not None and modes is not None:
                modes[row] = e.modes
            columns["evidence/camera"][row] = e.cameras
            if columns["evidence/origin"][row] != Status.INITIALISED:
                columns["evidence/origin"][row] = e.origin
            self.lost[row] = e.status == "lost"
        self.columns |= columns


def held(result: Result) -> Result:
    """Return a result in which frames without a pose have that of the last frame before, or of the first one."""
    known = np.isfinite(result.pose).all(axis=1)
    rows = np.maximum.accumulate(np.where(known, np.arange(len(result)), int(np.argmax(known))))
    return replace(result, pose=result.pose[rows], joints=result.joints[rows])


def without_absent(revision: Revision, absent: NDArray[np.bool_]) -> Revision:
    """Return a revision with NaN in the frames (F,) in which the person is absent and that are not bridged."""

    def blank(columns: Mapping[str, Any], rows: Any) -> dict[str, NDArray[Any]]:
        found = {name: np.array(values) for name, values in columns.items()}
        for values in found.values():
            if values.dtype.kind == "f":
                values[rows] = np.nan
        return found

    assert revision.smoothed is not None
    gaps = np.asarray(absent & ~np.asarray(revision.smoothed["bridged"]))
    return replace(revision, columns=blank(revision.columns, absent), smoothed=blank(revision.smoothed, gaps))
