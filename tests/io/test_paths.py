"""Outputs never replace inputs, whatever names and links they have."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import refused
from tk.errors import ConfigError, ExportError, VideoError
from tk.io.paths import Kind, c_name, check_not_input, check_output, looks_like, resolved, text_of

TEXT = Kind("a text of mine", (".txt", ".text"), looks_like(rb"mine"))


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A folder with the layout of a capture."""
    folder = tmp_path / "capture"
    for name in ("videos/cam1.mp4", "images/cam2/000000.png", "masks/cam1.mp4", "background/cam1.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("mine")
    for name in ("calibration.toml", "capture.toml", "truth.h5", "timestamps"):
        (folder / name).write_text("mine")
    return folder


@pytest.mark.parametrize(
    "name",
    ["calibration.toml", "capture.toml", "truth.h5", "videos/cam1.mp4", "videos", "masks/new.txt", "background/x/y.txt",
     "images/cam2/inspect.png", "images/../videos/new.txt"],
)  # fmt: skip
def test_no_output_lies_in_the_files_of_a_capture(capture: Path, name: str) -> None:
    with refused(ConfigError, name, "an input of this command", "choose another name"):
        check_not_input(capture / name, capture=capture)


def test_other_names_in_a_capture_are_allowed(capture: Path) -> None:
    for name in ("result.h5", "videos.h5", "refined.toml", "videos2/new.txt"):
        assert check_not_input(capture / name, capture=capture) == capture.resolve() / name


LINKS: dict[str, Callable[[Path, Path], object]] = {
    "hard link": lambda video, other: os.link(video, other),
    "symbolic link": lambda video, other: other.symlink_to(video),
    "link to the folder": lambda video, other: other.parent.joinpath("folder").symlink_to(video.parent),
    "capture's link": lambda video, other: (video.rename(other), video.symlink_to(other)),
}


@pytest.mark.parametrize("how", LINKS)
def test_links_to_an_input_are_recognised(capture: Path, tmp_path: Path, how: str) -> None:
    video, other = capture / "videos" / "cam1.mp4", tmp_path / "other.txt"
    LINKS[how](video, other)
    if how == "link to the folder":
        other = tmp_path / "folder" / "cam1.mp4"
    with refused(ConfigError, other, "an input of this command"):
        check_not_input(other, capture=capture)
    with refused(ConfigError, other, "an input of this command"):
        check_not_input(other, [None, video])


def test_loops_and_impossible_names_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.txt").symlink_to(tmp_path / "b.txt")
    (tmp_path / "b.txt").symlink_to(tmp_path / "a.txt")
    for path in (tmp_path / "a.txt", tmp_path / "a.txt" / "c.txt", tmp_path / ("n" * 5000), Path("zero\0.txt")):
        with refused(ConfigError, "cannot be written: ", "choose another name"):
            resolved(path)


def test_only_files_of_the_kind_are_replaced_and_only_with_force(tmp_path: Path) -> None:
    new, own, other = tmp_path / "new.txt", tmp_path / "own.txt", tmp_path / "other.text"
    own.write_text("mine, too")
    other.write_text("a thesis")
    assert check_output(new, TEXT) == new.resolve()
    with refused(ExportError, "own.txt: exists; choose another name") as caught:
        check_output(own, TEXT)
    assert caught.value.hint == "or replace it with --force"
    assert check_output(own, TEXT, force=True) == own.resolve()
    with refused(ExportError, "other.text", "is not a text of mine", "not overwritten"):
        check_output(other, TEXT, force=True)
    with refused(ConfigError, "new.mp4: a text of mine must end in .txt or .text"):
        check_output(tmp_path / "new.mp4", TEXT)
    with refused(ExportError, "is a folder"):
        check_output(tmp_path, TEXT)
    with refused(ExportError, "does not exist; make it first"):
        check_output(tmp_path / "no" / "new.txt", TEXT)


def test_names_that_are_not_utf8_are_refused_for_c_libraries() -> None:
    assert c_name(Path("größe.mp4"), VideoError) == "größe.mp4"
    with refused(VideoError, "is not UTF-8; rename the file"):
        c_name(Path(os.fsdecode(b"gr\xf6\xdfe.mp4")), VideoError)


def test_text_of_a_name_can_always_be_written() -> None:
    assert text_of("größe") == "größe"
    assert text_of("größe".encode()) == "größe"
    assert text_of(b"gr\xf6\xdfe".decode("utf-8", "surrogateescape")) == "gr\ufffd\ufffde"
