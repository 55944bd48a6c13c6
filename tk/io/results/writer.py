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
from tk.io.hdf5 import Hdf5Reader, open_hdf5
from tk.io.paths import check_output
from tk.io.results.data import FrameResult, ResultMeta, Value
from tk.io.results.files import ANY_HDF5, RESULT, SafeFile, TwinFolder, writing
from tk.io.results.layout import FrameSet, Twin, write_layout
from tk.io.results.reader import (
    check_format,
    check_hull,
    count_people,
    count_rows,
    read_meta,
    read_model,
    read_state,
)
from tk.io.results.schema import columns_of, prefix_of

Model = Mapping[str, Value]


class ResultWriter:
    """Write a result; a context manager. Make one with :meth:`create` or :meth:`resume`.

    When :meth:`append` returns, the frame is in the file, unless ``flush`` is False. An older result of the same name
    exists until the first frame is written. After an exception in the ``with`` block all finished frames are kept.

    Attributes:
        state: the last state given to :meth:`append`.
        models: the fitted body of each person, as given to :meth:`write_model`.
    """

    def __init__(
        self, path: Path, meta: ResultMeta, twin_folder: TwinFolder, twins: list[Twin], models: list[Model]
    ) -> None:
        self.path = path
        self.meta = meta
        self.state: Mapping[str, Value] = {}
        self.models = models
        self._columns = columns_of(meta)
        self._folder = twin_folder
        self._twins = twins  # [0] is written next, [1] is published (neither at first)
        self._recent: list[FrameSet] = []  # frame sets that are not yet in both twins
        self._published = False
        self._intact = True
        self._failure: ResultError | None = None

    @classmethod
    def create(cls, path: str | os.PathLike[str], meta: ResultMeta, people: int = 1) -> ResultWriter:
        """Start a result; an existing result of that name is replaced when the first frame is written.

        Args:
            path: the file.
            meta: the metadata, the same for every person.
            people: number of people. Others can be added by :meth:`append`.

        Raises:
            ResultError: the file cannot be written, another run is writing it, or a file of that name exists and is
                not a tk result.
        """
        target = check_output(Path(path), RESULT, force=True, error=ResultError)
        return cls._opened(target, meta, [{} for _ in range(people)], None)

    @classmethod
    def resume(cls, path: str | os.PathLike[str], meta: ResultMeta) -> tuple[ResultWriter, int]:
        """Continue a result after the last frame set that has a state; start a new one if there is none.

        Returns:
            the writer, with the stored ``state`` and the ``models`` of the file's people, and the number of finished
            frame sets.

        Raises:
            ResultError: as in :meth:`create`, or the file was made from another capture or configuration, or its state
                is damaged.
        """
        target = check_output(Path(path), ANY_HDF5, force=True, error=ResultError)
        if not target.exists():
            return cls.create(path, meta), 0
        with open_hdf5(target) as done:
            check_format(done)
            rows = [_check_resumable(done, meta, person) for person in range(count_people(done))]
            finished, state = read_state(done)
            if len(finished) > len(rows) or any(a > b for a, b in zip(finished, rows, strict=False)):
                done.fail(f"the state of the run is damaged; {_REMEDY}")
            models: list[Model] = [read_model(done, prefix_of(person)) for person in range(len(rows))]
        writer = cls._opened(target, meta, models, target)
        writer.state = state
        return writer, writer._twins[0].count

    @classmethod
    def _opened(cls, target: Path, meta: ResultMeta, models: list[Model], source: Path | None) -> ResultWriter:
        """Return a writer with two twins, copies of ``source`` or empty."""
        with writing(target), contextlib.ExitStack() as undo:
            folder = undo.enter_context(TwinFolder(target))
            twins = []
            for path in folder.twin_paths:
                if source:
                    shutil.copyfile(source, path)
                disk = undo.enter_context(SafeFile(path, "r+" if source else "w"))
                if not source:
                    write_layout(disk.file, meta, len(models))
                twins.append(Twin(disk, meta, models))
            undo.pop_all()
        return cls(target, meta, folder, twins, models)

    @property
    def model(self) -> Model:
        """Return the fitted body of person 0."""
        return self.models[0]

    def write_model(self, model: Model, person: int = 0) -> None:
        """Replace the fitted body of a person; it is written with the next frame.

        A name may contain slashes: ``{"torso/radii_m": ...}``.
        """
        self._add_people(person + 1)
        self.models[person] = dict(model)

    def append(
        self,
        results: FrameResult | Mapping[int, FrameResult],
        state: Mapping[str, Value] | None = None,
        flush: bool = True,
    ) -> None:
        """Add a finished frame set. With ``flush``, it is in the file on return, even if the process is then killed.

        Args:
            results: the frame, or the frame of each person who is present, by the person's number.
            state: state from which the run continues with bit-identical results: a few small arrays, numbers and
                texts. Only the latest state is kept.
            flush: False keeps the frame set in memory until the next call of :meth:`append`, :meth:`flush` or
                :meth:`close`. It saves time: most of it is a cost per flush, not per frame.

        Raises:
            ResultError: the disk is full, or the folder was removed.
            ValueError: a frame does not match the metadata, or a person's number is not the next one.
        """
        self._require_open()
        people = {0: results} if isinstance(results, FrameResult) else results
        count = self._recent[-1].index + 1 if self._recent else self._twins[1].count
        frame_set = FrameSet.of(count, people, state, self._columns)
        self._add_people(1 + max(people, default=0))
        self._recent.append(frame_set)
        if flush:
            self.flush()

    def flush(self) -> None:
        """Write all appended frames to the file."""
        self._require_open()
        self._intact = False
        try:
            with writing(self.path):
                self._update(self._twins[0])
                self._publish(self._twins[0])
                self._twins.reverse()
                self._intact = True
        except ResultError as error:
            self._failure = error
            raise
        behind = self._twins[0].count
        self._recent = [frame_set for frame_set in self._recent if frame_set.index >= behind]

    def close(self) -> None:
        """Close the file and remove the hidden folder. A second call does nothing."""
        if not self._twins:
            return
        (twin, other), self._twins = self._twins, []
        with writing(self.path), self._folder, other.disk:
            with twin.disk:  # HDF5 modifies a file while closing it: close it, then publish it
                if self._intact:
                    self._update(twin)
            if self._intact:
                with twin.disk.path.open("rb") as stream:
                    os.fsync(stream.fileno())
                self._publish(twin)

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
            raise self._failure or ValueError(f"{self.path}: an earlier write failed")

    def _add_people(self, count: int) -> None:
        if count > len(self.models) + 1:
            raise ValueError(f"person {count - 1} is not the next one: the file has {len(self.models)}")
        if count > len(self.models):
            self.models.append({})

    def _update(self, twin: Twin) -> None:
        """Write the bodies and the frame sets that this twin does not have yet."""
        twin.put_models(self.models)
        twin.append([frame_set for frame_set in self._recent if frame_set.index >= twin.count])
        twin.disk.flush_to_disk()

    def _publish(self, twin: Twin) -> None:
        self._folder.publish(twin.disk.path)
        self._published = True


_REMEDY = "it cannot be resumed: start again, or choose another name"


def _check_resumable(file: Hdf5Reader, meta: ResultMeta, person: int) -> int:
    """Return a person's number of rows, or raise ResultError if they cannot be continued with this metadata."""
    prefix = prefix_of(person)
    found = read_meta(file, prefix)
    try:
        difference = found.difference(meta)
    except ResultError as reason:
        file.fail(f"{reason}; {_REMEDY}")
    if difference:
        file.fail(f"was made differently: {difference}; {_REMEDY}")
    rows = count_rows(file, meta, prefix)
    check_hull(file, rows, prefix)
    return rows
