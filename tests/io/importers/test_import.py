"""What all formats share: search, errors, output; and the command."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Tk, refused
from tests.io.conftest import write_toml
from tests.io.importers.conftest import HEIGHT, WIDTH, Import, make_rig, points, renamed, tables, write_clips
from tests.io.importers.test_xml_formats import write_qca
from tk.errors import CalibrationError, CaptureError, VideoError
from tk.io.captures.capture import open_capture
from tk.io.importers import FORMATS, import_project
from tk.model.cameras.camera import Rig

CAMS = ["cam1", "cam2", "cam3", "cam4"]


def write_project(folder: Path) -> Path:
    write_toml(folder / "calibration.toml", tables(make_rig(), unit_m=0.001))
    write_clips(folder / "videos-raw", CAMS)
    return folder


def test_import_command_prints_notes_and_errors(folder: Path, tmp_path: Path, tk: Tk) -> None:
    write_project(folder)
    ran = tk("import", folder, "-o", tmp_path / "capture")
    assert ran.code == 0 and ran.out == ""
    notes = [line for line in ran.err.splitlines() if line.startswith("note: ")]
    assert len([note for note in notes if "lengths are taken for mm" in note]) == 1
    assert ran.err.splitlines()[-1] == f"4 cameras in {tmp_path / 'capture'}; check {tmp_path}/capture/capture.toml"
    tk("import", folder, "-o", tmp_path / "capture").complaint(str(tmp_path / "capture"), "exists already")
    tk("import", folder, "-o", tmp_path / "c", "--units", "inch").complaint("inch")
    tk("import", folder, "-o", tmp_path / "c", "--trial", "x").complaint("holds no videos of the trial 'x'")
    tk("import", tmp_path / "nowhere", "-o", tmp_path / "c").complaint("nowhere: is not a folder")


def test_capture_as_input_is_refused(folder: Path, tmp_path: Path, tk: Tk) -> None:
    tk("import", write_project(folder), "-o", tmp_path / "capture")
    tk("import", tmp_path / "capture", "-o", tmp_path / "c").complaint("is a capture already", "tk track")


def test_unknown_project_says_what_it_holds_and_what_was_searched(folder: Path, check: Import) -> None:
    for number in range(9):
        (folder / f"note{number}.md").write_text("# Nothing")
    with refused(CaptureError, "note0.md, note1.md", "and 3 more") as caught:
        import_project(folder, check.output)
    for form in FORMATS:
        assert form.patterns[0] in str(caught.value)
    assert len(str(caught.value)) - len(str(folder)) < 4 * 120


@pytest.mark.parametrize("command", [["track", "-o", "r.h5"], ["inspect"]])
def test_project_of_another_tool_is_refused_with_the_command_that_imports_it(
    folder: Path, tmp_path: Path, tk: Tk, command: list[str]
) -> None:
    write_project(folder)
    tk(command[0], folder, *command[1:]).complaint("is a project of Anipose", f"tk import {folder} -o CAPTURE")
    (folder / "calibration.toml").rename(folder / "my_camera_calibration.toml")
    tk(command[0], folder, *command[1:]).complaint("is a project of FreeMoCap", f"tk import {folder} -o CAPTURE")
    (folder / "my_camera_calibration.toml").unlink()
    tk(command[0], folder, *command[1:]).complaint(str(folder / "calibration.toml"))


@pytest.mark.parametrize(
    "name",
    [
        "calibration.toml",
        "camera_array.toml",
        "x_camera_calibration.toml",
        "intri.yml",
        "x.qca.txt",
        "x.xcp",
        "calibration_x.json",
        "calibration/Calib.toml",
    ],
)
def test_pipe_as_calibration_is_refused(folder: Path, check: Import, name: str) -> None:
    write_clips(folder / "videos", CAMS[:2])
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    os.mkfifo(path)
    os.mkfifo(folder / "videos" / "cam9.mp4")
    with pytest.raises(CalibrationError, match="is not a file") as caught:
        import_project(folder, check.output)
    assert str(path) in str(caught.value)


def test_pipe_among_the_videos_and_an_empty_output_folder_are_accepted(folder: Path, check: Import) -> None:
    write_project(folder)
    check.output.mkdir()
    os.mkfifo(folder / "videos-raw" / "cam5.mp4")
    check(folder, make_rig())


def test_huge_calibration_is_refused(folder: Path, check: Import) -> None:
    path = folder / "session.qca.txt"
    with path.open("wb") as file:
        file.truncate(2**24 + 1)
    with pytest.raises(CalibrationError, match="has more than 16 MiB"):
        import_project(folder, check.output)


@pytest.mark.parametrize(
    ("size", "expected", "note"),
    [
        ((WIDTH, HEIGHT - 8), (1.0, 0.0), "padding at the right and the bottom; the matrix stays"),
        ((WIDTH + 8, HEIGHT), (1.0, 0.0), "padding"),
        ((WIDTH // 2, HEIGHT // 2), (0.5, -0.25), "scaled by 0.5, and so is the matrix"),
        ((WIDTH * 2, HEIGHT * 2), (2.0, 0.5), "scaled by 2, and so is the matrix"),
    ],
)
def test_camera_is_adapted_to_padded_and_scaled_videos(
    folder: Path, check: Import, size: tuple[int, int], expected: tuple[float, float], note: str
) -> None:
    """A pixel x of the calibration is the pixel scale · x + shift of the video, pixel centres being whole numbers."""
    write_toml(folder / "calibration.toml", tables(make_rig()))
    write_clips(folder / "videos", CAMS, size)
    imported = import_project(folder, check.output)
    scale, shift = expected
    for camera, true in zip(open_capture(check.output).rig, make_rig(), strict=True):
        assert (camera.width, camera.height) == size
        np.testing.assert_allclose(camera.project(points())[0], scale * true.project(points())[0] + shift, atol=0.01)
    found = [line for line in imported.notes if note in line]
    assert len(found) == 4 and f"calibrated at {WIDTH}×{HEIGHT}, video {size[0]}×{size[1]}" in found[0]


@pytest.mark.parametrize(
    ("size", "complaint"),
    [((HEIGHT, WIDTH), "is the video turned by 90°?"), ((WIDTH, HEIGHT // 2), "(1 and 0.5)")],
)
def test_video_of_an_unrelated_size_is_refused(
    folder: Path, check: Import, size: tuple[int, int], complaint: str
) -> None:
    write_toml(folder / "calibration.toml", tables(make_rig()))
    write_clips(folder / "videos", CAMS, size)
    with pytest.raises(CalibrationError) as caught:
        import_project(folder, check.output)
    text = str(caught.value)
    assert complaint in text and f"calibrated at 320×240, video {size[0]}×{size[1]}" in text
    assert str(folder / "videos" / "cam1.mp4") in text and "\n" not in text


def test_videos_are_linked_or_copied(folder: Path, check: Import, monkeypatch: pytest.MonkeyPatch) -> None:
    write_project(folder)
    check(folder, make_rig()).note("hard links")
    original = folder / "videos-raw" / "cam2.mp4"
    assert original.stat().st_ino == (check.output / "videos" / "cam2.mp4").stat().st_ino

    def refuse(*_: object) -> None:
        raise OSError("another device")

    monkeypatch.setattr(os, "link", refuse)
    check.output = check.output.with_name("copied")
    check(folder, make_rig()).note("the videos were copied")
    copied = check.output / "videos" / "cam2.mp4"
    assert original.stat().st_ino != copied.stat().st_ino and original.read_bytes() == copied.read_bytes()


def test_failed_import_leaves_no_files(folder: Path, check: Import) -> None:
    write_project(folder)
    (folder / "videos-raw" / "cam3.mp4").write_bytes(b"no video")
    with pytest.raises(VideoError) as caught:
        import_project(folder, check.output)
    assert str(folder / "videos-raw" / "cam3.mp4") in str(caught.value)
    assert sorted(path.name for path in folder.parent.iterdir()) == ["project"]


def test_unwritable_output_is_refused(folder: Path, check: Import) -> None:
    write_project(folder)
    (folder.parent / "file").write_text("")
    with pytest.raises(CaptureError, match="cannot be written"):
        import_project(folder, folder.parent / "file" / "capture")


def test_camera_without_video_is_left_out(folder: Path, check: Import) -> None:
    write_project(folder)
    (folder / "videos-raw" / "cam4.mp4").unlink()
    check(folder, Rig(make_rig().cameras[:3])).note("no video of cam4: left out")


def test_invalid_file_names_of_cameras_are_replaced(folder: Path, check: Import) -> None:
    rig = renamed(make_rig(), "a/b", "a b", "metadata", "ok")
    write_toml(folder / "calibration.toml", {f"cam{k}": table for k, table in enumerate(tables(rig).values())})
    write_clips(folder / "videos-raw", ["cam0", "cam1", "cam2", "cam3"])
    checked = check(folder, rig)
    assert checked.capture.rig.names == ("a_b", "a_b_", "metadata_", "ok")
    checked.note("camera 'a/b' is called a_b in the capture")


def test_unsupported_video_format_is_named(folder: Path, check: Import) -> None:
    write_qca(folder / "session.qca.txt", make_rig())
    for name in CAMS:
        (folder / f"{name}.r3d").write_bytes(b"\x47")
    with pytest.raises(VideoError, match=r"the folder holds cam1.r3d, cam2.r3d, .*; tk reads .mp4, .m4v, .mov"):
        import_project(folder, check.output)


def test_parallel_cameras_get_no_volume(folder: Path, check: Import) -> None:
    """The capture is written without a volume, which the user has to add."""
    document = tables(make_rig())
    for index, table in enumerate(document.values()):
        table |= {"rotation": [-np.pi / 2, 0.0, 0.0], "translation": [float(index), 0.0, 0.0]}
    write_toml(folder / "calibration.toml", document)
    write_clips(folder / "videos", CAMS)
    imported = import_project(folder, check.output)
    assert any("no [volume] could be inferred: the cameras' axes are parallel; give one" in n for n in imported.notes)
    assert "\n# [volume]\n" in (check.output / "capture.toml").read_text()
