"""`tk doctor`: check the machine and the installation, one line for each thing.

What may abort the process or hang is tried in a process of its own, with a time limit.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, distribution, requires, version
from importlib.util import find_spec
from pathlib import Path

import click

from tk.commands import base
from tk.system import LINUX, machine
from tk.system.signals import how_it_ended

# Limit of a check in its own process. A first import from a slow disk and the first compilation take some 20 s.
_LIMIT_S = 120.0
# Memory below which there is a warning, bytes: a run of five small videos takes 0.4 GB (docs/robustness.md); images of
# full size and the process that decodes ahead take the rest.
_MEMORY = 2_000_000_000


class Missing(Exception):
    """A check has failed; the message is the reason and the remedy."""


def _try(code: str, remedy: str = "") -> str:
    """Run Python code in another process and return what it printed; raise Missing with the remedy if it fails."""
    command = [sys.executable, "-W", "ignore", "-c", code]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_LIMIT_S)
    except subprocess.TimeoutExpired:
        raise Missing(f"gave no answer for {_LIMIT_S:.0f} s{remedy}") from None
    if done.returncode < 0:
        raise Missing(f"the process {how_it_ended(done.returncode)}{remedy}")
    if done.returncode:
        raise Missing((done.stderr.decode(errors="replace").strip().splitlines() or ["no reason given"])[-1] + remedy)
    return done.stdout.decode(errors="replace").strip()


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", text)))


def _python() -> str:
    needs = distribution("tk-mocap").metadata["Requires-Python"] or ""
    low, high = sorted(_numbers(part) for part in re.findall(r"\d+\.\d+", needs))
    found = platform.python_version()
    if not low <= _numbers(found) < high:
        raise Missing(f"{found} is not {needs}; install another")
    return found


def _glibc() -> str:
    name, found = platform.libc_ver()
    if name != "glibc":
        text = f"{name or 'unknown'} {found}".strip()
        if LINUX:
            raise Missing(f"{text}; Taichi has wheels for glibc only: use another system")
        return text
    least = {package: _least_glibc(package) for package in ("taichi", "open3d-cpu")}
    text = f"{found}; needed by Taichi {least['taichi']}, by Open3D {least['open3d-cpu']}"
    if any(_numbers(found) < _numbers(needed) for needed in least.values()):
        raise Missing(f"{text}; use a newer system")
    return text


def _least_glibc(package: str) -> str:
    try:
        tags = distribution(package).read_text("WHEEL") or ""
    except PackageNotFoundError:
        return "0"
    return max((".".join(tag) for tag in re.findall(r"manylinux_(\d+)_(\d+)", tags)), key=_numbers, default="0")


def _packages() -> str:
    """Check the packages that tk requires; Taichi and Open3D have checks of their own."""
    names = [re.split(r"[^\w.-]", line)[0] for line in requires("tk-mocap") or () if "extra ==" not in line]
    found, missing = [], []
    for name in (name for name in names if name not in ("taichi", "open3d", "open3d-cpu", "tomli")):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            missing.append(name)
    if missing:
        raise Missing(f"pip install {' '.join(missing)}")
    _try("import numpy, scipy, cv2, h5py, av", ": pip install --force-reinstall tk-mocap")
    return ", ".join(found)


def _taichi() -> str:
    code = "from tk.kernels.runtime import ensure_runtime, ti; ensure_runtime(); print(*ti.__version__, sep='.')"
    return f"{_try(code, ': pip install --force-reinstall taichi')}, kernels start"


def _open3d() -> str:
    remedy = "; without it no tk view, hull meshes, 3D views: pip install open3d"
    return _try("import open3d; print(open3d.__version__)", remedy)


def _display() -> str:
    try:
        _try("from tk.view.window import require_display; require_display()")
    except Missing as reason:
        raise Missing(str(reason).split("tk view: ")[-1]) from None
    return os.environ.get("DISPLAY", "present")


def _codecs() -> str:
    if _try("import cv2; print(cv2.CAP_FFMPEG in cv2.videoio_registry.getBackends())") != "True":
        raise Missing(
            "OpenCV reads no videos: it is built without FFmpeg; pip install --force-reinstall opencv-python-headless"
        )
    return "OpenCV reads videos with FFmpeg"


def _encoder() -> str:
    _try("import av.codec; av.codec.Codec('libx264', 'w')", "; no overlay videos: pip install --force-reinstall av")
    return "PyAV writes H.264"


def _cache() -> str:
    code = "from tk.segmenters.weights import default_cache_dir as d\nimport tk.kernels.runtime\nprint(d().parent)"
    folder = Path(_try(code))
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    parts = ("taichi", "tk")  # the compiled kernels; the segmenter's weights
    size = sum(file.stat().st_size for part in parts for file in (folder / part).rglob("*") if file.is_file()) / 1e6
    if not os.access(existing, os.W_OK):
        raise Missing(f"{existing} is not writable, so every start compiles the kernels again: chmod u+w it")
    return f"{folder / parts[0]} and {parts[1]}, {size:.0f} MB, {shutil.disk_usage(existing).free / 1e9:.0f} GB free"


def _cores() -> str:
    limit = os.environ.get("TK_THREADS")
    return f"{machine.cores()}" + (f", TK_THREADS={limit}" if limit else "")


def _memory() -> str:
    free = machine.available_memory()
    if free is None:
        return "this system does not report how much is free"
    if free < _MEMORY:
        raise Missing(f"close other programs, or use fewer cameras: {free / 1e9:.1f} GB may be too little")
    return f"{free / 1e9:.1f} GB available"


def _segmenter() -> str:
    _extra("ai_edge_litert", "masks without an empty scene", "segmenter")()
    code = "from tk.segmenters.weights import FILES, default_cache_dir as d, _installed as i\n"
    code += "print(all(i(n) or (d() / 'segmenter' / n).is_file() for n in FILES))"
    return "weights present" if _try(code) == "True" else "weights are downloaded when they are first needed"


def _extra(package: str, what: str, extra: str) -> Callable[[], str]:
    def check() -> str:
        if find_spec(package) is None:
            raise Missing(f"for {what}: pip install 'tk-mocap[{extra}]'")
        return version(package)

    return check


#: checks by name; each returns what it found
CHECKS: dict[str, Callable[[], str]] = {
    "Python": _python,
    "glibc": _glibc,
    "packages": _packages,
    "Taichi": _taichi,
    "Open3D": _open3d,
    "display": _display,
    "codecs": _codecs,
    "encoder": _encoder,
    "cache": _cache,
    "cores": _cores,
    "memory": _memory,
    "segmenter": _segmenter,
    "Dask": _extra("distributed", "tk batch", "cluster"),
    "pandas": _extra("pandas", "tables of a result", "tables"),
    "xarray": _extra("xarray", "tables of a result", "tables"),
}
#: the checks without which `tk track` cannot work
NEEDED = ("Python", "packages", "Taichi", "codecs")


def examine() -> Iterator[tuple[str, str, bool]]:
    """Yield each check's name, its text, and whether it has failed."""
    for name, check in CHECKS.items():
        try:
            yield name, check(), False
        except Missing as reason:
            yield name, str(reason), True
        except Exception as error:  # a diagnosis must not end early
            yield name, f"the check failed: {type(error).__name__}: {error}", True


@click.command(epilog=base.example("tk doctor"))
def doctor() -> None:
    """Check this machine and the installation: one line for each thing, with the remedy.

    Exit code 0 if `tk track` can work, else 1.
    """
    broken = []
    for name, text, has_failed in examine():
        click.echo(f"{name:10}{'missing' if has_failed else 'ok'}: {' '.join(text.split())}")
        if has_failed and name in NEEDED:
            broken.append(name)
    click.echo(f"tk track cannot work: {', '.join(broken)}" if broken else "tk track can work")
    base.exit_with(int(bool(broken)))
