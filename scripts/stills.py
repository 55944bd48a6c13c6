"""Track single frame sets: the hardest start, in any pose, without a height, an empty scene or other frames.

    python -m scripts.stills CAPTURE… [--every 20] [--cameras A,B,…] [--people all] [--chairs] [--work DIR]

Some frames of each capture become captures of one image a camera. The masks are a network's. Each is tracked, and
compared with the capture's ``truth.h5``, or, without one, with a result of the whole capture. The table shows for each
person the mean error of the joints, cm, the joints that are more than 15 cm off without a warning (see
:mod:`scripts.faults`), and the joints that are so far off with their sigma, cm. With ``--chairs`` each frame becomes
four, in which a chair stands on one side of each person.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import tomli_w
from scipy.optimize import linear_sum_assignment

from scripts.any_start import Quiet
from scripts.faults import SILENT_M, Outcome
from scripts.furniture import SIDES, with_chairs
from scripts.synthetic.capture import write_calibration
from tk.errors import TkError
from tk.io.captures.capture import Capture, open_capture
from tk.io.results.reader import JointTrack, positions_at, read_result, read_truth
from tk.model.body.joints import JOINTS
from tk.run.session import track
from tk.run.task import RecordingOptions


def write_still(capture: Capture, images: np.ndarray, folder: Path) -> None:
    """Write a capture of one image (C, H, W, 3) a camera."""
    for camera, image in zip(capture.rig, images, strict=True):
        (folder / "images" / camera.name).mkdir(parents=True)
        cv2.imwrite(str(folder / "images" / camera.name / "000000.png"), image)
    write_calibration(capture.rig, folder / "calibration.toml")
    volume = {"center": list(capture.volume.center), "size": list(capture.volume.size)}
    up = capture.setup().up
    settings = {"name": folder.name, "fps": capture.fps, "up": up, "volume": volume, "init": {"pose": "any"}}
    (folder / "capture.toml").write_text(tomli_w.dumps(settings), encoding="utf-8")


def people_of(capture: Capture, work: Path) -> Sequence[JointTrack]:
    """Return the true joints of each person, or those of a result of the whole capture."""
    if capture.truth_file.exists():
        return read_truth(capture.truth_file)
    track(capture, work / "whole.h5", RecordingOptions(), Quiet(), force=True)
    return read_truth(work / "whole.h5")


def outcomes(found: Path, truth: np.ndarray) -> Iterator[Outcome | None]:
    """Yield the outcome of each person with true joints (P, J, 3); None for somebody whom the result does not have."""
    people = [person for person in read_result(found).people if np.isfinite(person.joints).all()]
    joints = np.array([person.joints[0] for person in people]).reshape(-1, 1, *truth.shape[1:])
    errors = np.linalg.norm(joints - truth, axis=-1)  # (N, P, J)
    pairs = zip(*linear_sum_assignment(np.nanmean(errors, axis=-1)), strict=True)
    whose = {int(true): int(person) for person, true in pairs}
    for k in range(len(truth)):
        if k not in whose:
            yield None
            continue
        person = people[whose[k]]
        assert person.sigma is not None
        yield Outcome(0, [], errors[whose[k], k][None], person.status[:1], person.sigma[:1])


def described(outcome: Outcome | None) -> str:
    """Return the cells of a person."""
    if outcome is None:
        return "not found"
    error, sigma = 100 * outcome.error_m[0], 100 * outcome.sigma_m[0]
    far = [f"{JOINTS[j]} {error[j]:.0f} ± {sigma[j]:.0f}" for j in np.flatnonzero(error > 100 * SILENT_M)]
    mark = " suspect" if outcome.suspect.any() else ""
    return f"{np.nanmean(error):5.2f} {np.count_nonzero(outcome.silent):2}{mark} {', '.join(far)}".rstrip()


def compare(capture: Capture, frames: Sequence[int], people: str, chairs: bool, work: Path) -> Iterator[str]:
    """Yield a line of the table for each still."""
    truth = people_of(capture, work)
    with capture.some_frames(frames) as reader:
        for frame in reader:
            true = positions_at(np.array([frame.index]), truth)[:, 0]
            known = true[np.isfinite(true).any(axis=(1, 2))]
            for side in range(SIDES) if chairs else (None,):
                name = f"{capture.name}-{frame.index:04d}" + ("" if side is None else f"-chair{side}")
                shown = frame.images if side is None else with_chairs(capture.rig, frame.images, known, side)
                write_still(capture, shown, work / name)
                yield f"{name:28} {tracked(work / name, known, people)}"


def tracked(folder: Path, known: np.ndarray, people: str) -> str:
    """Track the still in a folder; return the cells of its people, with true joints (P, J, 3)."""
    reporter, result = Quiet(), folder.with_suffix(".h5")
    try:
        track(open_capture(folder), result, RecordingOptions(people=people), reporter, force=True)
    except TkError as error:
        return f"refused: {error}"
    left_out = [note for note in reporter.notes if "left out" in note]
    return "; ".join([*map(described, outcomes(result, known)), *left_out])


def main(arguments: Sequence[str] | None = None) -> None:
    """Track the frames and print the table."""
    parser = argparse.ArgumentParser(prog="python -m scripts.stills", description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE")
    parser.add_argument("--every", type=int, default=20, metavar="N", help="frames between two stills, from N / 2 on")
    parser.add_argument("--cameras", help="use these cameras only")
    parser.add_argument("--people", default="auto", help="as for tk track")
    parser.add_argument("--chairs", action="store_true", help="draw chairs beside the people")
    parser.add_argument("--work", type=Path, help="folder for captures and results [default: temporary]")
    given = parser.parse_args(arguments)
    print("still                        mean silent far joints", flush=True)
    for path in given.captures:
        with tempfile.TemporaryDirectory(dir=given.work) as scratch:
            capture = open_capture(path, given.cameras and given.cameras.split(","), masks="none")
            if given.chairs and capture.setup().up != "z":
                parser.error(f"{path}: --chairs needs a capture with up = z")
            frames = range(min(given.every // 2, capture.frame_count - 1), capture.frame_count, given.every)
            for line in compare(capture, frames, given.people, given.chairs, Path(scratch)):
                print(line, flush=True)


if __name__ == "__main__":
    main()
