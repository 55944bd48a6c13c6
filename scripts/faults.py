"""Run `tk track` on recordings with artificial faults and print a table.

    python -m scripts.faults CAPTURE [--only NAME,…] [--begin N] [--camera NAME] [--foreign CAPTURE] [--work DIR]
        [-- further options]

Each fault is made in a copy of the capture without masks, so that the masks show the fault, too. ``tk track`` runs in a
process of its own. Columns:

- mean, worst: distance of all joints from the ground truth, mean over a frame, over frames that are neither lost nor
  suspect, cm.
- lost, suspect: number of such frames.
- bad: frames more than 10 cm off that are neither lost nor suspect; "unflagged": those of them whose sigma, the mean
  of the joints, is at most 5 cm.
- silent: joints more than 15 cm off without a warning (their frame is neither lost nor suspect, their sigma is at most
  5 cm), % of all joints.
- alarm: frames less than 6 cm off that are lost, suspect or have a joint without sigma, % of all frames.

Without a ``truth.h5`` the run without a fault is the reference.
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
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import tomli_w
import tomllib
from numpy.typing import NDArray

from scripts.synthetic.capture import write_calibration
from tk.io.captures.calibration import read_calibration
from tk.io.captures.capture import Capture, open_capture
from tk.io.results.reader import read_joints
from tk.io.results.status import Status, has_pose
from tk.model.cameras.camera import Rig
from tk.run.segmentation import make_labeller
from tk.settings import Settings

Video = list[NDArray[np.uint8]]

OFF_M = 0.10
"""A frame with a larger mean error must not be "tracked"."""
SILENT_M, SIGMA_M = 0.15, 0.05
"""A joint with a larger error must be marked; a larger sigma marks it."""
RIGHT_M = 0.06
"""A frame with a smaller mean error should not be marked."""
TURN_DEG = 2.0  # rotation of the faulty camera
MORE_DEG = 3.0  # rotation of the faulty cameras where too few correct ones are left to contradict them
FAR_DEG = 10.0  # rotation that excludes a camera
CUT = 40  # frames missing at a cut
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
        foreign: another capture with as many cameras; None: there is none.
        used: names of the cameras to track with; empty: all.
        cut: number of frames missing from :attr:`begin` on.
    """

    folder: Path
    original: Capture
    camera: int
    begin: int
    foreign: Path | None = None
    used: tuple[str, ...] = ()
    cut: int = 0

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

    def write(self, camera: int, images: Sequence[NDArray[np.uint8]], faster: int = 1) -> None:
        """Replace the camera's video by these images, at ``faster`` times its rate."""
        path = self.video(camera)
        path.unlink()
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=faster * Fraction(self.original.fps).limit_denominator(1000))
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


def turn(faulty: Faulty, angles_deg: dict[int, float]) -> None:
    """Rotate cameras in the calibration, by index, each about its own upright axis."""
    path = faulty.folder / "calibration.toml"
    cameras = list(read_calibration(path).rig)
    for i, angle in angles_deg.items():
        T = cv2.Rodrigues(np.radians([0.0, angle, 0.0]))[0]
        cameras[i] = replace(cameras[i], rotation=T @ cameras[i].rotation, translation=T @ cameras[i].translation)
    path.unlink()
    write_calibration(Rig(tuple(cameras)), path)


def turned(faulty: Faulty) -> None:
    """Rotate the camera in the calibration."""
    turn(faulty, {faulty.camera: TURN_DEG})


def two_turned(faulty: Faulty) -> None:
    """Rotate two cameras in the calibration, in opposite directions."""
    turn(faulty, {faulty.camera: MORE_DEG, (faulty.camera + 2) % len(faulty.original.rig): -MORE_DEG})


def one_of_two_turned(faulty: Faulty) -> None:
    """Use two cameras and rotate one of them in the calibration."""
    turn(faulty, {faulty.camera: MORE_DEG})
    names = faulty.original.rig.names
    faulty.used = names[faulty.camera - 1], names[faulty.camera]


def facing_cameras(faulty: Faulty) -> None:
    """Use two cameras that face each other."""
    axes = np.array([camera.rotation[2] for camera in faulty.original.rig])
    first, second = np.unravel_index(int(np.argmin(axes @ axes.T)), (len(axes), len(axes)))
    names = faulty.original.rig.names
    faulty.used = names[first], names[second]


def foreign_calibration(faulty: Faulty) -> None:
    """Use the calibration of another capture."""
    if faulty.foreign is None:
        raise SystemExit(f"{faulty.original.path}: no capture beside it has as many cameras (give --foreign CAPTURE)")
    path = faulty.folder / "calibration.toml"
    path.unlink()
    shutil.copy(faulty.foreign / "calibration.toml", path)


def swapped_videos(faulty: Faulty) -> None:
    """Swap the videos of two cameras."""
    one, other = faulty.video(faulty.camera), faulty.video((faulty.camera + 1) % len(faulty.original.rig))
    between = one.with_name("between" + one.suffix)
    one.rename(between)
    other.rename(one)
    between.rename(other)


def cut(faulty: Faulty) -> None:
    """Remove frames from all videos, so that the person jumps."""
    faulty.cut = CUT
    for camera in range(len(faulty.original.rig)):
        video = faulty.images(camera)
        faulty.write(camera, video[: faulty.begin] + video[faulty.begin + CUT :])


def wrong_fps(faulty: Faulty) -> None:
    """Give twice the videos' rate in `capture.toml`."""
    path = faulty.folder / "capture.toml"
    settings = tomllib.loads(path.read_text(encoding="utf-8")) | {"fps": 2 * faulty.original.fps}
    path.unlink()
    path.write_text(tomli_w.dumps(settings), encoding="utf-8")


def other_rate(faulty: Faulty) -> None:
    """Record one camera at twice the rate of the others."""
    images = faulty.images(faulty.camera)
    faulty.write(faulty.camera, [image for image in images for _ in range(2)], faster=2)


def bump(faulty: Faulty, angle_deg: float) -> None:
    """Rotate the camera in the middle of the recording."""
    camera = faulty.original.rig[faulty.camera]
    T = cv2.Rodrigues(np.radians([0.0, angle_deg, 0.0]))[0]
    warp = camera.matrix @ T @ np.linalg.inv(camera.matrix)

    def moved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        warped = cv2.warpPerspective(image, warp, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(warped, np.uint8)

    faulty.change(lambda video: [p if i < faulty.begin else moved(p) for i, p in enumerate(video)])


def bumped(faulty: Faulty) -> None:
    bump(faulty, TURN_DEG)


def camera_excluded(faulty: Faulty) -> None:
    """Use three cameras and rotate one so far that it must be excluded."""
    bump(faulty, FAR_DEG)
    names = faulty.original.rig.names
    faulty.used = tuple(names[(faulty.camera + i) % len(names)] for i in (-1, 0, 1))


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
    "foreign calibration": foreign_calibration,
    "two turned": two_turned,
    "one of two turned": one_of_two_turned,
    "facing cameras": facing_cameras,
    "swapped videos": swapped_videos,
    "cut": cut,
    "wrong fps": wrong_fps,
    "other rate": other_rate,
    "camera excluded": camera_excluded,
}


@dataclass(frozen=True)
class Outcome:
    """Outcome of a run.

    Attributes:
        code: exit code; None after a timeout.
        messages: lines printed, without progress.
        error_m: (F, 15), error of each joint.
        status: (F,), status of each frame.
        sigma_m: (F, 15), sigma of each joint.
    """

    code: int | None
    messages: list[str]
    error_m: NDArray[np.float64]
    status: NDArray[np.uint8]
    sigma_m: NDArray[np.float64]

    @staticmethod
    def empty(code: int | None, messages: list[str]) -> Outcome:
        """Return the outcome of a run without a result."""
        return Outcome(code, messages, np.zeros((0, 15)), np.zeros(0, np.uint8), np.zeros((0, 15)))

    @property
    def lost(self) -> NDArray[np.bool_]:
        return ~has_pose(self.status)

    @property
    def suspect(self) -> NDArray[np.bool_]:
        return self.status == Status.SUSPECT

    @property
    def silent(self) -> NDArray[np.bool_]:
        """(F, 15), joints far off without a warning."""
        marked = (self.lost | self.suspect)[:, None] | ~(self.sigma_m <= SIGMA_M)
        return (self.error_m > SILENT_M) & ~marked

    @property
    def alarm(self) -> NDArray[np.bool_]:
        """(F,), correct frames that are marked."""
        marked = self.lost | self.suspect | np.isnan(self.sigma_m).any(axis=1)
        return (self.error_m.mean(axis=1) < RIGHT_M) & marked

    def row(self, name: str) -> str:
        F = len(self.status)
        tracked = ~(self.lost | self.suspect)
        cm, sure = 100 * self.error_m.mean(axis=1)[tracked], self.sigma_m.mean(axis=1)[tracked] <= SIGMA_M
        bad = cm > 100 * OFF_M
        figures = f"{cm.mean():6.2f} {cm.max():6.2f}" if len(cm) else "     -      -"
        shares = f"{100 * self.silent.mean():6.2f} {100 * self.alarm.mean():5.1f}" if F else "     -     -"
        code = "hang" if self.code is None else str(self.code)
        return (
            f"{name:20} {code:>4} {figures} {self.lost.sum():4}/{F:<4} {self.suspect.sum():7} "
            f"{bad.sum():4} {(bad & sure).sum():9} {shares}  {' | '.join(self.messages)}"
        )


def make_faulty(
    name: str, capture: Path, folder: Path, camera: str | None, begin: int, foreign: Path | None = None
) -> Faulty:
    """Copy the capture without its masks and add a fault.

    Args:
        name: of the fault.
        capture: the capture.
        folder: the copy.
        camera: the faulty camera; None: the second one.
        begin: first frame of faults that do not last from the start.
        foreign: another capture with as many cameras; None: the first one beside the capture.
    """
    shutil.copytree(
        capture, folder, copy_function=os.link, ignore=shutil.ignore_patterns("masks*", "*.h5", "calibration_*")
    )
    settings = folder / "capture.toml"
    if not settings.exists():
        settings.write_text(tomli_w.dumps({"name": capture.name}), encoding="utf-8")
    original = open_capture(folder)
    names = original.rig.names
    if foreign is None and name == "foreign calibration":
        others = (path.parent for path in sorted(capture.resolve().parent.glob("*/calibration.toml")))
        same = (
            o for o in others if o != capture.resolve() and read_calibration(o / "calibration.toml").rig.names == names
        )
        foreign = next(same, None)
    faulty = Faulty(folder, original, names.index(camera) if camera else 1, begin, foreign)
    FAULTS[name](faulty)
    return faulty


def run(faulty: Faulty, truth: Path | None, result: Path, options: Sequence[str], limit_s: float) -> Outcome:
    """Track a copy in a process of its own and compare it with the ground truth, if there is one."""
    folder = faulty.folder
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
    if faulty.used:
        command += ["--cameras", ",".join(faulty.used)]
    try:
        ran = subprocess.run(command, capture_output=True, text=True, timeout=limit_s)
    except subprocess.TimeoutExpired:
        return Outcome.empty(None, [])
    lines = [line.replace(str(folder) + "/", "") for line in ran.stderr.splitlines()]
    if (crash := "Traceback (most recent call last):") in lines:
        lines = [*lines[: lines.index(crash)], f"crash: {lines[-1]}"]
    messages = [line for line in lines if line and not line.startswith(("frame ", "["))]
    if not result.exists():
        return Outcome.empty(ran.returncode, messages)
    found = read_joints(result)
    assert found.status is not None
    sigma = np.full(found.positions.shape[:2], np.nan) if found.sigma is None else found.sigma
    if truth is None:
        return Outcome(ran.returncode, messages, np.zeros(sigma.shape), found.status, sigma)
    true = read_joints(truth)
    rows = {int(frame): row for row, frame in enumerate(true.frames)}
    frames = np.where(found.frames < faulty.begin, found.frames, found.frames + faulty.cut)
    known = np.array([int(frame) in rows for frame in frames])
    expected = true.positions[[rows[int(frame)] for frame in frames[known]]]
    error = np.linalg.norm(found.positions[known] - expected, axis=2)
    return Outcome(ran.returncode, messages, error, found.status[known], sigma[known])


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the faults, track, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m scripts.faults", description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--only", default=",".join(FAULTS), help=f"some of {', '.join(FAULTS)}")
    parser.add_argument("--camera", help="the faulty camera [default: the second]")
    parser.add_argument("--begin", type=int, default=30, help="first frame of the fault")
    parser.add_argument("--foreign", type=Path, help="another capture with as many cameras [default: one beside it]")
    parser.add_argument("--work", type=Path, help="folder for captures and results [default: temporary]")
    parser.add_argument("--limit", type=float, default=1200.0, help="time limit of a run, seconds")
    given, options = parser.parse_known_args(arguments)
    options = [option for option in options if option != "--"]
    names = given.only.split(",")
    if unknown := set(names) - set(FAULTS):
        parser.error(f"no such fault: {', '.join(sorted(unknown))}; there are {', '.join(FAULTS)}")
    print(f"{'fault':20} exit   mean  worst   lost     suspect  bad unflagged silent alarm  messages")
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
            faulty = make_faulty(name, given.capture, folder, given.camera, given.begin, given.foreign)
            started = time.perf_counter()
            outcome = run(faulty, known, result, options, given.limit)
            print(outcome.row(name), f"[{time.perf_counter() - started:.0f} s]", flush=True)
            if known is None and name == "none":
                known = result


if __name__ == "__main__":
    main()
