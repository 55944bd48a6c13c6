"""All settings as a commented TOML file: `tk config`. The comments are the docstrings of the settings classes."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
from typing import Any

import tomli_w

from tk.errors import ConfigError
from tk.io.settings_file import PRESETS
from tk.settings import Settings

_WIDTH = 110
_HEAD = f"""\
All settings of tk. A file with some of them, given with --config, changes these and leaves the rest.
Presets, given with --preset: {", ".join(PRESETS)}."""


def annotated_toml(config: Settings) -> str:
    """Return the settings as TOML, each with a comment on its meaning and its default."""
    blocks = [_comment(_HEAD)]
    blocks += _table(config, Settings(), "", "")
    return "\n\n".join(blocks) + "\n"


def meanings(kind: type) -> dict[str, str]:
    """Return the description of each attribute in the docstring of a settings class, in its order.

    Raises:
        ConfigError: Python runs without docstrings (``-OO``).
    """
    text = inspect.getdoc(kind)
    if text is None:
        raise ConfigError("tk config: Python runs without docstrings (-OO), and the explanations are in them")
    found = re.search(r"^Attributes:\n((?:[ ]{4}.*\n?|\n)+)", text, re.M)
    described: dict[str, str] = {}
    names: list[str] = []
    for line in textwrap.dedent(found[1]).splitlines() if found else ():
        start = re.match(r"([a-z_]\w*(?:, [a-z_]\w*)*): (.*)", line)
        if start:
            names = start[1].split(", ")
            described |= dict.fromkeys(names, start[2])
        else:
            described |= {name: f"{described[name]} {line.strip()}".strip() for name in names}
    return described


def _table(values: Any, defaults: Any, path: str, title: str) -> list[str]:
    """Return the blocks of a table and of the tables in it."""
    described = meanings(type(values))
    lines, inner = [], []
    for field in dataclasses.fields(values):
        value, default = getattr(values, field.name), getattr(defaults, field.name)
        if dataclasses.is_dataclass(value):
            about = described.get(field.name) or (inspect.getdoc(type(value)) or "").partition("\n\n")[0]
            inner += _table(value, default, f"{path}{field.name}.", about)
            continue
        standard = _toml(field.name, default).partition(" = ")[2]
        lines.append(
            f"{_comment(f'{_sentence(described[field.name])} Default: {standard}')}\n{_toml(field.name, value)}"
        )
    if lines and path:
        lines[0] = f"{_comment(_sentence(title))}\n[{path[:-1]}]\n{lines[0]}"
    return lines + inner


def _sentence(text: str) -> str:
    """Return the text with a full stop, and a capital unless it begins with a symbol."""
    symbol = not re.match(r"[a-z]{2}|a ", text)
    return (text if symbol else text[0].upper() + text[1:]).rstrip(".") + "."


def _toml(name: str, value: object) -> str:
    return tomli_w.dumps({name: value}).strip()


def _comment(text: str) -> str:
    wrapped = (textwrap.fill(line, _WIDTH) for line in text.splitlines())
    return textwrap.indent("\n".join(wrapped), "# ", lambda line: True)
