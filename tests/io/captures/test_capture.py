from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.conftest import FRAMES, development_capture, refused
from tests.io.conftest import (
    CENTER,
    HEIGHT,
    WIDTH,
    MakeCapture,
    calibration_tables,
    picture,
    read_tag,
    write_picture,
    write_toml,
    write_video,
)
from tk.errors import CalibrationError, CaptureError, VideoError, VolumeError
from tk.io.captures.capture import FrameReader, open_capture
from tk.model.cameras.up import up_text


def write_masks(folder: Path, cameras: int, frames: int) -> None:
    for camera in range(cameras):
        for k in range(frames):
            mask = np.zeros((HEIGHT, WIDTH), np.uint8)
            mask[k, camera] = 255
            write_picture(folder / f"cam{camera + 1}" / f"{k:06d}.png", mask)


def test_settings_of_capture_toml_are_used(make_capture: MakeCapture) -> None:
    folder = make_capture(
        settings={
            "name": "dance",
            "fps": 20.0,
            "up": "-Y",
            "volume": {"center": [0.1, 0.0, 1.0], "size": [1.0, 1.5, 2]},
            "subject": {"height": 1.7},
            "init": {"frame": 3, "pose": "any"},
        }
    )
    capture = open_capture(folder)
    assert (capture.name, capture.fps, capture.up, capture.frame_count) == ("dance", 20.0, "-y", 12)
    assert capture.volume.center == (0.1, 0.0, 1.0) and capture.volume.size == (1.0, 1.5, 2.0)
    assert (capture.subject_height_m, capture.init_frame, capture.init_pose) == (1.7, 3, "any")
    np.testing.assert_array_equal(capture.up_axis, [0, -1, 0])
    assert capture.rig.names == ("cam1", "cam2", "cam3")
    assert not capture.has_masks and capture.background() is None
    (note,) = capture.warnings  # the cameras are upright along z
    assert "up = -y" in note
    changed: Any = capture
    with pytest.raises(dataclasses.FrozenInstanceError):
        changed.fps = 1.0


def test_up_may_be_any_direction(make_capture: MakeCapture) -> None:
    capture = open_capture(make_capture(settings={"up": [0.02, -0.99, 0.01]}))
    expected = np.array([0.02, -0.99, 0.01])
    np.testing.assert_allclose(capture.up_axis, expected / np.linalg.norm(expected), atol=1e-15)
    assert open_capture(make_capture(settings={"up": [0.0, -2.0, 0.0]}, name="axis")).up == "-y"


def test_settings_of_capture_toml_have_defaults(make_capture: MakeCapture) -> None:
    capture = open_capture(make_capture(settings={}, name="ring"))
    assert (capture.name, capture.fps, capture.up) == ("ring", 15.0, "z")
    assert (capture.subject_height_m, capture.init_frame, capture.init_pose) == (None, 0, "da-vinci")
    assert (capture.volume.lower < CENTER).all() and (capture.volume.upper > CENTER).all()
    assert len(capture.warnings) == 1 and "no [volume]" in capture.warnings[0]


def test_frames_are_in_order_and_synchronised(make_capture: MakeCapture) -> None:
    capture = open_capture(make_capture())
    for start, stop, expected in ((0, None, range(12)), (5, 9, range(5, 9)), (7, 99, range(7, 12))):
        with capture.frames(start, stop) as frames:
            seen = [(fs.index, [read_tag(image) for image in fs.images]) for fs in frames]
        assert seen == [(k, [(camera, k) for camera in range(3)]) for k in expected]
    for start, stop in ((12, None), (5, 5), (-1, 4)):
        with pytest.raises(CaptureError, match="has frames 0 to 11"):
            capture.frames(start, stop)


def test_cameras_of_different_sizes_are_padded(make_capture: MakeCapture) -> None:
    folder = make_capture(cameras=2)
    tables = calibration_tables(2)
    tables["cam2"]["size"] = [48, 64]
    write_toml(folder / "calibration.toml", tables)
    write_video(folder / "videos" / "cam2.mp4", [picture(1, k, (48, 64)) for k in range(12)])
    with open_capture(folder).frames() as frames:
        images = next(frames).images
    assert images.shape == (2, 64, 64, 3)
    assert read_tag(images[0, :48]) == (0, 0) and read_tag(images[1, :, :48]) == (1, 0)
    assert not images[0, 48:].any() and not images[1, :, 48:].any()


def test_a_subset_of_cameras_can_be_selected(make_capture: MakeCapture) -> None:
    folder = make_capture()
    (folder / "videos" / "cam2.mp4").unlink()  # not needed for the selected cameras
    capture = open_capture(folder, cameras=["cam3", "cam1"])
    assert capture.rig.names == ("cam1", "cam3")
    with capture.frames() as frames:
        assert [read_tag(image)[0] for image in next(frames).images] == [0, 2]
    with pytest.raises(CaptureError, match="which has cam1, cam2, cam3"):
        open_capture(folder, cameras=["cam1", "cam7"])


def test_folders_of_images_replace_videos(make_capture: MakeCapture) -> None:
    folder = make_capture(cameras=2)
    (folder / "videos").rename(folder / "old")
    for camera in range(2):
        for k in range(5):
            write_picture(folder / "images" / f"cam{camera + 1}" / f"{k:06d}.png", picture(camera, k))
    capture = open_capture(folder)
    assert (capture.frame_count, capture.fps) == (5, 30.0)
    assert any("fps" in line for line in capture.warnings)
    with capture.frames(2) as frames:
        assert [read_tag(image) for image in next(frames).images] == [(0, 2), (1, 2)]


def test_videos_are_matched_by_key_and_loosely(make_capture: MakeCapture) -> None:
    folder = make_capture(cameras=3)
    tables = calibration_tables(3)
    tables["cam1"]["name"] = "left"  # found by its key
    tables["cam2"]["name"] = "cam_2"  # found loosely
    write_toml(folder / "calibration.toml", tables)
    with open_capture(folder).frames() as frames:
        assert [read_tag(image)[0] for image in next(frames).images] == [0, 1, 2]
    tables["cam3"]["name"] = "cam-2"  # also wants cam2.mp4
    write_toml(folder / "calibration.toml", {key: tables[key] for key in ("cam1", "cam2")} | {"x": tables["cam3"]})
    with pytest.raises(VideoError, match=r"cam2\.mp4: fits both cameras 'cam_2' and 'cam-2'"):
        open_capture(folder)


# ------------------------------------------------------------------------------------------------ masks, background


def test_masks_auto_none_and_from_elsewhere(make_capture: MakeCapture, tmp_path: Path) -> None:
    folder = make_capture()
    write_masks(folder / "masks", 3, 12)
    assert not open_capture(folder, masks="none").has_masks
    (folder / "masks").rename(tmp_path / "elsewhere")
    assert not open_capture(folder).has_masks
    (tmp_path / "elsewhere").rename(folder / "masks")
    for masks in ("auto", str(folder / "masks")):
        capture = open_capture(folder, masks=masks)
        assert capture.has_masks
        with capture.frames(4, 6) as frames:
            for frame_set in frames:
                assert frame_set.masks is not None
                np.testing.assert_array_equal(
                    np.argwhere(frame_set.masks == 255), [(c, frame_set.index, c) for c in range(3)]
                )
    with pytest.raises(CaptureError, match="masks nowhere: is not a folder"):
        open_capture(folder, masks="nowhere")


def test_masks_of_another_size_or_length_are_refused(make_capture: MakeCapture) -> None:
    folder = make_capture()
    write_masks(folder / "masks", 2, 12)
    with refused(VideoError, f"{Path('masks', 'cam3.mp4')}: camera 'cam3' has no masks"):
        open_capture(folder)
    write_masks(folder / "masks", 3, 10)
    (folder / "masks" / "cam1" / "000010.png").unlink()
    (folder / "masks" / "cam1" / "000011.png").unlink()
    capture = open_capture(folder)
    assert capture.frame_count == 10  # masks are part of what all cameras have
    write_picture(folder / "masks" / "cam2" / "000000.png", np.zeros((HEIGHT, 32), np.uint8))
    with pytest.raises(VideoError, match=r"cam2: is 32×48, but calibration.toml gives camera 'cam2' 64×48"):
        open_capture(folder)


def test_background_is_read_from_clips_and_images(make_capture: MakeCapture) -> None:
    folder = make_capture(cameras=2)
    write_video(folder / "background" / "cam1.mp4", [picture(0, k % 32) for k in range(60)])
    with pytest.raises(VideoError, match=r"background.cam2\.png: camera 'cam2' has no background"):
        open_capture(folder).background()
    write_picture(folder / "background" / "cam2.png", picture(1, 7))
    background = open_capture(folder).background()
    assert background is not None
    assert [clip.shape for clip in background] == [(32, HEIGHT, WIDTH, 3), (1, HEIGHT, WIDTH, 3)]
    assert [read_tag(image)[1] for image in background[0]] == [k % 32 for k in range(32)]
    assert read_tag(background[1][0]) == (1, 7)
    write_picture(folder / "background" / "cam2.png", picture(1, 7, (32, 32)))
    with pytest.raises(VideoError, match=r"cam2\.png: is 32×32"):
        open_capture(folder).background()


# -------------------------------------------------------------------------------------------------------- bad input


def test_a_missing_folder_or_calibration_is_reported(make_capture: MakeCapture, tmp_path: Path) -> None:
    with refused(CaptureError, "nothing: is not a folder"):
        open_capture(tmp_path / "nothing")
    folder = make_capture()
    (folder / "calibration.toml").unlink()
    with refused(CalibrationError, folder / "calibration.toml"):
        open_capture(folder)


def test_a_camera_without_video_is_reported(make_capture: MakeCapture) -> None:
    folder = make_capture()
    (folder / "videos" / "cam2.mp4").unlink()
    with refused(VideoError, str(folder / "videos" / "cam2.mp4"), "cam1.mp4, cam3.mp4"):
        open_capture(folder)
    (folder / "videos").rename(folder / "movies")
    with pytest.raises(VideoError, match="neither videos/ nor images/"):
        open_capture(folder)
    (folder / "movies" / "cam1.mp4").rename(folder / "cam1.mp4")
    with refused(VideoError, "has no videos/; cam1.mp4 is in the folder itself", "move them to videos/") as caught:
        open_capture(folder)
    assert f"tk sync {folder} -o CAPTURE" in caught.value.hint


def test_an_image_size_other_than_calibrated_is_refused(make_capture: MakeCapture) -> None:
    folder = make_capture()
    write_video(folder / "videos" / "cam3.mp4", [picture(2, k, (80, 48)) for k in range(12)])
    with refused(VideoError, str(folder / "videos" / "cam3.mp4"), "80×48", "64×48", "calibration.toml"):
        open_capture(folder)


def test_videos_of_different_lengths_are_cut_to_the_shortest(make_capture: MakeCapture) -> None:
    folder = make_capture()
    write_video(folder / "videos" / "cam2.mp4", [picture(1, k) for k in range(9)])
    capture = open_capture(folder)
    assert capture.frame_count == 9
    assert len(capture.warnings) == 1
    assert str(folder / "videos" / "cam2.mp4") in capture.warnings[0] and "9 frames" in capture.warnings[0]
    with capture.frames() as frames:
        assert len(list(frames)) == 9


@pytest.mark.parametrize("late", [2, -3])
def test_time_offsets_select_the_images_of_a_frame(make_capture: MakeCapture, late: int) -> None:
    folder = make_capture(settings={"fps": 10.0})
    tables = calibration_tables(3)
    tables["cam2"]["time_offset"] = late / 10 + 0.03  # less than half a frame of it stays
    write_toml(folder / "calibration.toml", tables)
    capture = open_capture(folder)
    assert capture.late_frames == (0, late, 0)
    assert (capture.first_frame, capture.frame_count) == (max(late, 0), 12 + min(late, 0))
    assert any(f"cam2 {late:+d}" in warning for warning in capture.warnings)
    assert capture.as_recorded().late_frames == (0, 0, 0) and capture.as_recorded().frame_count == 12
    for start in (0, 1, 4):
        with capture.frames(start) as frames:
            for seen in frames:
                own = max(seen.index - late, 0)
                assert [read_tag(image) for image in seen.images] == [(0, seen.index), (1, own), (2, seen.index)]


def test_some_frames_are_the_same_as_in_all(make_capture: MakeCapture) -> None:
    capture = open_capture(make_capture())
    with capture.some_frames([1, 2, 6, 11]) as frames:
        assert len(frames) == 4
        for index, seen in zip((1, 2, 6, 11), frames, strict=True):
            assert seen.index == index and seen.time == pytest.approx(index / capture.fps)
            assert [read_tag(image) for image in seen.images] == [(c, index) for c in range(3)]


@pytest.mark.parametrize("start", [0, 8, 11])
def test_after_its_end_a_video_repeats_its_last_image(make_capture: MakeCapture, start: int) -> None:
    clips = open_capture(make_capture()).clips
    with FrameReader(clips, None, (clips[0].height, clips[0].width), range(start, 14), (2, -3, 2)) as frames:
        for seen in frames:
            early, late = min(seen.index + 3, 11), max(seen.index - 2, 0)
            assert [read_tag(image) for image in seen.images] == [(0, late), (1, early), (2, late)]


def test_impossible_time_offsets_are_refused(make_capture: MakeCapture) -> None:
    folder = make_capture(settings={"fps": 10.0})
    for value, complaint in ((1.3, "cam1.mp4: ends before all"), (1e5, "time_offset = 100000"), ("1", "finite number")):
        tables = calibration_tables(3)
        tables["cam2"]["time_offset"] = value
        write_toml(folder / "calibration.toml", tables)
        with pytest.raises(CaptureError, match=complaint):
            open_capture(folder)


@pytest.mark.parametrize(
    ("settings", "error", "complaint"),
    [
        (
            {"volume": {"center": [0, 0, 1], "size": [1, 0, 1]}},
            VolumeError,
            "[volume]: size = [1.0, 0.0, 1.0] is empty",
        ),
        ({"volume": {"center": [0, 0, 1], "size": [1, -2, 1]}}, VolumeError, "is empty"),
        ({"volume": {"center": [0, 0, 1]}}, VolumeError, "[volume]: size is missing"),
        ({"volume": {"center": [0, float("nan"), 1], "size": [1, 1, 1]}}, VolumeError, "center holds nan"),
        ({"volume": {"center": [0, 0, 60], "size": [1, 1, 1]}}, VolumeError, "no two cameras see"),
        ({"volume": [1, 2]}, CaptureError, "must be a table"),
        ({"fps": 1e300}, CaptureError, "fps = 1e+300 is too large"),
        ({"fps": 1e6}, CaptureError, "fps = 1e+06 must be between 0.01 and 100000"),
        ({"init": {"frame": 10**30}}, CaptureError, "is too large"),
        ({"volume": {"center": [0, 0, 1], "size": [1, 1, 1e8]}}, VolumeError, "too large or too far away"),
        ({"fps": 0}, CaptureError, "fps = 0 must be positive"),
        ({"fps": "15"}, CaptureError, "fps = '15' must be a finite number"),
        ({"fps": float("nan")}, CaptureError, "fps = nan"),
        ({"up": "w"}, CaptureError, "up = 'w' must be one of x, y, z, -x, -y, -z"),
        ({"up": [0.0, 1.0]}, CaptureError, "up must be 3 numbers, and is 2"),
        ({"up": [0.0, 0.0, 0.0]}, CaptureError, "up = [0.0, 0.0, 0.0] has no direction"),
        ({"name": 3}, CaptureError, "name = 3 must be a text"),
        ({"subject": [{"height": 1.7}, {"height": 178}]}, CaptureError, "[[subject]] 1: height = 178 must be between"),
        ({"subject": [3]}, CaptureError, "subject must be a table [subject], or several [[subject]]"),
        ({"subject": {"height": 178}}, CaptureError, "[subject]: height = 178 must be between 0.3 and 3 metres"),
        ({"init": {"frame": -1}}, CaptureError, "[init]: frame = -1"),
        ({"init": {"frame": 12}}, CaptureError, "[init]: frame = 12 is past the last frame, 11"),
        ({"init": {"frame": 1.5}}, CaptureError, "[init]: frame = 1.5 must be a whole number"),
        ({"init": {"pose": "t-pose"}}, CaptureError, "[init]: pose = 't-pose' must be one of da-vinci, any"),
    ],
)
def test_bad_settings_are_reported_in_one_line(
    make_capture: MakeCapture, settings: dict[str, Any], error: type, complaint: str
) -> None:
    folder = make_capture(cameras=2, settings=settings)
    with refused(error, str(folder / "capture.toml"), complaint):
        open_capture(folder)


def test_settings_that_are_no_toml_or_misspelt(make_capture: MakeCapture) -> None:
    folder = make_capture(cameras=2)
    (folder / "capture.toml").write_text("up = \n")
    with refused(CaptureError, str(folder / "capture.toml"), "invalid TOML"):
        open_capture(folder)
    (folder / "capture.toml").write_text("fsp = 3\n[subject]\nheigth = 1.8\n[volume]\ncenter=[0,0,1]\nsize=[1,1,1]\n")
    (warning,) = open_capture(folder).warnings
    assert warning.endswith("unknown keys are ignored: fsp, subject.heigth")


def test_millimetres_without_units_are_recognised(make_capture: MakeCapture) -> None:
    folder = make_capture(settings={})
    expected = open_capture(folder).rig.centers
    tables = calibration_tables(3)
    for table in tables.values():
        table["translation"] = [1000 * x for x in table["translation"]]
    write_toml(folder / "calibration.toml", tables)
    capture = open_capture(folder)
    np.testing.assert_allclose(capture.rig.centers, expected, atol=1e-12)
    (line,) = [line for line in capture.warnings if "[metadata] units" in line]
    assert "taken for mm" in line and "5.2 m apart" in line and str(folder / "calibration.toml") in line
    write_toml(folder / "calibration.toml", {**tables, "metadata": {"units": "mm"}})
    assert not any("[metadata]" in line for line in open_capture(folder).warnings)
    write_toml(folder / "calibration.toml", {**tables, "metadata": {"units": "m"}})  # what is said is believed
    assert any('units = "mm" missing' in line for line in open_capture(folder).warnings)


def test_a_volume_that_cannot_be_inferred_is_reported(make_capture: MakeCapture) -> None:
    folder = make_capture(cameras=2, settings={})
    tables = calibration_tables(2)
    tables["cam2"] |= {"rotation": tables["cam1"]["rotation"], "translation": [0.5, 0.5, 3.0]}
    write_toml(folder / "calibration.toml", tables)
    with refused(VolumeError, str(folder / "capture.toml"), "parallel", "add one"):
        open_capture(folder)


@pytest.mark.parametrize("settings", [{}, {"volume": {"center": [0.0, 0.0, 1.0], "size": [2.0, 2.0, 2.0]}}])
def test_cameras_in_the_axes_of_opengl_are_refused(make_capture: MakeCapture, settings: dict[str, Any]) -> None:
    folder = make_capture(cameras=4, settings=settings)
    tables = calibration_tables(4)
    flip = np.diag([1.0, -1.0, -1.0])
    for table in tables.values():
        table["rotation"] = (flip @ cv2.Rodrigues(np.array(table["rotation"]))[0]).tolist()
        table["translation"] = (flip @ table["translation"]).tolist()
    write_toml(folder / "calibration.toml", tables)
    with refused(CalibrationError, folder / "calibration.toml", "all 4 cameras look away", "OpenGL"):
        open_capture(folder)


def test_cameras_on_their_side_leave_the_default_up(make_capture: MakeCapture) -> None:
    folder = make_capture(cameras=5, settings={})
    tables = calibration_tables(5)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for table in tables.values():
        table["rotation"] = (quarter @ cv2.Rodrigues(np.array(table["rotation"]))[0]).tolist()
        table["translation"] = (quarter @ table["translation"]).tolist()
    write_toml(folder / "calibration.toml", tables)
    capture = open_capture(folder)
    assert capture.up == "z"
    assert any(
        "gives no up, and the cameras are mounted differently: z is a guess" in line for line in capture.warnings
    )


@pytest.mark.parametrize(("up", "wrong"), [("y", True), ("-z", True), ("z", False), ([0.0, 0.2, 1.0], False)])
def test_given_up_that_the_cameras_contradict_is_noted(make_capture: MakeCapture, up: Any, wrong: bool) -> None:
    capture = open_capture(make_capture(cameras=5, settings={"up": up}))
    assert capture.up == up_text(up)
    notes = [line for line in capture.warnings if "capture.toml: up = " in line]
    assert all("upright along z" in line and "--level" in line for line in notes) and len(notes) == wrong


# -------------------------------------------------------------------------------------------------- shared captures


@pytest.mark.parametrize(
    ("name", "cameras", "frames", "masks", "background"),
    [
        pytest.param("walk", 5, 80, True, 25, marks=pytest.mark.slow),
        ("dance", 5, 120, True, 25),
        ("punch", 5, 150, False, 25),
        ("treadmill-slow", 6, 340, True, None),
        pytest.param("rig9", 9, 40, True, 18, marks=pytest.mark.slow),
        ("balance", 4, 100, False, 1),
    ],
)
def test_development_captures_open_without_warnings(
    name: str, cameras: int, frames: int, masks: bool, background: int | None
) -> None:
    capture = open_capture(development_capture(name))
    assert (capture.name, len(capture.rig), capture.frame_count) == (name, cameras, frames)
    assert capture.has_masks is masks and capture.warnings == ()
    empty = capture.background()
    assert (None if empty is None else empty[0].shape[0]) == background
    with capture.frames(3, 5) as reader:
        frame_sets = list(reader)
    assert [frame_set.index for frame_set in frame_sets] == [3, 4]
    for camera, image in zip(capture.rig, frame_sets[0].images, strict=True):
        assert image[: camera.height, : camera.width].std() > 10  # the image is not blank
    if masks:
        assert frame_sets[0].masks is not None
        share = (frame_sets[0].masks == 255).mean(axis=(1, 2))
        assert ((share > 0.005) & (share < 0.4)).all()


def test_a_pipe_is_refused_without_waiting(make_capture: MakeCapture) -> None:
    """Reading a pipe would never end."""
    folder = make_capture()
    for name in ("capture.toml", "calibration.toml", "videos/cam1.mp4"):
        path = folder / name
        content = path.read_bytes()
        path.unlink()
        os.mkfifo(path)
        with pytest.raises(CaptureError, match=rf"{name}: .*not a file"):
            open_capture(folder)
        path.unlink()
        path.write_bytes(content)


@pytest.mark.parametrize(
    "text",
    [
        "fps = 1" + 400 * "0",
        "fps = 1" + 5000 * "0",
        "fps = " + 3000 * "[",
        "fps = " + 3000 * "[" + 3000 * "]",
        "name = 1" + 400 * "0",
        "[init]\nframe = -1" + 400 * "0",
        "[volume]\ncenter = [0, 0, 1" + 400 * "0" + "]\nsize = [1, 1, 1]",
    ],
)
def test_absurd_numbers_and_nesting_are_one_short_line(make_capture: MakeCapture, text: str) -> None:
    folder = make_capture()
    (folder / "capture.toml").write_text(text)
    with pytest.raises(CaptureError, match=r"capture\.toml: ") as caught:
        open_capture(folder)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_several_subjects_are_read(make_capture: MakeCapture) -> None:
    folder = make_capture()
    text = '[[subject]]\nheight = 1.8\n[[subject]]\nheight = 1.6\nposition = [1, 0, 0.9]\nbody = "b.toml"\nsize = 3\n'
    (folder / "capture.toml").write_text(text)
    capture = open_capture(folder)
    assert any("subject.size" in warning for warning in capture.warnings)
    first, second = capture.setup().subjects
    assert (first.height_m, first.position, second.height_m) == (1.8, None, 1.6) and capture.subject_height_m == 1.8
    assert second.position is not None and second.position.tolist() == [1.0, 0.0, 0.9]
    assert [s.body for s in capture.subjects] == [None, "b.toml"]


def test_damaged_images_are_found_after_opening(copy: Path) -> None:
    """FFmpeg fills up what it cannot decode, so the capture opens without an error."""
    capture = open_capture(copy)
    every = np.ones(len(capture.rig), np.bool_)
    assert capture.damaged(FRAMES, every) == []
    path = sorted((copy / "videos").iterdir())[1]
    content = bytearray(path.read_bytes())
    start, end = content.find(b"mdat") + 4, content.rfind(b"moov")  # the images lie before the index
    for place in np.random.default_rng(0).integers((start + end) // 2, end - 100, 20):
        content[place] ^= 0xFF
    path.unlink()
    path.write_bytes(content)
    (line,) = open_capture(copy).damaged(FRAMES, every)
    assert line.startswith(f"{path}: is damaged in ") and "copy it again" in line
    assert open_capture(copy).damaged(FRAMES, np.arange(len(every)) != 1) == []


def test_printed_capture_has_a_few_lines(tiny: Path) -> None:
    capture = open_capture(tiny)
    lines = str(capture).splitlines()
    assert lines == repr(capture).splitlines() and len(lines) == 4
    assert lines[0] == f"Capture demo: {tiny}" and "cameras: cam1, cam2" in lines[1] and "(160×120)" in lines[1]
    assert lines[2].startswith(f"{capture.frame_count} frames, 0 to {capture.frame_count - 1}, ")
    assert lines[3] == "masks: from masks; up: z"
    own = open_capture(tiny, masks="none")
    assert str(own).endswith("masks: against the empty scene in background; up: z")
    tilted = dataclasses.replace(capture, up="[-0.8993871328483293, 0.0, 0.4371528472941]")
    assert str(tilted).endswith("up: [-0.899, 0.000, 0.437]")
