"""The jobs of a batch, one per capture, and their records.

A record is a small JSON file, `jobs/NAME.json` in the batch's folder. The worker writes it at the start and at the end
of a job, so that the next run knows what is done, whichever process was killed.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from tk.errors import ConfigError, ResultError
from tk.io.captures.session import is_session, trials
from tk.io.paths import check_not_input, replacing, resolved
from tk.io.settings_file import to_toml
from tk.run.task import RecordingOptions, describe

#: folder of the records in the batch's folder
RECORDS = "jobs"

WAITING, BEGUN, DONE, FAILED = "waiting", "begun", "done", "failed"


def described(options: RecordingOptions) -> dict[str, str]:
    """Return each option as text. They must be the same when a batch is continued.

    Raises:
        ConfigError: the file of the body cannot be read.
    """
    start, stop = options.frames
    return {
        "method": options.method,
        "frames": f"{start}:{'' if stop is None else stop}",
        "cameras": ",".join(options.cameras) if options.cameras else "all",
        "masks": options.masks,
        "body": "none" if options.body is None else _hash(_content(options.body)),
        "causal": "yes" if options.causal else "no",
        "stored hull": "yes" if options.store_hull else "no",
        "people": describe(options.people),
        "settings": _hash(to_toml(options.settings).encode()),
    }


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job."""

    state: str = WAITING  # `WAITING`, `BEGUN`, `DONE` or `FAILED`
    # frames, lost, suspect: number of frames, of lost and of suspect frames, in the result
    frames: int = 0
    lost: int = 0
    suspect: int = 0
    tracked_now: int = 0  # frames that the last attempt added; fewer than `frames` if it continued an earlier attempt
    seconds: float = 0.0  # duration of the last attempt
    # error_cm, limbs_cm: mean joint distance from the ground truth, raw, and of the limbs without constant offsets;
    # None without ground truth
    error_cm: float | None = None
    limbs_cm: float | None = None
    silhouette_error: float | None = None  # mean E_S of the frames that are not lost
    sigma_cm: float | None = None  # median σ of the joints, cm
    notes: tuple[str, ...] = ()  # notes of the run
    failure: str = ""  # reason of a failure, in one line
    trace: str = ""  # traceback of a defect; empty if the input is the reason
    present: int = 0  # number of frames in the result in which the person is present

    @property
    def mostly_lost(self) -> bool:
        """Whether more than half of the frames in which the person is present are lost or suspect."""
        return 2 * (self.lost + self.suspect) > self.present

    @property
    def failed(self) -> bool:
        """Whether tracking did not end with a result."""
        return self.state == FAILED

    @property
    def frames_per_second(self) -> float | None:
        """Speed of the last attempt, start-up and both passes included; None if it tracked no frame."""
        return self.tracked_now / self.seconds if self.tracked_now and self.seconds > 0 else None


@dataclass(frozen=True)
class Job:
    """One capture of a batch."""

    name: str  # name of its result without suffix, unique in the folder
    capture: Path  # folder of the capture, absolute
    folder: Path  # folder of the batch, absolute
    options: RecordingOptions  # options of tracking
    pictures: bool = False  # write an overlay video and a report next to the result

    @property
    def page(self) -> Path:
        """The path of the report."""
        return self.folder / f"{self.name}.html"

    @property
    def output(self) -> Path:
        """The path of the result."""
        return self.folder / f"{self.name}.h5"

    @property
    def record(self) -> Path:
        """The path of the record."""
        return self.folder / RECORDS / f"{self.name}.json"

    def write(self, outcome: Outcome) -> None:
        """Replace the record atomically."""
        worker = {"host": socket.gethostname(), "pid": os.getpid()}
        record = {"capture": str(self.capture), "options": described(self.options), "by": worker, **asdict(outcome)}
        with replacing(self.record, ResultError) as part:
            part.write_text(json.dumps(record, indent=2), encoding="utf-8")

    def read(self) -> Outcome:
        """Return the outcome in the record; a waiting one without a record."""
        if not self.record.exists():
            return Outcome()
        record = _read_record(self.record)
        options = record.get("options")
        for name, value in described(self.options).items():
            found = options.get(name) if isinstance(options, dict) else None
            if found != value:
                raise ResultError(
                    f"{self.output}: was made with {name} {found}, not {value}; "
                    f"choose another folder, or remove the file and {self.record}"
                )
        return _outcome(record, self.record)


def make_jobs(captures: Sequence[Path], folder: Path, options: RecordingOptions, pictures: bool = False) -> list[Job]:
    """Return a job with a unique name for each capture, and for each capture in a session.

    A capture keeps the name from an earlier run in this folder. A new one has the name of its folder; if the name is
    taken, the names of the folders above are prepended.
    """
    folder = resolved(folder)
    captures = [trial for given in captures for trial in (trials(given) if is_session(given) else [given])]
    paths = [resolved(capture) for capture in captures]
    twice = next((given for given, path in zip(captures, paths, strict=True) if paths.count(path) > 1), None)
    if twice is not None:
        raise ConfigError(f"{twice}: is given twice; give each capture once")
    for path in paths:
        check_not_input(folder, capture=path)
    known: dict[str, str] = {}
    for record in _records(folder):
        known[str(_read_record(record).get("capture"))] = record.stem
    taken = set(known.values())
    jobs = []
    for path in paths:
        name = known.get(str(path)) or _free_name(path, taken)
        taken.add(name)
        job = Job(name, path, folder, options, pictures)
        if job.output.exists() and str(path) not in known:
            raise ResultError(f"{job.output}: exists, but not from tk batch; choose another folder")
        jobs.append(job)
    return jobs


def other_outcomes(jobs: Sequence[Job], folder: Path) -> list[tuple[Job, Outcome]]:
    """Return jobs and outcomes of earlier runs into this folder, of the captures that are not among ``jobs``."""
    named, found = {job.name for job in jobs}, []
    for path in _records(folder):
        if path.stem not in named:
            record = _read_record(path)
            job = Job(path.stem, Path(str(record.get("capture"))), folder, RecordingOptions())
            found.append((job, _outcome(record, path)))
    return found


def _free_name(path: Path, taken: set[str]) -> str:
    # "summary" is taken by summary.html; some file systems ignore case
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


def _records(folder: Path) -> list[Path]:
    """Return the records of a batch, without those that are being written."""
    return sorted(path for path in (folder / RECORDS).glob("*.json") if not path.match(".*.part.json"))


def _read_record(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        raise _damaged(path) from None
    if not isinstance(record, dict):
        raise _damaged(path)
    return record


def _outcome(record: dict[str, Any], path: Path) -> Outcome:
    try:
        outcome = Outcome(**{f.name: record[f.name] for f in fields(Outcome)})
        return replace(outcome, notes=tuple(map(str, outcome.notes)))
    except (KeyError, TypeError):
        raise _damaged(path) from None


def _damaged(path: Path) -> ResultError:
    return ResultError(f"{path}: is not a valid record of a batch; remove it to track this capture again")


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from None


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:12]
