"""What `tk track` makes of recordings in which something is wrong.

    python -m scripts.faults CAPTURE [--only NAME,…] [--frames N] [--camera NAME] [--work DIR] [-- further options]

Each fault is made in a copy of the capture, its masks left out so that what is wrong in the pictures is wrong in the
masks, too; ``tk track`` runs on it in a process of its own. A line a fault: the mean distance of all joints from the
truth over the frames that are not lost, the largest mean of such a frame, how many frames are lost, how many say
"tracked" and are more than 10 cm off, and what was said. Without a ``truth.h5`` the run without a fault is the truth.
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
"""A frame whose mean joint is farther off than this must not say "tracked"."""
TURN_DEG = 2.0
LATE = 3
FLIPPED_BYTES = 400


@dataclass
class Spoiled:
    """A capture that is to be spoilt.

    Attributes:
        folder: the copy: nothing in it may be written to in place, its files are links.
        original: the capture itself.
        camera: the index of the camera that suffers.
        begin: the frame in which it begins, where it does not last from the first.
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

    def pictures(self, camera: int) -> Video:
        """All pictures of a camera, BGR."""
        clip = self.original.clips[camera]
        pictures = []
        with closing(clip.open()) as reader:
            for _ in range(clip.frame_count):
                picture = np.empty((clip.height, clip.width, 3), np.uint8)
                reader.read(picture)
                pictures.append(picture)
        return pictures

    def write(self, camera: int, pictures: Sequence[NDArray[np.uint8]]) -> None:
        """Put these pictures in the place of the camera's video."""
        path = self.video(camera)
        path.unlink()
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=Fraction(self.original.fps).limit_denominator(1000))
            stream.height, stream.width = pictures[0].shape[:2]
            stream.pix_fmt = "yuv420p"
            stream.options = {"crf": "18", "preset": "veryfast"}
            for picture in pictures:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
            container.mux(stream.encode())

    def change(self, edit: Callable[[Video], Sequence[NDArray[np.uint8]]]) -> None:
        """Change the suffering camera's pictures."""
        self.write(self.camera, edit(self.pictures(self.camera)))

    def plate(self, camera: int) -> NDArray[np.uint8]:
        """The camera's picture of the empty scene."""
        clips = self.original.background()
        if clips is None:
            raise SystemExit(f"{self.original.path}: this fault needs background/")
        return np.asarray(np.median(clips[camera], axis=0), np.uint8)


def black(spoiled: Spoiled) -> None:
    spoiled.change(lambda video: [p if i < spoiled.begin else np.zeros_like(p) for i, p in enumerate(video)])


def frozen(spoiled: Spoiled) -> None:
    spoiled.change(lambda video: [video[min(i, spoiled.begin)] for i in range(len(video))])


def turned(spoiled: Spoiled) -> None:
    """The calibration has the camera 2° to the side of where it looks."""
    turn = cv2.Rodrigues(np.radians([0.0, TURN_DEG, 0.0]))[0]
    calibration = read_calibration(spoiled.folder / "calibration.toml")
    cameras = list(calibration.rig)
    camera = cameras[spoiled.camera]
    cameras[spoiled.camera] = type(camera)(
        camera.name, camera.width, camera.height, camera.matrix, camera.distortions,
        turn @ camera.rotation, turn @ camera.translation, camera.fisheye,
    )  # fmt: skip
    (spoiled.folder / "calibration.toml").unlink()
    write_calibration(Rig(tuple(cameras)), spoiled.folder / "calibration.toml")


def bumped(spoiled: Spoiled) -> None:
    """Somebody touches the camera in the middle of the recording: it looks 2° to the side from then on."""
    camera = spoiled.original.rig[spoiled.camera]
    turn = cv2.Rodrigues(np.radians([0.0, TURN_DEG, 0.0]))[0]
    warp = camera.matrix @ turn @ np.linalg.inv(camera.matrix)

    def moved(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        warped = cv2.warpPerspective(picture, warp, picture.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(warped, np.uint8)

    spoiled.change(lambda video: [p if i < spoiled.begin else moved(p) for i, p in enumerate(video)])


def short(spoiled: Spoiled) -> None:
    spoiled.change(lambda video: video[: 2 * len(video) // 3])


def truncated(spoiled: Spoiled) -> None:
    """The file was not copied to its end."""
    path = spoiled.video(spoiled.camera)
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data[: 2 * len(data) // 3])


def late(spoiled: Spoiled) -> None:
    spoiled.change(lambda video: video[LATE:])


def dropped(spoiled: Spoiled) -> None:
    """Five frames are missing here and there in one video, which is so much shorter."""
    gone = spoiled.begin + np.array([0, 4, 5, 12, 20])
    spoiled.change(lambda video: [p for i, p in enumerate(video) if i not in gone])


def exposure(spoiled: Spoiled) -> None:
    """One camera's exposure falls to 60 % while it records."""

    def darker(picture: NDArray[np.uint8], gain: float) -> NDArray[np.uint8]:
        return np.asarray((picture * gain).round(), np.uint8)

    spoiled.change(lambda video: [darker(p, 1.0 - 0.4 * i / (len(video) - 1)) for i, p in enumerate(video)])


def bystander(spoiled: Spoiled) -> None:
    """Somebody beside the person in two of the views, cut out of the same recording at another time."""
    original = spoiled.original
    label = make_labeller(original.setup(), original, Settings(), lambda _: None)
    with original.frames() as frames:
        masks = [label(frame)[0].copy() for frame in frames]
    for camera in (spoiled.camera, (spoiled.camera + 2) % len(original.rig)):
        video = spoiled.pictures(camera)
        result = []
        for i, picture in enumerate(video):
            picture = picture.copy()
            if i >= spoiled.begin:
                j = (i + len(video) // 2) % len(video)
                columns = [np.flatnonzero((masks[k][camera] >= 128).any(axis=0)) for k in (i, j)]
                width = picture.shape[1]
                # beside the person, on the side where there is more room
                middle = [float(c.mean()) if len(c) else width / 2 for c in columns]
                aim = middle[0] + width * (0.3 if middle[0] < width / 2 else -0.3)
                shift = round(aim - middle[1])
                where = np.roll(masks[j][camera][: picture.shape[0], :width] >= 128, shift, 1)
                picture[where] = np.roll(video[j], shift, 1)[where]
            result.append(picture)
        spoiled.write(camera, result)


def away(spoiled: Spoiled) -> None:
    """The person is away for ten frames: all pictures show the empty scene."""
    for camera in range(len(spoiled.original.rig)):
        plate = spoiled.plate(camera)
        gone = range(spoiled.begin, spoiled.begin + 10)
        spoiled.write(camera, [plate if i in gone else p for i, p in enumerate(spoiled.pictures(camera))])


def flipped(spoiled: Spoiled) -> None:
    """Bytes in the middle of a video's pictures are damaged."""
    path = spoiled.video(spoiled.camera)
    data = bytearray(path.read_bytes())
    path.unlink()
    start = data.find(b"mdat") + 4
    middle = len(data) // 3, 2 * len(data) // 3
    rng = np.random.default_rng(0)
    for position in rng.integers(max(start, middle[0]), middle[1], FLIPPED_BYTES):
        data[position] ^= int(rng.integers(1, 256))
    path.write_bytes(bytes(data))


FAULTS: dict[str, Callable[[Spoiled], None]] = {
    "none": lambda spoiled: None,
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
    """What came of a run.

    Attributes:
        code: exit code; None where it had to be stopped.
        said: what it printed, without its progress.
        error_m: (F,) mean distance of the joints in each frame; status: (F,).
    """

    code: int | None
    said: list[str]
    error_m: NDArray[np.float64]
    status: NDArray[np.uint8]

    def row(self, name: str) -> str:
        kept = self.status != Status.LOST
        cm = 100 * self.error_m[kept]
        bad = int((cm > 100 * OFF_M).sum())
        figures = f"{cm.mean():6.2f} {cm.max():6.2f}" if len(cm) else "     -      -"
        lost = int((~kept).sum())
        code = "hang" if self.code is None else str(self.code)
        return f"{name:10} {code:>4} {figures} {lost:4}/{len(kept):<4} {bad:4}  {' | '.join(self.said)}"


def spoil(name: str, capture: Path, folder: Path, camera: str | None, begin: int) -> Spoiled:
    """A copy of the capture, without its masks, with a fault in it."""
    shutil.copytree(
        capture, folder, copy_function=os.link, ignore=shutil.ignore_patterns("masks*", "*.h5", "calibration_*")
    )
    settings = folder / "capture.toml"
    if not settings.exists():
        settings.write_text(tomli_w.dumps({"name": capture.name}), encoding="utf-8")
    original = open_capture(folder)
    names = original.rig.names
    spoiled = Spoiled(folder, original, names.index(camera) if camera else 1, begin)
    FAULTS[name](spoiled)
    return spoiled


def run(folder: Path, truth: Path | None, result: Path, options: Sequence[str], limit_s: float) -> Outcome:
    """Track a folder in a process of its own and compare; ``truth`` None: there is nothing to compare with."""
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
    said = [line for line in lines if line and not line.startswith(("frame ", "["))]
    if not result.exists():
        return Outcome(ran.returncode, said, np.zeros(0), np.zeros(0, np.uint8))
    found = read_joints(result)
    assert found.status is not None
    if truth is None:
        return Outcome(ran.returncode, said, np.zeros(len(found.frames)), found.status)
    true = read_joints(truth)
    rows = {int(frame): row for row, frame in enumerate(true.frames)}
    known = np.array([int(frame) in rows for frame in found.frames])
    expected = true.positions[[rows[int(frame)] for frame in found.frames[known]]]
    error = np.linalg.norm(found.positions[known] - expected, axis=2).mean(axis=1)
    return Outcome(ran.returncode, said, error, found.status[known])


def main(arguments: Sequence[str] | None = None) -> None:
    """Make faults, track, print the table."""
    parser = argparse.ArgumentParser(prog="python -m scripts.faults", description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--only", default=",".join(FAULTS), help=f"some of {', '.join(FAULTS)}")
    parser.add_argument("--camera", help="the camera that suffers [default: the second]")
    parser.add_argument("--begin", type=int, default=30, help="the frame in which it begins")
    parser.add_argument("--work", type=Path, help="keep captures and results here")
    parser.add_argument("--limit", type=float, default=1200.0, help="seconds that a run may take")
    given, options = parser.parse_known_args(arguments)
    options = [option for option in options if option != "--"]
    names = given.only.split(",")
    if unknown := set(names) - set(FAULTS):
        parser.error(f"no such fault: {', '.join(sorted(unknown))}; there are {', '.join(FAULTS)}")
    print("fault      exit   mean  worst   lost      bad  said")
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
            spoil(name, given.capture, folder, given.camera, given.begin)
            started = time.perf_counter()
            outcome = run(folder, known, result, options, given.limit)
            print(outcome.row(name), f"[{time.perf_counter() - started:.0f} s]", flush=True)
            if known is None and name == "none":
                known = result


if __name__ == "__main__":
    main()
