"""Existing output is kept, exit codes, and JSON output."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import click
import cv2
import h5py
import numpy as np
import pytest

from tests.conftest import Tk
from tk.cli import main


def test_result_is_replaced_only_with_force_and_quiet_json_prints_nothing_but_json(
    tk: Tk, quick: Path, tiny: Path, causal: Path, tmp_path: Path
) -> None:
    result = Path(shutil.copy(causal, tmp_path / "r.h5"))
    command = ["track", tiny, "-o", result, "--config", quick, "--frames", ":2", "--causal"]
    before = result.read_bytes()
    tk(*command).complaint(str(result), "exists", "--resume", "--force")
    tk(*command, "--resume", "--force").complaint("force", "resume", "one of them")
    assert result.read_bytes() == before
    ran = tk(*command, "--seed", "4", "--force", "--quiet", "--json")
    assert (ran.code, ran.err) == (0, "")
    found = json.loads(ran.out)
    assert found["result"] == str(result) and found["frames"] == found["tracked_now"] == 2
    assert found["seconds"] > 0 and found["frames_per_second"] > 0
    with h5py.File(result, "r") as file:
        assert file.attrs["seed"] == 4


def test_force_does_not_replace_other_files(tk: Tk, tiny: Path, tmp_path: Path) -> None:
    other = tmp_path / "thesis.h5"
    other.write_text("mine")
    for command in ("track", "reconstruct"):
        tk(command, tiny, "-o", other, "--force").complaint("thesis.h5", "not overwritten")
    assert other.read_text() == "mine"


def test_hull_and_point_clouds_are_replaced_only_with_force(tk: Tk, tiny: Path, tmp_path: Path) -> None:
    settings = tmp_path / "s.toml"
    settings.write_text("voxels = 16\nahead = 0\n")
    command = ["reconstruct", tiny, "--config", settings, "--frames", ":2"]
    first = tk(*command, "-o", tmp_path / "h.h5", "--ply", tmp_path / "ply", "--quiet", "--json")
    assert (first.code, first.err) == (0, "")
    assert json.loads(first.out)["frames"] == 2
    tk(*command, "-o", tmp_path / "h.h5").complaint("h.h5", "--force")
    tk(*command, "-o", tmp_path / "i.h5", "--ply", tmp_path / "ply").complaint("000000.ply", "--force")
    assert not (tmp_path / "i.h5").exists()
    tk(*command, "-o", tmp_path / "i.h5", "--mesh", tmp_path / "ply").complaint("000000.ply", "--force")
    both = ["--ply", tmp_path / "new", "--mesh", tmp_path / "new"]
    tk(*command, "-o", tmp_path / "i.h5", *both).complaint("new", "a folder of its own")
    assert tk(*command, "-o", tmp_path / "h.h5", "--ply", tmp_path / "ply", "--force").code == 0


def test_exit_code_3_if_most_frames_are_lost(tk: Tk, quick: Path, copy: Path, tmp_path: Path) -> None:
    for mask in (copy / "masks").glob("*/*.png"):
        if int(mask.stem) >= 2 and mask.parent.name != "cam1":  # one camera still sees the person
            cv2.imwrite(str(mask), np.zeros_like(cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)))
    frames = 5
    options = ["--config", quick, "--quiet", "--json", "--frames", f":{frames}", "--causal"]
    ran = tk("track", copy, "-o", tmp_path / "r.h5", *options)
    assert ran.code == 3, ran.err
    assert ran.messages[-1].startswith("tk: ")
    assert f"{frames - 2} of {frames} frames are lost or suspect" in ran.messages[-1]
    found = json.loads(ran.out)
    assert (found["frames"], found["lost"], found["interrupted"]) == (frames, frames - 2, False)


def commands() -> list[str]:
    assert isinstance(main, click.Group)
    return sorted(name for name, command in main.commands.items() if not command.hidden)  # moved ones have no help


def test_help_lists_commands_with_full_sentences(tk: Tk) -> None:
    listed = tk("--help").out.partition("Commands:")[2]
    assert "..." not in listed and "…" not in listed
    for name in commands():
        assert name in listed


@pytest.mark.parametrize("name", commands())
def test_help_has_an_example_that_the_command_accepts(tk: Tk, name: str) -> None:
    ran = tk(name, "--help")
    assert ran.code == 0 and f"tk {name}" in ran.out and ran.err == ""
    assert isinstance(main, click.Group)
    command = main.commands[name]
    text = f"{command.help}\n{command.epilog}"  # as it was written, for the help wraps its lines
    examples = re.findall(r"(?:^|xample:|;) *tk (.+?)(?=;|$)", text, re.M)
    assert any(example.split()[0] == name for example in examples)
    for example in examples:
        first, *rest = shlex.split(example.partition(" > ")[0])
        main.commands[first].make_context(first, rest)


def test_shell_completion_is_available(tk: Tk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_TK_COMPLETE", "zsh_source")
    assert "compdef" in tk().out
