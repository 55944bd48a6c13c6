"""The sensitivity script: which numbers it changes, which range it reports, and one run on a tiny capture."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scripts import sensitivity
from scripts.sensitivity import (
    Run,
    constants,
    known_of,
    main,
    measure,
    members,
    page,
    scaled,
    tolerated,
    value_of,
)
from tests.conftest import FITTED
from tk.cli import main as tk


@dataclass(frozen=True)
class Table:
    size: float = 2.0
    count: int = 3


@pytest.mark.parametrize(
    ("value", "path", "expected"),
    [
        (3, [], 4),
        (0.5, [], 0.7),
        ((1.0, 2), [], (1.4, 3)),
        ((1.0, 2), ["1"], (1.0, 3)),
        ({"a": 1.0, "b": 5.0}, ["b"], {"a": 1.0, "b": 7.0}),
        (Table(), ["count"], Table(2.0, 4)),
    ],
)
def test_numbers_are_multiplied_and_integers_rounded(value: object, path: list[str], expected: object) -> None:
    assert scaled(value, 1.4, path) == pytest.approx(expected) if path == [] else scaled(value, 1.4, path) == expected


def test_values_that_are_no_numbers_are_refused() -> None:
    for value in (True, "full", None):
        with pytest.raises(ValueError, match="no number"):
            scaled(value, 2.0)


def test_range_ends_before_the_first_value_that_changes_the_accuracy() -> None:
    assert tolerated([(0.5, True), (0.7, False), (1.4, True), (2.0, True), (4.0, False)]) == (1.0, 2.0)
    assert tolerated([(0.7, True), (0.5, True)]) == (0.5, 1.0)


def test_table_names_values_errors_and_range() -> None:
    """Errors grow with the distance of the factor from 1; both captures count."""

    def errors(run: Run) -> np.ndarray:
        return np.array([[1.0, 2.0], [1.5, 2.5]]) + 0.09 * abs(run.factor - 1)

    lines = list(measure("silhouette.init_frames", [0.5, 0.99, 2.0, 3.0], errors, 0.1))
    frames = value_of("silhouette.init_frames")
    assert lines[0] == f"silhouette.init_frames = {frames}" and len(lines) == 6  # 0.99 rounds to the same
    assert "1.09  2.09" in lines[3] and "mean  1.34  2.34" in lines[3]
    assert lines[-1] == f"changes by less than 0.1 cm: {round(frames / 2)} to {2 * frames}"


def test_constant_and_numbers_derived_from_it_change_in_a_process_of_its_own() -> None:
    code = (
        "import scripts.sensitivity, tk.model.cameras.bundle as b; import tk.model.body.body_fit as f; "
        "print(b.SHAPE_NOISE_PX, b.BUNDLE_INFORMATION, f.BUNDLE_INFORMATION)"
    )
    name = "tk.model.cameras.bundle:SHAPE_NOISE_PX"
    ran = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, sensitivity._VARIABLE: json.dumps({name: 2.0})},
        capture_output=True,
        text=True,
        check=True,
    )
    from tk.model.cameras import bundle

    expected = [2 * bundle.SHAPE_NOISE_PX, bundle.BUNDLE_INFORMATION / 4, bundle.BUNDLE_INFORMATION / 4]
    assert [float(value) for value in ran.stdout.split()] == pytest.approx(expected)


def test_tiny_capture_is_tracked_with_each_value(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process, which has compiled the kernels."""

    def here(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        assert command[1:4] == ["-m", "scripts.sensitivity", "--track"]
        tk([*command[4:], "--causal"], standalone_mode=False)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", here)
    config = tmp_path / "quick.toml"
    config.write_text(FITTED, encoding="utf-8")
    options = ["--factors", "0.5", "--frames", "0:1", "--masks", "auto", "--config", str(config), "--limit", "100"]
    main(["silhouette.init_frames", "--captures", str(tiny), *options])
    lines = capsys.readouterr().out.splitlines()
    plain, changed = (line.split("mean")[1] for line in lines[2:4])
    assert plain.split()[:2] != changed.split()[:2] and "nan" not in changed
    assert lines[-1] == "changes by less than 100 cm: 2 to 3"


def test_group_is_multiplied_together_and_its_divided_members_divided() -> None:
    assert members("a:X+/b:Y+c.z", 4.0) == {"a:X": 4.0, "b:Y": 0.25, "c.z": 4.0}
    name = "silhouette.init_frames+tk.trackers.judgement:RECOVER_EVERY"
    lines = list(measure(name, [0.5, 2.0], lambda run: np.full((1, 2), run.factor), 0.6))
    assert lines[0] == f"{name} = table" and lines[-1] == "changes by less than 0.6 cm: factors 0.5 to 1"


def test_page_has_each_constant_with_its_comment_and_keeps_what_was_measured(tmp_path: Path) -> None:
    package = tmp_path / "pkg"
    package.mkdir()
    source = (
        '# A length, metres:\n# of two lines.\nA, B = 1.5, 2\nC = A\nD: int = 3  # Behind.\nname = 4\nT = "a | b", 5\n'
    )
    (package / "module.py").write_text(source, encoding="utf-8")
    found = list(constants(package))
    assert [one.key for one in found] == ["pkg.module:A, B", "pkg.module:D", "pkg.module:T"]
    assert [one.meaning for one in found][:2] == ["A length, metres: of two lines.", "Behind."]
    text = page(found, {"pkg.module:A, B": "1 | 2 cm", "pkg.module:T": "2 cm"})
    assert "| `T` | `('a \\| b', 5)` |" in text and "`D`" not in text
    assert page(found, known_of(text)) == text
    assert "2 to 4" in page(found, known_of(text) | {"pkg.module:D": "2 to 4"})


def test_page_of_the_package_names_constants_that_exist() -> None:
    known = known_of((sensitivity.PACKAGE.parent / "docs" / "constants.md").read_text(encoding="utf-8"))
    assert known and set(known) <= {one.key for one in constants(sensitivity.PACKAGE)}
