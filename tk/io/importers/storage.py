"""OpenCV's FileStorage as YAML or JSON: nested tables, lists, and matrices with `rows`, `cols` and `data`.

OpenCV's own reader is not used: a damaged file can crash the process. Of YAML only what FileStorage and ROS write is
read: tables and lists by indentation, and lists in brackets.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tk.errors import CalibrationError
from tk.io.importers.files import read_json
from tk.io.toml import read_text

#: an entry of a table: its key, perhaps in quotes, and what follows
_ENTRY = re.compile(r"""(?:"([^"]*)"|'([^']*)'|([^\s:#%\-\[\]{}][^:]*?))\s*:(?:\s+(.*)|)$""", re.S)
#: entries that are text even if they look like a number, such as a serial number
_NAMES = ("name", "camera_name")
#: a tag of YAML, such as !!opencv-matrix
_TAG = re.compile(r"^![^\s]*\s*")


def read_storage(path: Path) -> Mapping[str, Any]:
    """Return the document in a file: texts, lists and tables. A matrix is a list of rows, and its numbers are texts in
    YAML: see :func:`numbers`."""
    if path.suffix.lower() == ".json":
        return {key: _matrices(value) for key, value in read_json(path).items()}
    lines = _logical_lines(read_text(path, CalibrationError))
    try:
        document, stop = _block(lines, 0, lines[0][0]) if lines else ({}, 0)
    except (_NotYamlError, RecursionError):
        document, stop = {}, -1
    if not isinstance(document, dict) or not document or stop < len(lines):
        place = f" (line {lines[stop][2]})" if 0 < stop < len(lines) else ""
        raise CalibrationError(f"{path}: is not YAML as OpenCV writes it{place}")
    return document


def numbers(value: Any) -> Any:
    """Return a value with numbers in place of texts that are one, at any depth; names stay texts."""
    if isinstance(value, Mapping):
        return {key: item if key in _NAMES else numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [numbers(item) for item in value]
    if isinstance(value, str):
        try:
            return float(value.removeprefix(".") if value.lower() in (".nan", ".inf") else value)
        except ValueError:
            return value
    return value


class _NotYamlError(Exception):
    """The text is no YAML of the kind that is read."""


def _logical_lines(text: str) -> list[tuple[int, str, int]]:
    """Return indentation, text and number of each line; lines within brackets are joined."""
    joined: list[tuple[int, str, int]] = []
    depth = 0
    for number, line in enumerate(text.splitlines(), 1):
        bare = re.sub(r"(^|\s)#.*$", "", line).rstrip().expandtabs()
        if not bare or bare.startswith(("%", "---", "...")):
            continue
        if depth > 0:
            indent, before, first = joined.pop()
            joined.append((indent, f"{before} {bare.strip()}", first))
        else:
            joined.append((len(bare) - len(bare.lstrip()), bare.strip(), number))
        depth = max(0, depth + bare.count("[") - bare.count("]"))
    return joined


def _block(lines: list[tuple[int, str, int]], start: int, indent: int) -> tuple[Any, int]:
    """Return the table or list whose lines begin at ``start`` with this indentation, and the line after it."""
    table: dict[str, Any] = {}
    items: list[Any] = []
    index = start
    while index < len(lines) and lines[index][0] == indent:
        text = lines[index][1]
        if text == "-" or text.startswith("- "):
            items.append(_scalar(text[1:].strip()))
            index += 1
            continue
        entry = _ENTRY.match(text)
        if entry is None:
            break
        key = next(name for name in entry.groups()[:3] if name is not None)
        rest = _TAG.sub("", entry.group(4) or "")
        index += 1
        if rest:
            table[key] = _scalar(rest)
        elif index < len(lines) and (
            lines[index][0] > indent or (lines[index][0] == indent and lines[index][1].startswith("- "))
        ):
            if lines[index][0] == indent:  # a list may begin below its key
                stop = index
                while stop < len(lines) and lines[stop][0] == indent and lines[stop][1].startswith("- "):
                    stop += 1
                table[key] = [_scalar(line[1][1:].strip()) for line in lines[index:stop]]
                index = stop
            else:
                table[key], index = _block(lines, index, lines[index][0])
        else:
            table[key] = ""
    if table and items:
        raise _NotYamlError
    return (_matrix(table) if table else items), index


def _scalar(text: str) -> Any:
    """Return a list in brackets, or a text without its quotes."""
    if not text.startswith("["):
        return text[1:-1] if len(text) > 1 and text[0] in "\"'" and text[-1] == text[0] else text
    stack: list[list[Any]] = [[]]
    for token in re.findall(r"[\[\]]|\"[^\"]*\"|'[^']*'|[^\[\],\s]+", text):
        if token == "[":
            stack.append([])
        elif token == "]":
            if len(stack) < 2:
                raise _NotYamlError
            inner = stack.pop()
            stack[-1].append(inner)
        else:
            stack[-1].append(token.strip("\"'"))
    if len(stack) != 1 or len(stack[0]) != 1:
        raise _NotYamlError
    return stack[0][0]


def _matrices(value: Any) -> Any:
    """Return a value of JSON with its matrices as lists of rows."""
    if isinstance(value, Mapping):
        return _matrix({key: _matrices(item) for key, item in value.items()})
    return [_matrices(item) for item in value] if isinstance(value, list) else value


def _matrix(table: dict[str, Any]) -> Any:
    """Return the rows of a table that is a matrix; the table as it is if it is none, or has not enough numbers."""
    data = table.get("data")
    if not isinstance(data, list):
        return table
    shape = table.get("sizes") or [table.get("rows"), table.get("cols")]  # `sizes`: of an array that is no matrix
    try:
        rows, columns = ([int(side) for side in shape] + [1])[:2]
    except (TypeError, ValueError, OverflowError):
        return table
    if rows < 1 or columns < 1 or rows * columns != len(data):
        return table
    return [data[row * columns : (row + 1) * columns] for row in range(rows)]
