"""Generated bad input: commands refuse it in one line, or cope with it. `scripts/fuzz.py` runs many more cases."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from scripts.fuzz import KINDS, Base, make_case
from tests.conftest import Tk

#: cases of each kind in a normal run; half of them are refused
CASES = 4
#: seconds for a case on a busy machine; the first ones compile kernels
LIMIT_S = 60.0


def run_cases(tk: Tk, base: Base, folder: Path, kind: str, seeds: range) -> None:
    from scripts.fuzz import judge

    for seed in seeds:
        here = folder / str(seed)
        here.mkdir()
        arguments, what = make_case(base, here, kind, seed, tracking=False)
        begun = time.monotonic()
        ran = tk(*arguments)  # an exception that a command does not report fails the test
        outcome = judge(ran.code, ran.out, ran.err, time.monotonic() - begun, LIMIT_S)
        assert not outcome.problem, (kind, seed, what, arguments, outcome)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs POSIX")
@pytest.mark.parametrize("kind", KINDS)
def test_bad_input_ends_in_one_line(
    tk: Tk, tiny: Path, tracked: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_cases(tk, Base(tiny, tracked), tmp_path, kind, range(CASES))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_much_bad_input_ends_in_one_line(
    tk: Tk, tiny: Path, tracked: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_cases(tk, Base(tiny, tracked), tmp_path, kind, range(1000, 1060))
