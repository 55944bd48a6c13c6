"""Files that cannot be used as results, and places where none can be written."""

from __future__ import annotations

import io
import os
import shutil
import signal
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.io.result_files import append, assert_complete, fail_after, resume, write
from tests.io.result_victim import META
from tk.errors import ResultBusyError, ResultError, TkError
from tk.io.results.reader import read_joints, read_result, read_truth
from tk.io.results.writer import ResultWriter

ROOT = Path(__file__).parents[3]


def other_software(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["data"] = np.arange(3)


def not_hdf5(path: Path) -> None:
    path.write_text("frame,x,y,z\n")


def of_version(version: int) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        write(path, 1)
        with h5py.File(path, "r+") as file:
            file.attrs["format_version"] = version

    return make


def truncated(path: Path) -> None:
    write(path, 1)
    path.write_bytes(path.read_bytes()[:3000])


def incomplete(path: Path) -> None:
    write(path, 1)
    with h5py.File(path, "r+") as file:
        del file["frames"]


def missing(path: Path) -> None:
    pass


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (other_software, "other software|neither"),
        (not_hdf5, "not an HDF5 file"),
        (of_version(5), "format_version is 5.*use a newer tk"),
        (truncated, "damaged"),
        (incomplete, "no /frames"),
        (missing, "no such file"),
        (Path.mkdir, "is a folder"),
    ],
)
@pytest.mark.parametrize("read", [read_result, read_joints])
def test_unusable_files_are_named(tmp_path: Path, make, message: str, read) -> None:
    path = tmp_path / "some.h5"
    make(path)
    with pytest.raises(ResultError, match=message) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_results_of_an_older_version_are_ground_truth_and_no_results(tmp_path: Path) -> None:
    path = tmp_path / "some.h5"
    of_version(2)(path)
    for read in (read_result, read_joints):
        with pytest.raises(ResultError, match=r"format_version is 2.*versions 3 and 4.*: track the capture again"):
            read(path)
    assert np.isfinite(read_truth(path)[0].positions).all()


@pytest.mark.parametrize(
    ("make", "create", "resume"),
    [
        (other_software, "not overwritten", "not a tk-result"),
        (not_hdf5, "not overwritten", "not an HDF5 file"),
        (of_version(2), None, "format_version is 2.*track the capture again"),
    ],
)
def test_files_of_others_and_of_older_versions_are_not_continued(
    tmp_path: Path, make: Callable[[Path], None], create: str | None, resume: str
) -> None:
    path = tmp_path / "some.h5"
    make(path)
    before = path.read_bytes()
    with pytest.raises(ResultError, match=rf"some\.h5: .*{resume}"):
        ResultWriter.resume(path, META)
    if create:
        with pytest.raises(ResultError, match=rf"some\.h5: .*{create}"):
            ResultWriter.create(path, META)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["some.h5"]
    if not create:
        write(path, 1)


def test_paths_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe.h5")
    for path, message in [
        (tmp_path / "no" / "result.h5", "does not exist"),
        (tmp_path / "file" / "result.h5", "does not exist"),
        (tmp_path, "is a folder"),
        (tmp_path / "pipe.h5", "is not a"),
    ]:
        for start in (ResultWriter.create, ResultWriter.resume):
            with pytest.raises(ResultError, match=message) as caught:
                start(path, META)
            assert str(path) in str(caught.value)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    with pytest.raises(ResultError, match="Permission denied"):
        ResultWriter.create(tmp_path / "result.h5", META)


def test_older_result_stays_until_the_first_new_frame(path: Path) -> None:
    write(path, 3)
    before = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), ResultWriter.create(path, META):
        raise KeyboardInterrupt
    assert path.read_bytes() == before
    with pytest.raises(KeyboardInterrupt), ResultWriter.create(path, META) as writer:
        append(writer, 0)
        raise KeyboardInterrupt
    assert assert_complete(path, 1) == 1


def test_symbolic_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    link = tmp_path / "result.h5"
    link.symlink_to(tmp_path / "disk" / "real.h5")
    write(link, 2)
    assert link.is_symlink()
    assert assert_complete(tmp_path / "disk" / "real.h5", 2) == 2


def test_loop_of_links_is_named(tmp_path: Path) -> None:
    loop = tmp_path / "loop.h5"
    loop.symlink_to(tmp_path / "again.h5")
    (tmp_path / "again.h5").symlink_to(loop)
    for use in (lambda: ResultWriter.create(loop, META), lambda: ResultWriter.resume(loop / "r.h5", META)):
        with pytest.raises(TkError, match=r"loop\.h5.*: cannot be written: .*loop"):
            use()
    with pytest.raises(ResultError, match="link to nowhere"):
        read_result(loop)


def test_two_runs_cannot_write_the_same_file(path: Path) -> None:
    with ResultWriter.create(path, META) as writer:
        with pytest.raises(ResultBusyError, match=r"result\.h5: another run"):
            ResultWriter.create(path, META)
        append(writer, 0)
    assert assert_complete(path, 1) == 1


def test_without_hard_links(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    write(path, 5)
    assert assert_complete(path, 5) == 5


FULL = """
import sys
from pathlib import Path
import numpy as np
from tests.io.result_files import append, make_smoothed
from tests.io.result_victim import META
from tk.errors import ResultBusyError, ResultError, TkError
from tk.io.results.reader import read_result
from tests.io.result_files import revise_result
from tk.io.results.writer import ResultWriter
path = Path(sys.argv[1])
try:
    with ResultWriter.create(path, META) as writer:
        for index in range(2000):
            append(writer, index)
            print(index + 1)
except ResultError as error:
    print(error, file=sys.stderr)
try:
    revise_result(path, smoothed=make_smoothed(len(read_result(path))), model={"larger": np.ones(2**17)})
except ResultError as error:
    print(error, file=sys.stderr)
Path(sys.argv[2]).write_bytes(path.read_bytes())
"""


def test_full_disk_gives_one_line_and_keeps_finished_frames(tmp_path: Path) -> None:
    """On a real file system of 1 MB, in a process of its own, which must not crash when it ends."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = f"mount -t tmpfs -o size=1m none '{disk}'"
    isolate = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
    if shutil.which("unshare") is None or subprocess.run([*isolate, mount], capture_output=True).returncode:
        pytest.skip("no permission to mount a small file system")
    arguments = ["-c", FULL, str(disk / "result.h5"), str(tmp_path / "kept.h5")]
    done = subprocess.run(
        [*isolate, f'{mount} && exec "$@"', "sh", sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == f"{disk}/result.h5: cannot be written: No space left on device\n" * 2
    appended = int(done.stdout.split()[-1])
    assert assert_complete(tmp_path / "kept.h5", appended) == appended


@pytest.mark.parametrize("writes", [0, 1, 2, 3, 5, 10, 20, 50, 100, 150, 200, 300, 400])
def test_run_is_resumable_whenever_a_write_fails(path: Path, monkeypatch: pytest.MonkeyPatch, writes: int) -> None:
    write(path, 3)
    appended = 3
    with monkeypatch.context() as patch:
        fail_after(writes, patch)
        with pytest.raises(ResultError, match=r"result\.h5: cannot be written: No space left on device"):
            writer, _ = ResultWriter.resume(path, META)
            with writer:
                for index in range(3, 40):
                    append(writer, index)
                    appended = index + 1
    assert assert_complete(path, appended) == appended
    assert resume(path, appended + 1) == appended
    assert assert_complete(path, appended + 1) == appended + 1


def test_interruption_while_hdf5_writes_takes_effect_afterwards(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pressed: list[bool] = []

    class File(io.FileIO):
        def write(self, data: Any) -> int:
            if pressed:
                os.kill(os.getpid(), signal.SIGINT)
            return super().write(data)

    monkeypatch.setattr(io, "FileIO", File)
    with pytest.raises(KeyboardInterrupt), ResultWriter.create(path, META) as writer:
        append(writer, 0)
        pressed.append(True)
        append(writer, 1)
    assert assert_complete(path, 2) == 2


def test_process_ends_normally_with_an_open_writer(path: Path) -> None:
    script = """
import sys
from tests.io.result_files import append
from tests.io.result_victim import META
from tk.io.results.writer import ResultWriter
writer = ResultWriter.create(sys.argv[1], META)
append(writer, 0)
"""
    done = subprocess.run([sys.executable, "-c", script, str(path)], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert assert_complete(path, 1) == 1


def test_use_after_close_raises_value_error(tmp_path: Path) -> None:
    writer = ResultWriter.create(tmp_path / "result.h5", META)
    writer.close()
    writer.close()
    with pytest.raises(ValueError, match="closed"):
        append(writer, 0)
