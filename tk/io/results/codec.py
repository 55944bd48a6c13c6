"""Stores dataclasses in a result file: one codec for everything that a resumed run needs.

Arrays are entries of their own, named by their path, such as ``people/0/monitor/excluded``. All other values are in one
text, a JSON tree of the same structure. The fields' types say how to read them.
"""

from __future__ import annotations

import json
import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from tk.io.results.data import Value

T = TypeVar("T")

#: name of the entry with the tree; key of an array's path, and of a dataclass's name, in the tree
_TREE, _ARRAY, _CLASS = "tree", "array", "class"


def encode(value: Any) -> dict[str, Value]:
    """Return the entries of a dataclass. Fields are arrays, numbers, texts, enumerations, None, dataclasses, and lists,
    tuples and dictionaries of these.

    Raises:
        TypeError: a field is of another type.
    """
    entries: dict[str, Value] = {}
    tree = _encoded(value, "", entries)
    return {**entries, _TREE: json.dumps(tree)}


def decode(kind: type[T], entries: Mapping[str, Value]) -> T:
    """Return the dataclass of a class from its entries; others are ignored.

    Raises:
        KeyError, TypeError, ValueError: the entries are not those of this class.
    """
    found: T = _decoded(kind, json.loads(str(entries[_TREE])), entries)
    return found


def _encoded(value: Any, path: str, entries: dict[str, Value]) -> Any:
    if isinstance(value, Enum):
        return _encoded(value.value, path, entries)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        entries[path] = value
        return {_ARRAY: path}
    if is_dataclass(value):
        parts = {f.name: _encoded(getattr(value, f.name), _below(path, f.name), entries) for f in fields(value)}
        return {_CLASS: type(value).__name__, **parts}
    if isinstance(value, Mapping):
        return [[key, _encoded(item, _below(path, key), entries)] for key, item in value.items()]
    if isinstance(value, list | tuple):
        return [_encoded(item, _below(path, k), entries) for k, item in enumerate(value)]
    raise TypeError(f"{path}: a {type(value).__name__} cannot be stored")


def _decoded(kind: Any, tree: Any, entries: Mapping[str, Value]) -> Any:
    origin, args = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        if tree is None and type(None) in args:
            return None
        named = tree.get(_CLASS) if isinstance(tree, dict) else None
        others = [a for a in args if a is not type(None) and (named is None or getattr(a, "__name__", "") == named)]
        return _decoded(others[0], tree, entries)
    if kind is np.ndarray or origin is np.ndarray:
        return np.array(entries[tree[_ARRAY]])
    if kind is Any:
        return entries[tree[_ARRAY]] if isinstance(tree, dict) else tree
    if is_dataclass(kind):
        made: Any = kind
        if tree[_CLASS] != made.__name__:
            raise TypeError(f"{tree[_CLASS]} is no {made.__name__}")
        hints = get_type_hints(made)
        return made(**{f.name: _decoded(hints[f.name], tree[f.name], entries) for f in fields(made)})
    if origin in (list, tuple):
        of = [args[0]] * len(tree) if origin is list or args[1:] == (...,) else args
        return origin(_decoded(a, item, entries) for a, item in zip(of, tree, strict=True))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {args[0](key): _decoded(args[1], item, entries) for key, item in tree}
    return kind(tree)


def _below(path: str, name: object) -> str:
    return f"{path}/{name}" if path else str(name)
