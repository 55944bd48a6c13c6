"""A small rendered capture with everything in it, and the command line as a function.

Workers of pytest-xdist (`-n 2`) share the expensive fixtures, which one of them makes, and the cores.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hypothesis
import numpy as np
import pytest
import tomli_w

from scripts.synthetic.capture import Options, plan_capture, write_capture
from tk.errors import TkError
from tk.io import settings_file
from tk.io.captures.capture import Capture
from tk.io.captures.film import Film
from tk.io.results.reader import read_joints
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.initial_pose import pose_of_joints
from tk.model.body.skeleton import build_skeleton
from tk.run.reporter import Reporter
from tk.run.task import RecordingOptions
from tk.settings import Settings
from tk.system import LINUX
from tk.system.files import locked
from tk.system.machine import cores

if TYPE_CHECKING:
    from tk.run.session import Summary

# every run uses the same few examples, and none fails because the machine is slow; `make test-random` draws new ones
hypothesis.settings.register_profile("same", derandomize=True, deadline=None, max_examples=25)
hypothesis.settings.load_profile("same")

if "PYTEST_XDIST_WORKER" in os.environ:  # set before any kernel runs; results do not depend on the number of threads
    os.environ.setdefault("TK_THREADS", str(max(cores() // int(os.environ["PYTEST_XDIST_WORKER_COUNT"]), 1)))

# a shell that starts the tests in the background makes them ignore Ctrl-C, and their child processes, too
signal.signal(signal.SIGINT, signal.default_int_handler)

FRAMES = 14


@contextmanager
def refused(error: type[TkError], *parts: object) -> Iterator[pytest.ExceptionInfo[TkError]]:
    """Check that the block raises an error whose message is one line and contains these parts."""
    with pytest.raises(error) as caught:
        yield caught
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert str(part) in message, message


DEVELOPMENT_CAPTURES = Path(__file__).resolve().parents[2] / "shared" / "captures"


def development_capture(name: str) -> Path:
    """Return the folder of a development capture; skip the test where there is none."""
    folder = DEVELOPMENT_CAPTURES / name
    if not folder.is_dir():
        pytest.skip(f"needs the development capture {folder}")
    return folder


# settings for a run of one or two seconds: coarse, with the body of a person of average build, without a second process
QUICK = """
voxels = 32
ahead = 0
effort = 0.15
landmarks = "never"
[silhouette]
init_frames = 3
adapt = false
"""
# the same with a body that is fitted
FITTED = QUICK.replace("adapt = false", "adapt = true")


def track(
    capture: Capture,
    output: Path,
    settings: Settings,
    reporter: Reporter | None = None,
    resume: bool = False,
    force: bool = False,
    film: Film | None = None,
    **options: Any,
) -> Summary:
    """Track a recording; ``options`` are those of :class:`tk.run.task.RecordingOptions`."""
    from tk.run import session

    given = RecordingOptions(settings, **options)
    return session.track(capture, output, given, reporter or Silent(), resume, force, film)


@dataclass(frozen=True)
class Ran:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    @property
    def messages(self) -> list[str]:
        """The lines of stderr without progress."""
        progress = re.compile(r"frame \d+: \d+/\d+, |\[ *\d+\.\d s\] ")
        return [line for line in self.err.splitlines() if not progress.match(line)]

    def complaint(self, *parts: str) -> str:
        """Check that the command refused its input in one line that contains these parts; return the line.

        Notes and progress may precede it.
        """
        lines = self.messages
        assert self.code == 2, (self.code, self.out, self.err)
        assert self.out == ""
        assert len([line for line in lines if not line.startswith("note: ")]) == 1, self.err
        assert lines[-1].startswith("tk: "), self.err
        for part in parts:
            assert part in lines[-1], self.err
        return lines[-1]


Tk = Callable[..., Ran]


@pytest.fixture(scope="session", autouse=True)
def no_network() -> Iterator[None]:
    """Whatever is installed here, trackers ask no network for landmarks unless a test wants it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tk.segmenters.weights.at_hand", lambda: False)
        yield


@pytest.fixture
def tk(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Tk:
    """Return a function that runs a command in this process: ``tk("track", capture, "-o", result)``.

    Output of C libraries is captured, too. To save time, `tk track` writes neither video nor report unless ``pictures``
    is set, and starts no process before it knows whether it needs one.
    """
    from tk.cli import main

    monkeypatch.setattr("tk.run.worker.cores", lambda: 1)

    def run(*arguments: Any, pictures: bool = False) -> Ran:
        if arguments[:1] == ("track",) and not pictures:
            arguments = (*arguments, "--no-report")
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments], prog_name="tk")
        said = capfd.readouterr()
        code = ended.value.code
        return Ran(code if isinstance(code, int) else int(code is not None), said.out, said.err)

    return run


def run_clock(monkeypatch: pytest.MonkeyPatch, speed: float) -> None:
    """Let the clock of this process run faster or slower. A run writes its rows every half second of it."""
    clock = time.perf_counter
    monkeypatch.setattr(time, "perf_counter", lambda: speed * clock())


EVERY_FRAME = 1e6  # speed of the clock with which a run writes every frame at once


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a path written by ``make``, in the first worker of this test run that needs it."""
    root = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    path, lock, done = root / "shared" / name, root / "locks" / name, root / "locks" / f"{name}.done"
    path.parent.mkdir(exist_ok=True)
    lock.mkdir(parents=True, exist_ok=True)
    while True:
        with contextlib.suppress(BlockingIOError), locked(lock, BlockingIOError()):
            if not done.exists():
                make(path)
                done.touch()
            return path
        time.sleep(0.05)


FIRST_POSE = 'init = "first.toml"\n'


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered capture, read-only: 4 cameras of 160×120, :data:`FRAMES` frames, backgrounds, masks, truth.

    Its person's first pose is given. That spares each run the search for the person, and each second pass the
    comparison of both headings, which takes more than half of it.
    """

    def make(folder: Path) -> None:
        write_capture(plan_capture(Options(frames=FRAMES, cameras=4, size=(160, 120), seed=3)), folder, masks=True)
        skeleton = build_skeleton(BodyDimensions.from_stature(1.75))
        joints = read_joints(folder / "truth.h5").positions[0]
        pose = pose_of_joints(skeleton, np.arange(len(joints)), joints)
        values = np.where(skeleton.prismatic, pose, np.degrees(pose)).tolist()
        first = {"frame": 0, "angles": dict(zip(skeleton.names, values, strict=True))}
        (folder / "first.toml").write_text(tomli_w.dumps(first), encoding="utf-8")
        text = (folder / "capture.toml").read_text(encoding="utf-8")
        (folder / "capture.toml").write_text(text.replace("[subject]\n", f"[subject]\n{FIRST_POSE}"), encoding="utf-8")

    return made_once(tmp_path_factory, "tiny", make)


@pytest.fixture(scope="session")
def unposed(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rendered capture, read-only, without the first pose: the person is searched for."""

    def make(folder: Path) -> None:
        without_first_pose(Path(shutil.copytree(tiny, folder)))

    return made_once(tmp_path_factory, "unposed", make)


def without_first_pose(folder: Path, *changes: tuple[str, str]) -> Path:
    """Remove the first pose from a copy of the rendered capture, and replace texts in `capture.toml`."""
    text = (folder / "capture.toml").read_text(encoding="utf-8")
    for old, new in ((FIRST_POSE, ""), *changes):
        assert old in text
        text = text.replace(old, new)
    (folder / "capture.toml").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(params=["Linux", "portable"])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Use first what Linux has, then only what all systems have."""
    if request.param == "Linux" and not LINUX:
        pytest.skip("this system has the portable way only")
    monkeypatch.setenv("TK_PORTABLE", str(int(request.param == "portable")))
    return str(request.param)


@pytest.fixture
def copy(tiny: Path, tmp_path: Path) -> Path:
    """A writable copy of the rendered capture."""
    return Path(shutil.copytree(tiny, tmp_path / "capture"))


@pytest.fixture(scope="session")
def tracked(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result, read-only, of an uninterrupted run of the volumetric tracker over the rendered capture."""
    from tk.io.captures.capture import open_capture

    def make(path: Path) -> None:
        track(open_capture(tiny), path, settings_file.from_toml(QUICK), method="volumetric", store_hull=True)

    return made_once(tmp_path_factory, "unbroken.h5", make)


@pytest.fixture(scope="session")
def causal(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result, read-only, of an uninterrupted first pass of the default method over the rendered capture."""
    from tk.io.captures.capture import open_capture

    def make(path: Path) -> None:
        assert track(open_capture(tiny), path, settings_file.from_toml(QUICK), causal=True).lost == 0

    return made_once(tmp_path_factory, "causal.h5", make)


@pytest.fixture(scope="session")
def first_frame(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The results, read-only, of the first pass over one frame, of the methods region and volumetric."""
    from tk.io.captures.capture import open_capture

    def make(folder: Path) -> None:
        folder.mkdir()
        for method in ("region", "volumetric"):
            config = settings_file.from_toml(QUICK)
            track(open_capture(tiny), folder / f"{method}.h5", config, method=method, frames=(0, 1), causal=True)

    folder = made_once(tmp_path_factory, "first frame", make)
    return {path.stem: path for path in folder.iterdir()}


def as_if_killed(causal: Path, path: Path) -> Path:
    """Copy the result of a first pass, as it is before anything is computed from all of its frames."""
    import h5py

    shutil.copyfile(causal, path)
    with h5py.File(path, "r+") as file:
        del file["people/0/smoothed"]
        del file["cameras"]
    return path


@pytest.fixture(scope="session")
def refined(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with the second pass, which has nothing to report."""
    from tk.io.captures.capture import open_capture

    def make(path: Path) -> None:
        reporter = Silent()
        assert track(open_capture(tiny), path, settings_file.from_toml(QUICK), reporter).lost == 0
        assert reporter.notes == []

    return made_once(tmp_path_factory, "refined.h5", make)


@pytest.fixture(scope="session")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A settings file with :data:`QUICK`, for ``--config``."""
    path = tmp_path_factory.mktemp("settings") / "quick.toml"
    path.write_text(QUICK, encoding="utf-8")
    return path


class Silent:
    """A reporter that records notes and frames, for runs without a command line."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.total = self.done = 0
        self.frames: list[int] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def begin(self, total: int, done: int) -> None:
        self.total, self.done = total, done

    def advance(self, frame: int, estimate: object) -> None:
        self.frames.append(frame)

    def within(self, share: float) -> None:
        assert 0 < share <= 1


class StopAt(Silent):
    """A reporter during which somebody presses Ctrl-C, after a frame."""

    def __init__(self, frame: int) -> None:
        super().__init__()
        self.frame = frame

    def advance(self, frame: int, estimate: object) -> None:
        super().advance(frame, estimate)
        if frame == self.frame:
            signal.raise_signal(signal.SIGINT)
