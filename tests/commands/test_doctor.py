"""`tk doctor`: one line for each check, never a traceback."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import pytest

from tests.conftest import Tk
from tk.commands import doctor
from tk.commands.doctor import CHECKS, Missing


def test_one_line_each_on_this_machine(tk: Tk) -> None:
    """This machine runs the tests, so all that tracking needs is there."""
    ran = tk("doctor")
    lines = ran.out.splitlines()
    assert ran.code == 0 and lines[-1] == "tk track can work", ran.out
    assert [line.split()[0] for line in lines[:-1]] == list(CHECKS)
    assert all(line[10:].startswith(("ok: ", "missing: ")) for line in lines[:-1]), ran.out
    assert "Traceback" not in ran.out + ran.err


def test_only_checks_that_tracking_needs_decide_the_exit_code(tk: Tk, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(error: Exception) -> Callable[[], str]:
        def check() -> str:
            raise error

        return check

    checks = {"display": failing(Missing("no display")), "cores": lambda: "4", "cache": failing(OSError("unexpected"))}
    for name in list(CHECKS):
        monkeypatch.delitem(CHECKS, name)
    for name, check in checks.items():
        monkeypatch.setitem(CHECKS, name, check)
    ran = tk("doctor")
    assert ran.code == 0 and ran.out.splitlines() == [
        "display   missing: no display",
        "cores     ok: 4",
        "cache     missing: the check failed: OSError: unexpected",
        "tk track can work",
    ]
    monkeypatch.setitem(CHECKS, "Taichi", failing(Missing("does not start")))
    ran = tk("doctor")
    assert ran.code == 1 and ran.out.splitlines()[-1] == "tk track cannot work: Taichi"


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("import os; os.abort()", "the process was ended by SIGABRT; the remedy"),
        ("import time; time.sleep(60)", "gave no answer for 120 s; the remedy"),
        ("import no_such_package", "ModuleNotFoundError: No module named 'no_such_package'; the remedy"),
    ],
)
def test_crashes_and_hangs_are_reasons(code: str, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run = subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda *given, **options: run(*given, **{**options, "timeout": 1.0}))
    with pytest.raises(Missing, match=f"^{why}$"):
        doctor._try(code, "; the remedy")


def test_doctor_does_not_load_what_it_checks() -> None:
    code = "import sys, tk.commands.doctor; sys.exit(any(name in sys.modules for name in ('taichi', 'open3d', 'cv2')))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
