"""What the documentation says: its links lead somewhere, its files and options exist, its examples are accepted."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import click
import pytest

from tk.cli import main
from tk.config import Config
from tk.io.calibration import read_calibration
from tk.io.init_pose import read_init_pose
from tk.io.settings import read_settings
from tk.model.anthropometry import BodyDimensions
from tk.model.skeleton import JOINTS, build_skeleton

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
HOW_TO = ROOT / "docs" / "how-to.md"
POSE_NAMES = build_skeleton(BodyDimensions.from_stature(1.7)).names


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)


def toml_block(mark: str) -> str:
    """The how-to's one TOML block that holds ``mark``."""
    (found,) = (text for text in blocks(HOW_TO, "toml") if mark in text)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    headings = {
        re.sub(r"[^\w -]", "", line).strip().lower().replace(" ", "-") for line in re.findall(r"^#+ (.*)", text, re.M)
    }
    for target in re.findall(r"\]\(([^)]+)\)", text):
        if target.startswith("#"):
            assert target[1:] in headings, target
        elif "://" not in target:
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_files_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"\b(?:tk|scripts|tests|docs)/[\w/.-]+\.\w+", text):
        assert (ROOT / name).exists(), name
    for module in re.findall(r"python -m (scripts\.\w+)", text):
        assert (ROOT / module.replace(".", "/")).with_suffix(".py").exists(), module


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    assert isinstance(main, click.Group)
    for command, rest in re.findall(r"(?:^|`)tk (\w+)([^`\n#]*)", page.read_text(encoding="utf-8"), re.M):
        assert command in main.commands, command
        known = {name for parameter in main.commands[command].params for name in parameter.opts}
        assert set(re.findall(r"(?<!\w)(--?[a-z][\w-]*)", rest)) <= known | {"--help"}, command + rest


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_examples_compile(page: Path) -> None:
    for text in blocks(page, "python"):
        compile(text, str(page), "exec")


def test_settings_example_is_accepted() -> None:
    config = Config.from_toml(toml_block("segmentation ="))
    assert config != Config() and config.voxels == 128 and not config.appearance.enabled


@pytest.mark.parametrize("page", [HOW_TO, ROOT / "docs" / "method.md"], ids=lambda page: page.name)
def test_named_settings_exist(page: Path) -> None:
    tree = tomllib.loads(Config().to_toml())
    tables = {name for name, value in tree.items() if isinstance(value, dict)}
    named = re.findall(r"`(\w+)\.(\w+)(?: = [^`]*)?`", page.read_text(encoding="utf-8"))
    named = [(table, name) for table, name in named if table in tables]
    assert named
    for table, name in named:
        assert name in tree[table], f"{table}.{name}"


def test_capture_examples_are_accepted(tmp_path: Path) -> None:
    (tmp_path / "capture.toml").write_text(toml_block("[volume]"), encoding="utf-8")
    settings = read_settings(tmp_path / "capture.toml")
    assert settings.unknown == () and settings.volume is not None and settings.subject_height_m == 1.78
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
    text = re.sub(r"\s+", " ", HOW_TO.read_text(encoding="utf-8"))
    assert f"`{', '.join(JOINTS)}`" in text
