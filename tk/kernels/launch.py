"""Launches that cost a third: for kernels that run dozens of times a frame on small arrays.

Taichi spends 6 µs on each array of a launch, most of it to find out again what it is: type, place in the compiled
kernel, context. A :class:`Launcher` lets Taichi do so at the first call, remembers the compiled kernel and its context,
and from then on hands over pointers to those arrays that are not the ones of the call before: 2 µs each. That reaches
below Taichi's public interface; where a Taichi has no such thing, and in debug mode, every call is an ordinary one.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from tk.kernels.runtime import ti

_WHOLE = (ti.i32, ti.i64)


def _nothing() -> None:
    """In the place of a reference to an array where there was none yet."""


class Launcher:
    """A kernel with its first arguments fixed.

    Args:
        kernel: of arrays and plain numbers.
        constants: its first arguments, contiguous arrays that stay as they are.

    Calls take the rest. Arrays must be contiguous, of the types and numbers of dimensions of the first call, which
    Taichi itself has checked: TypeError otherwise.
    """

    def __init__(self, kernel: Callable[..., None], *constants: np.ndarray) -> None:
        self._kernel = kernel
        self._constants = constants
        self._program: Any = None
        self._compiled: Any = None
        self._context: Any = None
        self._expected: list[tuple[tuple[int], Any, int]] = []
        self._lock = threading.Lock()
        # what the context has: numbers, and weak references to arrays, so that none is held beyond its use
        self._last: list[Any] = []

    def __call__(self, *arguments: Any) -> None:
        with self._lock:
            program = ti.lang.impl.get_runtime().prog
            if self._compiled is None or self._program is not program:
                self._kernel(*self._constants, *arguments)
                self._remember(arguments)
                return
            self._update(arguments)
            self._launch(program, self._context)

    def _update(self, arguments: tuple[Any, ...]) -> None:
        context, last = self._context, self._last
        for i, ((slot, kind, ndim), value) in enumerate(zip(self._expected, arguments, strict=True)):
            if kind is float or kind is int:
                if value != last[i]:
                    set_number = context.set_arg_float if kind is float else context.set_arg_int
                    set_number(slot, kind(value))
                    last[i] = value
                continue
            if last[i]() is value:
                continue
            if value.dtype == kind and value.ndim == ndim and value.flags.c_contiguous:
                context.set_arg_external_array_with_shape(slot, value.ctypes.data, value.nbytes, value.shape, 0)
            else:
                raise TypeError(
                    f"argument {slot[0]} is {value.dtype} of {value.ndim} dimensions, "
                    f"contiguous: {value.flags.c_contiguous}; the first call had {kind} of {ndim}"
                )
            last[i] = weakref.ref(value)

    def _launch(self, program: Any, context: Any) -> None:
        program.launch_kernel(self._compiled, context)

    def _remember(self, arguments: tuple[Any, ...]) -> None:
        """What the call just made has shown; nothing where this Taichi is another one than we know."""
        try:
            program = ti.lang.impl.get_runtime().prog
            if program.config().debug:
                return
            primal = self._kernel._primal  # type: ignore[attr-defined]
            everything = (*self._constants, *arguments)
            source = primal.compiled_kernels[primal.ensure_compiled(*everything)]
            compiled = program.compile_kernel(program.config(), program.get_device_caps(), source)
            annotations = [argument.annotation for argument in primal.arguments]
        except (AttributeError, KeyError, TypeError):
            return
        first = len(self._constants)
        if not all(a.flags.c_contiguous for a in self._constants):
            return
        context = source.make_launch_context()
        for i, a in enumerate(self._constants):
            context.set_arg_external_array_with_shape((i,), a.ctypes.data, a.nbytes, a.shape, 0)
        self._expected = [
            ((i,), value.dtype, value.ndim)
            if isinstance(value, np.ndarray)
            else ((i,), int if annotations[i] in _WHOLE else float, 0)
            for i, value in enumerate(arguments, first)
        ]
        self._last = [_nothing if kind is not int and kind is not float else None for _, kind, _ in self._expected]
        self._program, self._context, self._compiled = program, context, compiled
