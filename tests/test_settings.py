from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tk.commands.config_text import annotated_toml, meanings
from tk.errors import ConfigError
from tk.io import settings_file
from tk.io.settings_file import PRESETS
from tk.model.cues.appearance import RATE
from tk.model.cues.edge_term import PAIRS, VIEWS
from tk.model.cues.objective import CHAIN_SAMPLES, TORSO_SAMPLES
from tk.optim.schedule import REFINE
from tk.optim.smd import MAX_ITERATIONS, MEMORY, WINDOW
from tk.settings import Settings, VolumetricSettings
from tk.trackers.volumetric import points_and_iterations


def leaves(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(name with dots, default) of every setting."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", value


DEFAULTS = dict(leaves(Settings()))
NUMBERS = [name for name, value in DEFAULTS.items() if isinstance(value, float)]


def toml(name: str, value: str) -> str:
    table, _, key = name.rpartition(".")
    return f"[{table}]\n{key} = {value}\n" if table else f"{key} = {value}\n"


def test_defaults_round_trip() -> None:
    assert settings_file.from_toml(settings_file.to_toml(Settings())) == Settings()
    assert settings_file.from_toml("") == Settings()


@given(
    voxels=st.integers(8, 512),
    seed=st.integers(0, 2**62),
    weight=st.floats(0, 1000, allow_subnormal=False),
    effort=st.floats(0.05, 20),
    colors=st.booleans(),
)
def test_values_round_trip(voxels: int, seed: int, weight: float, effort: float, colors: bool) -> None:
    config = Settings(voxels=voxels, seed=seed, effort=effort)
    config = dataclasses.replace(config, volumetric=VolumetricSettings(colors=colors, edge_weight=weight))
    assert settings_file.from_toml(settings_file.to_toml(config)) == config


def test_settings_missing_in_a_file_keep_their_default() -> None:
    config = settings_file.from_toml("voxels = 128\n[volumetric]\nedge_weight = 1\n")
    assert config.voxels == 128 and config.volumetric.edge_weight == 1.0
    assert isinstance(config.volumetric.edge_weight, float)
    changed = {name for name, value in leaves(config) if value != DEFAULTS[name]}
    assert changed == {"voxels", "volumetric.edge_weight"}


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("voxel = 3", ["unknown setting voxel", "voxels"]),
        ("[volumetric]\nspeed = 3", ["unknown setting volumetric.speed", "edge_weight"]),
        ("[traking]\n", ["unknown setting traking"]),
        ('voxels = "64"', ["voxels", "int"]),
        ("voxels = 64.0", ["voxels", "int"]),
        ("voxels = true", ["voxels", "int"]),
        ("[silhouette]\nprediction = true", ["silhouette.prediction", "float"]),
        ("[volumetric]\ncolors = 1", ["volumetric.colors", "bool"]),
        ("volumetric = 3", ["volumetric", "table"]),
        ('segmentation = "mog2"', ["segmentation"]),
        ("voxels = 2", ["voxels = 2", "8 to 512"]),
        ("seed = -1", ["seed = -1"]),
        ("ahead = -1", ["ahead = -1", "0 to 64"]),
        ("[silhouette]\nprediction = 7.0", ["prediction = 7.0"]),
        ("[silhouette]\nprediction = 2", ["prediction = 2"]),
        ("[smd]\nmemory = 0.3", ["unknown setting smd"]),
        ('effort = "fast"', ["effort", "must be of type"]),
        ("effort = true", ["effort", "must be of type"]),
        ("effort = 0.0", ["effort = 0", "from 0.05 to 20"]),
        ("voxels = ", ["invalid TOML"]),
        ("region = " + 3000 * "[", ["invalid TOML"]),
        ("[silhouette]\ninit_frames = 1000000000\n", ["silhouette.init_frames = 1000000000 is too large"]),
        ("[foreground]\nshadow_min = 1.5", ["foreground.shadow_min = 1.5"]),
        ("[volumetric]\nedge_weight = -1.0\n", ["volumetric.edge_weight = -1"]),
        ("[volumetric]\nedge_weight = 1e300\n", ["volumetric.edge_weight = 1e+300 is too large"]),
        (f"[volumetric]\nedge_weight = 1{400 * '0'}\n", ["volumetric.edge_weight = 1000", "is too large"]),
        ("[region]\nhypotheses = 0\n", ["region.hypotheses = 0"]),
        (f"voxels = 1{5000 * '0'}\n", ["invalid TOML"]),
        ("seed = 99999999999999999999", ["seed"]),
    ],
)
def test_mistakes_are_one_line_that_names_file_and_setting(tmp_path: Path, text: str, parts: list[str]) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        settings_file.read(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("name", NUMBERS)
def test_non_finite_values_are_refused(name: str, value: str) -> None:
    with pytest.raises(ConfigError, match=name.rpartition(".")[2]):
        settings_file.from_toml(toml(name, value))


@pytest.mark.parametrize("name", [name for name in DEFAULTS if not isinstance(DEFAULTS[name], str)])
@pytest.mark.parametrize("value", [-1, 0, 10**6])
def test_extreme_values_are_accepted_or_refused_with_a_message(name: str, value: int) -> None:
    default = DEFAULTS[name]
    text = str(bool(value)).lower() if isinstance(default, bool) else str(value)
    try:
        config = settings_file.from_toml(toml(name, text))
    except ConfigError as error:
        table, _, key = name.rpartition(".")
        assert key in str(error) or f"{table}: " in str(error)  # it names the setting, or at least its table
    else:
        assert dict(leaves(config))[name] == value or isinstance(default, bool)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml: cannot be read"):
        settings_file.read(tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match="cannot be read"):
        settings_file.read(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'segmentation = "\xe4"')
    with pytest.raises(ConfigError, match=r"latin\.toml: is not UTF-8"):
        settings_file.read(tmp_path / "latin.toml")


def test_every_default_is_finite() -> None:
    assert len(NUMBERS) > 5
    assert all(math.isfinite(DEFAULTS[name]) for name in NUMBERS)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_unlike_the_defaults(name: str) -> None:
    config = settings_file.preset(name)
    assert config != Settings()
    assert settings_file.from_toml(settings_file.to_toml(config)) == config


def test_the_papers_preset_has_the_papers_numbers() -> None:
    c = settings_file.preset("kehl2006")
    assert (VIEWS, PAIRS) == (3, 5)
    assert (c.voxels, RATE) == (64, 0.3)
    assert (TORSO_SAMPLES, CHAIN_SAMPLES, REFINE) == (60, 20, 0.5)
    assert (MEMORY, MAX_ITERATIONS, WINDOW) == (0.3, 40, 3)
    assert points_and_iterations(c.effort) == (1, 40)


def test_effort_is_iterations_below_one_and_points_above() -> None:
    found = [points_and_iterations(Settings(effort=e).effort) for e in (0.5, 1.0, 5.0, 0.05)]
    assert found == [(1, 20), (1, 40), (5, 40), (1, 2)]


def test_there_are_at_most_35_settings() -> None:
    assert len(DEFAULTS) <= 35


@pytest.mark.parametrize("config", [Settings(), settings_file.preset("kehl2006")], ids=["defaults", "kehl2006"])
def test_the_annotated_settings_are_the_settings(config: Settings) -> None:
    text = annotated_toml(config)
    assert settings_file.from_toml(text) == config
    lines = text.splitlines()
    for number, line in enumerate(lines):
        name, equals, _ = line.partition(" = ")
        if equals and not line.startswith("#"):
            assert lines[number - 1].startswith("# "), name  # each is explained
    assert all(len(line) <= 120 for line in lines)
    for default in ("Default: 64", "Default: true"):
        assert default in text


def test_each_setting_is_explained() -> None:
    def check(config: Any) -> None:
        said = meanings(type(config))
        for field in dataclasses.fields(config):
            value = getattr(config, field.name)
            if dataclasses.is_dataclass(value):
                check(value)
            else:
                assert len(said[field.name]) > 15, field.name

    check(Settings())


def test_the_papers_preset_is_the_default_but_for_the_search() -> None:
    c = settings_file.preset("kehl2006")
    assert c.silhouette.search_every == 0
    silhouette = dataclasses.replace(c.silhouette, search_every=Settings().silhouette.search_every)
    assert dataclasses.replace(c, silhouette=silhouette) == Settings()


def test_a_file_wins_over_a_preset(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text("voxels = 128\n[volumetric]\nedge_weight = 0.2\n")
    config = settings_file.read(file, settings_file.preset("kehl2006"))
    assert (config.voxels, config.volumetric.edge_weight, config.silhouette.search_every) == (128, 0.2, 0)


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(ConfigError, match="preset mine: choose one of kehl2006"):
        settings_file.preset("mine")
