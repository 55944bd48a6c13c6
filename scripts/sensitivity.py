"""Within which range of a constant or a setting the accuracy of tracking hardly changes.

    python -m scripts.sensitivity NAME… --captures CAPTURE… [--factors 0.5 0.7 1.4 2] [--frames A:B] [--masks none]
                                  [--method region] [--config FILE] [--limit 0.1] [--table docs/constants.md]
    python -m scripts.sensitivity --table docs/constants.md

NAME is a constant, ``tk.model.cameras.bundle:SEGMENT_M``, or a setting, ``silhouette.lost_error``. A dot after a
constant's name selects a field, a key or an index: ``tk.trackers.contour_finder:LINE_SEARCH.robust_px``. Numbers of a
whole table are multiplied together; integers are rounded. Constants that belong together are changed together: A+B
multiplies both, A+/B multiplies A and divides B by the same factor.

Each capture, which needs a ``truth.h5``, is tracked by ``tk track`` in a process of its own: once unchanged, then with
each number multiplied by each factor. A constant is multiplied where its module defines it, so all numbers derived from
it change, too. A line a value: mean errors of limbs (constant offsets removed) and of all joints (raw) by capture, cm.
Then the range of values around the present one in which the means of both over the captures change by less than
``--limit`` cm.

``--table`` writes a page of the constants that have been measured: value, meaning (the comment before the constant),
and the last column of the page as it was. The ranges just measured replace what it says of their constants.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.abc import MetaPathFinder, SourceLoader
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np

FACTORS = (0.5, 0.7, 1.4, 2.0)
PACKAGE = Path(__file__).parent.parent / "tk"
# Environment variable of a process that tracks with changed constants: JSON of names and factors.
_VARIABLE = "TK_SENSITIVITY"


@dataclass(frozen=True)
class Run:
    """One way to track the captures.

    Attributes:
        name: what is multiplied; None: nothing is.
        factor: by which.
    """

    name: str | None = None
    factor: float = 1.0


def scaled(value: Any, factor: float, path: Sequence[str] = ()) -> Any:
    """Return a value with its numbers multiplied, or only those of the field, key or index that ``path`` names."""
    if path:
        head, *rest = path
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return dataclasses.replace(value, **{head: scaled(getattr(value, head), factor, rest)})
        if isinstance(value, dict):
            return {**value, head: scaled(value[head], factor, rest)}
        return tuple(scaled(v, factor, rest) if i == int(head) else v for i, v in enumerate(value))
    if isinstance(value, bool) or value is None or isinstance(value, str):
        raise ValueError(f"{value!r} is no number")
    if isinstance(value, int):
        return round(value * factor)
    if isinstance(value, float | np.ndarray | np.floating):
        return value * factor
    if isinstance(value, dict):
        return {key: scaled(v, factor) for key, v in value.items()}
    if isinstance(value, tuple | list):
        return type(value)(scaled(v, factor) for v in value)
    raise ValueError(f"{value!r} is no number, nor a table of numbers")


def select(value: Any, path: Iterable[str]) -> Any:
    """Return the field, key or index of a value."""
    for part in path:
        value = getattr(value, part) if dataclasses.is_dataclass(value) else value[_key(value, part)]
    return value


def _key(value: Any, part: str) -> Any:
    return part if isinstance(value, dict) else int(part)


def assigned(node: ast.stmt) -> list[str]:
    """Return the names that a statement assigns; none if it is no assignment."""
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]


def members(name: str, factor: float) -> dict[str, float]:
    """Return the factor of each constant of a group such as A+/B."""
    return {one.removeprefix("/"): 1 / factor if one.startswith("/") else factor for one in name.split("+")}


# --- in the process that tracks ---------------------------------------------------------------------------------------


class _Scaling(MetaPathFinder):
    """Imports modules with constants multiplied right after their definitions.

    Args:
        factors: of the constants, by name.
    """

    def __init__(self, factors: Mapping[str, float]) -> None:
        self.factors: dict[str, dict[str, float]] = {}
        for name, factor in factors.items():
            module, _, constant = name.partition(":")
            self.factors.setdefault(module, {})[constant] = factor

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        if name not in self.factors:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None:
            assert isinstance(spec.loader, SourceLoader)
            cast(Any, spec.loader).get_code = lambda _: _with_factors(cast(str, spec.origin), self.factors[name])
        return spec


def _with_factors(file: str, factors: Mapping[str, float]) -> Any:
    """Return the code of a file with its constants multiplied."""
    tree = ast.parse(Path(file).read_text(encoding="utf-8"), file)
    for name, factor in factors.items():
        constant, *path = name.split(".")
        found = [position for position, node in enumerate(tree.body) if constant in assigned(node)]
        if not found:
            raise ImportError(f"{file} defines no {constant}")
        multiplied = f"{constant} = _scaled({constant}, {factor}, {path})"
        change = f"from scripts.sensitivity import scaled as _scaled\n{multiplied}"
        tree.body[found[0] + 1 : found[0] + 1] = ast.parse(change).body
    return compile(ast.fix_missing_locations(tree), file, "exec", dont_inherit=True)


if _VARIABLE in os.environ:
    sys.meta_path.insert(0, _Scaling(json.loads(os.environ[_VARIABLE])))


# --- in the process that compares -------------------------------------------------------------------------------------


def track_errors(run: Run, capture: Path, args: argparse.Namespace) -> tuple[float, float]:
    """Track a capture and return the mean errors of limbs (offsets removed) and of all joints, cm; NaN if it failed."""
    from tk.evaluation.joints import evaluate_files
    from tk.io import settings_file
    from tk.settings import Settings

    settings = settings_file.read(args.config) if args.config else Settings()
    settings = dataclasses.replace(settings, ahead=0)  # a process of its own for the masks would not scale constants
    environment = {name: value for name, value in os.environ.items() if name != _VARIABLE}
    changes = {} if run.name is None else members(run.name, run.factor)
    environment[_VARIABLE] = json.dumps({name: factor for name, factor in changes.items() if ":" in name})
    for name in changes.keys() - json.loads(environment[_VARIABLE]).keys():
        settings = scaled(settings, changes[name], name.split("."))
    with tempfile.TemporaryDirectory() as folder:
        result, config = Path(folder) / "result.h5", Path(folder) / "settings.toml"
        config.write_text(settings_file.to_toml(settings), encoding="utf-8")
        command = ["track", str(capture), "-o", str(result), "--config", str(config), "--no-report", "-q"]
        command += ["--masks", args.masks, "--method", args.method]
        command += ["--frames", args.frames] if args.frames else []
        done = subprocess.run(
            [sys.executable, "-m", "scripts.sensitivity", "--track", *command],
            env=environment, capture_output=True, text=True,
        )  # fmt: skip
        if done.returncode not in (0, 3):
            sys.stderr.write(done.stderr)
            return np.nan, np.nan
        found = evaluate_files(result, capture / "truth.h5")
    return found.corrected.limbs.mean_cm, found.raw.all.mean_cm


def value_of(name: str, config: Path | None = None) -> Any:
    """Return the present value of a constant or a setting."""
    module, colon, constant = name.partition(":")
    if colon:
        head, *path = constant.split(".")
        return select(getattr(importlib.import_module(module), head), path)
    from tk.io import settings_file
    from tk.settings import Settings

    return select(settings_file.read(config) if config else Settings(), name.split("."))


def tolerated(values: Sequence[tuple[float, bool]]) -> tuple[float, float]:
    """Return the smallest and the largest factor, around 1, between which every tried one is good.

    Args:
        values: factors in any order, and whether the accuracy hardly changed with each.
    """
    low = high = 1.0
    for factor, good in sorted((v for v in values if v[0] < 1), reverse=True):
        if not good:
            break
        low = factor
    for factor, good in sorted(v for v in values if v[0] > 1):
        if not good:
            break
        high = factor
    return low, high


def shown(value: Any) -> str:
    """Return a number as short text; a table as "table"."""
    return (
        f"{value:.4g}" if isinstance(value, float | np.floating) else str(value) if isinstance(value, int) else "table"
    )


def measure(
    name: str, factors: Sequence[float], errors: Callable[[Run], np.ndarray], limit: float, config: Path | None = None
) -> Iterable[str]:
    """Yield a table's lines for one constant or setting, or a group; ``errors`` returns (captures, 2) of a run, cm."""
    several = "+" in name
    present = tuple(value_of(one, config) for one in members(name, 1.0)) if several else value_of(name, config)
    base, judged = errors(Run()), []
    yield f"{name} = {shown(present)}"
    yield _line("unchanged", present, base)
    for factor in factors:
        value = present if several else scaled(present, factor)
        if isinstance(value, int) and value == present:  # it rounds to itself
            continue
        found = errors(Run(name, factor))
        change = np.abs(found.mean(axis=0) - base.mean(axis=0)).max()
        judged.append((factor, bool(change < limit)))
        yield _line(f"× {factor:g}", value, found) + f"   change {change:.2f}"
    low, high = tolerated(judged)
    if isinstance(present, float | int):
        ends = f"{shown(scaled(present, low))} to {shown(scaled(present, high))}"
    else:
        ends = f"factors {low:g} to {high:g}"
    yield f"changes by less than {limit:g} cm: {ends}"


def _line(label: str, value: Any, errors: np.ndarray) -> str:
    text = "   ".join(f"{limbs:5.2f} {raw:5.2f}" for limbs, raw in errors)
    return f"  {label:10} {shown(value):>12}   {text}   mean {errors[:, 0].mean():5.2f} {errors[:, 1].mean():5.2f}"


# --- the page of measured constants -----------------------------------------------------------------------------------

# Longest value in the page, characters.
_LONG = 80
_HEAD = """# Constants

Numbers that no user sets, by module: value, meaning with unit (the comment before the constant),
and what was measured with other values. Errors are mean errors of joints; the recordings are those
of the [results](results.md#recordings-and-errors). Constants that are not listed have their source
in the comment before them, or no result depends on them.

`python -m scripts.sensitivity --table docs/constants.md` writes the page from the sources. The last
column stays as it is; constants that the same run measures are added with their ranges.
"""


@dataclass(frozen=True)
class Constant:
    """A statement that defines constants.

    Attributes:
        module: such as "tk.trackers.region".
        names: that it assigns.
        value: its source, in one line.
        meaning: the comment before it or behind it.
    """

    module: str
    names: tuple[str, ...]
    value: str
    meaning: str

    @property
    def key(self) -> str:
        """The name in the page's first column."""
        return f"{self.module}:{', '.join(self.names)}"


def constants(package: Path) -> Iterator[Constant]:
    """Yield the constants of a package that contain numbers, in the order of the files."""
    for file in sorted(package.rglob("*.py")):
        source = file.read_text(encoding="utf-8")
        lines = source.splitlines()
        for node in ast.parse(source).body:
            names = assigned(node)
            value = getattr(node, "value", None)
            if not names or value is None or not names[0].strip("_").isupper() or not _numbers(value):
                continue
            module = ".".join(file.relative_to(package.parent).with_suffix("").parts)
            yield Constant(module, tuple(names), ast.unparse(value), _comment(lines, node))


def _numbers(value: ast.expr) -> bool:
    return any(isinstance(n, ast.Constant) and type(n.value) in (int, float) for n in ast.walk(value))


def _comment(lines: Sequence[str], node: ast.stmt) -> str:
    """Return the comment in the lines before a statement, or behind it; that of the constants right before, if none."""
    if "  # " in (last := lines[node.end_lineno - 1 if node.end_lineno else 0]) and "# fmt" not in last:
        return last.split("  # ", 1)[1]
    at = node.lineno - 1
    while at and lines[at - 1] and not lines[at - 1].startswith(("#", " ", "from", "import", ")")):
        at -= 1
    first = at
    while first and lines[first - 1].startswith("#"):
        first -= 1
    return " ".join(line.lstrip("#: ") for line in lines[first:at])


def known_of(text: str) -> dict[str, str]:
    """Return what the last column of a page says, by module and names."""
    known, module = {}, ""
    for line in text.splitlines():
        cells = re.split(r"(?<!\\)\|", line)
        if line.startswith("## "):
            module = line[3:]
        elif line.startswith("| `") and len(cells) == 6:
            known[f"{module}:{cells[1].strip(' `')}"] = cells[4].strip().replace("\\|", "|")
    return known


def page(found: Iterable[Constant], known: Mapping[str, str]) -> str:
    """Return the page of the constants of which something is ``known``, by module and names, or by one name."""
    parts, module = [_HEAD], ""
    for one in found:
        keys = one.key, *(f"{one.module}:{name}" for name in one.names)
        said = [known[key] for key in keys if key in known]
        if not said:
            continue
        if one.module != module:
            module = one.module
            parts.append(f"\n## {module}\n\n| constant | value | meaning | measured |\n|---|---|---|---|\n")
        value = one.value if len(one.value) < _LONG else "table"
        cells = [f"`{', '.join(one.names)}`", f"`{value}`", one.meaning, said[-1]]
        parts.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n")
    return "".join(parts)


def main(arguments: Sequence[str] | None = None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["--track"]:
        from tk.cli import main as tk

        tk(list(arguments[1:]))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--captures", nargs="+", type=Path, default=[], metavar="CAPTURE")
    parser.add_argument("--factors", nargs="+", type=float, default=FACTORS)
    parser.add_argument("--frames", help="as for tk track")
    parser.add_argument("--masks", default="none", help="as for tk track")
    parser.add_argument("--method", default="region", help="as for tk track")
    parser.add_argument("--config", type=Path, help="settings to begin with")
    parser.add_argument("--limit", type=float, default=0.1, help="smallest change that counts, cm")
    parser.add_argument("--table", type=Path, metavar="FILE", help="write the page of measured constants")
    args = parser.parse_args(arguments)
    if bool(args.names) != bool(args.captures) or not (args.names or args.table):
        parser.error("NAME and --captures belong together; without them, --table is needed")
    known: dict[Run, np.ndarray] = {}

    def errors(run: Run) -> np.ndarray:
        if run not in known:
            known[run] = np.array([track_errors(run, capture, args) for capture in args.captures])
        return known[run]

    if args.names:
        sys.stdout.write(f"limbs and raw errors, cm: {', '.join(capture.name for capture in args.captures)}\n")
    ranges = {}
    for name in args.names:
        for line in measure(name, args.factors, errors, args.limit, args.config):
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
        ranges[name] = line
    if args.table:
        before = args.table.read_text(encoding="utf-8") if args.table.exists() else ""
        args.table.write_text(page(constants(PACKAGE), known_of(before) | ranges), encoding="utf-8")


if __name__ == "__main__":
    main()
