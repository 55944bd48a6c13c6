"""RAW folders with known offsets, made of captures, and the errors of `tk sync` on them.

    python -m scripts.raw_folders ../shared/captures/walk ../shared/captures/dance    # a table, milliseconds
    python -m scripts.raw_folders CAPTURE --seeds 0 1 --keep DIR                      # keep the folders, or use them

The frames of a capture are played back and forth, with turns at random, after a part with the empty scene if the
capture has one. Each camera starts up to 60 s after the first, has a rate and a clock of its own, and leaves out
images; one is stored turned. The person claps or steps; the sound has the way to each camera, noise, and a filter for
each microphone. Where a lamp is switched, the cameras expose between the instants of the capture, each at a phase of
its own: such a folder is of no use for motion. A time stamp is the middle of the exposure.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product
from pathlib import Path

import av
import cv2
import h5py
import numpy as np
import tomli_w
from scipy.io import wavfile
from scipy.signal import butter, sosfilt

from tk.errors import TkError
from tk.io.captures.calibration import read_calibration
from tk.io.captures.capture_toml import read_settings
from tk.io.toml import load_toml
from tk.model.cameras.camera import Camera, Rig
from tk.synchronise.raw import read_raw
from tk.synchronise.run import synchronise
from tk.synchronise.travel import SOUND_M_S

SOUND_HZ = 48000


@dataclass(frozen=True)
class Recipe:
    """How a RAW folder is made.

    Attributes:
        sound: "clap", "steps" or "other" (each camera hears something else).
        flash: whether a lamp is switched on and off twice.
        apart_s: latest start after the first camera.
        length_s: time that all cameras have in common.
        empty_s: length of the part with the empty scene, if the capture has one.
        ppm: largest clock error.
        seed: of everything that is random.
    """

    sound: str = "clap"
    flash: bool = False
    apart_s: float = 60.0
    length_s: float = 30.0
    empty_s: float = 4.0
    ppm: float = 30.0
    seed: int = 0


@dataclass(frozen=True)
class Made:
    """A camera of a RAW folder: common time = offset + rate · own time; and the mean time that sound takes to it."""

    offset_s: float
    rate: float
    way_s: float


def make_raw(capture: Path, folder: Path, recipe: Recipe) -> dict[str, Made]:
    """Write a RAW folder and return the clocks of its cameras."""
    random = np.random.default_rng(recipe.seed)
    rig = true_rig(capture)
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
    played = _sound(recipe, capture, shown, fps, random)
    for c, (name, path) in enumerate(videos.items()):
        frames = _read(path)
        scenes = _read(capture / "background" / name) if has_empty else []
        rate = 1 + (random.uniform(-1, 1) * recipe.ppm * 1e-6 if c else 0.0)
        first = int(np.ceil(starts[c] * fps))
        end = ticks - random.integers(0, round(fps))
        step = 1.0
        if c == 1 and fps > 20:  # another rate
            step = 1.25
            chosen = np.unique(np.rint(np.arange(first, end - 1, step)).astype(int))
        elif fps > 50:  # half of the images, others in each camera
            step = 2.0
            chosen = np.arange(first + c % 2, end, 2)
        else:
            chosen = np.arange(first, end)
        if c == 2:  # a variable rate
            chosen = chosen[(random.random(len(chosen)) > 0.1) | (np.arange(len(chosen)) == 0)]
        # shares of an interval in which a row is exposed, and in which the rows are read, and the phase, seconds
        exposed, read, phase = random.uniform([0.15, 0.15, -0.5], [0.6, 0.4, 0.5]) * step / fps
        phase = phase if recipe.flash else 0.0
        offset = chosen[0] / fps + phase
        turned = c == 3
        part = folder / f"{name}.part.mp4"
        _write_video(part, [
            (
                (t / fps + phase - offset) / rate,
                _lit(
                    scenes[t % len(scenes)] if has_empty and empty[t] else frames[min(shown[t] + late.get(name, 0),
                                                                                     len(frames) - 1)],
                    t / fps + phase, exposed, read, lamp,
                ),
            )
            for t in chosen.tolist()
        ], turned)  # fmt: skip
        center = rig[rig.names.index(name)].center
        ways = [float(np.linalg.norm(place - center)) / SOUND_M_S for _, place, _ in played]
        bursts = _sound(recipe, capture, shown, fps, random) if recipe.sound == "other" else played
        sound = _heard(bursts, center, offset, rate, (end - first) / fps, random)
        _join(part, sound, folder / f"{name}.mp4", turned)
        made[name] = Made(offset, rate, float(np.mean(ways)))
    (folder / "truth.toml").write_text(
        tomli_w.dumps({name: {"offset": m.offset_s, "rate": m.rate, "way": m.way_s} for name, m in made.items()})
    )
    return made


def true_rig(capture: Path) -> Rig:
    """Return the cameras that recorded a capture; its own calibration may be wrong."""
    true = capture / "calibration_true.toml"
    return read_calibration(true if true.exists() else capture / "calibration.toml").rig


def _late(capture: Path) -> dict[str, int]:
    """Return by how many frames the videos of a capture are late, negative; the folders have none of it."""
    file = capture / "offset.txt"
    lines = file.read_text().splitlines() if file.exists() else []
    return {name: -int(frames) for name, frames in (line.split() for line in lines if not line.startswith("#"))}


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
        return [np.asarray(cv2.imread(str(path)))]
    frames: list[np.ndarray] = []
    video = cv2.VideoCapture(str(path))
    while True:
        ok, frame = video.read()
        if not ok:
            return frames
        frames.append(frame)


def _lit(frame: np.ndarray, time: float, exposed: float, read: float, lamp: np.ndarray) -> np.ndarray:
    """Return a frame with the light of a lamp that is switched on and off at these times; rows are read one by one.
    ``time``: the middle of the exposure of the middle row; ``exposed``, ``read``: of a row, and of all, seconds."""
    if not len(lamp) or time < lamp[0] - 1 or time > lamp[-1] + 1:
        return frame
    begin = time - exposed / 2 + read * (np.arange(len(frame)) / len(frame) - 0.5)
    light = np.zeros(len(frame))
    for on, off in lamp.reshape(-1, 2):
        light += np.clip(np.minimum(begin + exposed, off) - np.maximum(begin, on), 0, None) / exposed
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


#: a sound in the room: common time, seconds; place, metres; samples at :data:`SOUND_HZ`
Burst = tuple[float, np.ndarray, np.ndarray]


def _sound(recipe: Recipe, capture: Path, shown: np.ndarray, fps: float, random: np.random.Generator) -> list[Burst]:
    """Return the claps or steps of the person."""
    clap, total_s = recipe.sound == "clap", recipe.apart_s + recipe.length_s
    times = np.array([recipe.apart_s + 5.1]) if clap else np.arange(recipe.apart_s / 2, total_s - 1, 0.55)
    truth = capture / "truth.h5"
    if truth.exists():
        with h5py.File(truth) as file:
            body = np.nanmean(np.asarray(file["joints/position"]), axis=1)
    else:
        volume = read_settings(capture / "capture.toml").volume
        assert volume is not None
        body = np.array([volume.center])
    bursts = []
    for time in times + random.normal(0, 0.04, len(times)):
        place = np.array(body[min(int(shown[round(time * fps)]), len(body) - 1)])
        place[2] = 1.3 if clap else 0.0
        samples = random.standard_normal(2400) * np.exp(-np.arange(2400) / 300)
        bursts.append((float(time), place, (0.5 if clap else 0.1) * samples))
    return bursts


def _heard(
    bursts: list[Burst], center: np.ndarray, offset: float, rate: float, length_s: float, random: np.random.Generator
) -> np.ndarray:
    """Return what a microphone records: later by the way, with an echo, filtered, with noise, by the camera's clock."""
    own = np.arange(round(length_s / rate * SOUND_HZ)) / SOUND_HZ
    echo = random.uniform(0.011, 0.03)
    heard = np.zeros(len(own))
    for time, place, samples in bursts:
        for late, loud in ((0.0, 1.0), (echo, 0.4)):
            begin = time + float(np.linalg.norm(place - center)) / SOUND_M_S + late
            near = slice(*np.searchsorted(offset + rate * own, [begin, begin + len(samples) / SOUND_HZ]))
            at = (offset + rate * own[near] - begin) * SOUND_HZ
            heard[near] += loud * np.interp(at, np.arange(len(samples)), samples, 0, 0)
    band = (random.uniform(60, 250), random.uniform(3000, 8000))
    heard = sosfilt(butter(1, band, "bandpass", fs=SOUND_HZ, output="sos"), heard)
    return random.uniform(0.4, 1.0) * (heard + 0.003 * random.standard_normal(len(heard)))


def _join(video: Path, sound: np.ndarray, path: Path, turned: bool) -> None:
    """Write video and sound into one file."""
    wave = video.with_suffix(".wav")
    wavfile.write(wave, SOUND_HZ, np.clip(sound * 32767, -32768, 32767).astype(np.int16))
    command = ["ffmpeg", "-v", "error", "-y", "-i", str(video), "-i", str(wave), "-c:a", "aac", "-b:a", "96k"]
    command += ["-c:v", "copy", "-video_track_timescale", "90000"]
    if turned:
        command += ["-metadata:s:v:0", "rotate=270"]
    subprocess.run([*command, str(path)], check=True)
    video.unlink()
    wave.unlink()


FOLDERS = {"lamp": Recipe("clap", flash=True), "steps": Recipe("steps"), "other": Recipe("other")}
#: method: its folder, the methods that are used, and whether the cameras are known
CASES = {
    "sound, clap": ("lamp", "sound", False),
    "sound, clap, known cameras": ("lamp", "sound", True),
    "flash": ("lamp", "flash", False),
    "sound, steps": ("steps", "sound", False),
    "sound, steps, known cameras": ("steps", "sound", True),
    "person": ("steps", "person", False),
    "person, known cameras": ("steps", "person", True),
    "sound, other": ("other", "sound", False),
}


def errors_ms(folder: Path, cameras: Sequence[Camera], way: str) -> tuple[np.ndarray, list[str]]:
    """Return (N, 3) of the cameras that are synchronised the error, the error beyond the way of the sound, and sigma,
    ms; and the names of the others."""
    recordings = read_raw(folder)
    made = {name: Made(*values.values()) for name, values in load_toml(folder / "truth.toml").items()}
    done = synchronise(recordings, cameras, (way,))
    first = made[recordings[0].name]
    rows, unsure = [], []
    for c, recording in enumerate(recordings):
        own, true = float(np.mean(recording.span)), made[recording.name]
        if c in done.decision.unsure:
            unsure.append(recording.name)
        elif c:
            found = first.offset_s + first.rate * done.clocks.common(c, own)
            late = found - true.offset_s - true.rate * own
            heard = late - (first.way_s - true.way_s) * (way == "sound" and not cameras)
            rows.append((late, heard, float(done.clocks.offset_sigma_s[c])))
    return 1000 * np.array(rows).reshape(-1, 3), unsure


def main() -> None:
    """Print a table of errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--cases", default=";".join(CASES), help="separated by semicolons")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--keep", type=Path, help="keep the folders here, or use those of an earlier run")
    given = parser.parse_args()
    print("| capture | seed | method | errors, ms | beyond the way of the sound, ms | σ, ms | error / σ | not sure |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as temporary:
        for capture in given.captures:
            calibration = read_calibration(capture / "calibration.toml").rig
            for seed, name in product(given.seeds, given.cases.split(";")):
                kind, way, known = CASES[name]
                folder = (given.keep or Path(temporary)) / f"{capture.name}-{kind}-{seed}"
                if not (folder / "truth.toml").exists():
                    make_raw(capture, folder, replace(FOLDERS[kind], seed=seed))
                names = sorted(path.stem for path in folder.glob("*.mp4"))
                cameras = [calibration[calibration.names.index(each)] for each in names] if known else []
                try:
                    errors, unsure = errors_ms(folder, cameras, way)
                except TkError as error:
                    print(f"| {capture.name} | {seed} | {name} | {error} |", flush=True)
                    continue
                cells = [" ".join(f"{value:+.1f}" for value in column) for column in errors.T[:2]]
                cells += [" ".join(f"{value:.1f}" for value in errors[:, 2])]
                cells += [f"{np.abs(errors[:, 0] / errors[:, 2]).max():.1f}" if len(errors) else "–"]
                print(f"| {capture.name} | {seed} | {name} | {' | '.join(cells)} | {' '.join(unsure)} |", flush=True)


if __name__ == "__main__":
    main()
