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
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution, requires, version
from importlib.util import find_spec
from pathlib import Path

import click

from tk.commands import base

# Limit of a check in its own process. A first import from a slow disk and the first compilation take some 20 s.
_LIMIT_S = 120.0
# Memory below which there is a warning, bytes: a run of five small videos takes 0.4 GB (docs/robustness.md); images of
# full size and the process that decodes ahead take the rest.
_MEMORY = 2_000_000_000


@dataclass(frozen=True)
class Check:
    """The outcome of a check.

    Attributes:
        text: what was found; printed if there is no remedy.
        remedy: what to do; empty if all is well.
        needed: True if `tk track` cannot work without it.
    """

    text: str
    remedy: str = ""
    needed: bool = False


def _try(code: str) -> tuple[str, str]:
    """Run Python code in another process; return what it printed, and why it failed."""
    try:
        done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, timeout=_LIMIT_S)
    except subprocess.TimeoutExpired:
        return "", f"gave no answer for {_LIMIT_S:.0f} s"
    out, errors = (text.decode(errors="replace").strip() for text in (done.stdout, done.stderr))
    if done.returncode < 0:
        return out, f"the process was ended by signal {-done.returncode}"
    return out, (errors.splitlines() or ["no reason given"])[-1] if done.returncode else ""


def _python() -> Check:
    needs = distribution("tk-mocap").metadata["Requires-Python"] or ""
    low, high = sorted(_numbers(part) for part in re.findall(r"\d+\.\d+", needs))
    found = platform.python_version()
    return Check(found, "" if low <= _numbers(found) < high else f"{found} is not {needs}; install another", True)


def _glibc() -> Check:
    name, found = platform.libc_ver()
    if name != "glibc":
        is_linux = sys.platform == "linux"
        text = f"{name or 'unknown'} {found}".strip()
        return Check(
            text, f"{text}; Taichi has wheels for glibc only: use another system" if is_linux else "", is_linux
        )
    least = {package: _least_glibc(package) for package in ("taichi", "open3d-cpu")}
    text = f"{found}; needed by Taichi {least['taichi']}, by Open3D {least['open3d-cpu']}"
    too_old = [package for package, needed in least.items() if _numbers(found) < _numbers(needed)]
    remedy = f"{text}; use a newer system" if too_old else ""
    return Check(text, remedy, needed="taichi" in too_old)


def _least_glibc(package: str) -> str:
    try:
        tags = distribution(package).read_text("WHEEL") or ""
    except PackageNotFoundError:
        return "0"
    return max((".".join(tag) for tag in re.findall(r"manylinux_(\d+)_(\d+)", tags)), key=_numbers, default="0")


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", text)))


def _packages() -> Check:
    """Check the packages that tk requires; Taichi and Open3D have checks of their own."""
    names = [re.split(r"[^\w.-]", line)[0] for line in requires("tk-mocap") or () if "extra ==" not in line]
    found, missing = [], []
    for name in (name for name in names if name not in ("taichi", "open3d", "open3d-cpu", "tomli")):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            missing.append(name)
    _, why = _try("import numpy, scipy, cv2, h5py, av")
    remedy = f"pip install {' '.join(missing)}" if missing else f"{why}: pip install --force-reinstall tk-mocap"
    return Check(", ".join(found), remedy if missing or why else "", needed=True)


def _taichi() -> Check:
    code = "from tk.kernels.runtime import ensure_runtime, ti; ensure_runtime(); print(*ti.__version__, sep='.')"
    out, why = _try(code)
    return Check(f"{out}, kernels start", f"{why}: pip install --force-reinstall taichi" if why else "", True)


def _open3d() -> Check:
    out, why = _try("import open3d; print(open3d.__version__)")
    return Check(out, f"{why}; without it no tk view, hull meshes, 3D views: pip install open3d" if why else "")


def _display() -> Check:
    _, why = _try("from tk.view.window import require_display; require_display()")
    return Check(os.environ.get("DISPLAY", "present"), why.split("tk view: ")[-1])


def _codecs() -> Check:
    reads, why = _try("import cv2; print(cv2.CAP_FFMPEG in cv2.videoio_registry.getBackends())")
    if why or reads != "True":
        remedy = "pip install --force-reinstall opencv-python-headless"
        return Check("", f"{why or 'OpenCV reads no videos: it is built without FFmpeg'}; {remedy}", needed=True)
    _, why = _try("import av.codec; av.codec.Codec('libx264', 'w')")
    remedy = f"PyAV cannot write H.264, so no overlay videos ({why}): pip install --force-reinstall av"
    return Check("OpenCV reads videos with FFmpeg, PyAV writes H.264", remedy if why else "")


def _cache() -> Check:
    code = "from tk.model.hull.tables import default_cache_dir as d\nimport tk.kernels.runtime\nprint(d())"
    out, why = _try(code)
    if why:
        return Check("", why)
    folder = Path(out)
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6
    if not os.access(existing, os.W_OK):
        return Check(
            str(folder), f"{existing} is not writable, so every start compiles and computes again: chmod u+w it"
        )
    return Check(f"{folder}, {size:.0f} MB, {shutil.disk_usage(existing).free / 1e9:.0f} GB free")


def _cores() -> Check:
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("TK_THREADS")
    return Check(f"{count}" + (f", TK_THREADS={limit}" if limit else ""))


def _memory() -> Check:
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    info = Path("/proc/meminfo")  # counts what the system's cache can give back, too
    if info.exists() and (found := re.search(r"MemAvailable:\s+(\d+) kB", info.read_text())):
        free = 1024 * int(found[1])
    remedy = f"close other programs, or use fewer cameras: less than {_MEMORY / 1e9:.0f} GB may be too little"
    return Check(f"{free / 1e9:.1f} GB available", remedy if free < _MEMORY else "")


def _segmenter() -> Check:
    if find_spec("ai_edge_litert") is None:
        return Check("", "for masks without an empty scene: pip install 'tk-mocap[segmenter]'")
    code = "from tk.segmenters.weights import FILES, default_cache_dir as d, _installed as i\n"
    code += "print(all(i(n) or (d() / 'segmenter' / n).is_file() for n in FILES))"
    out, why = _try(code)
    present = "weights present" if out == "True" else "weights are downloaded when they are first needed"
    return Check(present, why)


def _extra(package: str, what: str, extra: str) -> Callable[[], Check]:
    def check() -> Check:
        if find_spec(package) is None:
            return Check("", f"for {what}: pip install 'tk-mocap[{extra}]'")
        return Check(version(package))

    return check


#: name: check
CHECKS: dict[str, Callable[[], Check]] = {
    "Python": _python,
    "glibc": _glibc,
    "packages": _packages,
    "Taichi": _taichi,
    "Open3D": _open3d,
    "display": _display,
    "codecs": _codecs,
    "cache": _cache,
    "cores": _cores,
    "memory": _memory,
    "segmenter": _segmenter,
    "ezc3d": _extra("ezc3d", "tk export --to c3d", "export"),
    "Dask": _extra("distributed", "tk batch", "cluster"),
    "pandas": _extra("pandas", "tables of a result", "tables"),
    "xarray": _extra("xarray", "tables of a result", "tables"),
}


def examine() -> Iterator[tuple[str, Check]]:
    """Yield each check's name and outcome; a check that fails itself is an outcome, too."""
    for name, check in CHECKS.items():
        try:
            yield name, check()
        except Exception as error:  # a diagnosis must not end early
            yield name, Check("", f"the check failed: {type(error).__name__}: {error}")


@click.command(epilog=base.example("tk doctor"))
def doctor() -> None:
    """Check this machine and the installation: one line for each thing, with the remedy.

    Exit code 0 if `tk track` can work, else 1.
    """
    broken = []
    for name, found in examine():
        state = f"missing: {found.remedy}" if found.remedy else f"ok: {found.text}"
        click.echo(f"{name:10}{' '.join(state.split())}")
        if found.remedy and found.needed:
            broken.append(name)
    if broken:
        click.echo(f"tk track cannot work: {', '.join(broken)}")
        raise click.exceptions.Exit(1)
    click.echo("tk track can work")
