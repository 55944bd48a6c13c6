"""Find and read files of other tools with care: a project's folder may hold anything."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from tk.errors import CalibrationError
from tk.io.toml import MOST_BYTES, Table, read_text


def read_xml(path: Path) -> Element:
    """Return the root of an XML document. Entities are refused: they can make a small file endless."""
    text = read_text(path, CalibrationError)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise CalibrationError(f"{path}: declares a document type, which calibrations do not; remove the declaration")
    # the text is decoded already, so the encoding that the file declares does not apply
    text = re.sub(r"^\s*<\?xml.*?\?>", "", text, count=1, flags=re.S)
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as reason:
        raise CalibrationError(f"{path}: invalid XML: {reason}") from None


def read_json(path: Path) -> Mapping[str, Any]:
    """Return the object in a JSON file."""
    text = read_text(path, CalibrationError)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as reason:  # ValueError: also a number of thousands of digits
        raise CalibrationError(f"{path}: invalid JSON: {reason}") from None
    if not isinstance(document, Mapping):
        raise CalibrationError(f"{path}: must hold one JSON object {{…}}")
    return document


def contains(path: Path, *words: bytes) -> bool:
    """Return whether a small file contains all of these words."""
    try:
        if not path.is_file() or path.stat().st_size > MOST_BYTES:  # a pipe never ends
            return False
        content = path.read_bytes()
    except OSError:
        return False
    return all(word in content for word in words)


def json_with(*words: bytes) -> Callable[[Path], list[Path]]:
    """Return a function that finds the JSON files of a project that contain all of these words."""
    return lambda root: [path for path in matching(root, "*.json", "calibration/*.json") if contains(path, *words)]


def listed_cameras(document: Mapping[str, Any], path: Path) -> list[Mapping[str, Any]]:
    """Return the list of tables ``cameras`` in a document."""
    listed = document.get("cameras")
    if not isinstance(listed, list) or not all(isinstance(item, Mapping) for item in listed):
        raise CalibrationError(f"{path}: has no list of `cameras`")
    return listed


def attributes(element: Element, where: str, words: Mapping[str, slice] = MappingProxyType({})) -> Table:
    """Return an element's attributes: a number, a list of numbers, or a text.

    Args:
        element: the element.
        where: begin of error messages.
        words: the words that count, of attributes with others.
    """
    values = {key: _parsed(text.split()[words.get(key, slice(None))], text) for key, text in element.attrib.items()}
    return Table(values, where, CalibrationError)


def child(parent: Element, path: str, where: str, words: Mapping[str, slice] = MappingProxyType({})) -> Table:
    """Return the :func:`attributes` of the first child at ``path``. Raises CalibrationError if there is none."""
    found = parent.find(path)
    if found is None:
        raise CalibrationError(f"{where}: has no <{path.rpartition('/')[2]}>")
    return attributes(found, f"{where}: <{found.tag}>", words)


def _parsed(words: Sequence[str], text: str) -> float | list[float] | str:
    try:
        values = [float(word) for word in words]
    except ValueError:
        return text
    return values[0] if len(values) == 1 else values


def matching(folder: Path, *patterns: str) -> list[Path]:
    """Return the folder's files that match these glob patterns, sorted, without folders and hidden files."""
    found = {path for pattern in patterns for path in folder.glob(pattern)}
    return sorted(path for path in found if not path.is_dir() and not path.name.startswith("."))


def only(files: Sequence[Path]) -> Path:
    """Return the one file; several are an error."""
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise CalibrationError(f"{files[0].parent}: holds several calibrations: {names}; keep only the right one")
    return files[0]
