"""Write a result file frame by frame; it can be read at any time, and an interrupted run can be resumed.

HDF5 rewrites its metadata (dataset sizes, chunk trees, superblock) in place and in several steps, so a process that is
killed during a flush can leave a file that does not open. A published result is therefore never modified. Two copies of
it, the twins, are in a hidden folder beside it. Each finished frame is written to the twin that is *not* published;
this twin is flushed and takes the result's name in one rename. The other twin gets the frame together with the next
one. After ``kill -9`` at any time, the name refers to a complete file with every appended frame, and the stored state
belongs to its last frame. A power cut is not covered: only the closed file is synced to the disk.

On a file system without hard links, the twin is copied for each frame: as safe, but slower.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from tk.errors import ResultError
from tk.io.hdf5 import open_hdf5
from tk.io.results.data import (
    FORMAT,
    FrameResult,
    Hull,
    HullPoints,
    JointAngles,
    JointTrack,
    Result,
    ResultMeta,
    UsedCameras,
    Value,
)
from tk.io.results.files import (
    WRITE_ERRORS,
    TwinFolder,
    as_result_error,
    check_is_result,
    move_to_memory,
    open_for_writing,
    writable,
)
from tk.io.results.layout import Row, Twin, put_model, write_layout
from tk.io.results.reader import (
    as_damage_error,
    check_format,
    check_hull,
    count_rows,
    read_joints,
    read_meta,
    read_result,
    read_values,
)
from tk.io.results.revision import revise_result
from tk.io.results.status import Status, has_pose

__all__ = [
    "FORMAT",
    "FrameResult",
    "Hull",
    "HullPoints",
    "JointAngles",
    "JointTrack",
    "Result",
    "ResultMeta",
    "ResultWriter",
    "Status",
    "UsedCameras",
    "Value",
    "as_damage_error",
    "has_pose",
    "read_joints",
    "read_result",
    "revise_result",
]


class ResultWriter:
    """Write a result; a context manager. Make one with :meth:`create` or :meth:`resume`.

    When :meth:`append` returns, the frame is in the file, unless ``flush`` is False. An older result of the same name
    exists until the first frame is written. After an exception in the ``with`` block all finished frames are kept.
    """

    def __init__(self, path: Path, meta: ResultMeta, twin_folder: TwinFolder, twins: list[Twin]) -> None:
        self.path = path
        self.meta = meta
        self.state: dict[str, Value] = {}
        self._workshop = twin_folder
        self._twins = twins  # [0] is written next, [1] is published (neither at first)
        self._recent: list[Row] = []  # rows that are not yet in both twins
        self.model: dict[str, Value] = {}
        self._model_version = 0
        self._published = False
        self._intact = True

    @classmethod
    def create(cls, path: str | os.PathLike[str], meta: ResultMeta) -> ResultWriter:
        """Start a result; an existing result of that name is replaced when the first frame is written.

        Raises:
            ResultError: the file cannot be written, another run is writing it, or a file of that name exists and is
                not a tk result.
        """
        target = writable(Path(path))
        if target.exists():
            check_is_result(target)
        with as_result_error(target), contextlib.ExitStack() as undo:
            twin_folder = undo.enter_context(TwinFolder(target))
            twins = []
            for twin_path in twin_folder.twin_paths:
                file = undo.enter_context(open_for_writing(twin_path, "w"))
                write_layout(file, meta)
                twins.append(Twin(twin_path, file))
            undo.pop_all()
        return cls(target, meta, twin_folder, twins)

    @classmethod
    def resume(cls, path: str | os.PathLike[str], meta: ResultMeta) -> tuple[ResultWriter, int]:
        """Continue a result after the last frame that has a state; start a new one if there is none.

        The writer's ``state`` is the last state given to :meth:`append`, its ``model`` the one given to
        :meth:`write_model`.

        Returns:
            the writer and the number of finished frames.

        Raises:
            ResultError: as in :meth:`create`, or the file was made from another capture or configuration.
        """
        target = writable(Path(path))
        if not target.exists():
            return cls.create(path, meta), 0
        with open_hdf5(target) as done:
            check_format(done)
            found = read_meta(done)
            try:
                difference = found.difference(meta)
            except ResultError as reason:
                done.fail(f"{reason}; start again with --force instead of --resume")
            if difference:
                done.fail(f"was made differently: {difference}; start again with --force instead of --resume")
            rows = count_rows(done, found)
            check_hull(done, rows)
            if "resume/rows" in done:
                done.array("resume/rows", "int64", (), limit=rows)
            state, model = read_values(done, "resume/state"), read_values(done, "model")
        with as_result_error(target), contextlib.ExitStack() as undo:
            twin_folder = undo.enter_context(TwinFolder(target))
            twins = []
            for twin_path in twin_folder.twin_paths:
                shutil.copyfile(target, twin_path)
                file = undo.enter_context(open_for_writing(twin_path, "r+"))
                twins.append(Twin(twin_path, file))
                twins[-1].drop_rows_without_state(meta)
            undo.pop_all()
        writer = cls(target, meta, twin_folder, twins)
        writer.state, writer.model = state, model
        return writer, twins[0].rows

    def write_model(self, model: Mapping[str, Value]) -> None:
        """Replace the fitted body of `/model`; it is written with the next frame.

        A name may contain slashes: ``{"torso/radii_m": ...}``.
        """
        self.model = dict(model)
        self._model_version += 1

    def append(self, result: FrameResult, state: Mapping[str, Value] | None = None, flush: bool = True) -> None:
        """Add a finished frame. With ``flush``, the frame is in the file on return, even if the process is then killed.

        Args:
            result: the frame.
            state: state from which the tracker continues with bit-identical results: a few small arrays, numbers and
                strings. Only the latest state is kept.
            flush: False keeps the frame in memory until the next call of :meth:`append`, :meth:`flush` or
                :meth:`close`. It saves time: most of it is a cost per flush, not per frame.

        Raises:
            ResultError: the disk is full, or the folder was removed.
        """
        self._require_open()
        rows = self._recent[-1].index + 1 if self._recent else self._twins[1].rows
        self._recent.append(Row.of(rows, result, state, self.meta))
        if flush:
            self.flush()

    def flush(self) -> None:
        """Write all appended frames to the file."""
        self._require_open()
        with as_result_error(self.path):
            self._intact = False
            twin = self._twins[0]
            self._update(twin)
            self._workshop.publish(twin.path)
            self._twins.reverse()
            self._published = True
            self._intact = True
        behind = self._twins[0].rows
        self._recent = [row for row in self._recent if row.index >= behind]

    def close(self) -> None:
        """Close the file and remove the hidden folder. A second call does nothing."""
        if not self._twins:
            return
        twins, self._twins = self._twins, []
        try:
            with as_result_error(self.path):
                if self._intact:
                    # HDF5 modifies a file while closing it: close it, then publish it
                    self._update(twins[0])
                    twins[0].file.close()
                    with twins[0].path.open("rb") as stream:
                        os.fsync(stream.fileno())
                    self._workshop.publish(twins[0].path)
        finally:
            for twin in twins:
                twin.file.close()
            self._workshop.close()

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and not (self._published or self._recent):
            self._intact = False  # no frame was finished: an older result stays
        if kind is None:
            self.close()
            return
        with contextlib.suppress(ResultError):  # report the first error
            self.close()

    def _require_open(self) -> None:
        if not self._twins:
            raise ValueError(f"{self.path} is closed")
        if not self._intact:
            raise ValueError(f"{self.path}: an earlier write failed")

    def _update(self, twin: Twin) -> None:
        """Write the body and the rows that this twin does not have yet."""
        try:
            if twin.model_version != self._model_version:
                put_model(twin.file, self.model)
                twin.model_version = self._model_version
            new_rows = [row for row in self._recent if row.index >= twin.rows]
            if new_rows:
                twin.append(new_rows)
            twin.file.flush()
        except WRITE_ERRORS:
            move_to_memory(twin.file)
            raise
