"""`tk demo --raw`: the demo as its cameras would have recorded it, and the commands that make a result of it."""

from __future__ import annotations

import shlex
import shutil
import struct
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from fractions import Fraction
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np
from numpy.typing import NDArray

from tk.commands.console import ConsoleReporter
from tk.errors import CaptureError

if TYPE_CHECKING:
    import av

#: measured side of a square of the board, metres
SQUARE_M = 0.11
# Times of the parts, seconds on the clock of the first camera. A place of the board lasts HELD_S.
_FPS, CLAPS_S, BOARDS_S, HELD_S, EMPTY_S, PERSON_S, _END_S = 15.0, (4.0, 36.0), 5.0, 0.4, 28.0, 30.0, 37.0
# Seconds by which each video starts later than the first one; the size of its clock's ticks; degrees by which its
# camera stands on its side.
_STARTS_S = (0.0, 1.4, 3.2, 0.8, 2.6)
_TICKS, _VARIABLE, _ON_ITS_SIDE = 30000, 2, 3
# Sound: samples a second, time in which a clap fades, s; and where the hands clap, metres.
_RATE, _FADES_S, _HANDS = 48000, 0.02, np.array([0.0, 0.0, 1.2])

Images = list[NDArray[np.uint8]]


@dataclass(frozen=True)
class _Scene:
    """What one camera has seen: images (H, W, 3) of the board, the empty room and the person."""

    boards: Images
    empty: Images
    person: Images

    def at(self, seconds: float) -> NDArray[np.uint8]:
        """Return the image at a time of the first camera's clock."""
        for images, begin, length in (
            (self.person, PERSON_S, 1 / _FPS),
            (self.empty, EMPTY_S, 1 / _FPS),
            (self.boards, BOARDS_S, HELD_S),
        ):
            since = seconds - begin + 0.5 / _FPS  # the nearest image of the scene
            if since >= 0:
                return images[min(int(since / length), len(images) - 1)]
        return self.empty[0]


def make_raw(folder: Path, progress: Callable[[str], None], cameras: Container[str] | None = None) -> None:
    """Write the demo as five cameras would have recorded it, `folder/<camera>.mp4`.

    The videos start at different times; the third has 29.97 images a second at variable intervals; the fourth camera
    stands on its side. Hands clap at the beginning and at the end. The person moves last.

    Args:
        folder: made if it is missing.
        progress: is called with a line for each video.
        cameras: names of those to write; all by default.
    """
    from tk.io.captures.calibration import read_calibration

    folder.mkdir(parents=True, exist_ok=True)
    with as_file(files("tk") / "data") as data:
        rig = read_calibration(data / "demo" / "calibration.toml").rig
        for c, camera in enumerate(rig):
            if cameras is not None and camera.name not in cameras:
                continue
            progress(f"making {folder / camera.name}.mp4")
            parts = (data / "boards", data / "demo" / "background", data / "demo" / "videos")
            scene = _Scene(*(list(_images(part / f"{camera.name}.mp4")) for part in parts))
            path = folder / f"{camera.name}.mp4"
            times = _times(c)
            _write(path, (np.rot90(scene.at(t)) if c == _ON_ITS_SIDE else scene.at(t) for t in times), times, c,
                   float(np.linalg.norm(camera.center - _HANDS)))  # fmt: skip
            if c == _ON_ITS_SIDE:
                _stand_up(path)


def _times(c: int) -> NDArray[np.float64]:
    """Return the times of a camera's images, seconds on the first camera's clock."""
    rng = np.random.default_rng(c)
    if c != _VARIABLE:
        return np.arange(_STARTS_S[c], _END_S, 1 / _FPS)
    times = np.arange(_STARTS_S[c], _END_S, 1001 / 30000)
    times[1:] += rng.uniform(-0.004, 0.004, len(times) - 1)
    return times


def _images(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Yield the images (H, W, 3) of a video, RGB."""
    import av

    with av.open(str(path)) as video:
        for frame in video.decode(video=0):
            yield frame.to_ndarray(format="rgb24")


def _write(path: Path, images: Iterator[NDArray[np.uint8]], times: NDArray[np.float64], c: int, away_m: float) -> None:
    """Write a video of images at times (N,), with the sound of a camera at a distance from the hands."""
    import av

    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=30, options={"crf": "20", "preset": "veryfast"})
        sound = container.add_stream("aac", rate=_RATE, layout="mono")
        ticks = np.round((times - times[0]) * _TICKS).astype(np.int64)
        for image, tick in zip(images, ticks.tolist(), strict=True):
            if tick == 0:
                video.height, video.width = image.shape[:2]
                video.pix_fmt = "yuv420p"
                video.codec_context.time_base = video.time_base = Fraction(1, _TICKS)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = tick, Fraction(1, _TICKS)
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
        _add_sound(container, sound, _sound(times[0], c, away_m))


def _sound(start_s: float, c: int, away_m: float) -> NDArray[np.float32]:
    """Return what a microphone records from a time on: claps with an echo, and its own noise."""
    from tk.synchronise.travel import SOUND_M_S

    claps = np.random.default_rng(100)  # the same for all
    samples = np.zeros(round((_END_S - start_s) * _RATE))
    fades = np.exp(-np.arange(round(8 * _FADES_S * _RATE)) / (_FADES_S * _RATE))
    for clap_s in CLAPS_S:
        ring = claps.normal(size=len(fades)) * fades
        for delay_s, strength in ((0.0, 0.5), (0.011 + 0.002 * c, 0.15)):
            first = round((clap_s + delay_s + away_m / SOUND_M_S - start_s) * _RATE)
            samples[first : first + len(ring)] += strength * ring / away_m
    own = np.random.default_rng(c)
    return np.clip(samples + own.normal(scale=0.003, size=len(samples)), -1.0, 1.0).astype(np.float32)


def _add_sound(container: av.container.OutputContainer, stream: av.AudioStream, samples: NDArray[np.float32]) -> None:
    import av

    for first in range(0, len(samples), 1024):
        frame = av.AudioFrame.from_ndarray(samples[None, first : first + 1024], "fltp", "mono")
        frame.rate, frame.pts, frame.time_base = _RATE, first, Fraction(1, _RATE)
        container.mux(stream.encode(frame))
    container.mux(stream.encode(None))


def _stand_up(path: Path) -> None:
    """Note in the header of a video's first track that its images are shown turned by 90° to the right."""
    one = 1 << 16
    before = struct.pack(">9i", one, 0, 0, 0, one, 0, 0, 0, 1 << 30)
    after = struct.pack(">9i", 0, one, 0, -one, 0, 0, 0, 0, 1 << 30)
    head, track, rest = path.read_bytes().partition(b"tkhd")
    path.write_bytes(head + track + rest.replace(before, after, 1))


def run_raw(folder: Path, force: bool, quiet: bool, no_report: bool) -> None:
    """Make the RAW folder in a folder, and run every command from it to the result.

    Raises:
        CaptureError: the folder exists, and ``force`` is False, or an earlier `tk demo --raw` has not written it.
    """
    from tk.commands.calibrate import calibrate
    from tk.commands.inspect import inspect
    from tk.commands.sync import sync
    from tk.commands.track import track

    run: dict[str, click.Command] = {"sync": sync, "calibrate": calibrate, "inspect": inspect, "track": track}
    raw, boards, capture, looks = inner = [folder / name for name in ("RAW", "BOARDS", "CAPTURE", "looks")]
    result, commands = folder / "result.h5", folder / "commands.txt"
    if folder.exists():
        if not force:
            raise CaptureError(f"{folder}: exists; add --force to replace what an earlier tk demo --raw wrote")
        if not commands.is_file():
            raise CaptureError(f"{folder}: is not of an earlier tk demo --raw; choose a new folder")
        for old in inner:
            shutil.rmtree(old, ignore_errors=True)
    lines = [
        ["sync", raw, "-o", boards, "--from", f"{BOARDS_S:g}", "--to", f"{EMPTY_S - 1:g}"],
        ["calibrate", boards, "--square", f"{SQUARE_M:g}", "-o", raw / "calibration.toml"],
        ["sync", raw, "-o", capture, "--from", f"{PERSON_S:g}", "--to", f"{PERSON_S + 5:g}",
         "--empty", f"{EMPTY_S:g}:{PERSON_S - 0.5:g}"],
        ["inspect", capture, "-o", looks],
        ["track", capture, "-o", result, *(["--force"] if force else []), *(["--no-report"] if no_report else [])],
    ]  # fmt: skip
    typed = [[str(word) for word in line] for line in lines]
    folder.mkdir(parents=True, exist_ok=True)
    commands.write_text("".join(f"tk {shlex.join(words)}\n" for words in typed))
    with ConsoleReporter(quiet, stage="making the videos of five cameras") as reporter:
        make_raw(raw, reporter.stage)
    for words in typed:
        click.echo(f"\n$ tk {shlex.join(words)}")
        silent = quiet and words[0] != "inspect"  # which shows no progress
        options = ["--quiet"] if silent else []
        if run[words[0]].main([*words[1:], *options], f"tk {words[0]}", standalone_mode=False):
            return
    with as_file(files("tk") / "data" / "demo" / "truth.h5") as truth:
        from tk.evaluation.joints import evaluate_files

        click.echo(evaluate_files(result, truth).format_table())
    click.echo(
        f"Everything is in {folder}, the commands in {commands}. Look at sync.png in {boards.name} and {capture.name}, "
        f"RAW/calibration.html, looks/inspect.png{'' if no_report else ', result.mp4, result.html'}. "
        "Next: your own videos in one folder, and the same commands with your times."
    )
