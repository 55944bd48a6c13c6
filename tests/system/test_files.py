"""Files without a name, locks and replaced files, on Linux and on all other systems."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tk.system import files
from tk.system.files import NamelessFile, link_or_copy, locked, publish, replace
from tk.system.names import file_name

pytestmark = pytest.mark.usefixtures("system")


class Busy(Exception):
    pass


def test_file_without_a_name_keeps_bytes_at_their_place(tmp_path: Path) -> None:
    file = NamelessFile.in_folder(tmp_path)
    assert file.write([memoryview(b"abc"), memoryview(b"de")], 3) == 5
    assert file.size() == 8 and file.read(5, 2) == b"\0abcd" and file.read(10, 6) == b"de"
    file.truncate(4)
    assert file.size() == 4 and file.read(10, 0) == b"\0\0\0a"


def test_no_file_remains(tmp_path: Path) -> None:
    file = NamelessFile.in_folder(tmp_path)
    file.hide()
    file.write([memoryview(b"kept")], 0)
    assert not list(tmp_path.iterdir()) and file.read(4, 0) == b"kept"
    other = NamelessFile.in_folder(tmp_path)
    del other
    assert not list(tmp_path.iterdir())


def test_file_that_another_process_opens_has_no_name_afterwards(tmp_path: Path) -> None:
    file = NamelessFile.in_folder(tmp_path)
    if file.path is None:
        pytest.skip("Linux: it never has one")
    file.write([memoryview(b"one")], 0)
    theirs = NamelessFile.of(file.path)
    assert not list(tmp_path.iterdir())
    theirs.write([memoryview(b"two")], 3)
    assert file.read(9, 0) == b"onetwo"


def test_memory_is_shared_by_all_that_map_a_file() -> None:
    file = NamelessFile.in_memory(8192)
    first, second = file.map(), file.map()
    first[4096:4099] = b"abc"
    assert second[4096:4099] == b"abc"
    files.give_back(first, 4096, 4096)  # 0 or as before, and still usable
    first[4096:4099] = b"new"
    assert second[4096:4099] == b"new"


def test_there_is_no_file_in_a_folder_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(OSError):
        NamelessFile.in_folder(tmp_path / "nothing")


LOCKER = """
import sys
from pathlib import Path
from tk.system.files import locked
with locked(Path(sys.argv[1]), SystemExit("busy")):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_lock_excludes_other_processes_and_ends_with_a_killed_one(tmp_path: Path) -> None:
    command = [sys.executable, "-c", LOCKER, str(tmp_path)]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes) as holder:
        assert holder.stdout is not None and holder.stdout.readline().strip() == b"locked"
        with pytest.raises(Busy), locked(tmp_path, Busy()):
            pass
        holder.kill()
    with locked(tmp_path, Busy()):
        pass
    assert not list(tmp_path.iterdir())


def test_published_bytes_stay_while_the_writer_goes_on(tmp_path: Path) -> None:
    own, spare, target = tmp_path / "0", tmp_path / "spare", tmp_path / "target"
    with own.open("wb") as file:
        file.write(b"first")
        file.flush()
        target.write_bytes(b"old")
        is_own = publish(own, spare, target)
        assert target.read_bytes() == b"first" and not spare.exists()
        if not is_own:  # else the writer leaves the file as it is
            file.write(b", second")
            file.flush()
            assert target.read_bytes() == b"first"
    assert is_own == (files.portable() is False)


def test_file_that_is_read_for_a_moment_is_replaced_afterwards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows refuses while another program has it open."""
    if not files.portable():
        pytest.skip("Linux replaces open files")
    source, target, refusals = tmp_path / "new", tmp_path / "old", [1, 2]
    source.write_bytes(b"new")
    target.write_bytes(b"old")
    real = os.replace

    def refuse(*paths: Path) -> None:
        if refusals:
            refusals.pop()
            raise PermissionError(13, "in use")
        real(*paths)

    monkeypatch.setattr(os, "replace", refuse)
    replace(source, target)
    assert target.read_bytes() == b"new" and not refusals and not source.exists()
    refusals.extend(range(10_000))
    source.write_bytes(b"newer")
    with pytest.raises(PermissionError):
        replace(source, target, patience_s=0.1)
    assert target.read_bytes() == b"new"


def test_file_is_copied_where_it_can_have_no_second_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = tmp_path / "original"
    original.write_bytes(b"bytes")
    assert not link_or_copy(original, tmp_path / "link")

    def refuse(*_: Path) -> None:
        raise OSError(95, "not supported")

    monkeypatch.setattr(os, "link", refuse)
    assert link_or_copy(original, tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == (tmp_path / "link").read_bytes() == b"bytes"


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("cam 1", "cam_1"), ("left/front", "left_front"), ("größe", "größe"), ("...", "camera"), ("con", "_con"),
        ("COM3.front", "_COM3.front"), ("console", "console"), ("a:b|c?", "a_b_c_"), ("Cam2", "Cam2_"), ("cam.", "cam"),
        ("x" * 300, "x" * 60),
    ],
)  # fmt: skip
def test_names_that_every_system_accepts(text: str, name: str) -> None:
    assert file_name(text, "camera", ["cam2"]) == name
