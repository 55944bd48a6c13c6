"""The codec of dataclasses: what is stored is read again, with the same bits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tk.io.results.codec import decode, encode
from tk.io.results.layout import pack_state, unpack_state


class Color(Enum):
    RED = "red"


@dataclass(frozen=True)
class Cat:
    lives: int


@dataclass(frozen=True)
class Dog:
    weight_kg: float
    bones: NDArray[np.float64] | None


@dataclass(frozen=True)
class Owner:
    name: str
    pets: list[Cat | Dog]
    first: Cat | Dog | None
    ages: dict[int, tuple[int, float]]
    seen: NDArray[np.bool_]
    color: Color
    pair: tuple[int, ...]
    anything: dict[str, Any]


OWNER = Owner(
    "Ann",
    [Cat(9), Dog(np.inf, np.array([0.1, np.nan])), Dog(0.1 + 0.2, None)],
    None,
    {3: (1, 0.1)},
    np.zeros((2, 0), np.bool_),
    Color.RED,
    (),
    {"a/b": np.arange(3, dtype=np.uint8), "c": "text", "d": 1.5},
)


def stored(value: Any, kind: Any) -> Any:
    return decode(kind, unpack_state(pack_state(1, 1, encode(value)))[2])


def test_values_are_read_as_they_were_stored() -> None:
    found = stored(OWNER, Owner)
    assert repr(found) == repr(OWNER)
    assert found.seen.dtype == np.bool_ and found.seen.shape == (2, 0)
    assert found.anything["a/b"].dtype == np.uint8 and isinstance(found.ages[3], tuple)
    assert stored(replace(OWNER, first=Dog(1.0, None)), Owner).first == Dog(1.0, None)


def test_other_classes_and_unknown_types_are_refused() -> None:
    with pytest.raises(TypeError, match="Cat is no Dog"):
        decode(Dog, encode(Cat(9)))
    with pytest.raises(KeyError):
        decode(Dog, {})
    with pytest.raises(TypeError, match="anything/x: a object"):
        encode(replace(OWNER, anything={"x": object()}))
