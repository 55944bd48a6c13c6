"""Run commands on generated bad input; count tracebacks, signals, hangs and errors of several lines.

    python -m scripts.fuzz [-n 1000] [--seed 0] [--jobs 2] [--kinds toml,video,…] [--limit SECONDS] [--base DIR]
        [--refused] [--show]

Each case is one command in a process of its own, on a copy of a small rendered capture and of its result in which one
thing is damaged: a text, a video, a mask, the result or its resume state, a file in place of a folder, the arguments.
A case passes if the exit code is 0 to 3, there is no traceback, an exit with 2 prints one line, and it ends in time.
The processes are forks of one that has imported the package, so a case that is refused takes milliseconds.
"""

from __future__ import annotations

import argparse
import collections
import importlib
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from scripts.synthetic.capture import Options, plan_capture, write_capture

SETTINGS = """voxels = 16
ahead = 0
effort = 0.1
[silhouette]
init_frames = 2
"""
POSE = "[joints]\npelvis = [0, 0, 0.9]\nneck = [0, 0, 1.4]\nhead_top = [0, 0, 1.7]\n"
#: memory that a case may take; a larger demand fails there and not in the other processes of the machine
MEMORY_BYTES = 12 * 2**30

NASTY = (
    "nan", "inf", "-inf", "-1", "0", "1e308", "-1e300", "1e-300", "1" + 400 * "0", '""', '"x"', "[]", "{}", "[[]]",
    "true",
    "'\\u0000'", '"ä€𝄞"', "9223372036854775808", "2024-01-01", "[1, [2]]", "''' '''", "=", "[", "# ", "",
    "\x00", "\ufeff",
)  # fmt: skip
# no paths outside the case's folder that could be written
NASTY_ARGUMENTS = (
    "", " ", "-1", "0", "nan", "1e9", ":", "3:1", "-3:2", "0:99999999999999999999", ",", "a,b", "cam1", "cam1,cam1",
    "/proc/self/mem", "/proc/x/y", "\n", "ä€", "\udcff", "x" * 300, "x" * 5000, "none", "median", "%s", "{}", "--", "-",
    "nowhere/x.h5", "result.h5", "capture", "capture/calibration.toml", "loop", "capture/videos/cam1.mp4",
)  # fmt: skip


@dataclass(frozen=True)
class Base:
    """What the cases damage.

    Attributes:
        capture: a small capture with masks and background.
        result: a result of tracking it, with a resume state.
    """

    capture: Path
    result: Path


@dataclass(frozen=True)
class Outcome:
    """How a case ended.

    Attributes:
        code: exit code; negative: the number of the signal that ended it.
        err: its stderr.
        seconds: its duration.
        problem: what is wrong with that; empty if nothing is.
    """

    code: int
    out: str
    err: str
    seconds: float
    problem: str


def judge(code: int, out: str, err: str, seconds: float, limit_s: float) -> Outcome:
    """Return the outcome of a command."""
    complaints = [line for line in err.splitlines() if line.startswith("tk: ")]
    problem = ""
    if "Traceback (most recent call last)" in err + out:
        problem = "traceback"
    elif seconds >= limit_s:
        problem = "hang"
    elif code < 0:
        problem = f"signal {signal.Signals(-code).name}"
    elif code not in (0, 1, 2, 3):
        problem = f"exit code {code}"
    elif code == 2 and (len(complaints) != 1 or err.splitlines()[-1] != complaints[0]):
        problem = "no single line"
    elif code == 1 and not complaints and not out:  # tk doctor prints a table
        problem = "no reason"
    elif "Warning: " in err:
        problem = "warning"
    return Outcome(code, out, err, seconds, problem)


# --- damage -----------------------------------------------------------------------------------------------------------


def damage_text(rng: random.Random, path: Path) -> str:
    """Damage a text file; return what was done."""
    content = path.read_bytes()
    text = content.decode()
    lines = text.splitlines()
    row = rng.randrange(len(lines))
    key = lines[row].partition("=")[0]
    kind = rng.choice(("value", "value", "value", "number", "number", "line", "twice", "cut", "bytes", "other", "swap"))
    value = rng.choice(NASTY)
    if kind == "value":
        lines[row] = f"{key}= {value}"
    elif kind == "number":
        digits = [k for k, c in enumerate(text) if c.isdigit()]
        start = stop = rng.choice(digits or [0])
        while stop < len(text) and text[stop] in "0123456789.eE":
            stop += 1
        lines = (text[:start] + value + text[stop:]).splitlines()
    elif kind == "line":
        del lines[row]
    elif kind == "twice":
        lines.insert(row, lines[row])
    elif kind == "swap":
        other = rng.randrange(len(lines))
        lines[row], lines[other] = lines[other], lines[row]
    elif kind == "cut":
        lines = text[: rng.randrange(len(text))].splitlines()
    changed = "\n".join(lines).encode("utf-8", "surrogatepass")
    if kind == "bytes":
        place = rng.randrange(len(content))
        changed = content[:place] + rng.randbytes(rng.choice((1, 4, 100))) + content[place + 1 :]
    elif kind == "other":
        changed = rng.choice((b"", b"\x00" * 100, text.encode("utf-16"), b"[" * 5000, b"a = " + b"{a = " * 3000, b"\n"))
    path.write_bytes(changed)
    return f"{kind} {key.strip()} {value!r:.20}"


def damage_bytes(rng: random.Random, path: Path) -> str:
    """Damage a file of any kind; return what was done."""
    content = bytearray(path.read_bytes())
    kind = rng.choice(("flip", "flip", "flip", "cut", "zeros", "empty", "noise", "twice", "text", "head"))
    size = len(content)
    if kind == "flip":
        for _ in range(rng.choice((1, 10, 100, 1000))):
            content[rng.randrange(size)] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del content[rng.randrange(size) :]
    elif kind == "zeros":
        start = rng.randrange(size)
        stop = min(start + rng.choice((16, 1000, size)), size)
        content[start:stop] = bytes(stop - start)
    elif kind == "empty":
        content.clear()
    elif kind == "noise":
        content[:] = rng.randbytes(size)
    elif kind == "twice":
        content += bytes(content)
    elif kind == "text":
        content[:] = b"nothing\n" * 10
    else:
        content[: min(size, 64)] = rng.randbytes(min(size, 64))
    path.write_bytes(content)
    return kind


def damage_place(rng: random.Random, path: Path) -> str:
    """Put something else in the place of a file or folder; return what."""
    kind = rng.choice(("missing", "folder", "pipe", "loop", "nowhere", "text"))
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "nowhere":
        path.symlink_to("nowhere")
    elif kind == "text":
        path.write_text("nothing\n")
    return kind


def damage_hdf5(rng: random.Random, path: Path) -> str:
    """Change a dataset, group or attribute of an HDF5 file; return what was done."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = rng.choice(names)
        kind = rng.choice(("delete", "values", "values", "shape", "type", "group", "attribute", "attribute", "rename"))
        held = file[name]
        nasty: Any = rng.choice((np.nan, np.inf, -1, 0, 1e300, 2**62, "x", b"\xff", np.zeros(3), np.zeros((0, 2))))
        if kind == "attribute":
            holder = rng.choice((file, held))
            key = rng.choice(list(holder.attrs) or ["format"])
            holder.attrs[key] = nasty
            return f"attribute {holder.name} {key} {nasty!r:.20}"
        if kind == "rename":
            file.move(name, f"{name}_")
        elif kind == "values" and isinstance(held, h5py.Dataset) and held.dtype.kind in "fiu" and held.size:
            flat = held[()].reshape(-1)
            with np.errstate(all="ignore"):
                number = nasty if isinstance(nasty, (int, float)) else -7
                flat[rng.randrange(len(flat)) :: rng.choice((1, 7, 10**6))] = np.array(number, float).astype(held.dtype)
            held[...] = flat.reshape(held.shape)
        else:
            shape = held.shape if isinstance(held, h5py.Dataset) else ()
            del file[name]
            if kind == "shape":
                file[name] = np.zeros(rng.choice(((), (0,), (1,), (3, 3), (*shape, 2), shape[:-1], (7, *shape[1:]))))
            elif kind == "type":
                file[name] = rng.choice((nasty, np.zeros(shape, complex), np.zeros(shape, bool), "text"))
            elif kind == "group":
                file.create_group(name)
    return f"{kind} {name} {nasty!r:.20}"


# --- cases ------------------------------------------------------------------------------------------------------------


def copied(base: Base, folder: Path) -> Path:
    """Copy a capture, its result, settings and an initial pose into a folder; return the capture."""
    shutil.copytree(base.capture, folder / "capture")
    shutil.copyfile(base.result, folder / "result.h5")
    (folder / "settings.toml").write_text(SETTINGS)
    (folder / "pose.toml").write_text(POSE)
    (folder / "loop").symlink_to("loop")
    return folder / "capture"


def reading(rng: random.Random, folder: Path, tracking: bool) -> list[str]:
    """Return a command that reads a capture; ``tracking``: also those that take seconds."""
    quick = ["--config", f"{folder}/settings.toml"]
    capture = f"{folder}/capture"
    commands = [
        ["reconstruct", capture, "-o", f"{folder}/h.h5", "--frames", "0:1", *quick],
        ["report", f"{folder}/result.h5", capture, "-o", f"{folder}/p.html"],
        ["evaluate", f"{folder}/result.h5", f"{capture}/truth.h5"],
        ["render", f"{folder}/result.h5", capture, "--png", f"{folder}/png", "--frames", "0"],
        ["import", capture, "-o", f"{folder}/imported"],
    ]
    if tracking:
        track = ["track", capture, "-o", f"{folder}/r.h5", "--frames", "0:2", "--no-report", *quick]
        commands += 3 * [track, [*track, "--causal", "--resample"]]
        commands += [["inspect", capture, *quick], ["level", capture, *quick]]
        commands += [["refine", capture, f"{folder}/result.h5", "-o", f"{folder}/new.toml", *quick]]
    return rng.choice(commands)


def toml_case(rng: random.Random, folder: Path, tracking: bool) -> tuple[list[str], str]:
    name = rng.choice(("calibration.toml", "calibration.toml", "capture.toml"))
    return reading(rng, folder, tracking), f"{name}: {damage_text(rng, folder / 'capture' / name)}"


def times_case(rng: random.Random, folder: Path, tracking: bool) -> tuple[list[str], str]:
    (folder / "capture" / "timestamps").mkdir()
    cameras = [path.stem for path in (folder / "capture" / "videos").iterdir()]
    for camera in cameras:
        (folder / "capture" / "timestamps" / f"{camera}.csv").write_text("".join(f"{k / 15:.4f}\n" for k in range(40)))
    how = rng.choice((damage_text, damage_text, damage_bytes, damage_place))
    what = how(rng, folder / "capture" / "timestamps" / f"{rng.choice(cameras)}.csv")
    return [*reading(rng, folder, tracking)], f"timestamps: {what}"


def settings_case(rng: random.Random, folder: Path, tracking: bool) -> tuple[list[str], str]:
    from tk.commands.config_text import annotated_toml
    from tk.settings import Settings

    path = folder / "settings.toml"
    lines = [line for line in annotated_toml(Settings()).splitlines() if line and not line.startswith("#")]
    path.write_text("\n".join(lines) + "\n")
    what = damage_text(rng, path)
    command = rng.choice((["config"], ["reconstruct", f"{folder}/capture", "-o", f"{folder}/h.h5", "--frames", "0:1"]))
    return [*command, "--config", str(path)], f"settings: {what}"


def pose_case(rng: random.Random, folder: Path, tracking: bool) -> tuple[list[str], str]:
    what = damage_text(rng, folder / "pose.toml")
    command = ["track", f"{folder}/capture", "-o", f"{folder}/r.h5", "--frames", "0:1", "--causal", "--no-report"]
    option = rng.choice(("--init-pose", "--body"))
    return [*command, "--config", f"{folder}/settings.toml", option, f"{folder}/pose.toml"], f"{option}: {what}"


def video_case(rng: random.Random, folder: Path, tracking: bool) -> tuple[list[str], str]:
    parts = [path for name in ("videos", "background", "masks") for path in (folder / "capture" / name).rglob("*")]
    path = rng.choice([path for path in parts if path.is_file()])
    what = damage_bytes(rng, path)
    return [*reading(rng, folder, tracking)], f"{path.relative_to(folder)}: {what}"


def place_case(rng: random.Random, folder: Path, tracking: bool) -> tuple[list[str], str]:
    capture = folder / "capture"
    path = rng.choice(
        [capture, folder / "result.h5", folder / "settings.toml", *capture.iterdir(), *capture.glob("*/*")]
    )
    return [*reading(rng, folder, tracking)], f"{path.relative_to(folder)}: {damage_place(rng, path)}"


def result_case(rng: random.Random, folder: Path, tracking: bool) -> tuple[list[str], str]:
    path = folder / "result.h5"
    what = rng.choice((damage_hdf5, damage_hdf5, damage_hdf5, damage_bytes))(rng, path)
    capture = f"{folder}/capture"
    commands = [
        ["report", str(path), "-o", f"{folder}/p.html"],
        ["report", str(path), capture, "-o", f"{folder}/p.html"],
        ["render", str(path), capture, "--png", f"{folder}/png", "--frames", "0"],
        ["render", str(path), "--view", "3d", "-o", f"{folder}/v.mp4", "--frames", "0:1"],
        ["evaluate", str(path), f"{capture}/truth.h5"],
        ["evaluate", f"{capture}/truth.h5", str(path)],
        ["export", str(path), "--to", "trc,mot,bvh,csv,gltf,c3d", "-o", f"{folder}/out"],
        ["export", str(path), "--to", "csv,bvh", "-o", f"{folder}/out", "--smoothed"],
        ["view", str(path), "--screenshot", f"{folder}/s.png"],
    ]
    if tracking:
        resume = ["track", capture, "-o", str(path), "--resume", "--no-report", "--config", f"{folder}/settings.toml"]
        commands += 3 * [resume, [*resume, "--causal"]]
        commands += [["refine", capture, str(path), "-o", f"{folder}/new.toml"]]
    return rng.choice(commands), f"result: {what}"


def arguments_case(rng: random.Random, folder: Path, tracking: bool) -> tuple[list[str], str]:
    import click

    from tk.cli import main

    assert isinstance(main, click.Group)
    name = rng.choice([name for name in main.commands if tracking or name not in ("demo", "batch", "track", "inspect")])
    good = {"capture": f"{folder}/capture", "result": f"{folder}/result.h5", "truth": f"{folder}/capture/truth.h5"}
    good |= {"folder": f"{folder}/capture", "captures": f"{folder}/capture", "output": f"{folder}/out.h5"}
    good |= {"config_file": f"{folder}/settings.toml", "formats": "csv", "frames": "0:1"}
    arguments = [name]
    for parameter in main.commands[name].params:
        nasty = rng.choice(NASTY_ARGUMENTS)
        nasty = f"{folder}/{nasty}" if rng.random() < 0.5 and "/" not in nasty[:1] else nasty
        value = good.get(str(parameter.name), nasty) if rng.random() < 0.7 else nasty
        value = value.replace("\x00", "")
        if parameter.name in ("scheduler", "workers"):
            continue
        if isinstance(parameter, click.Argument):
            arguments += [value] * rng.choice((1, 1, 1, 1, 1, 1, 0, 2))
        elif parameter.required or parameter.name == "config_file" or rng.random() < 0.25:
            arguments += [parameter.opts[-1]] if getattr(parameter, "is_flag", False) else [parameter.opts[-1], value]
    return arguments, "arguments"


KINDS: Mapping[str, Callable[[random.Random, Path, bool], tuple[list[str], str]]] = {
    "toml": toml_case,
    "times": times_case,
    "settings": settings_case,
    "pose": pose_case,
    "video": video_case,
    "place": place_case,
    "result": result_case,
    "arguments": arguments_case,
}


def make_case(base: Base, folder: Path, kind: str, seed: int, tracking: bool) -> tuple[list[str], str]:
    """Write the files of a case into a folder; return its command, and what is damaged."""
    copied(base, folder)
    return KINDS[kind](random.Random(f"{kind} {seed}"), folder, tracking)


# --- processes --------------------------------------------------------------------------------------------------------


def make_base(folder: Path) -> Base:
    """Render a capture and track it."""
    from tk.io import settings_file
    from tk.io.captures.capture import open_capture
    from tk.run.reporter import Silent
    from tk.run.session import track
    from tk.run.task import RecordingOptions

    capture = folder / "base"
    write_capture(plan_capture(Options(frames=6, cameras=4, size=(96, 72), seed=3)), capture, masks=True)
    settings = settings_file.from_toml(SETTINGS)
    # a causal result can be resumed
    options = RecordingOptions(settings, frames=(0, 4), causal=True)
    track(open_capture(capture), folder / "base.h5", options, Silent())
    return Base(capture, folder / "base.h5")


def run_case(arguments: list[str], folder: Path, limit_s: float) -> Outcome:
    """Run a command in a fork of this process."""
    files = [folder / "stdout", folder / "stderr"]
    begun = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _run(arguments, folder, files)
    code: int | None = None
    while code is None and time.monotonic() - begun < limit_s:
        ended, status = os.waitpid(pid, os.WNOHANG)
        code = os.waitstatus_to_exitcode(status) if ended else None
        time.sleep(0.02)
    seconds = time.monotonic() - begun
    if code is None:
        os.killpg(pid, signal.SIGKILL)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    out, err = (file.read_text(errors="replace") for file in files)
    return judge(code, out, err, seconds, limit_s)


def _run(arguments: list[str], folder: Path, files: list[Path]) -> None:
    """Become the command; never returns."""
    code = 1
    try:
        os.setsid()
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        for number, file in enumerate(files, 1):
            os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.stdout, sys.stderr = (open(number, "w", closefd=False, errors="strict") for number in (1, 2))  # noqa: SIM115
        sys.argv = ["tk", *arguments]
        from tk.cli import main

        main(arguments, prog_name="tk")
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)


def main() -> int:
    """Run the cases and print a table; return 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=1000, help="number of cases")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--limit", type=float, default=60.0, help="seconds after which a case hangs")
    parser.add_argument(
        "--base", type=Path, metavar="DIR", help="keep the capture and its result here for the next run"
    )
    parser.add_argument("--refused", action="store_true", help="no commands that take seconds if the input is good")
    parser.add_argument("--show", action="store_true", help="print every case")
    given = parser.parse_args()
    for name in ("tk.cli", "tk.run.session", "tk.report.page", "tk.render.scene", "tk.export", "tk.inspection.checks"):
        importlib.import_module(name)  # before the forks
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        # every process is a fork with one thread; Taichi must not have run in a process that is forked
        given.base = given.base or folder
        given.base.mkdir(parents=True, exist_ok=True)
        if (given.base / "calibration.toml").exists():
            raise SystemExit(f"{given.base}: is a capture; --base is a folder for the script's own files")
        if not (given.base / "base.h5").exists() and _in_fork(lambda: make_base(given.base)) != 0:
            return 1
        pids = [_fork(lambda job=job: _run_share(given, folder, job)) for job in range(given.jobs)]  # type: ignore[misc]
        ended = [os.waitpid(pid, 0)[1] for pid in pids]
        counts: collections.Counter[str] = collections.Counter()
        for file in folder.glob("counts*.json"):
            counts.update(json.loads(file.read_text()))
    for what, count in sorted(counts.items()):
        print(f"{count:6d} {what}")
    return int(any(ended) or any(not what.startswith("exit code ") for what in counts))


def _fork(work: Callable[[], object]) -> int:
    """Start a fork that does some work and exits; return its process id."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            work()
            code = 0
        except Exception:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(code)
    return pid


def _in_fork(work: Callable[[], object]) -> int:
    return os.waitpid(_fork(work), 0)[1]


def _run_share(given: argparse.Namespace, scratch: Path, job: int) -> None:
    """Run every ``given.jobs``-th case, and write the counts of the outcomes."""
    base = Base(given.base / "base", given.base / "base.h5")
    kinds = given.kinds.split(",")
    counts: collections.Counter[str] = collections.Counter()
    for number in range(job, given.n, given.jobs):
        kind, seed = kinds[number % len(kinds)], given.seed + number // len(kinds)
        folder = scratch / f"{kind}{seed}"
        folder.mkdir()
        arguments, what = make_case(base, folder, kind, seed, not given.refused)
        outcome = run_case(arguments, folder, given.limit)
        counts[outcome.problem or f"exit code {outcome.code}"] += 1
        if outcome.problem or given.show:
            said = (outcome.err.splitlines() or [""])[-1]
            shown = " ".join(arguments).replace(f"{folder}/", "")
            print(
                f"{kind} {seed}: {outcome.problem or outcome.code}, {outcome.seconds:.1f} s: {shown!r:.300} ({what}): "
                f"{said!a:.300}"
            )
            if outcome.problem == "traceback":
                print("\n".join(outcome.err.splitlines()[-8:]))
            sys.stdout.flush()
        shutil.rmtree(folder, ignore_errors=True)
    (scratch / f"counts{job}.json").write_text(json.dumps(counts))


if __name__ == "__main__":
    sys.exit(main())
