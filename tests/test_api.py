"""The Python interface: what `import tk` offers, and that it leaves the process alone."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tk
from tests.conftest import FRAMES, QUICK
from tests.io.conftest import picture, write_video
from tk.errors import ConfigError, ResultError
from tk.io import settings_file

ROOT = Path(__file__).resolve().parents[1]


def test_import_has_no_side_effects():
    code = (
        "import os, sys, signal; before = dict(os.environ), set(sys.modules), signal.getsignal(signal.SIGINT);"
        "import tk; heavy = {'numpy', 'taichi', 'cv2', 'open3d', 'h5py', 'scipy'} & set(sys.modules);"
        "assert dict(os.environ) == before[0] and not heavy, heavy;"
        "assert signal.getsignal(signal.SIGINT) is before[2]; print(sorted(set(dir(tk)) & {'track', 'Body'}))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "['Body', 'track']"


def test_every_public_name_exists():
    for name in tk.__all__:
        assert getattr(tk, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        tk.nonsense  # noqa: B018


def test_resume_without_an_output_is_refused(tiny: Path) -> None:
    with pytest.raises(ConfigError, match="resume and force need an output file"):
        tk.track(tiny, resume=True)


@pytest.mark.parametrize("frames", ["a", 5, (0, "x"), (0.5, None), (1, 2, 3)])
def test_frames_that_are_none_are_refused(tiny: Path, frames: Any) -> None:
    with pytest.raises(ConfigError, match=r"^frames .*give the first one and the end"):
        tk.track(tiny, frames=frames)


def test_arguments_of_other_types_are_accepted_or_refused_in_one_line(tiny: Path) -> None:
    assert tk.open_capture(tiny, "cam1, cam3").rig.names == ("cam1", "cam3")
    tk.track(tiny, frames=(np.int64(0), np.int64(3)))  # begins when the first estimate is asked for
    tk.track(tiny, people=0)
    with pytest.raises(ConfigError, match="give auto, all, or different numbers"):
        tk.track(tiny, people=0.5)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="has no method segment"):
        tk.track(tiny, segmenter=lambda image: image)  # type: ignore[arg-type]


def test_errors_name_no_options_of_the_command_line() -> None:
    """Only their hints do, which the command line adds."""
    option = re.compile(r"(^|[^\w-])--[a-z]")
    found = []
    for file in sorted((ROOT / "tk").rglob("*.py")):
        if file.parts[-2] in ("commands", "calibration", "synchronise"):  # these have no Python interface yet
            continue
        source = file.read_text(encoding="utf-8")
        if not option.search(source):
            continue
        for raised in (n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Raise)):
            hints = [k for k in ast.walk(raised) if isinstance(k, ast.keyword) and k.arg == "hint"]
            allowed = {id(part) for hint in hints for part in ast.walk(hint)}
            for text in ast.walk(raised):
                if isinstance(text, ast.Constant) and isinstance(text.value, str) and id(text) not in allowed:
                    found += [f"{file.name}:{text.lineno}: {text.value}"] * bool(option.search(text.value))
    assert found == []


def test_path_is_tracked_once_and_the_result_is_described_in_three_lines(tiny: Path, causal: Path) -> None:
    config = settings_file.from_toml(QUICK)
    with pytest.raises(ResultError, match="exists"):
        tk.track(tiny, causal, config=config)
    lines = repr(tk.track(tiny, causal, config=config, causal=True, resume=True)).splitlines()  # nothing is left to do
    assert len(lines) == 3 and all(len(line) < 120 for line in lines)
    assert "causal.h5" in lines[0] and f"{FRAMES} frames" in lines[1]


def test_progress_is_logged(tiny: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", "tk"):
        tk.track(tiny, tmp_path / "r.h5", config=settings_file.from_toml(QUICK), causal=True)
    shown = [record.getMessage() for record in caplog.records if re.match(r"frame \d+: ", record.getMessage())]
    assert 1 < len(shown) <= 10 and shown[-1].endswith(f": {FRAMES}/{FRAMES}"), shown


def test_notes_are_logged(copy, tmp_path, caplog):
    write_video(copy / "videos" / "cam2.mp4", [picture(1, k, (160, 120)) for k in range(3)])
    config = settings_file.from_toml(QUICK)
    next(tk.track(tk.open_capture(copy), config=config))
    (warning,) = [r.getMessage() for r in caplog.records if r.name.startswith("tk") and r.levelname == "WARNING"]
    assert "only the first 3 are used" in warning
