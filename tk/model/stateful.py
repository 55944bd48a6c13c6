"""Objects whose state is a frozen dataclass. A run stores it, and continues from it with the same bits."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

S = TypeVar("S")


class Stateful(Generic[S]):
    """An object that changes from frame to frame.

    Attributes:
        State: frozen dataclass. Each field is named as the attribute that it holds, without a leading underscore; the
            field of another :class:`Stateful` holds that object's state.
    """

    State: ClassVar[type[Any]]

    @property
    def state(self) -> S:
        """A copy of what changes; setting it goes back to that frame.

        Raises:
            TypeError: the state is of another class.
        """
        found: S = self.State(**{f.name: _copy(getattr(self, self._attribute(f.name))) for f in fields(self.State)})
        return found

    @state.setter
    def state(self, state: S) -> None:
        if not isinstance(state, self.State):
            raise TypeError(f"{type(state).__name__} is no {self.State.__name__}")
        for f in fields(self.State):
            name, value = self._attribute(f.name), getattr(state, f.name)
            part = getattr(self, name, None)
            if isinstance(part, Stateful):
                part.state = value
            else:
                setattr(self, name, _copy(value))
        self._restored()

    def _restored(self) -> None:
        """Compute what follows from a state that has been set."""

    def _attribute(self, name: str) -> str:
        return name if hasattr(self, name) else f"_{name}"


def _copy(value: Any) -> Any:
    """Return a value that does not change with the object; the elements of lists and dictionaries are frozen."""
    if isinstance(value, Stateful):
        return value.state
    return value.copy() if isinstance(value, np.ndarray | list | dict) else value
