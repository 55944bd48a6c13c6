"""Pose2Sim, FreeMoCap, Caliscope and Anipose: the same tables in different folders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.io.conftest import look_at, write_picture, write_toml
from tests.io.importers.conftest import (
    FRAMES,
    HEIGHT,
    WIDTH,
    Import,
    make_rig,
    points,
    renamed,
    rodrigues,
    tables,
    write_clips,
)
from tests.io.importers.test_xml_formats import write_qca
from tk.errors import CalibrationError, VideoError
from tk.io.captures.capture import open_capture
from tk.io.importers import Wanted, import_project
from tk.model.cameras.camera import Rig
from tk.model.cameras.up import up_vector

CAMS = ["cam1", "cam2", "cam3", "cam4"]


def write_pose2sim(session: Path) -> Rig:
    """Write a session as Pose2Sim does: sizes as floats, four distortions, names of folders of the intrinsics."""
    rig = make_rig()
    named = renamed(rig, *(f"int_cam{k:02d}_img" for k in range(1, 5)))
    document = tables(named)
    for table in document.values():
        table["size"] = [float(WIDTH), float(HEIGHT)]
        table["distortions"] = table["distortions"][:4]
        table["fisheye"] = False
    (session / "calibration").mkdir()
    write_toml(
        session / "calibration" / "Calib_scene.toml", {**document, "metadata": {"adjusted": False, "error": 0.0}}
    )
    return rig


def test_pose2sim(folder: Path, check: Import) -> None:
    rig = write_pose2sim(folder)
    (folder / "calibration" / "intrinsics" / "int_cam01_img").mkdir(parents=True)
    write_picture(folder / "calibration/intrinsics/int_cam01_img/board_01.png", np.zeros((9, 9, 3), np.uint8))
    write_clips(folder / "videos", ["cam01", "cam02", "cam03", "cam04"])
    checked = check(folder, rig)
    assert checked.capture.rig.names[0] == "int_cam01_img"
    assert checked.capture.up == "z"
    checked.note("Calib_scene.toml", "lengths are in m")
    checked.note("up = z", "the axis")
    checked.note("hard links")
    text = (checked.imported.path / "capture.toml").read_text()
    assert "# imported from Pose2Sim, Calib_scene.toml" in text
    assert "\n# up: the axis" in text and "[volume]" in text


def test_matches_by_parts_of_names_are_reported(folder: Path, check: Import) -> None:
    rig = write_pose2sim(folder)
    write_clips(folder / "videos", [f"walk - Camera {n}" for n in range(1, 5)])
    note = check(folder, rig).note("matched by parts of them")
    assert "int_cam01_img ↔ walk - Camera 1.mp4" in note and "int_cam04_img ↔ walk - Camera 4.mp4" in note


def test_pose2sim_matches_in_order_if_names_differ(folder: Path, check: Import) -> None:
    rig = write_pose2sim(folder)
    write_clips(folder / "raw-2d", ["back", "front", "left", "right"])
    note = check(folder, rig).note("matched in their order")
    assert "int_cam01_img ↔ back.mp4" in note and "int_cam04_img ↔ right.mp4" in note


def test_trial_uses_the_calibration_of_its_session(folder: Path, check: Import) -> None:
    rig = write_pose2sim(folder)
    for trial in ("walk", "run"):
        write_clips(folder / trial / "videos", ["cam01", "cam02", "cam03", "cam04"])
    with pytest.raises(VideoError, match=r"several recordings, in run/videos, walk/videos; choose one"):
        import_project(folder, check.output)
    check(folder, rig, trial="walk")
    check.output = check.output.with_name("from_the_trial")
    check(folder / "run", rig)


def test_pose2sim_with_the_file_of_qualisys(folder: Path, check: Import) -> None:
    (folder / "calibration").mkdir()
    rig = make_rig()
    write_qca(folder / "calibration" / "Calib.qca.txt", rig)
    write_clips(folder / "videos", CAMS)
    assert "# imported from Pose2Sim" in (check(folder, rig).imported.path / "capture.toml").read_text()


def test_size_with_fractions_is_replaced_by_the_videos(folder: Path, check: Import) -> None:
    """Pose2Sim's conversions double the principal point, which may be 30 pixels off the middle."""
    rig = make_rig()
    document = tables(renamed(rig, "1", "2", "3", "4"))
    for k, table in enumerate(document.values()):
        table["size"] = [WIDTH - 30.5 + k, HEIGHT + 4.25]
    (folder / "calibration").mkdir()
    write_toml(folder / "calibration" / "Calib.toml", document)
    write_clips(folder / "videos", ["1", "2", "3", "4"])
    note = check(folder, rig).note("camera '2'", "is not an image's")
    assert note.endswith(f"290.5×244.2, is not an image's; the video's is used, {WIDTH}×{HEIGHT}")


def test_freemocap_2_keeps_videos_in_a_folder(folder: Path, check: Import) -> None:
    rig = renamed(make_rig(), "0", "1", "2", "3")
    name = "2026-08-11_19-05-16_GMT-5_mocap"
    (folder / name).mkdir()
    write_toml(folder / name / f"{name}_camera_calibration.toml", tables(rig, unit_m=0.001))
    for kind, end in (("synchronized", ""), ("annotated", "_annotated")):
        write_clips(folder / name / "videos" / kind, [f"{name}.camera{k}{end}" for k in range(4)])
    check(folder / name, rig)


def test_freemocap_without_a_board_on_the_floor(folder: Path, check: Import) -> None:
    """The world is camera 0's frame and lengths are millimetres, which the file does not say."""
    rig = make_rig()
    first = rig[0]
    turned = [
        replace(
            camera,
            rotation=camera.rotation @ first.rotation.T,
            translation=camera.translation - camera.rotation @ first.rotation.T @ first.translation,
        )
        for camera in rig
    ]
    own = Rig(tuple(turned))
    document = tables(renamed(own, *(f"cam_{k}" for k in range(4))), unit_m=0.001)
    metadata = {"adjusted": False, "charuco_square_size": 54.0, "path_to_recorded_videos": "x"}
    write_toml(folder / "project_camera_calibration.toml", {**document, "metadata": metadata})
    write_clips(folder / "synchronized_videos", [f"Camera_{k:03d}_synchronized" for k in range(4)])

    imported = import_project(folder, check.output)
    check.output = check.output.with_name("again")
    p_camera = points() @ first.rotation.T + first.translation
    checked = import_project(folder, check.output)
    assert (
        imported.notes[0] == checked.notes[0] and "lengths are in mm, the default of this format" in imported.notes[0]
    )
    capture = open_capture(check.output)
    for camera, true in zip(capture.rig, own, strict=True):
        np.testing.assert_allclose(camera.project(p_camera)[0], true.project(p_camera)[0], atol=0.01)
    # up is the true one, tilted in the camera's frame: not snapped to an axis
    expected = first.rotation @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(up_vector(capture.up), expected, atol=1e-4)
    assert any("the frame of camera cam_0" in note for note in imported.notes)


def test_caliscope_old_layout(folder: Path, check: Import) -> None:
    """config.toml with [cam_N], 3×3 rotations, and cameras that are switched off or not placed yet."""
    rig = make_rig()
    document: dict[str, object] = {"CreationDate": "2023-05-06", "fps_recording": 24}
    for index, camera in enumerate(rig):
        document[f"cam_{index}"] = {
            "port": index,
            "size": [WIDTH, HEIGHT],
            "rotation_count": 0,
            "matrix": camera.matrix.tolist(),
            "distortions": camera.distortions.tolist(),
            "translation": camera.translation.tolist(),
            "rotation": camera.rotation.tolist(),
            "ignore": False,
        }
    assert isinstance(document["cam_0"], dict)
    unplaced = {key: value for key, value in document["cam_0"].items() if key not in ("rotation", "translation")}
    document["cam_4"] = {**unplaced, "rotation": "null", "translation": "null"}
    document["cam_5"] = {**document["cam_0"], "ignore": True}
    document["charuco"] = {"columns": 4, "rows": 5}
    document["capture_volume"] = {"stage": 2}
    write_toml(folder / "config.toml", document)
    write_clips(folder / "recordings" / "walk", [f"port_{k}" for k in range(6)])
    write_clips(folder / "calibration" / "extrinsic", [f"port_{k}" for k in range(6)])
    checked = check(folder, rig)
    checked.note("'cam_4' has no rotation and no translation: left out")
    checked.note("'cam_5' is switched off (ignore = true): left out")
    checked.note("no camera matches port_4, port_5")


def test_caliscope_new_layout(folder: Path, check: Import) -> None:
    rig = make_rig()
    cameras = {
        str(index): {
            "cam_id": index,
            "rotation_count": -(index % 3),
            "size": [WIDTH, HEIGHT],
            "matrix": camera.matrix.tolist(),
            "distortions": camera.distortions.tolist(),
            "translation": camera.translation.tolist(),
            "rotation": rodrigues(camera),
        }
        for index, camera in enumerate(rig)
    }
    write_toml(folder / "camera_array.toml", {"cameras": cameras})
    for take in ("first", "second"):
        write_clips(folder / "recordings" / take, [f"cam_{k}" for k in range(4)])
    capture = check(folder, rig, trial="second").capture
    assert capture.rig.names == ("0", "1", "2", "3")
    assert capture.calibration.turns == (0, 3, 2, 0)  # kept, clockwise


@pytest.mark.parametrize("metadata", [{}, {"units": "mm"}])
def test_anipose_in_millimetres(folder: Path, check: Import, metadata: dict[str, str]) -> None:
    rig = renamed(make_rig(), "A", "B", "C", "D")
    (folder / "calibration").mkdir()
    document = {f"cam_{k}": table for k, table in enumerate(tables(rig, unit_m=0.001).values())}
    write_toml(folder / "calibration" / "calibration.toml", {**document, "metadata": metadata})
    write_clips(folder / "videos-raw", [f"trial1-cam{letter}" for letter in "ABCD"], suffix=".avi")
    checked = check(folder, rig)
    checked.note("lengths are in mm, as the file says" if metadata else "lengths are taken for mm")


def test_delays_of_the_cameras_are_kept(folder: Path) -> None:
    known = tables(make_rig())
    known["cam2"]["time_offset"] = 0.05
    write_toml(folder / "calibration.toml", known)
    write_clips(folder / "videos-raw", CAMS)
    imported = import_project(folder, folder.with_name("imported"), Wanted(unit="m"))
    assert open_capture(imported.path).time_offset_s == (0.0, 0.05, 0.0, 0.0)


def test_table_top_in_millimetres_or_room_in_centimetres_needs_a_unit(folder: Path, check: Import) -> None:
    write_toml(folder / "calibration.toml", tables(make_rig(), unit_m=0.01))
    write_clips(folder / "videos-raw", CAMS)
    with pytest.raises(CalibrationError, match=r"may be in cm \(.*\) or mm \(.*: give the unit"):
        check(folder, make_rig())
    check(folder, make_rig(), unit="cm")


def test_close_cameras_that_see_a_person_are_in_millimetres(folder: Path, check: Import) -> None:
    rig = make_rig()
    center = np.array([3.0, 0.0, 1.0])
    cameras = [
        replace(camera, rotation=rotation, translation=-rotation @ place)
        for k, camera in enumerate(rig)
        for place in [center + np.array([0.0, 0.3 * k, 0.1 * k])]
        for rotation in [look_at(place, np.array([0.0, 0.0, 1.0]))[0]]
    ]
    write_toml(folder / "calibration.toml", tables(Rig(tuple(cameras)), unit_m=0.001))
    write_clips(folder / "videos-raw", CAMS)
    check(folder, Rig(tuple(cameras))).note("lengths are taken for mm: a person fits into the views")


def test_units_option_overrides_the_file(folder: Path, check: Import) -> None:
    rig = make_rig()
    write_toml(folder / "calibration.toml", {**tables(rig, unit_m=0.01), "metadata": {"units": "m"}})
    write_clips(folder, CAMS)
    check(folder, rig, unit="cm").note("lengths are in cm, as requested")


def test_masks_and_background_are_imported_if_complete(folder: Path, check: Import) -> None:
    rig = make_rig()
    write_toml(folder / "calibration.toml", tables(rig))
    write_clips(folder / "videos-raw", CAMS)
    for name in CAMS:
        write_picture(folder / "background" / f"{name}.png", np.full((HEIGHT, WIDTH, 3), 7, np.uint8))
        for k in range(FRAMES):
            write_picture(folder / "masks" / name / f"{k:06d}.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    capture = check(folder, rig).capture
    assert capture.has_masks
    background = capture.background()
    assert background is not None and all((picture == 7).all() for picture in background)

    (folder / "background" / "cam3.png").unlink()
    for mask in (folder / "masks").iterdir():
        mask.rename(mask.with_name(f"{mask.name} of someone"))
    (folder / "masks" / "cam1 of someone").rename(folder / "masks" / "x")
    (folder / "masks" / "cam2 of someone").rename(folder / "masks" / "y")
    (folder / "masks" / "cam3 of someone").rename(folder / "masks" / "z")
    check.output = check.output.with_name("again")
    checked = check(folder, rig)
    assert not checked.capture.has_masks and checked.capture.background() is None
    checked.note("background: has nothing of cam3: all of it is left out")
    checked.note("masks: cannot match videos and cameras by name", "masks/ is left out")


def test_too_few_cameras_have_a_pose(folder: Path, check: Import) -> None:
    document = tables(make_rig())
    for name in CAMS[1:]:
        document[name] |= {"rotation": "null"}
    write_toml(folder / "calibration.toml", document)
    write_clips(folder, CAMS)
    with pytest.raises(CalibrationError, match=r"1 calibrated camera, .*'cam2' has no rotation: left out"):
        import_project(folder, check.output)


def test_two_calibrations_are_refused(folder: Path, check: Import) -> None:
    write_pose2sim(folder)
    (folder / "calibration" / "Calib_old.toml").write_text("")
    with pytest.raises(CalibrationError, match=r"several calibrations: Calib_old.toml, Calib_scene.toml"):
        import_project(folder, check.output)
