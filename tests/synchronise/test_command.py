"""`tk sync` on small RAW folders, whole and with faults."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import numpy as np
import pytest
import tomli_w
from click.testing import CliRunner, Result
from numpy.typing import NDArray

from tests.synchronise.scenes import ring, wander, watch
from tests.synchronise.test_sound import steps
from tk.cli import main
from tk.io.captures.calibration import camera_table
from tk.io.captures.capture import open_capture
from tk.io.importers.videos import natural
from tk.io.toml import load_toml
from tk.synchronise.looks import Look
from tk.synchronise.raw import list_files
from tk.synchronise.sound import RATE

NAMES = ("a", "b", "c")
STARTS = (0.0, 2.2, 1.0)
LENGTH_S = 12.0


def write(path: Path, look: Look, sound: NDArray[np.float64] | None = None, timecode: str | None = None) -> None:
    """Write images and sound as a video."""
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=30, options={"preset": "ultrafast", "crf": "20"})
        video.height, video.width, video.pix_fmt = (*look.greys.shape[1:], "yuv420p")
        video.codec_context.time_base = video.time_base = Fraction(1, 90000)
        if timecode:
            video.metadata["timecode"] = timecode
        audio = None if sound is None else container.add_stream("aac", rate=RATE, layout="mono")
        for time, grey in zip(look.times_s, look.greys, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(grey), "gray")
            frame.pts, frame.time_base = round(time * 90000), Fraction(1, 90000)
            container.mux(video.encode(frame))
        container.mux(video.encode())
        if audio is not None and sound is not None:
            part = av.AudioFrame.from_ndarray(sound[None].astype(np.float32), "fltp", "mono")
            part.sample_rate, part.pts = RATE, 0
            container.mux(audio.encode(part))
            container.mux(audio.encode())


@cache
def seen(c: int, start_s: float = 0.0, length_s: float = LENGTH_S) -> Look:
    return watch(ring(3)[c], [wander(0), wander(1)], STARTS[c] + start_s, length_s, (25.0, 25.0, 20.0)[c], seed=c)


def heard(c: int, sound: NDArray[np.float64]) -> NDArray[np.float64]:
    noise = 0.01 * np.random.default_rng(c).standard_normal(round(LENGTH_S * RATE))
    first = round(STARTS[c] * RATE)
    return np.clip(0.3 * sound[first : first + len(noise)] + noise, -1, 1)


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A RAW folder with sound; b's video shows what it should only together with the calibration."""
    folder = tmp_path_factory.mktemp("raw") / "RAW"
    folder.mkdir()
    sound = steps(0, LENGTH_S + 4)
    for c, name in enumerate(NAMES):
        write(folder / f"{name}.mp4", seen(c), heard(c, sound))
    return folder


@pytest.fixture
def copy(raw: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(raw, tmp_path / "RAW"))


def calibrate(folder: Path) -> None:
    cameras = {name: {**camera_table(camera), "name": name} for name, camera in zip(NAMES, ring(3), strict=True)}
    (folder / "calibration.toml").write_text(tomli_w.dumps(cameras))


def run(folder: Path, *options: str) -> tuple[Result, Path]:
    output = folder.parent / "CAPTURE"
    return CliRunner().invoke(main, ["sync", str(folder), "-o", str(output), "-q", *options]), output


def test_raw_folder_becomes_a_capture(copy: Path) -> None:
    calibrate(copy)
    result, capture = run(copy, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)["cameras"]
    assert [found[name]["offset_s"] for name in NAMES] == pytest.approx(STARTS, abs=0.008)
    assert found["b"]["sigma_s"] < 0.02 and "known cameras" in found["b"]["method"]
    document = load_toml(capture / "capture.toml")
    assert (capture / document["videos"]["b"]["path"]).resolve() == copy / "b.mp4"
    assert document["from"] == pytest.approx(2.2, abs=0.01) and "fps" not in document
    assert json.loads(result.stdout)["fps"] == open_capture(capture).fps == 20.0
    assert sorted(path.name for path in capture.iterdir()) == ["calibration.toml", "capture.toml", "sync.png"]


def test_second_run_does_not_replace_a_capture(copy: Path) -> None:
    offsets = ("--offsets", "a=0,b=2.2,c=1")
    assert run(copy, *offsets)[0].exit_code == 0
    result, capture = run(copy, *offsets)
    assert result.exit_code == 2 and "--force" in result.output
    (capture / "capture.toml").write_text((capture / "capture.toml").read_text() + "\n[subject]\nheight = 1.7\n")
    assert run(copy, *offsets, "--force", "--from", "3")[0].exit_code == 0
    document = load_toml(capture / "capture.toml")
    assert document["subject"]["height"] == 1.7 and document["from"] == 3.0


def test_rate_of_millisecond_time_stamps_is_that_of_the_camera(copy: Path) -> None:
    calibrate(copy)
    for c, name in enumerate(NAMES):
        (copy / f"{name}.mp4").unlink()
        own = np.arange(120) / 30
        write(copy / f"{name}.mkv", Look(own, watch(ring(3)[c], [], 0.0, 4.0, 30.0, c).greys))
    result, capture = run(copy, "--offsets", "a=0,b=0,c=0", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["fps"] == open_capture(capture).fps == 30.0


def test_rate_that_is_given_is_written_and_one_of_an_earlier_run_is_not_kept(copy: Path) -> None:
    assert run(copy, *HAND, "--fps", "10")[0].exit_code == 0
    capture = copy.parent / "CAPTURE"
    assert load_toml(capture / "capture.toml")["fps"] == 10.0
    assert run(copy, *HAND, "--force")[0].exit_code == 0
    assert "fps" not in load_toml(capture / "capture.toml")


def test_from_is_in_seconds_of_the_first_video_whatever_its_offset(copy: Path) -> None:
    result, capture = run(copy, "--offsets", "a=100,b=102.2,c=101", "--from", "3")
    assert result.exit_code == 0, result.output
    document = load_toml(capture / "capture.toml")
    assert document["from"] == 3.0
    assert [document["videos"][name]["offset"] for name in NAMES] == pytest.approx([0, 2.2, 1])


def test_capture_with_a_background_gets_no_second_empty_scene(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tk.synchronise.text.find_empty", lambda looks, clocks: (2.5, 4.5))
    (copy.parent / "CAPTURE" / "background").mkdir(parents=True)
    result, capture = run(copy, *HAND)
    assert result.exit_code == 0 and "empty scene: in background/" in result.output, result.output
    assert "background" not in load_toml(capture / "capture.toml")
    result, _ = run(copy, *HAND, "--force", "--empty", "3:4")
    assert result.exit_code == 2 and "has background/ of its own" in result.stderr


def test_folder_that_is_named_as_a_video_is_no_video(copy: Path) -> None:
    (copy / "d.mp4").mkdir()
    assert list(list_files(copy)) == list(NAMES)


def test_digits_that_are_no_number_are_text() -> None:
    assert sorted(["10", "²", "2"], key=natural) == ["²", "2", "10"]


def test_another_calibration_in_the_capture_is_replaced_only_if_asked_for(copy: Path) -> None:
    offsets = ("--offsets", "a=0,b=2.2,c=1")
    calibrate(copy)
    capture = copy.parent / "CAPTURE"
    capture.mkdir()
    (capture / "calibration.toml").write_text("# of another day\n")
    result, _ = run(copy, *offsets)
    assert result.exit_code == 2 and "differs from" in result.output and not (capture / "capture.toml").exists()
    assert run(copy, *offsets, "--force")[0].exit_code == 0
    assert (capture / "calibration.toml").read_bytes() == (copy / "calibration.toml").read_bytes()


def test_chapters_are_one_video(copy: Path) -> None:
    (copy / "b.mp4").unlink()
    (copy / "b").mkdir()
    write(copy / "b" / "GX020012.MP4", seen(1, 6.0, 6.0))
    write(copy / "b" / "GX010012.MP4", seen(1, 0.0, 6.0))
    calibrate(copy)
    result, capture = run(copy)
    assert result.exit_code == 0, result.output
    part = load_toml(capture / "capture.toml")["videos"]["b"]
    assert [Path(path).name for path in part["path"]] == ["GX010012.MP4", "GX020012.MP4"]
    assert part["offset"] == pytest.approx(2.2, abs=0.01)


def other_sound(folder: Path) -> None:
    still = seen(1)
    other = Look(still.times_s, watch(ring(3)[1], [wander(8), wander(9)], 70.0, LENGTH_S, 25.0).greys)
    write(folder / "b.mp4", other, heard(1, steps(9, LENGTH_S + 4)))


def contradicting(folder: Path) -> None:
    """The sound of b is 1 s late, its pictures are right."""
    write(folder / "b.mp4", seen(1), np.roll(heard(1, steps(0, LENGTH_S + 4)), RATE))
    calibrate(folder)


def mirrored(folder: Path) -> None:
    look = seen(1)
    write(folder / "b.mp4", Look(look.times_s, look.greys[:, :, ::-1]))
    calibrate(folder)


def constant(folder: Path) -> None:
    look = seen(1)
    write(folder / "b.mp4", Look(look.times_s, np.repeat(look.greys[:1], len(look.greys), axis=0)))


def no_sound_no_motion(folder: Path) -> None:
    noise = np.random.default_rng(0).normal(100, 1.5, (250, 90, 160))
    write(folder / "b.mp4", Look(np.arange(250) / 25, noise.astype(np.uint8)))


def another_name(folder: Path) -> None:
    calibrate(folder)
    (folder / "b.mp4").rename(folder / "x.mp4")


def only_one(folder: Path) -> None:
    for name in ("b", "c"):
        (folder / f"{name}.mp4").unlink()


def small(path: Path, shape: tuple[int, int] = (90, 160)) -> None:
    """Write three seconds of noise."""
    grey = np.random.default_rng([*path.name.encode()]).normal(100, 20, (30, *shape))
    write(path, Look(np.arange(30) / 10, np.clip(grey, 0, 255).astype(np.uint8)))


def chapter_gap(folder: Path) -> None:
    (folder / "b.mp4").unlink()
    (folder / "b").mkdir()
    for number in (1, 3):
        small(folder / "b" / f"GX0{number}0012.MP4")


def created(path: Path, time: str) -> None:
    """Write the creation time of a video into it."""
    part = path.with_name(f"part{path.suffix}")
    with av.open(str(path)) as before, av.open(str(part), "w") as after:
        after.metadata["creation_time"] = time
        stream = after.add_stream_from_template(before.streams.video[0])
        for packet in before.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                after.mux(packet)
    part.rename(path)


def chapters(folder: Path, *times: str) -> None:
    """Write chapters of b that were created at these times."""
    (folder / "b.mp4").unlink()
    (folder / "b").mkdir()
    for number, time in enumerate(times):
        small(folder / "b" / f"CLIP{number}.MP4")
        created(folder / "b" / f"CLIP{number}.MP4", f"2026-01-01T{time}Z")


def other_size(folder: Path, shape: tuple[int, int]) -> None:
    calibrate(folder)
    small(folder / "b.mp4", shape)


HAND = ("--offsets", "a=0,b=2.2,c=1")
FAULTS: dict[str, tuple[Callable[[Path], object], tuple[str, ...], str]] = {
    "other sound and pictures": (other_sound, (), "camera b: not sure when it was recorded: its sound is another one"),
    "contradiction": (contradicting, (), "camera b: not sure when it was recorded: its sound and its pictures"),
    "mirrored": (mirrored, (), "camera b: its picture is mirrored"),
    "constant": (constant, (), "camera b: shows the same picture all the time"),
    "no sound, no motion": (no_sound_no_motion, (), "camera b: not sure when it was recorded: it has no sound"),
    "one second": (lambda folder: write(folder / "b.mp4", seen(1, 0, 1.0)), (), "camera b: is 1.0 s long"),
    "one camera": (only_one, (), "holds one camera, a"),
    "two minutes late": (lambda _: None, ("--offsets", "a=0,b=120,c=1"), "camera b: has no time in common"),
    "camera without offset": (lambda _: None, ("--offsets", "a=0,b=2"), "camera c is missing"),
    "same file twice": (lambda f: shutil.copy(f / "a.mp4", f / "b.mp4"), (), "b.mp4: is the same file as"),
    "same name twice": (lambda f: shutil.copy(f / "a.mp4", f / "a.mov"), (), "another file has the same name"),
    "link to nothing": (lambda f: (f / "d.mp4").symlink_to(f / "gone.mp4"), (), "d.mp4"),
    "missing chapter": (chapter_gap, (), "GX030012.MP4: chapter 2 of this recording is missing"),
    "chapters out of order": (
        lambda f: chapters(f, "10:20:00", "10:00:00"), (), "CLIP1.MP4: camera b: was recorded 1200 s before CLIP0.MP4",
    ),
    "two recordings": (
        lambda f: chapters(f, "10:00:00", "10:20:00"), (), "CLIP1.MP4: camera b: was created 1200 s after CLIP0.MP4",
    ),
    "other resolution": (lambda f: other_size(f, (180, 320)), (), "camera b: is 320×180, but calibration.toml"),
    "turned": (lambda f: other_size(f, (160, 90)), (), "camera b: is 90×160, but calibration.toml is of 160×90"),
    "broken calibration": (lambda f: (f / "calibration.toml").write_text("a = ["), (), "calibration.toml"),
    "from after the end": (lambda _: None, (*HAND, "--from", "300"), "--from 300: all cameras show"),
    "empty outside": (lambda _: None, (*HAND, "--empty", "30:40"), "--empty 30:40: all cameras show"),
    "unknown camera in offsets": (lambda _: None, ("--offsets", "a=0,b=2,x=1"), "there is no camera 'x'"),
    "offset without number": (lambda _: None, ("--offsets", "a=0,b=two"), "--offsets a=0,b=two"),
    "unknown camera": (lambda _: None, ("--cameras", "a,x"), "has no camera 'x'"),
    "unknown method": (lambda _: None, ("--by", "smell"), "--by smell: must be one of"),
    "ends before it begins": (lambda _: None, ("--from", "5", "--to", "3"), "ends before it begins"),
    "name": (another_name, (), "camera x: has no camera in"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_one_line_that_names_the_camera(copy: Path, fault: str) -> None:
    spoil, options, line = FAULTS[fault]
    spoil(copy)
    result, capture = run(copy, *options)
    assert result.exit_code == 2, result.output
    assert line in result.stderr and result.stderr.strip().count("\n") == 0, result.stderr
    assert not (capture / "capture.toml").exists()


def test_suggested_offsets_are_accepted_once_seconds_are_filled_in(copy: Path) -> None:
    """Also where names have spaces, as a shell reads the line; offsets that are known are kept."""
    no_sound_no_motion(copy)
    (copy / "c.mp4").rename(copy / "the third.mp4")
    given = shlex.split(run(copy)[0].stderr.split("give --offsets ")[1])[0]
    assert re.fullmatch(r"a=0,b=SECONDS,the third=-?\d+\.\d{4}", given), given
    result, capture = run(copy, "--offsets", given.replace("SECONDS", "2.2"))
    assert result.exit_code == 0 and (capture / "capture.toml").exists(), result.stderr
