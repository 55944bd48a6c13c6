"""Uses of Taichi's internals, for speed only. With an unknown Taichi version they do nothing.

:class:`Launcher` makes launches cost a third. Taichi spends 6 µs on each array of a launch, mostly to determine its
type, its place in the compiled kernel and the context again. A Launcher leaves that to Taichi at the first call, stores
the compiled kernel and its context, and from then on passes pointers to the arrays that changed: 2 µs each.

:func:`shorten_notes` halves the time of the Python transformation of kernels at each start. For each node of a kernel's
syntax tree Taichi notes its position for error messages, with the line of code wrapped to 80 columns and underlined.
For each call of a ``@ti.func`` it reads that function's source again. Shortened notes have file, line and code only,
for the kernels of this package, and each source is read once.

:func:`quick_import` and :func:`quick_decorators` halve the time of importing Taichi and the kernels. For each decorated
function Taichi searches the sources of all modules for the line that called, to know whether a class contains it. The
frame itself says so.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import sys
import textwrap
import threading
import weakref
from collections.abc import Callable, Iterator
from types import FrameType, SimpleNamespace
from typing import Any

import numpy as np

_OURS = "tk."


def program() -> Any:
    """Return Taichi's running program; None before ``ti.init``. :mod:`tk.kernels.runtime` has imported Taichi."""
    return sys.modules["taichi"].lang.impl.get_runtime().prog


# --- launches ----------------------------------------------------------------------------------------------------


def _nothing() -> None:
    """Stand for a weak reference to an array before the first call."""


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
        self._program: Any = None
        self._compiled: Any = None
        self._context: Any = None
        self._expected: list[tuple[tuple[int], Any, int]] = []
        self._lock = threading.Lock()
        # the context's numbers, and weak references to its arrays: no array is kept alive longer than its user needs it
        self._last: list[Any] = []

    def __call__(self, *arguments: Any) -> None:
        with self._lock:
            running = program()
            if self._compiled is None or self._program is not running:
                self._kernel(*self._constants, *arguments)
                self._remember(arguments)
                return
            self._update(arguments)
            self._launch(running, self._context)

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

    def _launch(self, running: Any, context: Any) -> None:
        running.launch_kernel(self._compiled, context)

    def _remember(self, arguments: tuple[Any, ...]) -> None:
        """Store the kernel that the last call compiled; nothing if this Taichi is an unknown version."""
        taichi = sys.modules["taichi"]
        try:
            running = program()
            if running.config().debug:
                return
            primal = self._kernel._primal  # type: ignore[attr-defined]
            everything = (*self._constants, *arguments)
            source = primal.compiled_kernels[primal.ensure_compiled(*everything)]
            compiled = running.compile_kernel(running.config(), running.get_device_caps(), source)
            annotations = [argument.annotation for argument in primal.arguments]
        except (AttributeError, KeyError, TypeError):
            return
        first = len(self._constants)
        if not all(a.flags.c_contiguous for a in self._constants):
            return
        context = source.make_launch_context()
        for i, a in enumerate(self._constants):
            context.set_arg_external_array_with_shape((i,), a.ctypes.data, a.nbytes, a.shape, 0)
        whole = taichi.i32, taichi.i64
        self._expected = [
            ((i,), value.dtype, value.ndim)
            if isinstance(value, np.ndarray)
            else ((i,), int if annotations[i] in whole else float, 0)
            for i, value in enumerate(arguments, first)
        ]
        self._last = [_nothing if kind is not int and kind is not float else None for _, kind, _ in self._expected]
        self._program, self._context, self._compiled = running, context, compiled


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
    if kernels.textwrap is textwrap and getattr(kernels, "getsourcelines", None) is inspect.getsourcelines:
        kernels.textwrap = SimpleNamespace(fill=_fill, dedent=textwrap.dedent)
        kernels.getsourcelines = functools.cache(inspect.getsourcelines)
    return True


def _short_notes(full: Callable[[Any, Any], str]) -> Callable[[Any, Any], str]:
    @functools.wraps(full)
    def note(self: Any, node: Any) -> str:
        try:
            function = self.func.func
            if function.__module__.startswith(_OURS):
                code = self.src[node.lineno - 1].strip()
                return f'File "{self.file}", line {node.lineno + self.lineno_offset}, in {function.__name__}:\n{code}\n'
        except (AttributeError, IndexError):
            pass
        return full(self, node)

    return note


def _fill(line: str, tabsize: int = 8, width: int = 70) -> str:
    """Return what ``textwrap.fill`` returns, faster for lines that need no wrapping."""
    spaces = line.expandtabs(tabsize).rstrip()
    if len(spaces) > width:
        return textwrap.fill(line, tabsize=tabsize, width=width)
    return "".join(" " if c.isspace() else c for c in spaces)
