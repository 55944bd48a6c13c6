"""The machine and the user's folders, on Linux and on all other systems."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tk.system import LINUX, machine


@pytest.mark.usefixtures("system")
def test_cores_are_counted_and_memory_is_known_or_not() -> None:
    assert 1 <= machine.cores() <= (os.cpu_count() or 1)
    free = machine.available_memory()
    assert free is None or 10**6 < free < 10**15
    assert (free is None) == (os.environ["TK_PORTABLE"] == "1")


def test_folder_of_temporary_files_is_the_users_own(tmp_path: Path) -> None:
    assert machine.temporary_folder("tk-test").name.startswith("tk-test-")
    assert machine.is_ours(tmp_path)


@pytest.mark.skipif(not LINUX, reason="each system has its own folder")
def test_cache_folder_is_that_of_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert machine.cache_folder() == tmp_path
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert machine.cache_folder() == tmp_path / ".cache"
