"""Every script can be imported: what they take from each other and from tk is there."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.mark.parametrize("name", sorted(path.stem for path in SCRIPTS.glob("[!_]*.py")))
def test_script_can_be_imported(name: str) -> None:
    importlib.import_module(f"scripts.{name}")
