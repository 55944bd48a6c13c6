"""Uses of Taichi's internals, for speed only. With an unknown Taichi version they do nothing.

:class:`Launcher` reduces the cost of a launch to a third. Taichi spends 6 µs on each array of a launch, mostly to find
its type and its place in the compiled kernel again. A Launcher makes the first launch by Taichi, stores the compiled
kernel and its context, and then passes pointers to the arrays that changed: 2 µs each.

:func:`shorten_notes` halves the time in which Python transforms the kernels at each start. For each node of a kernel's
syntax tree Taichi notes its position for error messages, with the line of code wrapped to 80 columns and underlined.
For each call of a ``@ti.func`` it reads that function's source again. Shortened notes, for the kernels of this package,
have file, line and code only, and each source is read once. Functions of Taichi have them, too.

:func:`quick_import` and :func:`quick_decorators` halve the time of importing Taichi and the kernels. To know whether a
class contains a decorated function, Taichi searches the sources of all modules for the decorator's line. The caller's
frame shows it at once.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import inspect
import sys
import textwrap
import threading
import weakref
from collections.abc import Callable, Iterator
from types import FrameType, SimpleNamespace
from typing import Any

import numpy as np

_OURS = "tk.", "scripts.synthetic.", "taichi."


def program() -> Any:
    """Return Taichi's running program; None before ``ti.init``. :mod:`tk.kernels.runtime` has imported Taichi."""
    return sys.modules["taichi"].lang.impl.get_runtime().prog


# --- launches ----------------------------------------------------------------------------------------------------


class _Number:
    """An argument that is a number."""

    __slots__ = ("_index", "_kind", "_last")

    def __init__(self, index: int, kind: type[int] | type[float]) -> None:
        self._index, self._kind, self._last = (index,), kind, None

    def put(self, context: Any, value: Any) -> None:
        """Put the value into the context of a launch, unless it is there already."""
        if value != self._last:
            set_number = context.set_arg_float if self._kind is float else context.set_arg_int
            set_number(self._index, self._kind(value))
            self._last = value


class _Array:
    """An argument that is an array like that of the first call."""

    __slots__ = ("_dtype", "_index", "_last", "_ndim")

    def __init__(self, index: int, first: np.ndarray) -> None:
        self._index, self._dtype, self._ndim = (index,), first.dtype, first.ndim
        self._last: Callable[[], np.ndarray | None] = lambda: None

    def put(self, context: Any, value: np.ndarray) -> None:
        """Put a pointer to the array into the context of a launch, unless it is there already."""
        if self._last() is value:
            return
        if value.dtype != self._dtype or value.ndim != self._ndim or not value.flags.c_contiguous:
            raise TypeError(
                f"argument {self._index[0]} is {value.dtype} of {value.ndim} dimensions, contiguous: "
                f"{value.flags.c_contiguous}; the first call had {self._dtype} of {self._ndim}"
            )
        context.set_arg_external_array_with_shape(self._index, value.ctypes.data, value.nbytes, value.shape, 0)
        self._last = weakref.ref(value)  # keeps no array alive


class Launcher:
    """A kernel with its first arguments fixed.

    Args:
        kernel: a Taichi kernel of arrays and numbers.
        constants: its first arguments, contiguous arrays that do not change.

    Calls pass the other arguments. Arrays must be contiguous, with the types and numbers of dimensions of the first
    call, which Taichi itself has checked: TypeError otherwise. In debug mode every call is an ordinary launch.
    """

    def __init__(self, kernel: Callable[..., None], *constants: np.ndarray) -> None:
        self._kernel = kernel
        self._constants = constants
        self._lock = threading.Lock()
        # of the first call: Taichi's program, the compiled kernel, its context, and the places of the arguments in it
        self._program: Any = None
        self._compiled: Any = None
        self._context: Any = None
        self._arguments: list[_Number | _Array] = []

    def __call__(self, *values: Any) -> None:
        with self._lock:
            running = program()
            if self._compiled is None or self._program is not running:
                with _no_collection():
                    self._kernel(*self._constants, *values)
                self._remember(values)
                return
            for argument, value in zip(self._arguments, values, strict=True):
                argument.put(self._context, value)
            self._launch(running)

    def _launch(self, running: Any) -> None:
        running.launch_kernel(self._compiled, self._context)

    def _remember(self, values: tuple[Any, ...]) -> None:
        """Store the kernel that the last call compiled; nothing if this Taichi is an unknown version."""
        taichi = sys.modules["taichi"]
        try:
            running = program()
            if running.config().debug:
                return
            primal = self._kernel._primal  # type: ignore[attr-defined]
            source = primal.compiled_kernels[primal.ensure_compiled(*self._constants, *values)]
            compiled = running.compile_kernel(running.config(), running.get_device_caps(), source)
            types = [argument.annotation for argument in primal.arguments]
        except (AttributeError, KeyError, TypeError):
            return
        if not all(array.flags.c_contiguous for array in self._constants):
            return
        context = source.make_launch_context()
        for i, array in enumerate(self._constants):
            _Array(i, array).put(context, array)
        whole = taichi.i32, taichi.i64
        self._arguments = [
            _Array(i, value) if isinstance(value, np.ndarray) else _Number(i, int if types[i] in whole else float)
            for i, value in enumerate(values, len(self._constants))
        ]
        self._program, self._context, self._compiled = running, context, compiled


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Collect no garbage inside: the syntax tree of a kernel consists of many objects, all of them in use."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


# --- decorators ---------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def quick_import() -> Iterator[None]:
    """Import Taichi inside without a search for the sources of the import system, which has none."""
    original = inspect.getframeinfo

    def quick(frame: FrameType, context: int = 1) -> Any:
        if frame.f_code.co_filename.startswith("<frozen "):
            raise OSError("no source")  # which Taichi takes for: no class
        return original(frame, context)

    inspect.getframeinfo = quick  # type: ignore[assignment]
    try:
        yield
    finally:
        inspect.getframeinfo = original


def quick_decorators(kernels: Any) -> bool:
    """Decide by the frame whether a class contains a decorated function; return whether this Taichi version is known.

    Args:
        kernels: the module ``taichi.lang.kernel_impl``.
    """
    original = getattr(kernels, "_inside_class", None)
    if not callable(original):
        return False

    def inside_class(level_of_class_stackframe: int) -> bool:
        # the frame before is the one that contains the function; only a class body has this name
        if "__qualname__" not in sys._getframe(level_of_class_stackframe - 1).f_locals:
            return False
        return bool(original(level_of_class_stackframe + 1))

    kernels._inside_class = inside_class
    return True


# --- notes about kernels' sources --------------------------------------------------------------------------------


def shorten_notes(utilities: Any, kernels: Any) -> bool:
    """Shorten the notes and read each source once; return whether this Taichi version is known.

    Args:
        utilities: the module ``taichi.lang.ast.ast_transformer_utils``.
        kernels: the module ``taichi.lang.kernel_impl``.
    """
    context: Any = getattr(utilities, "ASTTransformerContext", None)
    full = getattr(context, "get_pos_info", None)
    if not callable(full) or getattr(kernels, "textwrap", None) is None:
        return False
    if not hasattr(full, "__wrapped__"):
        context.get_pos_info = _short_notes(full)
    if kernels.textwrap is textwrap:
        kernels.textwrap = SimpleNamespace(fill=_fill, dedent=textwrap.dedent)
        for name in ("getsourcefile", "getsourcelines"):
            if callable(read := getattr(kernels, name, None)):
                setattr(kernels, name, functools.cache(read))
    return True


def _short_notes(full: Callable[[Any, Any], str]) -> Callable[[Any, Any], str]:
    known: dict[tuple[Any, int], str] = {}  # by function and line: a line has ten nodes, and a function many callers

    @functools.wraps(full)
    def note(self: Any, node: Any) -> str:
        try:
            function, line = place = self.func.func, node.lineno
            if place not in known and function.__module__.startswith(_OURS):
                where = f'File "{self.file}", line {line + self.lineno_offset}, in {function.__name__}'
                known[place] = f"{where}:\n{self.src[line - 1].strip()}\n"
            return known.get(place) or full(self, node)
        except (AttributeError, IndexError):
            return full(self, node)

    return note


@functools.cache
def _fill(line: str, tabsize: int = 8, width: int = 70) -> str:
    """Return what ``textwrap.fill`` returns, faster for lines that need no wrapping, or that were asked for before."""
    spaces = line.expandtabs(tabsize).rstrip()
    if len(spaces) > width:
        return textwrap.fill(line, tabsize=tabsize, width=width)
    return "".join(" " if c.isspace() else c for c in spaces)
