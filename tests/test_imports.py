"""The direction of imports within tk, as docs/architecture.md states it."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILES = {
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
    for file in sorted((ROOT / "tk").rglob("*.py"))
}


def imports(node: ast.AST) -> Iterator[str]:
    """Yield the modules of tk that a syntax tree imports, inside functions too, except for type annotations."""
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        return
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name in FILES)
    elif isinstance(node, ast.ImportFrom) and node.module is not None:
        for alias in node.names:
            whole = f"{node.module}.{alias.name}"
            yield from (name for name in (whole if whole in FILES else node.module,) if name in FILES)
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.expr):  # imports are statements
            yield from imports(child)


@functools.cache
def tree(name: str) -> ast.Module:
    """Return the syntax tree of a module."""
    return ast.parse(FILES[name].read_text(encoding="utf-8"))


@functools.cache
def imported(name: str) -> set[str]:
    """Return the modules of tk that a module imports."""
    return set(imports(tree(name))) - {name}


def member(module: str) -> str:
    """Return the package or top module of tk that a module belongs to; "tk" for the package itself."""
    return module.split(".")[1] if "." in module else module


def levels() -> dict[str, int]:
    """Return the level of each package and top module, 0 the highest, from the line in docs/architecture.md."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"^Imports run one way[^`]*`([^`]*)`", text, re.M)
    rows = [row.split(", ") for row in " ".join(line.split()).split(" → ")]
    return {name: k for k, row in enumerate(rows) for name in row}


def test_every_package_has_a_level() -> None:
    assert {member(name) for name in FILES} - {"tk", "__main__"} == set(levels())


def test_imports_go_to_lower_levels_only() -> None:
    level = levels()
    wrong = [
        f"{name} imports {other}"
        for name in FILES
        for other in sorted(imported(name))
        if member(name) in level
        and member(other) in level
        and member(name) != member(other)
        and level[member(other)] <= level[member(name)]
    ]
    assert not wrong


def test_no_module_imports_itself_through_others() -> None:
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " → ".join((*path[path.index(name) :], name))
        if name not in done:
            for other in sorted(imported(name)):
                visit(other, (*path, name))
            done.add(name)

    for name in FILES:
        visit(name, ())


#: modules, and attributes of ``os`` and ``sys``, that some systems lack; all that may be used outside of tk.system
NOT_EVERYWHERE = {
    "curses", "fcntl", "grp", "msvcrt", "posix", "pty", "pwd", "resource", "select", "selectors", "signal", "syslog",
    "termios", "tty", "winreg",
}  # fmt: skip
OF_OS = {
    "PathLike", "SEEK_END", "W_OK", "X_OK", "access", "close", "cpu_count", "devnull", "dup", "dup2", "environ",
    "fsencode", "fspath", "fstat", "fsync", "getpid", "path", "replace", "stat", "strerror", "unlink", "urandom",
    "utime", "walk",
}  # fmt: skip
#: attributes and arguments of other modules
ELSEWHERE = {
    "AF_UNIX", "MADV_REMOVE", "chmod", "get_context", "hardlink_to", "pass_fds", "preexec_fn", "recv_fds", "send_fds",
    "socketpair", "start_new_session", "symlink_to",
}  # fmt: skip
PLACES = ("/dev/", "/proc/", "/run/", "/sys/", "/tmp/", "/var/", "C:")


def of_some_systems(tree: ast.AST) -> Iterator[str]:
    """Yield what a module names that does not exist on Linux, Windows and macOS alike."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in NOT_EVERYWHERE)
        elif isinstance(node, ast.ImportFrom) and node.module in {*NOT_EVERYWHERE, "os"}:
            yield f"from {node.module}"
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            name, owner = node.attr, node.value.id
            if (owner == "os" and name not in OF_OS) or (owner, name) in (("sys", "platform"), ("platform", "system")):
                yield f"{owner}.{name}"
        if isinstance(node, ast.Attribute) and node.attr in ELSEWHERE:
            yield node.attr
        elif isinstance(node, ast.keyword) and node.arg in ELSEWHERE:
            yield node.arg
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith(PLACES):
            yield node.value


def test_only_one_package_uses_what_some_systems_lack() -> None:
    found = {f"{name}: {used}" for name in FILES if member(name) != "system" for used in of_some_systems(tree(name))}
    assert not found


def test_what_some_systems_lack_is_found() -> None:
    code = "import fcntl\nfrom os import link\nos.getuid()\nPopen(pass_fds=())\nopen('/proc/meminfo')\nsys.platform"
    assert len(list(of_some_systems(ast.parse(code)))) == 6
    assert not list(of_some_systems(ast.parse("import socket, mmap\nos.replace(a, b)\nPath.unlink(c)")))


def test_a_run_imports_no_part_of_scipy_before_its_first_use() -> None:
    """SciPy would take as long to import as all of tk."""
    code = (
        "import sys, tk.cli; assert 'numpy' not in sys.modules;"
        "import tk.run.session, tk.io.importers, tk.trackers.region;"
        "print(*(name for name in sys.modules if name.startswith('scipy.') and name.count('.') == 1))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {"scipy.linalg", "scipy.ndimage", "scipy.optimize", "scipy.spatial"} & set(found) == set()
