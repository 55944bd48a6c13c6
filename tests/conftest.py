"""A tiny capture with everything in it, and the command line as a function.

Workers of pytest-xdist (`-n 2`) make what costs seconds once among them, and share the cores.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hypothesis
import pytest

from scripts.synthetic.capture import Options, plan_capture, write_capture
from tk.io import settings_file
from tk.io.captures.capture import Capture
from tk.model.setup import Setup

# every run draws the same examples; `pytest --hypothesis-profile default` draws new ones
hypothesis.settings.register_profile("same", derandomize=True)
hypothesis.settings.load_profile("same")

if "PYTEST_XDIST_WORKER" in os.environ:  # before any kernel runs: the results are the same with fewer threads
    _cores = len(os.sched_getaffinity(0))
    os.environ.setdefault("TK_THREADS", str(max(_cores // int(os.environ["PYTEST_XDIST_WORKER_COUNT"]), 1)))

FRAMES = 14

# coarse, short fits of the body, and no second process to be started: a whole run takes a second or two
QUICK = """
voxels = 32
ahead = 0
effort = 0.15
[silhouette]
init_frames = 3
[silhouette.fit]
frames = 2
rounds = 2
"""


def setup_and_source(capture: Capture) -> tuple[Setup, Capture]:
    """Return the two things that a recording gives."""
    return capture.setup(), capture


@dataclass(frozen=True)
class Ran:
    """What a command said."""

    code: int
    out: str
    err: str

    @property
    def told(self) -> list[str]:
        """The lines of stderr but for those that tell the progress."""
        progress = re.compile(r"frame \d+: \d+/\d+, |\[ *\d+\.\d s\] ")
        return [line for line in self.err.splitlines() if not progress.match(line)]

    def complaint(self, *parts: str) -> str:
        """The one line that a command left that could not use its input; it holds these parts.

        Notes and lines of progress may stand before it.
        """
        lines = self.told
        assert self.code == 2, (self.code, self.out, self.err)
        assert self.out == ""
        assert len([line for line in lines if not line.startswith("note: ")]) == 1, self.err
        assert lines[-1].startswith("tk: "), self.err
        for part in parts:
            assert part in lines[-1], self.err
        return lines[-1]


Tk = Callable[..., Ran]


@pytest.fixture
def tk(capfd: pytest.CaptureFixture[str]) -> Tk:
    """``tk("track", capture, "-o", result)`` in this process; what libraries print below Python is heard, too.

    A run of `tk track` leaves no video and no report, which take their time, unless ``pictures`` is set.
    """
    from tk.cli import main

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


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A path that ``make`` has written, whichever worker of this test run came first."""
    root = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    (root / "shared").mkdir(exist_ok=True)
    path, done = root / "shared" / name, root / "shared" / f".{name}.done"
    with (root / "shared" / f".{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # goes with its process, however that ends
        if not done.exists():
            make(path)
            done.touch()
    return path


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered capture: 4 cameras of 160×120, :data:`FRAMES` frames, backgrounds, masks, truth. Not to be changed."""

    def make(folder: Path) -> None:
        write_capture(plan_capture(Options(frames=FRAMES, cameras=4, size=(160, 120), seed=3)), folder, masks=True)

    return made_once(tmp_path_factory, "tiny", make)


@pytest.fixture
def copy(tiny: Path, tmp_path: Path) -> Path:
    """The tiny capture, to be spoilt."""
    return Path(shutil.copytree(tiny, tmp_path / "capture"))


@pytest.fixture(scope="session")
def tracked(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of an unbroken run of the volumetric tracker over the tiny capture. Not to be changed."""
    from tk.io.captures.capture import open_capture
    from tk.run.session import track

    def make(path: Path) -> None:
        track(open_capture(tiny), path, settings_file.from_toml(QUICK), Silent(), method="volumetric", store_hull=True)

    return made_once(tmp_path_factory, "unbroken.h5", make)


@pytest.fixture(scope="session")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """:data:`QUICK` as a file for ``--config``."""
    path = tmp_path_factory.mktemp("settings") / "quick.toml"
    path.write_text(QUICK, encoding="utf-8")
    return path


class Silent:
    """A reporter that remembers, for runs without a command line."""

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
