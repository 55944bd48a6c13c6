"""`tk batch`: names, records, the summary; and a real scheduler with workers, one of which is killed."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from tests.conftest import QUICK, Tk, track
from tests.made_results import write_motion
from tk.batch import Job, Outcome, exit_code
from tk.batch.jobs import BEGUN, DONE, FAILED, make_jobs
from tk.batch.run import _finished, run_batch
from tk.batch.summary import write_summary
from tk.batch.work import _errors, work
from tk.errors import CaptureError, ConfigError, ResultError
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.io.results.status import Status
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.skeleton import JOINTS, build_skeleton
from tk.run.session import Summary
from tk.run.task import RecordingOptions
from tk.system.files import locked

ROOT = Path(__file__).parents[1]
CONFIG = settings_file.from_toml(QUICK)


def folders(*paths: Path) -> list[Path]:
    for path in paths:
        path.mkdir(parents=True)
    return list(paths)


# --- names and records ------------------------------------------------------------------------------------------------


def test_captures_get_unique_names_and_keep_them(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "jobs").mkdir(parents=True)
    ann, bob, low = folders(tmp_path / "ann" / "walk", tmp_path / "bob" / "walk", tmp_path / "bob" / "WALK")
    jobs = make_jobs([ann, bob, low], out, RecordingOptions())
    assert [job.name for job in jobs[:2]] == ["walk", "bob_walk"]
    assert len({job.name.lower() for job in jobs}) == 3
    for job in jobs:
        job.write(Outcome(DONE, frames=3))
    # another order, and a part of them: the names stay
    assert [job.name for job in make_jobs([bob, ann], out, RecordingOptions())] == [jobs[1].name, jobs[0].name]


def test_duplicate_captures_and_foreign_results_are_refused(tmp_path: Path) -> None:
    walk, out = folders(tmp_path / "walk", tmp_path / "out")
    with pytest.raises(ConfigError, match="walk: is given twice"):
        make_jobs([walk, tmp_path / "out" / ".." / "walk"], out, RecordingOptions())
    (out / "walk.h5").write_text("mine")
    with pytest.raises(ResultError, match=r"walk\.h5: exists, but not from tk batch"):
        make_jobs([walk], out, RecordingOptions())


def test_records_are_read_back_and_other_options_are_refused(tmp_path: Path) -> None:
    walk, out = folders(tmp_path / "walk", tmp_path / "out" / "jobs")
    (job,) = make_jobs([walk], out.parent, RecordingOptions())
    assert job.read() == Outcome()
    outcome = Outcome(DONE, 14, 2, 1, 10, 1.5, 2.0, None, 0.05, 1.2, ("a note",))
    job.write(outcome)
    assert job.read() == outcome
    (other,) = make_jobs([walk], out.parent, RecordingOptions(method="silhouette"))
    with pytest.raises(ResultError, match=r"made with method region, not silhouette; choose another folder"):
        other.read()
    (tuned,) = make_jobs([walk], out.parent, RecordingOptions(CONFIG))
    with pytest.raises(ResultError, match="made with settings"):
        tuned.read()


@pytest.mark.parametrize("text", ["", "[1]", "{", "[" * 100_000, '{"capture": 3}', '{"capture": 3, "options": 4}'])
def test_damaged_records_are_refused(tmp_path: Path, text: str) -> None:
    walk, records = folders(tmp_path / "walk", tmp_path / "out" / "jobs")
    (records / "walk.json").write_text(text)
    with pytest.raises(ResultError):
        make_jobs([walk], tmp_path / "out", RecordingOptions())[0].read()
        Job("walk", walk, tmp_path / "out", RecordingOptions()).read()


# --- the summary ------------------------------------------------------------------------------------------------------


def test_summary_lists_all_outcomes(tmp_path: Path) -> None:
    odd = tmp_path / "a <b> & c"
    captures = folders(odd, tmp_path / "two", tmp_path / "three", tmp_path / "out" / "jobs")[:3]
    jobs = make_jobs(captures, tmp_path / "out", RecordingOptions())
    outcomes = dict(
        zip(
            [job.name for job in jobs],
            [
                Outcome(DONE, 10, 6, 1, 10, 5.0, 2.345, 1.5, 0.031, 1.8, ("a note, with a comma",), present=8),
                Outcome(FAILED, failure="x.mp4: is cut off"),
                Outcome(),
            ],
            strict=True,
        )
    )
    write_summary(tmp_path / "out", jobs, outcomes)
    with (tmp_path / "out" / "summary.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows] == ["mostly lost", "failed", "waiting"]
    assert rows[0]["lost_percent"] == "75" and rows[0]["error_cm"] == "2.345" and rows[0]["frames_per_second"] == "2"
    assert rows[0]["suspect"] == "1" and rows[0]["suspect_percent"] == "12.5"
    assert rows[0]["notes"] == "a note, with a comma" and rows[1]["notes"] == "x.mp4: is cut off"
    assert {rows[2][name] for name in ("frames", "error_cm", "seconds")} == {""}
    page = (tmp_path / "out" / "summary.html").read_text(encoding="utf-8")
    assert "a &lt;b&gt; &amp; c" in page and "<b>" not in page
    assert "1 done, 1 failed, 1 waiting" in page and 'http-equiv="refresh"' in page
    ended = {name: Outcome(DONE, 1) for name in outcomes}
    write_summary(tmp_path / "out", jobs, ended)
    assert 'http-equiv="refresh"' not in (tmp_path / "out" / "summary.html").read_text(encoding="utf-8")


def test_summary_lists_captures_of_earlier_calls(tmp_path: Path) -> None:
    ann, bob, out = folders(tmp_path / "ann", tmp_path / "bob", tmp_path / "out" / "jobs")
    earlier, now = make_jobs([ann, bob], out.parent, RecordingOptions())
    earlier.write(Outcome(DONE, 20, 1, notes=("of yesterday",), present=20))
    now.write(Outcome(BEGUN))
    (out / ".bob.part.json").write_text("half writ")  # a worker writes its record meanwhile
    write_summary(out.parent, [now], {"bob": Outcome(DONE, 5)})
    with (out.parent / "summary.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(row["name"], row["capture"]) for row in rows] == [("bob", str(bob)), ("ann", str(ann))]
    assert [(row["state"], row["frames"], row["notes"]) for row in rows] == [
        ("done", "5", ""),
        ("done", "20", "of yesterday"),
    ]
    page = (out.parent / "summary.html").read_text(encoding="utf-8")
    assert "2 done" in page and "25 frames, 1 of them lost" in page
    assert [job.name for job in make_jobs([bob, ann], out.parent, RecordingOptions())] == ["bob", "ann"]
    # one that was interrupted, and is not continued by this call, keeps no page waiting
    earlier.write(Outcome(BEGUN))
    write_summary(out.parent, [now], {"bob": Outcome(DONE, 5)})
    assert 'http-equiv="refresh"' not in (out.parent / "summary.html").read_text(encoding="utf-8")


def test_absent_person_is_no_lost_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in `tk track`, the frames with the person are judged."""
    (job,) = make_jobs(folders(tmp_path / "walk", tmp_path / "jobs")[:1], tmp_path, RecordingOptions())
    skeleton = build_skeleton(BodyDimensions.from_stature(1.75))
    status = np.array([Status.ABSENT] * 12 + [Status.LOST] * 5 + [Status.SUSPECT] * 2 + [Status.TRACKED] * 6, np.uint8)

    def made(capture: object, output: Path, *_: object, **options: object) -> Summary:
        poses = np.zeros((len(status), len(skeleton.names)))
        write_motion(output, skeleton, poses, {}, lambda f: {"status": status[f]})
        return Summary(status, 1.0, len(status))

    monkeypatch.setattr("tk.io.importers.open_recording", lambda *_: None)
    monkeypatch.setattr("tk.run.session.track", made)
    outcome = work(job)
    assert (outcome.state, outcome.frames, outcome.lost, outcome.suspect) == (DONE, 25, 5, 2), outcome.failure
    assert outcome.mostly_lost and job.read() == outcome
    status[12:14] = Status.TRACKED
    job.output.unlink()
    assert not work(job).mostly_lost


def test_exit_codes() -> None:
    good, lost = Outcome(DONE, 20, 5, present=10), Outcome(DONE, 20, 6, present=10)
    bad, defect = Outcome(FAILED, failure="no such file"), Outcome(FAILED, failure="a defect", trace="Traceback …")
    assert exit_code({"a": good}) == 0
    assert exit_code({"a": good, "b": lost}) == 3
    assert exit_code({"a": good, "b": lost, "c": bad}) == 2
    assert exit_code({"a": good, "b": bad, "c": defect}) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--workers", "0"], "workers = 0"),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"], "give workers or a scheduler, not both"),
        (["--body", "nobody.h5"], "nobody.h5: cannot be read"),
        (["--frames", "5"], "--frames 5"),
    ],
)
def test_bad_options(tk: Tk, tiny: Path, tmp_path: Path, options: list[str], message: str) -> None:
    tk("batch", tiny, "-o", tmp_path / "out", *options).complaint(message)


def test_dashboard_needs_bokeh(tk: Tk, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bokeh", None)
    tk("batch", tiny, "-o", tmp_path / "out", "--dashboard").complaint("Bokeh", "pip install bokeh")


class _Client:
    """A Dask client that delivers messages, then one finished capture."""

    def __init__(self, messages: list[dict[str, Any]]) -> None:
        self.messages = messages

    def subscribe_topic(self, topic: str, handle: Callable[[Any], None]) -> None:
        self.handle = handle

    def submit(self, function: object, job: Job, key: str, **options: Any) -> Any:
        client = self

        class Done:
            cancelled, exception, result = (lambda self: False), (lambda self: None), (lambda self: Outcome(DONE))

            def add_done_callback(self, put: Callable[[Any], None]) -> None:
                for message in client.messages:
                    client.handle((0.0, message))
                put(self)

        done: Any = Done()
        done.key = key
        return done


class _Notes:
    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def progress(self, name: str, done: int, total: int) -> None: ...

    def finished(self, name: str, outcome: Outcome, done: int, total: int) -> None: ...


def test_death_of_a_worker_is_reported(tmp_path: Path) -> None:
    """A capture that begins for the second time had another worker before."""
    (job,) = make_jobs(folders(tmp_path / "walk"), tmp_path / "out", RecordingOptions())
    progress = [(0, True), (7, False), (5, True), (9, False)]
    messages = [{"name": "walk", "done": done, "total": 9, "begins": begins} for done, begins in progress]
    reporter = _Notes()
    assert dict(_finished(_Client(messages), [job], reporter, None)) == {"walk": Outcome(DONE)}
    assert reporter.notes == ["walk: its worker died (out of memory?); another one continues after 5 frames"]


def test_error_without_offsets_is_not_given_for_a_still_person(tmp_path: Path) -> None:
    capture, out = folders(tmp_path / "walk", tmp_path / "out")
    (job,) = make_jobs([capture], out, RecordingOptions())
    skeleton = build_skeleton(BodyDimensions.from_stature(1.75))
    still = skeleton.joints(np.zeros(len(skeleton.names)))
    bent = still + 0.0
    bent[[JOINTS.index(f"{name}_l") for name in ("elbow", "wrist", "knee", "ankle")], 0] += 0.3

    def errors(*second: np.ndarray) -> tuple[tuple[float | None, float | None], list[str]]:
        notes: list[str] = []
        for path, shift in ((capture / "truth.h5", 0.0), (job.output, 0.02)):
            with h5py.File(path, "w") as file:
                file["frames"] = np.arange(12)
                for person, other in enumerate(second):
                    positions = np.array([still, other] * 6) + shift + [2.0 * person, 0, 0]
                    file[f"people/{person}/joints/position"] = positions
                    file[f"people/{person}/joints/position"].attrs["names"] = list(JOINTS)
        return _errors(job, notes.append), notes

    (error_cm, limbs_cm), notes = errors(still)
    assert error_cm == pytest.approx(2 * np.sqrt(3)) and limbs_cm is None
    assert len(notes) == 1 and "the limbs move by 0.0 cm" in notes[0]
    (_, limbs_cm), notes = errors(bent)
    assert limbs_cm == pytest.approx(0, abs=1e-6) and not notes
    (error_cm, limbs_cm), notes = errors(still, bent)
    assert error_cm == pytest.approx(2 * np.sqrt(3)) and limbs_cm == pytest.approx(0, abs=1e-6) and not notes
    assert errors(still, still)[0][1] is None


def test_two_batches_in_one_folder_are_refused(tk: Tk, tiny: Path, tmp_path: Path) -> None:
    jobs = tmp_path / "out" / "jobs"
    jobs.mkdir(parents=True)
    with locked(jobs, AssertionError("in use")):
        tk("batch", tiny, "-o", tmp_path / "out").complaint("another tk batch uses it")


def test_failure_of_a_capture_has_the_hint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise CaptureError("rec: is a Pose2Sim project", hint="tk import rec -o CAPTURE")

    monkeypatch.setattr("tk.io.importers.open_recording", refuse)
    (tmp_path / "jobs").mkdir()
    outcome = work(Job("rec", tmp_path / "rec", tmp_path, RecordingOptions()))
    assert outcome.failure == "rec: is a Pose2Sim project; tk import rec -o CAPTURE"


def test_files_beside_the_captures_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notes, given = [], []
    table = tmp_path / "table.csv"
    table.touch()
    (tmp_path / "rec").mkdir()
    reporter = SimpleNamespace(note=notes.append)
    monkeypatch.setattr("tk.batch.run.make_jobs", lambda captures, *_: given.extend(captures) or [])
    assert run_batch([table, tmp_path / "rec"], tmp_path / "out", RecordingOptions(), reporter) == {}
    assert given == [tmp_path / "rec"] and str(table) in notes[0]


# --- a real cluster ---------------------------------------------------------------------------------------------------


class Program:
    """Python in a separate process, and its stderr."""

    def __init__(self, errors: Path, *arguments: object) -> None:
        self._errors = errors
        with errors.open("w") as file:
            self.process = subprocess.Popen(
                [sys.executable, *map(str, arguments)],
                cwd=ROOT,
                stdout=subprocess.DEVNULL,
                stderr=file,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
            )

    @property
    def errors(self) -> str:
        return self._errors.read_text()

    def until(self, happened: Callable[[], bool], seconds: float = 240) -> None:
        """Wait for an event that cannot happen after this process has ended."""
        deadline = time.monotonic() + seconds
        while not happened():
            assert self.process.poll() is None, self.errors
            assert time.monotonic() < deadline, self.errors
            time.sleep(0.02)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    """Start Python with some arguments; kill processes that still run at the end."""
    running: list[Program] = []

    def begin(*arguments: object) -> Program:
        running.append(Program(tmp_path / f"{len(running)}.err", *arguments))
        return running[-1]

    yield begin
    for program in running:
        program.process.kill()
        program.process.wait()


def rows(path: Path) -> int:
    if not path.exists():
        return 0
    with h5py.File(path, "r", locking=False) as file:
        return int(file["frames"].shape[0])


def assert_same(path: Path, expected: Path) -> None:
    """Compare every dataset bit by bit except times."""
    with h5py.File(path, "r") as a, h5py.File(expected, "r") as b:
        found: list[set[str]] = [set(), set()]
        for file, names in ((a, found[0]), (b, found[1])):
            file.visititems(lambda name, item, to=names: to.add(name) if isinstance(item, h5py.Dataset) else None)
        assert found[0] == found[1]
        for name in found[0]:
            if not name.startswith("timing/"):
                assert np.asarray(a[name][()]).tobytes() == np.asarray(b[name][()]).tobytes(), name


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs POSIX signals")
@pytest.mark.slow
def test_killed_worker_and_scheduler_lose_nothing_and_repeat_nothing(
    quick: Path, tmp_path: Path, start: Callable[..., Program]
) -> None:
    """A worker is killed in the middle of a capture, then the scheduler; the same command, on a new local cluster,
    finishes. One of the captures cannot be read."""
    # a result is written twice a second: it takes more frames than the tiny capture's to be met half done
    demo, frames = ROOT / "tk" / "data" / "demo", 75
    captures = [tmp_path / name for name in ("one", "two", "three")]
    for capture in captures:  # a link to the demo itself would be the same capture again
        capture.mkdir()
        for item in demo.iterdir():
            (capture / item.name).symlink_to(item)
    broken = tmp_path / "broken"
    broken.mkdir()
    out = tmp_path / "out"
    tk = "import sys; from tk.cli import main; main(prog_name='tk')"
    batch = ["-c", tk, "batch", broken, *captures, "-o", out, "--config", quick, "--no-report"]

    def records() -> dict[str, dict[str, Any]]:
        return {path.stem: json.loads(path.read_text()) for path in (out / "jobs").glob("[!.]*.json")}

    def ended() -> set[str]:
        return {name for name, record in records().items() if record["state"] in (DONE, FAILED)}

    def under_way() -> list[str]:
        return [name for name in set(records()) - ended() if 2 <= rows(out / f"{name}.h5") < frames]

    contact = tmp_path / "scheduler.json"
    place = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", contact]
    scheduler = start("-m", "distributed.cli.dask_scheduler", "--port", 0, *place)
    scheduler.until(contact.exists)
    worker = ("-m", "distributed.cli.dask_worker", "--nthreads", 1, "--no-nanny", *place)
    workers = [start(*worker) for _ in range(2)]
    first = start(*batch, "--scheduler", json.loads(contact.read_text())["address"])
    first.until(lambda: bool(under_way()))
    victim = under_way()[0]
    os.kill(records()[victim]["by"]["pid"], signal.SIGKILL)
    done_then = rows(out / f"{victim}.h5")
    assert 2 <= done_then < frames
    first.until(lambda: len(ended()) >= 2)  # the broken one, and one of the worker that lives
    scheduler.process.kill()
    assert first.process.wait(120) == 1, first.errors
    assert first.errors.splitlines()[-1].endswith("scheduler has stopped; the same command continues the batch")
    for program in workers:  # without a scheduler, the one that lives would end what it has begun
        program.process.kill()
        program.process.wait()
    before = {name: ((out / f"{name}.h5").read_bytes(), records()[name]) for name in ended() - {"broken"}}
    assert before

    second = start(*batch, "--workers", 2)
    assert second.process.wait(300) == 2, second.errors  # for the broken one
    assert f"note: {len(before)} of 4 captures are finished already" in second.errors
    for name, (content, record) in before.items():
        assert ((out / f"{name}.h5").read_bytes(), records()[name]) == (content, record)
    assert "calibration.toml: there is no such file" in records()["broken"]["failure"]
    unbroken = tmp_path / "unbroken.h5"
    track(open_capture(captures[0]), unbroken, CONFIG)
    for capture in captures:
        record = records()[capture.name]
        assert (record["state"], record["frames"], record["lost"], record["trace"]) == (DONE, frames, 0, "")
        assert_same(out / f"{capture.name}.h5", unbroken)
    assert records()[victim]["tracked_now"] <= frames - done_then
    with (out / "summary.csv").open(newline="", encoding="utf-8") as file:
        assert [row["state"] for row in csv.DictReader(file)] == ["failed", "done", "done", "done"]
    results = [f"{capture.name}.h5" for capture in captures]
    assert sorted(p.name for p in out.iterdir()) == sorted([*results, "jobs", "summary.csv", "summary.html"])
