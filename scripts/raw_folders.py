"""RAW folders with known offsets, made of captures, and the errors of `tk sync` on them.

    python -m scripts.raw_folders ../shared/captures/walk ../shared/captures/dance    # a table, milliseconds
    python -m scripts.raw_folders CAPTURE --keep DIR                                  # keep the folders

The frames of a capture are played back and forth, with turns at random, after a part with the empty scene if the
capture has one. Each camera starts up to 60 s after the first, has a rate and a clock of its own, and leaves out
images; one is stored turned. The sound has the way to each camera, noise, and a filter for each microphone.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import tomli_w
from scipy.io import wavfile
from scipy.signal import butter, sosfilt

from tk.errors import TkError
from tk.io.captures.calibration import read_calibration
from tk.synchronise.raw import read_cameras, read_raw
from tk.synchronise.run import synchronise

SOUND_HZ = 48000
#: m/s
SPEED_OF_SOUND = 343.0
#: share of an interval in which a row is exposed, and in which the rows are read
EXPOSED, READ = 0.4, 0.4


@dataclass(frozen=True)
class Recipe:
    """How a RAW folder is made.

    Attributes:
        sound: "clap", "steps", "other" (each camera hears something else) or "none".
        flash: whether a lamp is switched on and off.
        calibrated: whether the calibration is in RAW.
        apart_s: latest start after the first camera.
        length_s: time that all cameras have in common.
        empty_s: length of the part with the empty scene, if the capture has one.
        ppm: largest clock error.
        seed: of everything that is random.
    """

    sound: str = "none"
    flash: bool = False
    calibrated: bool = False
    apart_s: float = 60.0
    length_s: float = 30.0
    empty_s: float = 4.0
    ppm: float = 30.0
    seed: int = 0


@dataclass(frozen=True)
class Made:
    """A camera of a RAW folder: common time = offset + rate · own time; and the time that sound takes to it."""

    offset_s: float
    rate: float
    way_s: float


def make_raw(capture: Path, folder: Path, recipe: Recipe) -> dict[str, Made]:
    """Write a RAW folder and return the clocks of its cameras."""
    random = np.random.default_rng(recipe.seed)
    calibration = read_calibration(capture / ("calibration_true.toml" if (capture / "calibration_true.toml").exists()
                                              else "calibration.toml"))  # fmt: skip
    rig = calibration.rig
    videos = {path.stem: path for path in sorted((capture / "videos").iterdir())}
    late = _late(capture)
    fps = float(cv2.VideoCapture(str(next(iter(videos.values())))).get(cv2.CAP_PROP_FPS))
    total = recipe.apart_s + recipe.length_s
    ticks = round(total * fps)
    count = min(int(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)) for path in videos.values()) - 2
    shown = _back_and_forth(ticks, count, random) + 1
    has_empty = (capture / "background").is_dir()
    empty = np.arange(ticks) < (recipe.apart_s + recipe.empty_s) * fps
    empty &= np.arange(ticks) >= recipe.apart_s * fps
    starts = np.concatenate([[0.3], random.uniform(0.2, 1.0, len(rig) - 1) * recipe.apart_s])
    lamp = recipe.apart_s + recipe.empty_s + np.array([3.013, 3.42, 7.13, 7.71]) if recipe.flash else np.empty(0)
    folder.mkdir(parents=True, exist_ok=True)
    made = {}
    source = np.array([0.4, 0.3, 1.2])
    played = _sound(recipe, total, random)
    for c, (name, path) in enumerate(videos.items()):
        frames = _read(path)
        scenes = _read(capture / "background" / name) if has_empty else []
        rate = 1 + (random.uniform(-1, 1) * recipe.ppm * 1e-6 if c else 0.0)
        first = int(np.ceil(starts[c] * fps))
        end = ticks - random.integers(0, round(fps))
        if c == 1 and fps > 20:  # another rate
            chosen = np.unique(np.rint(np.arange(first, end - 1, 1.25)).astype(int))
        elif fps > 50:  # half of the images, others in each camera
            chosen = np.arange(first + c % 2, end, 2)
        else:
            chosen = np.arange(first, end)
        if c == 2:  # a variable rate
            chosen = chosen[(random.random(len(chosen)) > 0.1) | (np.arange(len(chosen)) == 0)]
        offset = chosen[0] / fps
        turned = c == 3
        part = folder / f"{name}.part.mp4"
        _write_video(part, [
            (
                (t / fps - offset) / rate,
                _lit(
                    scenes[t % len(scenes)] if has_empty and empty[t] else frames[min(shown[t] + late.get(name, 0),
                                                                                     len(frames) - 1)],
                    t / fps, fps, lamp,
                ),
            )
            for t in chosen.tolist()
        ], turned)  # fmt: skip
        way_s = float(np.linalg.norm(source - rig[rig.names.index(name)].center)) / SPEED_OF_SOUND
        sound = None
        if recipe.sound != "none":
            heard = _sound(recipe, total, random) if recipe.sound == "other" else played
            sound = _heard(heard, offset, rate, (end - first) / fps, way_s, random)
        _join(part, sound, folder / f"{name}.mp4", turned)
        made[name] = Made(offset, rate, way_s)
    if recipe.calibrated:
        shutil.copy(capture / "calibration.toml", folder / "calibration.toml")
    (folder / "truth.toml").write_text(
        tomli_w.dumps({name: {"offset": each.offset_s, "rate": each.rate} for name, each in made.items()})
    )
    return made


def _late(capture: Path) -> dict[str, int]:
    """Return by how many frames a video of the capture is late; the folders have none of it."""
    file = capture / "offset.txt"
    words = file.read_text().split() if file.exists() else []
    names = [word.strip(":,.") for word in words if word.startswith("cam")]
    return {names[0]: -1} if names else {}


def _back_and_forth(ticks: int, count: int, random: np.random.Generator) -> np.ndarray:
    """Return (ticks,) frames, played back and forth with turns at random."""
    frames, at, step = [], 0, 1
    for _ in range(ticks):
        frames.append(at)
        if at + step not in range(count) or (4 < at < count - 5 and random.random() < 0.02):
            step = -step
        at = int(np.clip(at + step, 0, count - 1))
    return np.array(frames)


def _read(path: Path) -> list[np.ndarray]:
    """Return the frames of a video or picture, named with or without its suffix."""
    if not path.suffix:
        path = next(path.parent.glob(f"{path.name}.*"))
    if path.suffix == ".png":
        return [cv2.imread(str(path))]
    frames = []
    video = cv2.VideoCapture(str(path))
    while True:
        ok, frame = video.read()
        if not ok:
            return frames
        frames.append(frame)


def _lit(frame: np.ndarray, time: float, fps: float, lamp: np.ndarray) -> np.ndarray:
    """Return a frame with the light of a lamp that is switched on and off at these times; rows are read one by one."""
    if not len(lamp) or time < lamp[0] - 1 or time > lamp[-1] + 1:
        return frame
    begin = time + READ / fps * np.arange(len(frame)) / len(frame)
    light = np.zeros(len(frame))
    for on, off in lamp.reshape(-1, 2):
        light += np.clip(np.minimum(begin + EXPOSED / fps, off) - np.maximum(begin, on), 0, None) * fps / EXPOSED
    return np.clip(frame + 45.0 * light[:, None, None], 0, 255).astype(np.uint8)


def _write_video(path: Path, images: Sequence[tuple[float, np.ndarray]], turned: bool) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=90000, options={"preset": "ultrafast", "crf": "23"})
        first = np.rot90(images[0][1]) if turned else images[0][1]
        stream.height, stream.width, stream.pix_fmt = (*first.shape[:2], "yuv420p")
        stream.codec_context.time_base = stream.time_base = Fraction(1, 90000)
        for time, image in images:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(np.rot90(image) if turned else image), "bgr24")
            frame.pts, frame.time_base = round(time * 90000), stream.time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _sound(recipe: Recipe, total_s: float, random: np.random.Generator) -> np.ndarray:
    """Return what sounds in the room, at :data:`SOUND_HZ`."""
    sound = np.zeros(round(total_s * SOUND_HZ))
    begin = recipe.apart_s
    times = np.array([begin + 5.1]) if recipe.sound == "clap" else np.arange(begin / 2, total_s - 1, 0.55)
    for time in times + random.normal(0, 0.04, len(times)):
        at = round(time * SOUND_HZ)
        burst = random.standard_normal(2400) * np.exp(-np.arange(2400) / 300)
        sound[at : at + 2400] += (0.5 if recipe.sound == "clap" else 0.1) * burst[: len(sound[at : at + 2400])]
    return sound


def _heard(
    sound: np.ndarray, offset: float, rate: float, length_s: float, way_s: float, random: np.random.Generator
) -> np.ndarray:
    """Return what a microphone records: later by the way, with an echo, filtered, with noise, by the camera's clock."""
    own = np.arange(round(length_s / rate * SOUND_HZ)) / SOUND_HZ
    echo = random.uniform(0.011, 0.03)
    at = (offset + rate * own - way_s) * SOUND_HZ
    heard = np.interp(at, np.arange(len(sound)), sound, 0, 0)
    heard += 0.4 * np.interp(at - echo * SOUND_HZ, np.arange(len(sound)), sound, 0, 0)
    band = (random.uniform(60, 250), random.uniform(3000, 8000))
    heard = sosfilt(butter(1, band, "bandpass", fs=SOUND_HZ, output="sos"), heard)
    return random.uniform(0.4, 1.0) * (heard + 0.003 * random.standard_normal(len(heard)))


def _join(video: Path, sound: np.ndarray | None, path: Path, turned: bool) -> None:
    """Write video and sound into one file."""
    command = ["ffmpeg", "-v", "error", "-y", "-i", str(video)]
    wave = video.with_suffix(".wav")
    if sound is not None:
        wavfile.write(wave, SOUND_HZ, np.clip(sound * 32767, -32768, 32767).astype(np.int16))
        command += ["-i", str(wave), "-c:a", "aac", "-b:a", "96k"]
    command += ["-c:v", "copy", "-video_track_timescale", "90000"]
    if turned:
        command += ["-metadata:s:v:0", "rotate=270"]
    subprocess.run([*command, str(path)], check=True)
    video.unlink()
    wave.unlink(missing_ok=True)


#: method: how its folders are made, the methods that are used, and the calibration
CASES = {
    "sound, clap": (Recipe("clap"), ("sound",)),
    "sound, steps": (Recipe("steps"), ("sound",)),
    "sound, other": (Recipe("other"), ("sound",)),
    "flash": (Recipe(flash=True), ("flash",)),
    "person": (Recipe(), ("person",)),
    "person, known cameras": (Recipe(calibrated=True), ("person",)),
}  # fmt: skip


def errors_ms(folder: Path, made: dict[str, Made], ways: Sequence[str]) -> tuple[np.ndarray, list[str]]:
    """Return (3, N) of the cameras that are synchronised the error, the error beyond the way of the sound, and sigma,
    ms; and the names of the others."""
    recordings = read_raw(folder)
    _, cameras = read_cameras(folder, recordings)
    done = synchronise(recordings, cameras, ways)
    first = made[recordings[0].name]
    rows, unsure = [], []
    for c, recording in enumerate(recordings):
        own, true = float(np.mean(recording.span)), made[recording.name]
        if c in done.decision.unsure:
            unsure.append(recording.name)
        elif c:
            found = first.offset_s + first.rate * done.clocks.common(c, own)
            late = found - true.offset_s - true.rate * own
            way = first.way_s - true.way_s if ways == ("sound",) else 0.0
            rows.append((late, late - way, float(done.clocks.offset_sigma_s[c])))
    return 1000 * np.abs(np.array(rows).reshape(-1, 3).T), unsure


def main() -> None:
    """Print a table of errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--cases", default=";".join(CASES), help="separated by semicolons")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="keep the folders here")
    given = parser.parse_args()
    print("| capture | method | largest error, ms | without the way of the sound, ms | σ, ms | not sure |")
    print("|---|---|---|---|---|---|")
    for capture in given.captures:
        for name in given.cases.split(";"):
            recipe, ways = CASES[name]
            with tempfile.TemporaryDirectory() as temporary:
                where = (given.keep or Path(temporary)) / f"{capture.name}-{name.replace(', ', '-').replace(' ', '-')}"
                made = make_raw(capture, where, replace(recipe, seed=given.seed))
                try:
                    errors, unsure = errors_ms(where, made, ways)
                except TkError as error:
                    print(f"| {capture.name} | {name} | {error} | | | |", flush=True)
                    continue
                late, beyond, sigma = errors.max(axis=1) if errors.size else np.full(3, np.nan)
                text = f"{late:.1f} | {beyond:.1f} | {sigma:.1f}" if errors.size else "– | – | –"
                print(f"| {capture.name} | {name} | {text} | {len(unsure)} of {len(made)} |", flush=True)


if __name__ == "__main__":
    main()
