"""Run `tk track` on recordings with artificial faults and print a table.

    python -m scripts.faults CAPTURE [--only NAME,…] [--begin N] [--camera NAME] [--work DIR] [-- further options]

Each fault is made in a copy of the capture without masks, so that the masks show the fault, too. ``tk track`` runs in a
process of its own. Columns: mean distance of all joints from the ground truth over frames that are not lost, cm; the
largest mean of such a frame; lost frames; frames that are "tracked" but more than 10 cm off; and the messages. Without
a ``truth.h5`` the run without a fault is the reference.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray

from scripts.synthetic.capture import write_calibration
from tk.io.captures.calibration import read_calibration
from tk.io.captures.capture import Capture, open_capture
from tk.io.results.writer import Status, read_joints
from tk.model.cameras.camera import Rig
from tk.run.segmentation import make_labeller
from tk.settings import Settings

Video = list[NDArray[np.uint8]]

OFF_M = 0.10
"""A frame with a larger mean error must not be "tracked"."""
TURN_DEG = 2.0  # rotation of the faulty camera
LATE = 3  # frames
FLIPPED_BYTES = 400


@dataclass
class Faulty:
    """A copy of a capture that gets a fault.

    Attributes:
        folder: the copy. Its files are links, so they must be replaced, not changed.
        original: the capture.
        camera: index of the faulty camera.
        begin: first frame of faults that do not last from the start.
    """

    folder: Path
    original: Capture
    camera: int
    begin: int

    @property
    def count(self) -> int:
        return self.original.frame_count

    def video(self, camera: int) -> Path:
        clip = self.original.clips[camera].path
        return self.folder / clip.parent.name / clip.name

    def images(self, camera: int) -> Video:
        """Read all images of a camera, BGR."""
        clip = self.original.clips[camera]
        images = []
        with closing(clip.open()) as reader:
            for _ in range(clip.frame_count):
                image = np.empty((clip.height, clip.width, 3), np.uint8)
                reader.read(image)
                images.append(image)
        return images

    def write(self, camera: int, images: Sequence[NDArray[np.uint8]]) -> None:
        """Replace the camera's video by these images."""
        path = self.video(camera)
        path.unlink()
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=Fraction(self.original.fps).limit_denominator(1000))
            stream.height, stream.width = images[0].shape[:2]
            stream.pix_fmt = "yuv420p"
            stream.options = {"crf": "18", "preset": "veryfast"}
            for image in images:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
            container.mux(stream.encode())

    def change(self, edit: Callable[[Video], Sequence[NDArray[np.uint8]]]) -> None:
        """Change the images of the faulty camera."""
        self.write(self.camera, edit(self.images(self.camera)))

    def plate(self, camera: int) -> NDArray[np.uint8]:
        """Return the camera's image of the empty scene."""
        clips = self.original.background()
        if clips is None:
            raise SystemExit(f"{self.original.path}: this fault needs background/")
        return np.asarray(np.median(clips[camera], axis=0), np.uint8)


def black(faulty: Faulty) -> None:
    faulty.change(lambda video: [p if i < faulty.begin else np.zeros_like(p) for i, p in enumerate(video)])


def frozen(faulty: Faulty) -> None:
    faulty.change(lambda video: [video[min(i, faulty.begin)] for i in range(len(video))])


def turned(faulty: Faulty) -> None:
    """Rotate the camera by 2° in the calibration."""
    turn = cv2.Rodrigues(np.radians([0.0, TURN_DEG, 0.0]))[0]
    calibration = read_calibration(faulty.folder / "calibration.toml")
    cameras = list(calibration.rig)
    camera = cameras[faulty.camera]
    cameras[faulty.camera] = type(camera)(
        camera.name, camera.width, camera.height, camera.matrix, camera.distortions,
        turn @ camera.rotation, turn @ camera.translation, camera.fisheye,
    )  # fmt: skip
    (faulty.folder / "calibration.toml").unlink()
    write_calibration(Rig(tuple(cameras)), faulty.folder / "calibration.toml")


def bumped(faulty: Faulty) -> None:
    """Rotate the camera by 2° in the middle of the recording."""
    camera = faulty.original.rig[faulty.camera]
    turn = cv2.Rodrigues(np.radians([0.0, TURN_DEG, 0.0]))[0]
    warp = camera.matrix @ turn @ np.linalg.inv(camera.matrix)

    def moved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        warped = cv2.warpPerspective(image, warp, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(warped, np.uint8)

    faulty.change(lambda video: [p if i < faulty.begin else moved(p) for i, p in enumerate(video)])


def short(faulty: Faulty) -> None:
    faulty.change(lambda video: video[: 2 * len(video) // 3])


def truncated(faulty: Faulty) -> None:
    """Truncate the video file."""
    path = faulty.video(faulty.camera)
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data[: 2 * len(data) // 3])


def late(faulty: Faulty) -> None:
    faulty.change(lambda video: video[LATE:])


def dropped(faulty: Faulty) -> None:
    """Drop five frames of one video, which becomes shorter."""
    gone = faulty.begin + np.array([0, 4, 5, 12, 20])
    faulty.change(lambda video: [p for i, p in enumerate(video) if i not in gone])


def exposure(faulty: Faulty) -> None:
    """Reduce the exposure of one camera gradually to 60 %."""

    def darker(image: NDArray[np.uint8], gain: float) -> NDArray[np.uint8]:
        return np.asarray((image * gain).round(), np.uint8)

    faulty.change(lambda video: [darker(p, 1.0 - 0.4 * i / (len(video) - 1)) for i, p in enumerate(video)])


def bystander(faulty: Faulty) -> None:
    """Add a second person to two of the views, cut out of the same recording at another time."""
    original = faulty.original
    label = make_labeller(original.setup(), original, Settings(), lambda _: None)
    with original.frames() as frames:
        masks = [label(frame)[0].copy() for frame in frames]
    for camera in (faulty.camera, (faulty.camera + 2) % len(original.rig)):
        video = faulty.images(camera)
        result = []
        for i, image in enumerate(video):
            image = image.copy()
            if i >= faulty.begin:
                j = (i + len(video) // 2) % len(video)
                columns = [np.flatnonzero((masks[k][camera] >= 128).any(axis=0)) for k in (i, j)]
                width = image.shape[1]
                # on the side of the person with more room
                middle = [float(c.mean()) if len(c) else width / 2 for c in columns]
                aim = middle[0] + width * (0.3 if middle[0] < width / 2 else -0.3)
                shift = round(aim - middle[1])
                where = np.roll(masks[j][camera][: image.shape[0], :width] >= 128, shift, 1)
                image[where] = np.roll(video[j], shift, 1)[where]
            result.append(image)
        faulty.write(camera, result)


def away(faulty: Faulty) -> None:
    """Show the empty scene in all views for ten frames."""
    for camera in range(len(faulty.original.rig)):
        plate = faulty.plate(camera)
        gone = range(faulty.begin, faulty.begin + 10)
        faulty.write(camera, [plate if i in gone else p for i, p in enumerate(faulty.images(camera))])


def flipped(faulty: Faulty) -> None:
    """Damage bytes in the middle of a video's images."""
    path = faulty.video(faulty.camera)
    data = bytearray(path.read_bytes())
    path.unlink()
    start = data.find(b"mdat") + 4
    middle = len(data) // 3, 2 * len(data) // 3
    rng = np.random.default_rng(0)
    for position in rng.integers(max(start, middle[0]), middle[1], FLIPPED_BYTES):
        data[position] ^= int(rng.integers(1, 256))
    path.write_bytes(bytes(data))


FAULTS: dict[str, Callable[[Faulty], None]] = {
    "none": lambda faulty: None,
    "black": black,
    "frozen": frozen,
    "turned": turned,
    "bumped": bumped,
    "short": short,
    "truncated": truncated,
    "late": late,
    "dropped": dropped,
    "exposure": exposure,
    "bystander": bystander,
    "away": away,
    "flipped": flipped,
}


@dataclass(frozen=True)
class Outcome:
    """Outcome of a run.

    Attributes:
        code: exit code; None after a timeout.
        messages: lines printed, without progress.
        error_m: (F,), mean joint error of each frame.
        status: (F,), status of each frame.
    """

    code: int | None
    messages: list[str]
    error_m: NDArray[np.float64]
    status: NDArray[np.uint8]

    def row(self, name: str) -> str:
        kept = self.status != Status.LOST
        cm = 100 * self.error_m[kept]
        bad = int((cm > 100 * OFF_M).sum())
        figures = f"{cm.mean():6.2f} {cm.max():6.2f}" if len(cm) else "     -      -"
        lost = int((~kept).sum())
        code = "hang" if self.code is None else str(self.code)
        return f"{name:10} {code:>4} {figures} {lost:4}/{len(kept):<4} {bad:4}  {' | '.join(self.messages)}"


def make_faulty(name: str, capture: Path, folder: Path, camera: str | None, begin: int) -> Faulty:
    """Copy the capture without its masks and add a fault."""
    shutil.copytree(
        capture, folder, copy_function=os.link, ignore=shutil.ignore_patterns("masks*", "*.h5", "calibration_*")
    )
    settings = folder / "capture.toml"
    if not settings.exists():
        settings.write_text(tomli_w.dumps({"name": capture.name}), encoding="utf-8")
    original = open_capture(folder)
    names = original.rig.names
    faulty = Faulty(folder, original, names.index(camera) if camera else 1, begin)
    FAULTS[name](faulty)
    return faulty


def run(folder: Path, truth: Path | None, result: Path, options: Sequence[str], limit_s: float) -> Outcome:
    """Track a folder in a process of its own and compare it with the ground truth, if there is one."""
    command = [
        sys.executable,
        "-c",
        "from tk.cli import main; main()",
        "track",
        str(folder),
        "-o",
        str(result),
        *options,
    ]
    try:
        ran = subprocess.run(command, capture_output=True, text=True, timeout=limit_s)
    except subprocess.TimeoutExpired:
        return Outcome(None, [], np.zeros(0), np.zeros(0, np.uint8))
    lines = [line.replace(str(folder) + "/", "") for line in ran.stderr.splitlines()]
    if (crash := "Traceback (most recent call last):") in lines:
        lines = [*lines[: lines.index(crash)], f"crash: {lines[-1]}"]
    messages = [line for line in lines if line and not line.startswith(("frame ", "["))]
    if not result.exists():
        return Outcome(ran.returncode, messages, np.zeros(0), np.zeros(0, np.uint8))
    found = read_joints(result)
    assert found.status is not None
    if truth is None:
        return Outcome(ran.returncode, messages, np.zeros(len(found.frames)), found.status)
    true = read_joints(truth)
    rows = {int(frame): row for row, frame in enumerate(true.frames)}
    known = np.array([int(frame) in rows for frame in found.frames])
    expected = true.positions[[rows[int(frame)] for frame in found.frames[known]]]
    error = np.linalg.norm(found.positions[known] - expected, axis=2).mean(axis=1)
    return Outcome(ran.returncode, messages, error, found.status[known])


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the faults, track, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m scripts.faults", description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--only", default=",".join(FAULTS), help=f"some of {', '.join(FAULTS)}")
    parser.add_argument("--camera", help="the faulty camera [default: the second]")
    parser.add_argument("--begin", type=int, default=30, help="first frame of the fault")
    parser.add_argument("--work", type=Path, help="folder for captures and results [default: temporary]")
    parser.add_argument("--limit", type=float, default=1200.0, help="time limit of a run, seconds")
    given, options = parser.parse_known_args(arguments)
    options = [option for option in options if option != "--"]
    names = given.only.split(",")
    if unknown := set(names) - set(FAULTS):
        parser.error(f"no such fault: {', '.join(sorted(unknown))}; there are {', '.join(FAULTS)}")
    print("fault      exit   mean  worst   lost      bad  messages")
    with tempfile.TemporaryDirectory() as scratch:
        work = given.work or Path(scratch)
        truth = given.capture / "truth.h5"
        known: Path | None = truth if truth.exists() else None
        if known is None and "none" not in names:
            names = ["none", *names]
        for name in names:
            folder, result = work / name, work / f"{name}.h5"
            shutil.rmtree(folder, ignore_errors=True)
            result.unlink(missing_ok=True)
            work.mkdir(parents=True, exist_ok=True)
            make_faulty(name, given.capture, folder, given.camera, given.begin)
            started = time.perf_counter()
            outcome = run(folder, known, result, options, given.limit)
            print(outcome.row(name), f"[{time.perf_counter() - started:.0f} s]", flush=True)
            if known is None and name == "none":
                known = result


if __name__ == "__main__":
    main()
