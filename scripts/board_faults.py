"""Recordings of a board with a fault each: what `tk calibrate` answers.

    python -m scripts.board_faults               # a table: fault, exit code, verdict, line

Small images of two or three cameras; a camera named in the table is the faulty one.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scripts.synthetic.boards import Recipe, make_rig, place_boards, render_boards
from tk.calibration.boards import Board, make_board
from tk.calibration.poses import Pose, exp

SQUARE_M = 0.11
RECIPE = Recipe(
    ((30, 3.2, 1.4, "phone"), (85, 3.4, 2.0, "webcam"), (150, 3.2, 1.6, "phone")),
    size=(800, 600), shared=20, close=8, seed=21,
)  # fmt: skip
BOARD = make_board("charuco", None, SQUARE_M)
NAMES = ("cam1", "cam2", "cam3")


@dataclass(frozen=True)
class Fault:
    """A fault.

    Attributes:
        name: what is wrong.
        spoil: changes the folder of the pictures.
        options: of the command.
        parts: texts that the answer contains.
    """

    name: str
    spoil: Callable[[Path], object]
    options: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()


def _each(folder: Path, name: str, change: Callable[[np.ndarray, int], np.ndarray | None]) -> None:
    """Change the pictures of a camera; None removes one."""
    for file in sorted((folder / name).glob("*.png")):
        changed = change(cv2.imread(str(file)), int(file.stem))
        if changed is None:
            file.unlink()
        else:
            cv2.imwrite(str(file), changed)


def _keep(folder: Path, name: str, wanted: Callable[[int], bool]) -> None:
    _each(folder, name, lambda image, n: image if wanted(n) else None)


def _rerender(
    folder: Path, name: str, board: Board = BOARD, poses: Callable[[dict[int, Pose]], dict[int, Pose]] | None = None
) -> None:
    """Render a camera's pictures again, with another board or other poses."""
    c = NAMES.index(name)
    shutil.rmtree(folder / name)
    rig = make_rig(RECIPE)
    true = place_boards(RECIPE, rig, BOARD)
    changed = poses(true) if poses else true
    render_boards(folder, RECIPE, board, lambda _, __: changed, cameras=[c], room=False, rig=rig)


def _late(poses: dict[int, Pose]) -> dict[int, Pose]:
    """A video that is one place late."""
    shared = [n for n in poses if 0 < n < 100]
    return {n: poses[n - 1] if n - 1 in shared else pose for n, pose in poses.items()}


def _bumped(poses: dict[int, Pose]) -> dict[int, Pose]:
    """A camera that turns by two degrees in the middle: the board moves the other way."""
    camera = make_rig(RECIPE)[1]
    own = Pose(camera.rotation, camera.translation)
    turn = own.inverse() @ Pose(exp(np.array([0, np.radians(2.0), 0])), np.zeros(3)) @ own
    return {n: turn @ pose if 11 <= n < 100 else pose for n, pose in poses.items()}


def _bent(image: np.ndarray, n: int) -> np.ndarray:
    """A picture whose rows are shifted in a wave: a rolling shutter, or a bent board."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    return np.asarray(cv2.remap(image, x + 3 * np.sin(y / 25 + n).astype(np.float32), y, cv2.INTER_LINEAR))


def _swap(folder: Path) -> None:
    for n in range(1, 21):
        a, b = folder / "cam1" / f"{n:04d}.png", folder / "cam2" / f"{n:04d}.png"
        if n % 2:
            a.rename(folder / "t.png")
            b.rename(a)
            (folder / "t.png").rename(b)


def _constant(folder: Path) -> None:
    """Every picture of a camera is the same."""
    same = cv2.imread(str(folder / "cam2" / "0001.png"))
    _each(folder, "cam2", lambda image, n: same)


def _copied(folder: Path) -> None:
    """The pictures of one camera are those of another one."""
    shutil.rmtree(folder / "cam3")
    shutil.copytree(folder / "cam1", folder / "cam3")


def _reversed(poses: dict[int, Pose]) -> dict[int, Pose]:
    """The pictures of the shared places in reverse order."""
    shared = [n for n in poses if 0 < n < 100]
    turned = dict(zip(shared, reversed(shared), strict=True))
    return {n: poses[turned.get(n, n)] for n in poses}


def _far_late(poses: dict[int, Pose]) -> dict[int, Pose]:
    """A video that is seven places late: most of its pictures are of places that others no longer show."""
    shared = [n for n in poses if 0 < n < 100]
    return {n: poses[n - 7] if n - 7 in shared else pose for n, pose in poses.items() if n - 7 in shared or n >= 100}


def _zoom(folder: Path, by: float, wanted: Callable[[int], bool]) -> None:
    """cam2 has a longer focal length in some pictures; ``by``: factor."""

    def change(image: np.ndarray, n: int) -> np.ndarray:
        if not wanted(n):
            return image
        h, w = image.shape[:2]
        M = np.array([[by, 0, (1 - by) * (w - 1) / 2], [0, by, (1 - by) * (h - 1) / 2]])
        return np.asarray(cv2.warpAffine(image, M, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))

    _each(folder, "cam2", change)


def _nothing(folder: Path) -> None:
    return None


FAULTS = (
    Fault("none", _nothing, (), ("good",)),
    Fault("square in millimetres", _nothing, ("--square", "110"), ("110 m", "--square 0.11 if")),
    Fault("square in centimetres", _nothing, ("--square", "11"), ("11 m", "--square 0.11 if")),
    Fault("other dictionary", _nothing, ("--dictionary", "5x5_50"), ("camera cam1", "--dictionary 4x4_50")),
    Fault("fewer squares given", _nothing, ("--size", "5x4"), ("camera cam1", "--size 7x5")),
    Fault("more squares given", _nothing, ("--size", "9x6"), ("camera cam1", "--size 7x5")),
    Fault("chessboard asked for", _nothing, ("--board", "chessboard"), ("camera cam1", "--board charuco")),
    Fault(
        "cam2 blurred", lambda f: _each(f, "cam2", lambda i, n: cv2.GaussianBlur(i, (0, 0), 7)), (),
        ("camera cam2", "blurred"),
    ),
    Fault("cam2 mirrored", lambda f: _each(f, "cam2", lambda i, n: i[:, ::-1].copy()), (), ("camera cam2", "mirror")),
    Fault("cam2 black", lambda f: _each(f, "cam2", lambda i, n: i // 60), (), ("camera cam2", "one colour")),
    Fault("cam2 one constant picture", _constant, (), ("camera cam2",)),
    Fault("cam3 shares nothing", lambda f: _keep(f, "cam3", lambda n: n >= 100), (), ("camera cam3", "to nobody")),
    Fault("cam3 two pictures", lambda f: _keep(f, "cam3", lambda n: n in (140, 141)), (), ("camera cam3", "too few")),
    Fault("cam3 only far boards", lambda f: _keep(f, "cam3", lambda n: n < 100), (), ("camera cam3", "factor of 2")),
    Fault("cam2 one place late", lambda f: _rerender(f, "cam2", poses=_late), (), ("camera cam2",)),
    Fault("cam2 bumped in the middle", lambda f: _rerender(f, "cam2", poses=_bumped), (), ("camera cam2", "moved")),
    Fault("cam1 and cam2 swapped in parts", _swap, (), ("camera cam",)),
    Fault(
        "cam3 sees a board of 80 %", lambda f: _rerender(f, "cam3", make_board("charuco", None, 0.088)), (),
        ("camera cam3",),
    ),
    Fault("cam2 bent board", lambda f: _each(f, "cam2", _bent), (), ("camera cam2",)),
    Fault("cam2 other size of one picture", lambda f: _each(
        f, "cam2", lambda i, n: cv2.resize(i, (640, 480)) if n == 3 else i), (), ("cam2", "640")),
    Fault(
        "mirrored print", lambda f: [_each(f, name, lambda i, n: i[:, ::-1].copy()) for name in NAMES], (),
        ("camera cam1", "mirror"),
    ),
    Fault("cam3 has the pictures of cam1", _copied, (), ("camera cam3", "cam1")),
    Fault("cam2 seven places late", lambda f: _rerender(f, "cam2", poses=_far_late), (), ("camera cam2",)),
    Fault("cam2 in reverse order", lambda f: _rerender(f, "cam2", poses=_reversed), (), ("camera cam2",)),
    Fault("cam2 zooms by 10 % in the middle", lambda f: _zoom(f, 1.1, lambda n: 11 <= n < 100), (), ("camera cam2",)),
    Fault("cam2 zooms by 3 % in the middle", lambda f: _zoom(f, 1.03, lambda n: 11 <= n < 100), (), ("camera cam2",)),
    Fault(
        "cam2 zooms by 3 % before the close places", lambda f: _zoom(f, 1.03, lambda n: n >= 100), (),
        ("camera cam2", "zoomed"),
    ),
    Fault("cam2 zooms by 1 % in the middle", lambda f: _zoom(f, 1.01, lambda n: n >= 11), (), ("camera cam2",)),
    Fault("cam3 one picture", lambda f: _keep(f, "cam3", lambda n: n == 140), (), ("camera cam3", "too few")),
    Fault(
        "cam2 picture cut off",
        lambda f: (f / "cam2" / "0003.png").write_bytes((f / "cam2" / "0003.png").read_bytes()[:900]),
        (), ("cam2/0003.png", "cut off"),
    ),
    Fault("no folder of a camera", lambda f: [shutil.rmtree(f / name) for name in NAMES], (), ("no cameras",)),
    Fault("floor not in the pictures", _nothing, ("--floor", "77"), ("--floor 77",)),
    Fault("floor is a board in the air", _nothing, ("--floor", "5"), ("--floor 5",)),
)  # fmt: skip


def answer(folder: Path, output: Path, options: Sequence[str]) -> tuple[int, str]:
    """Return the exit code and the last lines of the command."""
    square = () if "--square" in options else ("--square", str(SQUARE_M))
    command = [sys.executable, "-c", "from tk.cli import main; main()", "calibrate", str(folder), "-o", str(output)]
    ran = subprocess.run([*command, *square, "--quiet", *options], capture_output=True, text=True, check=False)
    lines = [line for line in ran.stderr.splitlines() if line.startswith(("tk:", "note:"))]
    words = [line for line in ran.stdout.splitlines() if line.startswith(("good", "usable"))]
    return ran.returncode, " | ".join([*lines, *words]) or ran.stderr[-300:]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", action="append", help="faults whose name contains this text; several times")
    parser.add_argument("--keep", type=Path, help="folder for the pictures without a fault; used again")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        clean = (options.keep or Path(temporary)) / "clean"
        if not clean.exists():
            render_boards(clean, RECIPE, BOARD, room=False)
        print("| fault | exit | as expected | answer |\n|---|---|---|---|")
        for fault in FAULTS:
            if options.only and not any(text in fault.name for text in options.only):
                continue
            folder = Path(temporary) / "boards"
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(clean, folder)
            fault.spoil(folder)
            code, text = answer(folder, Path(temporary) / "calibration.toml", [*fault.options, "--force"])
            text = text.replace(temporary, "…")
            good = all(part in text for part in fault.parts) and (fault.name == "none" or " good:" not in f" {text}")
            print(f"| {fault.name} | {code} | {'yes' if good else 'NO'} | {text} |", flush=True)


if __name__ == "__main__":
    main()
