"""Write a result frame by frame; it can be read at any time, and an interrupted run can be resumed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from tk.errors import ResultError
from tk.io.hdf5_writer import Hdf5Writer, writing
from tk.io.paths import check_output
from tk.io.results.data import ResultMeta, Value
from tk.io.results.files import ANY_HDF5, RESULT
from tk.io.results.layout import Layout, Values, pack_state
from tk.io.results.reader import open_result, read_state
from tk.io.results.schema import absent_row, checked_row
from tk.io.results.status import has_pose

Model = Mapping[str, Value]


class ResultWriter:
    """Write a result; a context manager. Make one with :meth:`create` or :meth:`resume`.

    When :meth:`append` returns, the frame is in the file, unless ``flush`` is False. An older result of the same name
    exists until the first frame is written. After an exception in the ``with`` block all finished frames are kept.

    Attributes:
        state: the state from which a resumed run continues.
        models: the fitted body of each person, as given to :meth:`write_model`.
    """

    def __init__(
        self,
        path: Path,
        meta: ResultMeta,
        disk: Hdf5Writer,
        models: Sequence[Model],
        frames: int = 0,
        state: Mapping[str, Value] | None = None,
    ) -> None:
        self.path = path
        self.meta = meta
        self.state = state or {}
        self.models = list(models)
        self._disk = disk
        self._layout = Layout(disk.file, meta)
        self._absent = absent_row(self._layout.person)
        self._frames = frames  # those that wait included
        self._waiting: list[tuple[Values, dict[int, Values]]] = []  # of the run, and by person
        self._waiting_models: dict[int, Model] = {}
        self._waiting_state: tuple[int, int, Model] | None = None
        self._written = False
        self._failure: ResultError | None = None

    @classmethod
    def create(cls, path: str | os.PathLike[str], meta: ResultMeta) -> ResultWriter:
        """Start a result; an existing result of that name is replaced when the first frame is written.

        Args:
            path: the file.
            meta: the metadata, the same for every person; people are added by :meth:`append`.

        Raises:
            ResultError: the file cannot be written, another run is writing it, or a file of that name exists and is
                not a tk result.
        """
        target = check_output(Path(path), RESULT, force=True, error=ResultError)
        with writing(target):
            writer = cls(target, meta, Hdf5Writer(target), [{}])
            writer._layout.begin()
        return writer

    @classmethod
    def resume(cls, path: str | os.PathLike[str], meta: ResultMeta) -> tuple[ResultWriter, int]:
        """Continue a result after the last frame that has a state; start a new one if there is none.

        Returns:
            the writer, with the stored ``state`` and the ``models`` of the file's people, and the number of finished
            frames.

        Raises:
            ResultError: as in :meth:`create`, or the file was made from another capture or configuration, or its state
                is damaged.
        """
        target = check_output(Path(path), ANY_HDF5, force=True, error=ResultError)
        if not target.exists():
            return cls.create(path, meta), 0
        remedy = "it cannot be resumed: start again, or choose another name"
        with open_result(target, to_change=True) as (file, people):
            for person in people:
                try:
                    difference = person.meta.difference(meta)
                except ResultError as reason:
                    file.fail(f"{reason}; {remedy}")
                if difference:
                    file.fail(f"was made differently: {difference}; {remedy}")
                stored = person.rows()  # the second pass needs them
                if not np.isfinite(stored["pose"][has_pose(stored["status"])]).all():
                    file.fail(f"/pose is NaN in a frame that has a pose; {remedy}")
            frames, count, state = read_state(file) or (people[0].count, len(people), {})
            if not 0 < count <= len(people) or not 0 <= frames <= people[0].count:
                file.fail(f"the state of the run is damaged; {remedy}")
            models = [person.model() for person in people[:count]]
        with writing(target), contextlib.ExitStack() as undo:
            disk = Hdf5Writer(target, target)
            undo.callback(disk.close, publish=False)
            writer = cls(target, meta, disk, models, frames, state)
            writer._layout.keep(frames, count)
            undo.pop_all()
        return writer, frames

    @property
    def model(self) -> Model:
        """Return the fitted body of person 0."""
        return self.models[0]

    def write_model(self, model: Model, person: int = 0) -> None:
        """Replace the fitted body of a person; it is written with the next frame.

        A name may contain slashes: ``{"torso/radii_m": ...}``.
        """
        self._require_open()
        self._add_people(person + 1)
        self.models[person] = self._waiting_models[person] = dict(model)

    def append(
        self,
        frame: Mapping[str, ArrayLike],
        people: Mapping[int, Mapping[str, ArrayLike]],
        state: Mapping[str, Value] | None = None,
        flush: bool = True,
    ) -> None:
        """Add a finished frame. With ``flush``, it is in the file on return, even if the process is then killed.

        Args:
            frame: values of the run, by the paths of :data:`~tk.io.results.schema.ROWS`.
            people: values of each person, and optionally of the hull, by the person's number. People of the file who
                are not in it are absent.
            state: state from which the run continues with bit-identical results: a few small arrays, numbers and
                texts. Only the latest state is kept.
            flush: False keeps the frame in memory until the next call of :meth:`append`, :meth:`flush` or
                :meth:`close`. It saves time: most of it is a cost per flush, not per frame.

        Raises:
            ResultError: the disk is full, or the folder was removed.
            ValueError: a frame does not match the metadata, or a person's number is not the next one.
        """
        self._require_open()
        # copies: a tracker may reuse its arrays
        row = checked_row(frame, self._layout.run)
        rows: dict[int, Values] = {n: checked_row(values, self._layout.person) for n, values in people.items()}
        self._add_people(1 + max(people, default=0))
        self._waiting.append((row, rows))
        self._frames += 1
        self._keep(state)
        if flush:
            self.flush()

    def flush(self, state: Mapping[str, Value] | None = None) -> None:
        """Write all appended frames to the file, and the state after them as for :meth:`append`."""
        self._require_open()
        self._keep(state)
        try:
            with writing(self.path):
                self._write_waiting()
                self._disk.publish()
                self._written = True
        except ResultError as error:
            self._failure = error
            raise

    def close(self) -> None:
        """Write all appended frames, close the file, and remove the hidden folder. A second call does nothing."""
        self._close(publish=True)

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._close(publish=True)
        else:
            with contextlib.suppress(ResultError):  # report the first error
                # if no frame is finished, an older result stays
                self._close(publish=self._written or bool(self._waiting))

    def _close(self, publish: bool) -> None:
        if not self._disk.file:
            return
        with writing(self.path), self._disk:  # publishes what is written if no error occurs
            if publish and self._failure is None:
                self._write_waiting()
            else:
                self._disk.close(publish=False)

    def _keep(self, state: Mapping[str, Value] | None) -> None:
        """Keep a copy of the state after the frames so far, if there is one."""
        if state is not None:
            copy = {name: value if isinstance(value, str) else np.array(value) for name, value in state.items()}
            self._waiting_state = (self._frames, len(self.models), copy)

    def _require_open(self) -> None:
        if not self._disk.file:
            raise ValueError(f"{self.path} is closed")
        if self._failure is not None:
            raise self._failure

    def _add_people(self, count: int) -> None:
        if count > len(self.models) + 1:
            raise ValueError(f"person {count - 1} is not the next one: the file has {len(self.models)}")
        if count > len(self.models):
            self.models.append({})

    def _write_waiting(self) -> None:
        """Pass bodies, frames and state on to HDF5."""
        people = range(len(self.models))
        for person in people:
            self._layout.add_person(person)
            if person in self._waiting_models:
                self._layout.put_model(person, self._waiting_models[person])
        if self._waiting:
            rows = {n: [present.get(n, self._absent) for _, present in self._waiting] for n in people}
            self._layout.append([frame for frame, _ in self._waiting], rows)
        if self._waiting_state is not None:
            self._layout.put_state(pack_state(*self._waiting_state))
        self._waiting, self._waiting_models, self._waiting_state = [], {}, None
