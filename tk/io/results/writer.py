"""The result file: written frame by frame, readable at any moment, and resumable.

HDF5 rewrites its own bookkeeping (dataset sizes, chunk trees, superblock) in place and in several steps, so a process
killed inside a flush can leave a file that does not open. A published result is therefore never written to. Two twins
live in a hidden folder beside it; each finished frame goes into the twin that is *not* published, that twin is flushed
and takes the result's name in one rename. The other twin catches up with the next frame. So whatever the moment of a
``kill -9``, the name stands for a complete file with every frame appended so far, and the state for resuming in it
belongs to its last frame. (A power cut is another matter: only the closed file is synced to the disk.)

On a file system without hard links a twin is copied and not linked: as safe, but a copy of the file each frame.
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
    Workshop,
    as_result_error,
    check_is_result,
    move_to_memory,
    open_for_writing,
    writable,
)
from tk.io.results.layout import Row, Twin, put_cameras, put_model, write_layout
from tk.io.results.reader import (
    blamed_on,
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
    "blamed_on",
    "has_pose",
    "read_joints",
    "read_result",
    "revise_result",
]


class ResultWriter:
    """Writes a result; a context manager. Make one with :meth:`create` or :meth:`resume`.

    When :meth:`append` returns, the frame is in the file, unless it was asked not to flush. Before the first frame an
    older result of the same name is still there. Leaving the ``with`` block by an exception keeps all finished frames.
    """

    def __init__(self, path: Path, meta: ResultMeta, workshop: Workshop, twins: list[Twin]) -> None:
        self.path = path
        self.meta = meta
        self.state: dict[str, Value] = {}
        self._workshop = workshop
        self._twins = twins  # [0] is written next; [1] is published, or both are as new
        self._recent: list[Row] = []  # those that a twin lacks
        self.model: dict[str, Value] = {}
        self._cameras: UsedCameras | None = None
        self._model_version = self._cameras_version = 0
        self._published = False
        self._intact = True

    @classmethod
    def create(cls, path: str | os.PathLike[str], meta: ResultMeta) -> ResultWriter:
        """Start a result; an existing result of that name is replaced once the first frame is finished.

        Raises:
            ResultError: the file cannot be written there, another run is writing it, or a file of that name is not
                a tk result (it is left alone).
        """
        target = writable(Path(path))
        if target.exists():
            check_is_result(target)
        with as_result_error(target), contextlib.ExitStack() as undo:
            workshop = undo.enter_context(Workshop(target))
            twins = []
            for twin_path in workshop.twin_paths:
                file = undo.enter_context(open_for_writing(twin_path, "w"))
                write_layout(file, meta)
                twins.append(Twin(twin_path, file))
            undo.pop_all()
        return cls(target, meta, workshop, twins)

    @classmethod
    def resume(cls, path: str | os.PathLike[str], meta: ResultMeta) -> tuple[ResultWriter, int]:
        """Take up a result where its run stopped; start a new one where there is none.

        The writer's ``state`` holds what was last given to :meth:`append`; the frames reach exactly as far. Its
        ``model`` is what was given to :meth:`write_model`.

        Returns:
            the writer and the number of frames that are done.

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
                done.fail(f"{reason}; start afresh with --force in the place of --resume")
            if difference:
                done.fail(f"was made differently: {difference}; start afresh with --force in the place of --resume")
            rows = count_rows(done, found)
            check_hull(done, rows)
            if "resume/rows" in done:
                done.array("resume/rows", "int64", (), most=rows)
            state, model = read_values(done, "resume/state"), read_values(done, "model")
        with as_result_error(target), contextlib.ExitStack() as undo:
            workshop = undo.enter_context(Workshop(target))
            twins = []
            for twin_path in workshop.twin_paths:
                shutil.copyfile(target, twin_path)
                file = undo.enter_context(open_for_writing(twin_path, "r+"))
                twins.append(Twin(twin_path, file))
                twins[-1].drop_rows_without_state(meta)
            undo.pop_all()
        writer = cls(target, meta, workshop, twins)
        writer.state, writer.model = state, model
        return writer, twins[0].rows

    def write_model(self, model: Mapping[str, Value]) -> None:
        """Store the fitted body under `/model`, replacing an earlier one. It is in the file with the next frame.

        A name may hold slashes: ``{"torso/radii_m": ...}``.
        """
        self.model = dict(model)
        self._model_version += 1

    def write_cameras(self, cameras: UsedCameras) -> None:
        """Store the calibration as used under `/cameras`, replacing an earlier one. It is in the file with the next
        frame."""
        self._cameras = cameras
        self._cameras_version += 1

    def append(self, result: FrameResult, state: Mapping[str, Value] | None = None, flush: bool = True) -> None:
        """Add a finished frame; on return it is in the file, whatever happens to this process, if ``flush`` is True.

        Args:
            result: the frame.
            state: what the tracker needs to continue from here bit for bit: a few small arrays, numbers and strings.
                Only the latest is kept.
            flush: False leaves the frame in memory until the next one, :meth:`flush` or :meth:`close`: most of the
                time that a frame takes goes to opening and closing the file's columns, not to what is written.

        Raises:
            ResultError: the disk is full, or the folder has gone.
        """
        self._requireopen_for_writing()
        rows = self._recent[-1].index + 1 if self._recent else self._twins[1].rows
        self._recent.append(Row.of(rows, result, state, self.meta))
        if flush:
            self.flush()

    def flush(self) -> None:
        """Bring the file up to date."""
        self._requireopen_for_writing()
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
        """Close the file and tidy up. A second call does nothing."""
        if not self._twins:
            return
        twins, self._twins = self._twins, []
        try:
            with as_result_error(self.path):
                if self._intact:
                    # HDF5 touches a file while it closes it: close first, publish then
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
            self._intact = False  # nothing was finished: an older result stays
        if kind is None:
            self.close()
            return
        with contextlib.suppress(ResultError):  # the first error is the one to see
            self.close()

    def _requireopen_for_writing(self) -> None:
        if not self._twins:
            raise ValueError(f"{self.path} is closed")
        if not self._intact:
            raise ValueError(f"{self.path}: an earlier write failed")

    def _update(self, twin: Twin) -> None:
        """Write into this twin what it lacks."""
        try:
            if twin.model_version != self._model_version:
                put_model(twin.file, self.model)
                twin.model_version = self._model_version
            if self._cameras is not None and twin.cameras_version != self._cameras_version:
                put_cameras(twin.file, self._cameras)
                twin.cameras_version = self._cameras_version
            news = [row for row in self._recent if row.index >= twin.rows]
            if news:
                twin.append(news)
            twin.file.flush()
        except WRITE_ERRORS:
            move_to_memory(twin.file)
            raise
