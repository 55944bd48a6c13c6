"""`tk demo --raw`: the videos it makes, and the way from them to a result."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import av
import numpy as np
import pytest

from tests.conftest import Tk
from tk.commands.demo_raw import CLAPS_S, EMPTY_S, PERSON_S, SQUARE_M, make_raw
from tk.io.captures.calibration import read_calibration
from tk.io.results.reader import read_result
from tk.io.toml import load_toml
from tk.synchronise.looks import pictures_at
from tk.synchronise.raw import Recording, read_raw
from tk.synchronise.sound import RATE, read_track

#: seconds by which the videos start later than the first one, as the module says of them
STARTS_S = {"cam1": 0.0, "cam2": 1.4, "cam3": 3.2, "cam4": 0.8, "cam5": 2.6}


@pytest.fixture(scope="module")
def fourth(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The video of the camera that stands on its side."""
    folder = tmp_path_factory.mktemp("demo") / "RAW"
    told: list[str] = []
    make_raw(folder, told.append, ["cam4"])
    assert told == [f"making {folder / 'cam4'}.mp4"]
    # a folder of one video is refused, and so is the same file twice
    (folder / "other.mp4").write_bytes((folder / "cam4.mp4").read_bytes() + b"\0\0\0\x08free")
    return read_raw(folder)[0]


@pytest.mark.slow
def test_images_have_the_times_of_a_camera_that_starts_later(fourth: Recording) -> None:
    assert len(fourth.times_s) == round((37.0 - STARTS_S["cam4"]) * 15)
    np.testing.assert_allclose(fourth.times_s, np.arange(len(fourth.times_s)) / 15, atol=1e-4)
    assert fourth.dropped == 0


@pytest.mark.slow
def test_the_camera_on_its_side_is_shown_upright(fourth: Recording) -> None:
    (path,) = fourth.paths
    with av.open(str(path)) as video:
        stored = video.streams.video[0]
        assert stored.height > stored.width
    with as_file(files("tk") / "data" / "demo") as demo:
        for common_s, part, frame in ((EMPTY_S + 0.5, "background", 0), (PERSON_S + 2, "videos", 30)):
            with av.open(str(demo / part / "cam4.mp4")) as video:
                images = [image.to_ndarray(format="bgr24") for image in video.decode(video=0)]
            (shown,) = pictures_at(fourth, [common_s - STARTS_S["cam4"]], images[0].shape[0])
            assert shown.shape == images[0].shape
            assert np.abs(shown.astype(float) - images[min(frame, len(images) - 1)]).mean() < 4


@pytest.mark.slow
def test_claps_are_heard_after_the_way_of_the_sound(fourth: Recording) -> None:
    track = read_track(fourth)
    assert track is not None
    with as_file(files("tk") / "data" / "demo" / "calibration.toml") as path:
        (camera,) = (camera for camera in read_calibration(path).rig if camera.name == "cam4")
    way_s = float(np.linalg.norm(camera.center - [0, 0, 1.2])) / 343
    loud = np.flatnonzero(np.abs(track.samples) > 0.5 * np.abs(track.samples).max()) / RATE + track.start_s
    begins = loud[np.diff(loud, prepend=-1.0) > 0.2]
    np.testing.assert_allclose(begins, [clap - STARTS_S["cam4"] + way_s for clap in CLAPS_S], atol=0.004)


def test_only_what_the_demo_wrote_is_replaced(tk: Tk, tmp_path: Path) -> None:
    video = tmp_path / "RAW" / "cam1.mp4"
    video.parent.mkdir()
    video.write_bytes(b"mine")
    tk("demo", "--raw", "-o", tmp_path).complaint(str(tmp_path), "exists; add --force")
    tk("demo", "--raw", "-o", tmp_path, "--force").complaint("not of an earlier tk demo --raw", "choose a new folder")
    assert video.read_bytes() == b"mine"


@pytest.mark.slow
def test_every_command_succeeds_from_raw_videos_to_a_result(tk: Tk, tmp_path: Path) -> None:
    folder = tmp_path / "demo-raw"
    ran = tk("demo", "--raw", "-o", folder, "--no-report")
    assert ran.code == 0, ran.err
    typed = (folder / "commands.txt").read_text().splitlines()
    assert [line.split()[1] for line in typed] == ["sync", "calibrate", "sync", "inspect", "track"]
    assert all(f"$ {line}" in ran.out for line in typed)
    assert f"--square {SQUARE_M:g}" in typed[1]
    third = read_raw(folder / "RAW")[2]
    intervals = np.diff(third.times_s)
    assert abs(intervals.mean() - 1001 / 30000) < 1e-5 and intervals.std() > 1e-3
    for capture in ("BOARDS", "CAPTURE"):
        found = load_toml(folder / capture / "capture.toml")["videos"]
        for name, start_s in STARTS_S.items():
            assert abs(found[name]["offset"] - start_s) < 0.01
        assert (folder / capture / "sync.png").is_file()
    assert "\ngood: 5 cameras" in ran.out and "No problems found." in ran.out
    result = read_result(folder / "result.h5")
    assert len(result.joints) == 75 and np.isfinite(result.joints).all()
    row = next(line for line in ran.out.splitlines() if line.startswith("all 15 "))
    assert float(row.split()[2]) < 3.0  # mean error, cm
