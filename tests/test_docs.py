"""What the documentation says: its links lead somewhere, its files and options exist, its examples are accepted."""

from __future__ import annotations

import re
import shlex
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import click
import pytest

from tests.conftest import Tk
from tk.cli import main
from tk.io import settings_file
from tk.io.captures.calibration import read_calibration
from tk.io.captures.capture_toml import read_settings
from tk.io.captures.init_pose import read_init_pose
from tk.io.toml import parse_toml
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.skeleton import JOINTS, build_skeleton
from tk.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
POSE_NAMES = build_skeleton(BodyDimensions.from_stature(1.7)).names


@cache
def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), re.M | re.S)


def headings(page: Path) -> set[str]:
    """The anchors of a page's headings."""
    found = re.findall(r"^#+ (.*)", text_of(page), re.M)
    return {re.sub(r"[^\w -]", "", line).strip().lower().replace(" ", "-") for line in found}


def toml_block(mark: str) -> str:
    """The documentation's one TOML block that holds ``mark``."""
    (found,) = (text for page in PAGES for text in blocks(page, "toml") if mark in text)
    return found


def shell_commands(page: Path) -> list[str]:
    """The `tk …` lines of a page's shell blocks."""
    lines = "".join(blocks(page, "sh")).replace("\\\n", " ").splitlines()
    return [line for line in lines if line.startswith("tk ")]


def test_links_have_a_target() -> None:
    for page, target in ((one, target) for one in PAGES for target in re.findall(r"\]\(([^)]+)\)", text_of(one))):
        if "://" in target:
            continue
        name, _, heading = target.partition("#")
        other = page.parent / name if name else page
        assert other.exists(), (page.name, target)
        assert not heading or heading in headings(other), (page.name, target)


def test_named_files_exist() -> None:
    text = "".join(map(text_of, PAGES))
    for name in re.findall(r"\b(?:tk|scripts|tests|docs)/[\w/.-]+\.\w+", text):
        assert (ROOT / name).exists(), name
    for module in re.findall(r"python -m (scripts\.\w+)", text):
        assert (ROOT / module.replace(".", "/")).with_suffix(".py").exists(), module


def test_commands_and_options_exist() -> None:
    assert isinstance(main, click.Group)
    for command, rest in re.findall(r"(?:^|`)tk (\w+)([^`\n#]*)", "".join(map(text_of, PAGES)), re.M):
        assert command in main.commands, command
        known = {name for parameter in main.commands[command].params for name in parameter.opts}
        assert set(re.findall(r"(?<!\w)(--?[a-z][\w-]*)", rest)) <= known | {"--help"}, command + rest


def test_commands_are_accepted() -> None:
    """Each parses as the real command line does it."""
    assert isinstance(main, click.Group)
    for line in (line for page in PAGES for line in shell_commands(page)):
        words = shlex.split(re.sub(r"\s[|>]\s.*", "", line), comments=True)[1:]
        if words[0].startswith("-"):
            assert {words[0]} <= {"--help", "--version"}, line
            continue
        try:
            main.commands[words[0]].make_context(words[0], words[1:])
        except click.exceptions.Exit:  # --help
            assert "--help" in words, line


@pytest.mark.filterwarnings("default")
def test_commands_that_need_no_recording_run(
    tk: Tk, causal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that work on nothing, or on the demo's result; `tk demo` itself has a test of its own."""
    lines = {line: page for page in PAGES for line in shell_commands(page)}
    own = [line for line in lines if re.match(r"tk (--help|\w+ --help|config)|tk \w+ demo\.h5", line)]
    assert len(own) >= 5 and any("export demo.h5" in line for line in own)
    monkeypatch.chdir(tmp_path)
    shutil.copy(causal, "demo.h5")
    (tmp_path / "settings.toml").write_text("voxels = 64\n")
    for line in own:
        words = shlex.split(line, comments=True)
        words = words[: words.index(">")] if ">" in words else words
        ran = tk(*words[1:])
        assert ran.code == 0, (lines[line].name, line, ran.err)


def test_python_examples_compile() -> None:
    for page in PAGES:
        for text in blocks(page, "python"):
            compile(text, str(page), "exec")


def test_settings_example_is_accepted() -> None:
    config = settings_file.from_toml(toml_block("effort ="))
    assert config != Settings() and config.voxels == 128 and not config.volumetric.colors


def test_named_settings_exist() -> None:
    """On every page but the changelog, which names settings that are gone."""
    tree = parse_toml(settings_file.to_toml(Settings()), "settings")
    found = 0
    for page in PAGES:
        for path in re.findall(r"`(\w+\.[\w.]+)(?: = [^`]*)?`", text_of(page)):
            table, *names = path.split(".")
            if not isinstance(tree.get(table), dict) or page.name == "CHANGELOG.md":
                continue
            value: Any = tree[table]
            for name in names:
                assert name in value, f"{page.name}: {path}"
                value = value[name]
            found += 1
    assert found >= 5


def test_capture_examples_are_accepted(tmp_path: Path) -> None:
    examples = [text for name in ("capture", "tutorial") for text in blocks(ROOT / "docs" / f"{name}.md", "toml")]
    examples = [text for text in examples if "[subject]" in text]
    for text, height in zip(examples, (1.78, 1.75), strict=True):
        (tmp_path / "capture.toml").write_text(text, encoding="utf-8")
        settings = read_settings(tmp_path / "capture.toml")
        assert settings.unknown == () and settings.subjects[0].height_m == height
    (tmp_path / "calibration.toml").write_text(toml_block("[metadata]"), encoding="utf-8")
    (camera,) = read_calibration(tmp_path / "calibration.toml").rig
    assert (camera.width, camera.height) == (640, 480)


def test_initial_poses_are_accepted(tmp_path: Path) -> None:
    file = tmp_path / "pose.toml"
    for mark in ("[joints]", "[angles]"):
        file.write_text(toml_block(mark), encoding="utf-8")
        pose = read_init_pose(file, POSE_NAMES)
        assert bool(pose.joints) == (mark == "[joints]")
    for example in sorted((ROOT / "docs" / "examples").glob("*.toml")):
        assert read_init_pose(example, POSE_NAMES).joints


def test_joint_names_are_all_listed() -> None:
    text = re.sub(r"\s+", " ", (ROOT / "docs" / "start.md").read_text(encoding="utf-8"))
    assert f"`{', '.join(JOINTS)}`" in text


def test_every_page_is_in_the_index_and_in_the_readme() -> None:
    pages = {page.stem for page in (ROOT / "docs").glob("*.md")} - {"README"}
    index = (ROOT / "docs" / "index.rst").read_text(encoding="utf-8").split()
    assert pages <= set(index)
    for readme, folder in ((ROOT / "README.md", "docs/"), (ROOT / "docs" / "README.md", "")):
        text = readme.read_text(encoding="utf-8")
        assert all(f"({folder}{page}.md" in text for page in pages), readme


def test_pages_have_no_directives_that_github_shows_as_text() -> None:
    assert not re.findall(r"^[`:]{3,}\{.*|\{[\w:]+\}`", "".join(map(text_of, PAGES)), re.M)


def test_tables_begin_with_their_heading() -> None:
    """An empty line inside a table splits it, and the rest is shown as text."""
    lines = ["", *(line for page in PAGES for line in [*text_of(page).splitlines(), ""])]
    for before, line, after in zip(lines, lines[1:], lines[2:], strict=False):
        if line.startswith("|") and not before.startswith("|"):
            assert re.fullmatch(r"\|[-:| ]+\|", after), line


def test_lines_of_documentation_are_short() -> None:
    for page in PAGES:
        if page.name == "CHANGELOG.md":
            continue
        for number, line in enumerate(text_of(page).splitlines(), 1):
            assert len(line) <= 100 or line.startswith("|"), f"{page.name}:{number}"
