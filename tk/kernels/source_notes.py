"""Kernels' sources noted briefly: half of the time that Taichi takes to transform a kernel, at each start.

For each node of a kernel's syntax tree Taichi writes down where it stands, the line of code wrapped to 80 columns and
underlined, in case an error is to be told; and for each call of a ``@ti.func`` it reads that function's source anew.
:func:`brief` has it write down file, line and code alone, for the kernels of this package, and read each source once.
That reaches below Taichi's public interface; a Taichi that has no such thing is left as it is.
"""

from __future__ import annotations

import functools
import inspect
import textwrap
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

_OURS = "tk."


def brief(utilities: Any, kernels: Any) -> bool:
    """Make the notes brief; whether this is a Taichi that has them.

    Args:
        utilities: the module ``taichi.lang.ast.ast_transformer_utils``.
        kernels: the module ``taichi.lang.kernel_impl``.
    """
    context: Any = getattr(utilities, "ASTTransformerContext", None)
    full = getattr(context, "get_pos_info", None)
    if not callable(full) or getattr(kernels, "textwrap", None) is None:
        return False
    if not hasattr(full, "__wrapped__"):
        context.get_pos_info = _brief_notes(full)
    if kernels.textwrap is textwrap and getattr(kernels, "getsourcelines", None) is inspect.getsourcelines:
        kernels.textwrap = SimpleNamespace(fill=_fill, dedent=textwrap.dedent)
        kernels.getsourcelines = functools.cache(inspect.getsourcelines)
    return True


def _brief_notes(full: Callable[[Any, Any], str]) -> Callable[[Any, Any], str]:
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
    """What ``textwrap.fill`` makes of a line that is not to be wrapped."""
    spaces = line.expandtabs(tabsize).rstrip()
    if len(spaces) > width:
        return textwrap.fill(line, tabsize=tabsize, width=width)
    return "".join(" " if c.isspace() else c for c in spaces)
