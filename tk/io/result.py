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
import fcntl
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType

import h5py

from tk.errors import ResultError
from tk.io.result_data import (
    FORMAT,
    FORMAT_VERSION,
    FrameResult,
    Hull,
    HullPoints,
    JointTrack,
    Result,
    ResultMeta,
    Status,
    Value,
    check_format,
    open_hdf5,
    read_joints,
    read_meta,
    read_result,
    read_values,
)
from tk.io.result_layout import Row, Twin, write_layout

__all__ = [
    "FORMAT",
    "FORMAT_VERSION",
    "FrameResult",
    "Hull",
    "HullPoints",
    "JointTrack",
    "Result",
    "ResultMeta",
    "ResultWriter",
    "Status",
    "Value",
    "read_joints",
    "read_result",
]


class ResultWriter:
    """Writes a result; a context manager. Make one with :meth:`create` or :meth:`resume`.

    When :meth:`append` returns, the frame is in the file. Before the first frame an older result of the same name
    is still there. Leaving the ``with`` block by an exception keeps all finished frames.
    """

    def __init__(self, path: Path, meta: ResultMeta, workshop: _Workshop, twins: list[Twin]) -> None:
        self.path = path
        self.meta = meta
        self.state: dict[str, Value] = {}
        self._workshop = workshop
        self._twins = twins  # [0] is written next; [1] is published, or both are as new
        self._recent: list[Row] = []  # those that a twin lacks
        self.model: dict[str, Value] = {}
        self._model_version = 0
        self._published = False
        self._intact = True

    @classmethod
    def create(cls, path: str | os.PathLike[str], meta: ResultMeta) -> ResultWriter:
        """Start a result; an existing result of that name is replaced once the first frame is finished.

        Raises:
            ResultError: the file cannot be written there, another run is writing it, or a file of that name is not
                a tk result (it is left alone).
        """
        target = _writable(Path(path))
        if target.exists():
            _check_is_result(target)
        with _as_result_error(target), contextlib.ExitStack() as undo:
            workshop = undo.enter_context(_Workshop(target))
            twins = []
            for twin_path in workshop.twin_paths:
                file = undo.enter_context(_open(twin_path, "w"))
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
        target = _writable(Path(path))
        if not target.exists():
            return cls.create(path, meta), 0
        with open_hdf5(target) as done:
            check_format(done, target)
            difference = read_meta(done, target).difference(meta)
            if difference:
                raise ResultError(f"{target}: was made differently: {difference}; run without --resume to start afresh")
            state, model = read_values(done, "resume/state"), read_values(done, "model")
        with _as_result_error(target), contextlib.ExitStack() as undo:
            workshop = undo.enter_context(_Workshop(target))
            twins = []
            for twin_path in workshop.twin_paths:
                shutil.copyfile(target, twin_path)
                file = undo.enter_context(_open(twin_path, "r+"))
                twins.append(Twin(twin_path, file))
                twins[-1].drop_rows_without_state()
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

    def append(self, result: FrameResult, state: Mapping[str, Value] | None = None) -> None:
        """Add a finished frame; on return it is in the file, whatever happens to this process.

        Args:
            result: the frame.
            state: what the tracker needs to continue from here bit for bit: a few small arrays, numbers and strings.
                Only the latest is kept.

        Raises:
            ResultError: the disk is full, or the folder has gone.
        """
        self._require_open()
        rows = self._recent[-1].index + 1 if self._recent else self._twins[1].rows
        self._recent.append(Row.of(rows, result, state, self.meta))
        self.flush()

    def flush(self) -> None:
        """Bring the file up to date. :meth:`append` does it by itself; this is for a model without frames."""
        self._require_open()
        with _as_result_error(self.path):
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
            with _as_result_error(self.path):
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
        if kind is not None and not self._published:
            self._intact = False  # nothing was finished: an older result stays
        if kind is None:
            self.close()
            return
        with contextlib.suppress(ResultError):  # the first error is the one to see
            self.close()

    def _require_open(self) -> None:
        if not self._twins:
            raise ValueError(f"{self.path} is closed")
        if not self._intact:
            raise ValueError(f"{self.path}: an earlier write failed")

    def _update(self, twin: Twin) -> None:
        """Write into this twin what it lacks."""
        try:
            if twin.model_version != self._model_version:
                twin.put_model(self.model)
                twin.model_version = self._model_version
            news = [row for row in self._recent if row.index >= twin.rows]
            if news:
                twin.append(news)
            twin.file.flush()
        except (OSError, RuntimeError):
            _move_to_memory(twin.file)
            raise


class _Workshop:
    """The hidden folder beside a result in which its twins are made. Holding it keeps other runs away."""

    def __init__(self, target: Path) -> None:
        self._target = target
        self._folder = target.with_name(f".{target.name}.tmp")
        self._folder.mkdir(exist_ok=True)
        self._handle = os.open(self._folder, os.O_RDONLY)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._handle)
            raise ResultError(
                f"{target}: another run is writing this result; wait for it, or choose another name"
            ) from None
        except OSError:
            pass  # no locks on this file system: nothing keeps a second run away
        for leftover in self._folder.iterdir():  # of a run that was killed
            leftover.unlink()
        self.twin_paths = (self._folder / "0.h5", self._folder / "1.h5")

    def publish(self, twin: Path) -> None:
        """Let the result's name stand for this twin, in one step."""
        new = self._folder / "new.h5"
        try:
            os.link(twin, new)
        except FileExistsError:  # a rename failed before
            new.unlink()
            os.link(twin, new)
        except OSError:
            shutil.copyfile(twin, new)
        os.replace(new, self._target)

    def close(self) -> None:
        os.close(self._handle)
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> _Workshop:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# --- files and their errors -------------------------------------------------------------------------------------------


def _open(path: Path, mode: str) -> h5py.File:
    # "earliest": newer superblocks carry a flag "being written" that a killed process leaves set, and the file then
    # refuses to open. No locks: readers of the published twin must not be kept out.
    return h5py.File(path, mode, libver="earliest", locking=False)


def _check_is_result(target: Path) -> None:
    """Refuse to replace what is not a result of any version."""
    try:
        with open_hdf5(target) as file:
            if file.attrs.get("format") == FORMAT:
                return
    except ResultError:
        pass
    raise ResultError(f"{target}: exists and is not a {FORMAT}; it is not overwritten: choose another name")


def _move_to_memory(file: h5py.File) -> None:
    """After a failed write: let HDF5 go on in memory, for the file is lost.

    HDF5 1.10 to 2.0 crash the process when a file is closed, at the latest at exit, that still cannot be written.
    """
    if not hasattr(os, "memfd_create"):  # Linux
        return
    handle = file.id.get_vfd_handle()
    memory = os.memfd_create("tk-result")
    size, done = os.fstat(handle).st_size, 0
    while done < size:
        done += os.sendfile(memory, handle, done, size - done)
    os.dup2(memory, handle)
    os.close(memory)


@contextlib.contextmanager
def _as_result_error(target: Path) -> Iterator[None]:
    """The system's and HDF5's refusals as one line; HDF5 reports a full disk as either of the two types."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        system = re.search(r"error message = '([^']+)'", reason)
        reason = system[1] if system else reason
        raise ResultError(f"{target}: cannot be written: {reason}") from error


def _writable(path: Path) -> Path:
    """The path with links followed, so that a rename does not replace the link; refuse what can be seen to fail."""
    target = path.resolve()
    if target.is_dir():
        raise ResultError(f"{path}: is a folder; name a file in it")
    if not target.parent.is_dir():
        raise ResultError(f"{path}: the folder {target.parent} does not exist; make it first")
    if target.exists() and not (target.is_file() and os.access(target, os.W_OK)):
        raise ResultError(f"{path}: cannot be written; choose another name")
    return target
