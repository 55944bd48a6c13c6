"""Settings as TOML: files, presets, and the text that a result file stores."""

from __future__ import annotations

import dataclasses
import math
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import tomli_w

from tk.errors import ConfigError
from tk.io.toml import LARGE, parse_toml, read_text, shown
from tk.settings import MOST_COUNT, Settings

T = TypeVar("T")

PRESETS = ("kehl2006",)


def to_toml(settings: Settings) -> str:
    """Return all settings as TOML text."""
    return tomli_w.dumps(dataclasses.asdict(settings))


def from_toml(text: str, where: str = "configuration", base: Settings | None = None) -> Settings:
    """Return the settings of a TOML text; settings that it does not name are those of ``base``, the defaults if None.

    Raises:
        ConfigError: an unknown name, a wrong type, or a value out of range; the message begins with ``where``.
    """
    return _build(base or Settings(), parse_toml(text, where, ConfigError), where)


def read(path: Path, base: Settings | None = None) -> Settings:
    """Return the settings of a file, see :func:`from_toml`."""
    return from_toml(read_text(path, ConfigError), str(path), base)


def preset(name: str) -> Settings:
    """Return one of the :data:`PRESETS`, which are the files of ``tk/data/presets/``.

    Raises:
        ConfigError: there is no preset of this name.
    """
    if name not in PRESETS:
        raise ConfigError(f"preset {name}: choose one of {', '.join(PRESETS)}")
    text = (resources.files("tk") / "data" / "presets" / f"{name}.toml").read_text(encoding="utf-8")
    return from_toml(text, f"preset {name}")


def _build(default: T, values: dict[str, Any], where: str, path: str = "") -> T:
    """Return ``default`` with the values of a table, recursively."""
    known = {f.name: getattr(default, f.name) for f in dataclasses.fields(default)}  # type: ignore[arg-type]
    hints = get_type_hints(type(default))
    changes: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{path}{key}"
        if key not in known:
            raise ConfigError(f"{where}: unknown setting {name}; known here: {', '.join(known)}")
        old = known[key]
        if isinstance(value, int) and name != "seed" and abs(value) > MOST_COUNT:
            raise ConfigError(f"{where}: {name} = {shown(value)} is too large; give {MOST_COUNT} at most")
        if isinstance(value, float) and math.isfinite(value) and abs(value) > LARGE:
            raise ConfigError(f"{where}: {name} = {value:g} is too large; give {LARGE:g} at most")
        if dataclasses.is_dataclass(old):
            if not isinstance(value, dict):
                raise ConfigError(f"{where}: {name} must be a table")
            changes[key] = _build(old, value, where, f"{name}.")
            continue
        if hints[key] is float and type(value) is int:
            changes[key] = float(value)
        elif type(value) is not hints[key]:
            raise ConfigError(f"{where}: {name} = {shown(value)} must be of type {type(old).__name__}, as {old!r} is")
        elif isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{where}: {name} = {value} must be a finite number")
        else:
            changes[key] = value
    try:
        return dataclasses.replace(default, **changes)  # type: ignore[type-var]
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
