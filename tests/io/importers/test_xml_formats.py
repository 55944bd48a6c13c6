"""Qualisys and Vicon."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.io.importers.conftest import HEIGHT, WIDTH, Import, make_rig, points, renamed, write_clips
from tk.errors import VideoError
from tk.io.captures.capture import open_capture
from tk.io.importers import import_project
from tk.model.cameras.camera import Rig
from tk.model.cameras.up import up_text

SERIALS = ["26578", "26579", "26580", "26581"]

#: what the part of the sensor that a video shows leaves out, pixels
LEFT, TOP = 40, 24


def write_qca(path: Path, rig: Rig, models: tuple[str, ...] = ("Miqus Video",) * 4) -> None:
    """Write a file as QTM does: 1/64 pixels of the whole sensor, millimetres, a frame with y up and z backwards."""
    cameras = []
    for camera, model in zip(rig, models, strict=True):
        R = np.diag([1.0, -1.0, -1.0]) @ camera.rotation
        x, y, z = 1000 * camera.center
        r = " ".join(f'r{i + 1}{j + 1}="{R[i, j]:.9f}"' for i in range(3) for j in range(3))
        K, d = camera.matrix, camera.distortions
        cameras.append(
            f'<camera active="1" serial="{camera.name}" model="{model}" viewrotation="0">\n'
            f'<fov_video left="{LEFT}" top="{TOP}" right="{LEFT + WIDTH - 1}" bottom="{TOP + HEIGHT - 1}"/>\n'
            f'<transform x="{x:.6f}" y="{y:.6f}" z="{z:.6f}" {r}/>\n'
            f'<intrinsic focalLengthU="{64 * K[0, 0]}" focalLengthV="{64 * K[1, 1]}" skew="0.000000" '
            f'centerPointU="{64 * (K[0, 2] + LEFT)}" centerPointV="{64 * (K[1, 2] + TOP)}" '
            f'radialDistortion1="{d[0]}" radialDistortion2="{d[1]}" radialDistortion3="{d[4]}" '
            f'tangentalDistortion1="{d[2]}" tangentalDistortion2="{d[3]}"/></camera>'
        )
    text = "<?xml version='1.0' encoding='ASCII'?>\n<calibration type=\"regular\"><cameras>\n"
    path.write_text(text + "\n".join(cameras) + "\n</cameras></calibration>\n")


def write_xcp(path: Path, rig: Rig, radial: tuple[float, float] = (0.0, 0.0), markers: int = 1) -> None:
    """Write a file as Nexus does: millimetres, quaternions with the real part last, an inverse distortion."""
    cameras = []
    for camera in rig:
        quaternion = " ".join(map(repr, Rotation.from_matrix(camera.rotation).as_quat().tolist()))
        position = " ".join(map(repr, (1000 * camera.center).tolist()))
        K = camera.matrix
        cameras.append(
            f'<Camera DEVICEID="{camera.name}" TYPE="Vicon.VideoCamera" DISPLAY_TYPE="Vue" NAME="" '
            f'SENSOR_SIZE="{camera.width} {camera.height}" PIXEL_ASPECT_RATIO="{float(K[0, 0] / K[1, 1])!r}">'
            f'<KeyFrames><KeyFrame FRAME="0" FOCAL_LENGTH="{K[0, 0]}" PRINCIPAL_POINT="{K[0, 2]} {K[1, 2]}" '
            f'POSITION="{position}" ORIENTATION="{quaternion}" '
            f'VICON_RADIAL2="ViconRadial2 {K[0, 2]} {K[1, 2]} {radial[0]!r} {radial[1]!r} 0"/></KeyFrames></Camera>'
        )
    for index in range(markers):
        cameras.append(f'<Camera DEVICEID="{index}" TYPE="DxCore160" DISPLAY_TYPE="T160"><KeyFrames/></Camera>')
    path.write_text('<?xml version="1.0" encoding="UTF-8"?>\n<Cameras>\n' + "\n".join(cameras) + "\n</Cameras>\n")


def test_qualisys(folder: Path, check: Import) -> None:
    rig = renamed(make_rig(), *SERIALS)
    write_qca(folder / "session.qca.txt", rig)
    write_clips(folder, [f"walk_Miqus_{k}_{serial}" for k, serial in enumerate(SERIALS, 3)], suffix=".avi")
    checked = check(folder, rig)
    checked.note("lengths are in mm, as the format says")
    assert checked.capture.up == "z"


def test_qualisys_marker_cameras_record_no_videos(folder: Path, check: Import) -> None:
    rig = renamed(make_rig(), *SERIALS)
    write_qca(folder / "session.qca.txt", rig, ("Miqus Video", "Oqus 300+", "Miqus Video", "Miqus Video"))
    write_clips(folder, [SERIALS[0], SERIALS[2], SERIALS[3]])
    checked = check(folder, Rig((rig[0], rig[2], rig[3])))
    checked.note("1 of its 4 cameras record no videos: left out")


@pytest.mark.parametrize("model", ["Miqus Hybrid", "Oqus 210c"])
def test_qualisys_camera_with_a_video_is_a_video_camera(folder: Path, check: Import, model: str) -> None:
    rig = renamed(make_rig(), *SERIALS)
    write_qca(folder / "session.qca.txt", rig, ("Miqus Video", model, "Miqus Video", model))
    write_clips(folder, [f"trial01_Miqus_{serial}" for serial in SERIALS])
    notes = check(folder, rig).imported.notes
    assert not any("left out" in note for note in notes)


def test_marker_cameras_vote_for_up_and_need_no_calibration(folder: Path, check: Import) -> None:
    """The video cameras hang on their side; two of the marker cameras are not calibrated."""
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    turn = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    upright = make_rig(world=turn)
    video = [replace(c, rotation=quarter @ c.rotation, translation=quarter @ c.translation) for c in upright]
    markers = [*upright, *upright.cameras[:3]]
    rig = renamed(Rig((*video, *markers)), *SERIALS, *(f"9{k}" for k in range(len(markers))))
    path = folder / "session.qca.txt"
    write_qca(path, rig, ("Miqus Video",) * 4 + ("Miqus M3",) * len(markers))
    before, first, rest = path.read_text().partition('serial="90"')
    path.write_text(before + first + rest.replace('r11="', 'r11="7', 1).replace("focalLengthU", "U", 1))
    write_clips(folder, SERIALS)
    imported = import_project(folder, check.output)
    assert open_capture(check.output).up == up_text(turn[:, 2].round(9))
    assert any("7 of its 11 cameras record no videos: left out" in note for note in imported.notes)


@pytest.mark.parametrize("unit", [64.0, 1.0])
@pytest.mark.parametrize("name", ["session.qca.txt", "cal.txt"])
def test_qualisys_without_fov_video_shows_the_whole_sensor(folder: Path, check: Import, unit: float, name: str) -> None:
    """Theia writes such files, in pixels."""
    rig = renamed(make_rig(), *SERIALS)
    path = folder / name
    write_qca(path, rig)
    text = re.sub(r"<fov_video .*/>", "", path.read_text())
    extent = f'sensorMinU="0" sensorMinV="0" sensorMaxU="{unit * WIDTH - 1}" sensorMaxV="{unit * HEIGHT - 1}" '

    def scaled(found: re.Match[str]) -> str:
        shift = {"centerPointU": LEFT, "centerPointV": TOP}.get(found[1], 0)
        return f'{found[1]}="{(float(found[2]) / 64 - shift) * unit!r}"'

    text = re.sub(r'(focalLength[UV]|centerPoint[UV])="([^"]*)"', scaled, text)
    path.write_text(text.replace("<intrinsic ", f"<intrinsic {extent}"))
    write_clips(folder, SERIALS)
    check(folder, rig).note("has no fov_video: the videos are taken to show the whole sensor")


def test_vicon_camera_with_a_video_is_a_video_camera(folder: Path, check: Import) -> None:
    rig = renamed(make_rig(distorted=False), *SERIALS)
    path = folder / "session.xcp"
    write_xcp(path, rig)
    path.write_text(path.read_text().replace('TYPE="Vicon.VideoCamera" DISPLAY_TYPE="Vue"', 'TYPE="Vero"', 2))
    write_clips(folder, [f"Walk01.{serial}" for serial in SERIALS], suffix=".avi")
    check(folder, rig)


def test_vicon(folder: Path, check: Import) -> None:
    rig = renamed(make_rig(distorted=False), *SERIALS)
    write_xcp(folder / "session.xcp", rig)
    write_clips(folder, [f"Walk01.{serial}.20190301120000" for serial in SERIALS], suffix=".avi")
    checked = check(folder, rig)
    checked.note("1 of its 5 cameras record no videos: left out")
    checked.note("lengths are in mm, as the format says")


def test_vicon_distortion_is_the_inverse_of_opencvs(folder: Path, check: Import) -> None:
    """A pixel that Vicon's model corrects to the ideal projection is the pixel that our camera projects to."""
    rig = renamed(make_rig(distorted=False), *SERIALS)
    k1, k2 = 6e-7, 4e-13
    write_xcp(folder / "session.xcp", rig, (k1, k2))
    write_clips(folder, SERIALS)
    import_project(folder, check.output)
    moved = []
    for camera, ideal in zip(open_capture(check.output).rig, rig, strict=True):
        pixels, expected = camera.project(points())[0], ideal.project(points())[0]
        principal, aspect = ideal.matrix[:2, 2], np.array([1.0, ideal.matrix[0, 0] / ideal.matrix[1, 1]])
        offset = (pixels - principal) * aspect
        r2 = (offset**2).sum(axis=1, keepdims=True)
        corrected = principal + (1 + k1 * r2 + k2 * r2**2) * offset / aspect
        np.testing.assert_allclose(corrected, expected, atol=0.01)
        moved.append(np.abs(pixels - expected).max())
    assert max(moved) > 0.2  # there was something to undo


def test_vicon_with_several_trials_in_one_folder(folder: Path, check: Import) -> None:
    rig = renamed(make_rig(distorted=False), *SERIALS)
    write_xcp(folder / "session.xcp", rig)
    for trial in ("Walk01", "Walk02"):
        write_clips(folder, [f"{trial}.{serial}" for serial in SERIALS], suffix=".avi")
    with pytest.raises(VideoError, match=r"cannot match videos and cameras .* rename the videos"):
        import_project(folder, check.output)
    check(folder, rig, trial="Walk02")


def test_rotated_view_of_qualisys_is_noted(folder: Path, check: Import) -> None:
    """The file does not say whether the exported video is rotated."""
    rig = renamed(make_rig(), *SERIALS)
    path = folder / "session.qca.txt"
    write_qca(path, rig)
    path.write_text(path.read_text().replace('viewrotation="0"', 'viewrotation="180"', 1))
    write_clips(folder, SERIALS)
    check(folder, rig).note("QTM shows 26578 turned (viewrotation)")
