"""Track a person with cameras calibrated with rendered boards, and with the true cameras: do the limbs differ?

    python -m scripts.board_tracking CAPTURE OUTPUT --frames 0:90

CAPTURE has a `truth.h5`. OUTPUT receives the boards, `board.toml`, two results and their errors.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from scripts.board_rigs import compare
from scripts.synthetic.boards import Recipe, place_boards, render_boards
from tk.calibration.boards import make_board
from tk.calibration.footage import read_footage
from tk.calibration.poses import Pose
from tk.calibration.rig import Options, calibrate
from tk.calibration.verdict import judge
from tk.io.captures.calibration import read_calibration, write_calibration
from tk.model.cameras.camera import Camera, Rig

BOARD = make_board("charuco", None, 0.11)


def calibrated(capture: Path, output: Path) -> Rig:
    """Return the cameras of a capture, calibrated with rendered boards, in the world of the capture."""
    source = read_calibration(capture / "calibration.toml")
    rig = source.rig
    recipe = Recipe(
        tuple((0.0, 3.0, 1.0, "phone") for _ in rig), size=(rig[0].width, rig[0].height), shared=30, close=10, seed=31
    )
    boards = output / "boards"
    if not boards.exists():
        render_boards(boards, recipe, BOARD, room=False, rig=rig)
    done = calibrate(read_footage(boards, BOARD, None, lambda _: None), BOARD, Options(), lambda _: None)
    verdict = judge(done)
    found = Rig(tuple(done.rig[done.names.index(name)] for name in rig.names))
    errors = compare(found, rig)
    print(f"{verdict.word}, expected {1000 * verdict.error_m:.2f} mm; {errors}", flush=True)
    # the world of the board on the floor to that of the capture: known, as a user would measure it
    floor = place_boards(recipe, rig, BOARD)[0]
    motion = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)) @ floor.inverse()
    cameras = []
    for camera in found:
        pose = Pose(camera.rotation, camera.translation) @ motion
        cameras.append(replace(camera, rotation=pose.rotation, translation=pose.translation))
    _write(output / "board.toml", capture, Rig(tuple(cameras)))
    return Rig(tuple(cameras))


def _write(path: Path, capture: Path, rig: Rig) -> None:
    source = read_calibration(capture / "calibration.toml")
    write_calibration(path, source, rig, source.time_offset_s or (0.0,) * len(rig))
    text = path.read_text()
    for camera in rig:  # write_calibration keeps the distortion of the source
        text = _with_distortion(text, camera)
    path.write_text(text)


def _with_distortion(text: str, camera: Camera) -> str:
    import tomli_w

    from tk.io.toml import parse_toml

    document = parse_toml(text, "calibration")
    for table in document.values():
        if isinstance(table, dict) and table.get("name") == camera.name:
            table["distortions"], table["fisheye"] = camera.distortions.tolist(), camera.fisheye
    return tomli_w.dumps(document)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--frames", default="0:90")
    options = parser.parse_args(arguments)
    capture, output = options.capture.resolve(), options.output
    output.mkdir(parents=True, exist_ok=True)
    calibrated(capture, output)
    for name, calibration in (("true", capture / "calibration.toml"), ("board", output / "board.toml")):
        copy = output / name
        shutil.rmtree(copy, ignore_errors=True)
        copy.mkdir()
        for part in capture.iterdir():
            if part.name != "calibration.toml":
                (copy / part.name).symlink_to(part)
        shutil.copy(calibration, copy / "calibration.toml")
        tk = [sys.executable, "-c", "from tk.cli import main; main()"]
        result = str(output / f"{name}.h5")
        track = ["track", str(copy), "-o", result, "--frames", options.frames, "--no-report", "--force", "--quiet"]
        subprocess.run([*tk, *track], check=True)
        done = subprocess.run([*tk, "evaluate", result, str(capture / "truth.h5")], capture_output=True, text=True)
        print(f"{name}:\n{done.stdout}{done.stderr}", flush=True)


if __name__ == "__main__":
    main()
