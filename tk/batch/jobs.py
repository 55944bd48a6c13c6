"""What a batch is made of: a job a capture, and the record of how far each has got.

A record is a small JSON file, `jobs/NAME.json` in the batch's folder. The worker writes it, when it begins and when it
ends, so that whoever is killed, the next run knows what is done.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from tk.errors import ConfigError, ResultError
from tk.io.settings_file import to_toml
from tk.settings import Settings

#: of the batch's folder: one record a capture
RECORDS = "jobs"

WAITING, BEGUN, DONE, FAILED = "waiting", "begun", "done", "failed"


@dataclass(frozen=True)
class TrackOptions:
    """Options of `tk track` that are the same for every capture; see :func:`tk.run.session.track`.

    Attributes:
        body: a result or a TOML file whose body all captures share: they show the same person.
    """

    method: str = "region"
    frames: tuple[int, int | None] = (0, None)
    cameras: tuple[str, ...] | None = None
    masks: str = "auto"
    body: Path | None = None
    causal: bool = False
    store_hull: bool = False
    config: Settings = field(default_factory=Settings)

    def told(self) -> dict[str, str]:
        """Each option as text: what must be the same when a batch is taken up again.

        Raises:
            ConfigError: the body's file cannot be read.
        """
        start, stop = self.frames
        return {
            "method": self.method,
            "frames": f"{start}:{'' if stop is None else stop}",
            "cameras": ",".join(self.cameras) if self.cameras else "all",
            "masks": self.masks,
            "body": "none" if self.body is None else _hash(_content(self.body)),
            "causal": "yes" if self.causal else "no",
            "stored hull": "yes" if self.store_hull else "no",
            "settings": _hash(to_toml(self.config).encode()),
        }


@dataclass(frozen=True)
class Outcome:
    """How far a capture has got.

    Attributes:
        state: :data:`WAITING`, :data:`BEGUN`, :data:`DONE` or :data:`FAILED`.
        frames, lost: in the result.
        tracked_now: frames that the last attempt added; fewer than ``frames`` where it went on with an earlier one's.
        seconds: that the last attempt took.
        error_cm, limbs_cm: mean joint distance as it is, and of the limbs with constant offsets taken off, where the
            capture has a truth.
        silhouette_error: mean E_S of the frames that are not lost.
        sigma_cm: median σ of the joints.
        said: notes while it ran.
        failure: why it failed, in one line.
        trace: of a defect; empty where the user can mend it.
    """

    state: str = WAITING
    frames: int = 0
    lost: int = 0
    tracked_now: int = 0
    seconds: float = 0.0
    error_cm: float | None = None
    limbs_cm: float | None = None
    silhouette_error: float | None = None
    sigma_cm: float | None = None
    said: tuple[str, ...] = ()
    failure: str = ""
    trace: str = ""

    @property
    def failed(self) -> bool:
        """Whether tracking ended with an error."""
        return self.state == FAILED

    @property
    def mostly_lost(self) -> bool:
        """Whether more than half of the frames are lost."""
        return self.state == DONE and 2 * self.lost > self.frames

    @property
    def frames_per_second(self) -> float | None:
        """Of the last attempt, both passes and all start-up included; None where it had nothing to track."""
        return self.tracked_now / self.seconds if self.tracked_now and self.seconds > 0 else None


@dataclass(frozen=True)
class Job:
    """One capture of a batch.

    Attributes:
        name: of its result, without ending; no other capture of the folder has it.
        capture: the capture's folder, absolute.
        folder: the batch's, absolute.
        options: how it is tracked.
        pictures: leave an overlay video and a report beside the result.
    """

    name: str
    capture: Path
    folder: Path
    options: TrackOptions
    pictures: bool = False

    @property
    def page(self) -> Path:
        """The report, if there is one."""
        return self.folder / f"{self.name}.html"

    @property
    def output(self) -> Path:
        """The result file."""
        return self.folder / f"{self.name}.h5"

    @property
    def record(self) -> Path:
        """The file that tells how far it has got."""
        return self.folder / RECORDS / f"{self.name}.json"

    def write(self, outcome: Outcome) -> None:
        """Replace the record in one step.

        Raises:
            ResultError: it cannot be written.
        """
        worker = {"host": socket.gethostname(), "pid": os.getpid()}
        told = {"capture": str(self.capture), "options": self.options.told(), "by": worker, **asdict(outcome)}
        part = self.record.with_name(f".{self.record.name}.{os.getpid()}.part")
        try:
            part.write_text(json.dumps(told, indent=2), encoding="utf-8")
            os.replace(part, self.record)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise ResultError(f"{self.record}: cannot be written: {error.strerror or error}") from None

    def read(self) -> Outcome:
        """What the record says; an outcome that waits where there is none.

        Raises:
            ResultError: it was begun with other options, or the record is damaged.
        """
        if not self.record.exists():
            return Outcome()
        told = _read_record(self.record)
        options = told.get("options")
        for name, value in self.options.told().items():
            found = options.get(name) if isinstance(options, dict) else None
            if found != value:
                raise ResultError(
                    f"{self.output}: was made with another {name}: {found}, not {value}; "
                    f"choose another folder, or remove it and {self.record}"
                )
        try:
            outcome = Outcome(**{f.name: told[f.name] for f in fields(Outcome)})
            return Outcome(**{**asdict(outcome), "said": tuple(map(str, outcome.said))})
        except (KeyError, TypeError):
            raise _damaged(self.record) from None


def make_jobs(captures: Sequence[Path], folder: Path, options: TrackOptions, pictures: bool = False) -> list[Job]:
    """A job for each capture, with a name of its own.

    A capture keeps the name that an earlier run in this folder gave it. A new one is called as its folder is; where the
    name is taken, the folder above is put before it.

    Raises:
        ConfigError: a capture is given twice.
        ResultError: the folder holds a result that no batch has made, or a damaged record.
    """
    folder = folder.resolve()
    paths = [capture.resolve() for capture in captures]
    twice = next((given for given, path in zip(captures, paths, strict=True) if paths.count(path) > 1), None)
    if twice is not None:
        raise ConfigError(f"{twice}: is given twice; give each capture once")
    known: dict[str, str] = {}
    for record in sorted((folder / RECORDS).glob("*.json")):
        known[str(_read_record(record).get("capture"))] = record.stem
    taken = set(known.values())
    jobs = []
    for path in paths:
        name = known.get(str(path)) or _free_name(path, taken)
        taken.add(name)
        job = Job(name, path, folder, options, pictures)
        if job.output.exists() and str(path) not in known:
            raise ResultError(f"{job.output}: exists, and tk batch did not make it; choose another folder")
        jobs.append(job)
    return jobs


def _free_name(path: Path, taken: set[str]) -> str:
    # reports lie beside summary.html; file systems may not tell capitals apart
    lower = {"summary", *(name.lower() for name in taken)}
    parts = [part for part in path.parts if part != path.anchor] or ["capture"]
    for count in range(1, len(parts) + 1):
        name = "_".join(parts[-count:])
        if name.lower() not in lower:
            return name
    number = 2
    while f"{parts[-1]}_{number}".lower() in lower:
        number += 1
    return f"{parts[-1]}_{number}"


def _read_record(path: Path) -> dict[str, Any]:
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        raise _damaged(path) from None
    if not isinstance(told, dict):
        raise _damaged(path)
    return told


def _damaged(path: Path) -> ResultError:
    return ResultError(f"{path}: cannot be read as the record of a batch; remove it to do this capture again")


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"--body {path}: cannot be read: {error.strerror or error}") from None


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:12]
