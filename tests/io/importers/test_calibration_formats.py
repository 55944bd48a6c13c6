"""Calibration programs without recordings: multical, calib.io, OpenCV's files, COLMAP, OptiTrack.

Each file is written from a rig with truth, in full precision; its cameras then project within 1e-6 px.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refused
from tests.io.importers.conftest import HEIGHT, WIDTH, Import, make_rig, points, renamed, rodrigues, write_clips
from tests.io.importers.test_xml_formats import write_qca
from tk.errors import CalibrationError
from tk.io.importers import Wanted, import_project, read_project
from tk.model.cameras.camera import Camera, Rig

NAMES = ["cam1", "cam2", "cam3", "cam4"]
EXACT_PX = 1e-6
Y_UP = np.diag([1.0, -1.0, -1.0])


def moved(rig: Rig, rotation: np.ndarray, shift: np.ndarray, scale: float = 1.0) -> Rig:
    """Return the rig in another world, in which a point X has the coordinates scale (rotation X + shift)."""
    return Rig(
        tuple(
            replace(
                camera,
                rotation=camera.rotation @ rotation.T,
                translation=scale * (camera.translation - camera.rotation @ rotation.T @ shift),
            )
            for camera in rig
        )
    )


def in_first(rig: Rig) -> Rig:
    """Return the rig in the frame of its first camera."""
    return moved(rig, rig[0].rotation, rig[0].translation)


def lens(rig: Rig, kind: str) -> Rig:
    """Return the rig with a lens model of another kind."""
    numbers = {
        "none": np.zeros(5),
        "k1": np.array([-0.12, 0, 0, 0, 0]),
        "k1k2": np.array([-0.12, 0.05, 0, 0, 0]),
        "p": np.array([-0.12, 0.05, 0.0011, -0.0007, 0]),
        "rational": np.array([-0.1, 0.05, 0.0011, -0.0007, 0.01, 0.02, 0.01, -0.005]),
        "fisheye": np.array([0.03, -0.01, 0.004, -0.001]),
    }[kind]
    return Rig(tuple(replace(camera, distortions=numbers, fisheye=kind == "fisheye") for camera in rig))


def pose(camera: Camera) -> np.ndarray:
    return np.vstack([np.column_stack([camera.rotation, camera.translation]), [0, 0, 0, 1]])


def write_multical(folder: Path, rig: Rig, chain: bool = False) -> None:
    """Write a file as multical does: poses relative to the first camera, or each to the one before."""
    poses = {rig[0].name: pose(rig[0])}
    for index in range(1, len(rig)):
        base = rig[index - 1 if chain else 0]
        poses[f"{rig[index].name}_to_{base.name}"] = pose(rig[index]) @ np.linalg.inv(pose(base))
    document = {
        "cameras": {
            camera.name: {
                "model": "fisheye" if camera.fisheye else "standard",
                "image_size": [WIDTH, HEIGHT],
                "K": camera.matrix.tolist(),
                "dist": [camera.distortions.tolist()],
            }
            for camera in rig
        },
        "camera_poses": {name: {"R": T[:3, :3].tolist(), "T": T[:3, 3].tolist()} for name, T in poses.items()},
    }
    (folder / "calibration.json").write_text(json.dumps(document))


def write_calibio(folder: Path, rig: Rig, serials: bool = True) -> None:
    """Write a file as calib.io's calibrator does: the model has a name once, later cameras refer to its number."""
    cameras = []
    for index, camera in enumerate(rig):
        K, d = camera.matrix, np.zeros(14)
        d[: len(camera.distortions)] = camera.distortions
        keys = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
        values = {
            "f": K[0, 0],
            "ar": K[1, 1] / K[0, 0],
            "cx": K[0, 2],
            "cy": K[1, 2],
            **dict(zip(keys, d, strict=True)),
        }
        data = {
            "CameraModelCRT": {"CameraModelBase": {"imageSize": {"width": WIDTH, "height": HEIGHT}}},
            "parameters": {key: {"state": 0, "val": float(value)} for key, value in values.items()},
        }
        named = {"polymorphic_id": 1} if index else {
            "polymorphic_id": 2147483649, "polymorphic_name": "libCalib::CameraModelOpenCV"
        }  # fmt: skip
        transform = {
            "rotation": dict(zip(("rx", "ry", "rz"), rodrigues(camera), strict=True)),
            "translation": dict(zip("xyz", camera.translation.tolist(), strict=True)),
        }
        own = {"serial": camera.name} if serials else {}
        cameras.append({"model": {**named, "ptr_wrapper": {"valid": 1, "data": data}}, "transform": transform, **own})
    (folder / "rig.json").write_text(json.dumps({"Calibration": {"cameras": cameras}}))


def storage_text(values: dict[str, Any], suffix: str) -> str:
    """Return a document as OpenCV's FileStorage writes it."""
    kind = cv2.FILE_STORAGE_FORMAT_JSON if suffix == ".json" else cv2.FILE_STORAGE_FORMAT_YAML
    storage = cv2.FileStorage(f"x{suffix}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | kind)
    for key, value in values.items():
        storage.write(key, value)
    return str(storage.releaseAndGetString())


def opencv_values(camera: Camera, own_pose: bool = False) -> dict[str, Any]:
    R, t = camera.rotation, camera.translation
    if own_pose:
        R, t = R.T, camera.center
    return {
        "image_width": WIDTH,
        "image_height": HEIGHT,
        "camera_matrix": camera.matrix,
        "distortion_coefficients": camera.distortions[None],
        "rvec": cv2.Rodrigues(R)[0],
        "tvec": np.asarray(t)[:, None],
    }


def write_opencv(folder: Path, rig: Rig, suffix: str = ".yml", own_pose: bool = False) -> None:
    for camera in rig:
        (folder / f"{camera.name}{suffix}").write_text(storage_text(opencv_values(camera, own_pose), suffix))


def write_stereo(folder: Path, rig: Rig) -> None:
    """Write the two files of OpenCV's sample of a stereo calibration."""
    a, b = rig[0], rig[1]
    intrinsics = {"M1": a.matrix, "D1": a.distortions[None], "M2": b.matrix, "D2": b.distortions[None]}
    (folder / "intrinsics.yml").write_text(storage_text(intrinsics, ".yml"))
    R = b.rotation @ a.rotation.T
    values = {"R": R, "T": (b.translation - R @ a.translation)[:, None], "R1": np.eye(3), "P1": np.eye(3, 4)}
    (folder / "extrinsics.yml").write_text(storage_text(values, ".yml"))


def write_colmap(folder: Path, rig: Rig, model: str = "OPENCV", images: int = 1, turn_deg: float = 0.0) -> None:
    """Write a model as COLMAP does, with points of every second image; ``turn_deg``: of a camera's later images."""
    keys = {
        "SIMPLE_PINHOLE": "fcc", "PINHOLE": "ffcc", "SIMPLE_RADIAL": "fcc1", "RADIAL": "fcc12", "OPENCV": "ffcc12pq",
        "FULL_OPENCV": "ffcc12pq3456", "OPENCV_FISHEYE": "ffcc1234", "SIMPLE_RADIAL_FISHEYE": "fcc1",
    }[model]  # fmt: skip
    lenses, views = ["# Camera list with one line of data per camera:"], ["# Image list", "# Number of images: 4"]
    for index, camera in enumerate(rig, 1):
        K, d = camera.matrix, camera.distortions
        named = dict(zip("1234" if camera.fisheye else "12pq3456", [*d, *np.zeros(8)], strict=False))
        focal, center = [K[0, 0], K[1, 1]], [K[0, 2] + 0.5, K[1, 2] + 0.5]
        numbers = [focal.pop(0) if key == "f" else center.pop(0) if key == "c" else named[key] for key in keys]
        lenses.append(f"{index} {model} {WIDTH} {HEIGHT} {' '.join(repr(float(number)) for number in numbers)}")
        for image in range(images):
            R = Rotation.from_euler("y", turn_deg * image, degrees=True).as_matrix() @ camera.rotation
            x, y, z, w = Rotation.from_matrix(R).as_quat()
            t = -R @ camera.center
            name = f"{camera.name}/{image:04d}.jpg" if images > 1 else f"{camera.name}.jpg"
            values = " ".join(repr(float(value)) for value in (w, x, y, z, *t))
            views += [f"{10 * index + image} {values} {index} {name}", "10.5 20.5 -1 30 40 7" if index % 2 else ""]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("\n".join(lenses) + "\n")
    (folder / "images.txt").write_text("\n".join(views) + "\n")


def write_mcal(folder: Path, rig: Rig, transposed: bool = False) -> None:
    """Write a file as Motive does: UTF-16, metres, the camera's frame with y up and z backwards."""
    cameras = []
    for index, camera in enumerate(rig, 1):
        M = (Y_UP @ camera.rotation).T
        M = M.T if transposed else M
        K, d = camera.matrix.astype(object), camera.distortions.tolist()
        model = (
            f'LensCenterX="{K[0, 2]!r}" LensCenterY="{K[1, 2]!r}" HorizontalFocalLength="{K[0, 0]!r}" '
            f'VerticalFocalLength="{K[1, 1]!r}" k1="{d[0]!r}" k2="{d[1]!r}" k3="{d[4]!r}" TangentialX="{d[2]!r}" '
            f'TangentialY="{d[3]!r}"'
        )
        matrix = " ".join(f'OrientMatrix{k}="{float(value)!r}"' for k, value in enumerate(M.ravel()))
        x, y, z = (float(value) for value in camera.center)
        cameras.append(
            f'<Camera Serial="{camera.name}"><Properties CameraID="{index}" FrameRate="120"/>'
            f'<Attributes ImagerPixelWidth="{WIDTH}" ImagerPixelHeight="{HEIGHT}"/><Intrinsic k1="9"/>'
            f"<IntrinsicStandardCameraModel {model}/>"
            f'<Extrinsic X="{x!r}" Y="{y!r}" Z="{z!r}" {matrix}/></Camera>'
        )
    text = '<?xml version="1.0" encoding="utf-16"?>\n<Profile><Calibration><Cameras>' + "\n".join(cameras)
    path = folder / "System Calibration.mcal"
    path.write_bytes((text + "</Cameras></Calibration></Profile>").encode("utf-16"))


def clips(folder: Path, names: list[str] = NAMES) -> None:
    write_clips(folder / "videos", names)


@pytest.mark.parametrize("chain", [False, True])
@pytest.mark.parametrize("kind", ["p", "rational", "fisheye"])
def test_multical(folder: Path, check: Import, chain: bool, kind: str) -> None:
    rig = in_first(lens(make_rig(), kind))
    write_multical(folder, rig, chain)
    clips(folder)
    found = import_project(folder, check.output)
    assert found.cameras == 4
    compare(folder, rig, make_rig()[0])


def compare(folder: Path, rig: Rig, first: Camera) -> None:
    """Check that the project in a folder has the cameras of a rig whose world is the frame of its first camera."""
    found = read_project(folder).rig
    X = points() @ first.rotation.T + first.translation
    assert found.names == rig.names
    for camera, true in zip(found, rig, strict=True):
        np.testing.assert_allclose(camera.project(X)[0], true.project(X)[0], atol=EXACT_PX, rtol=0)


def test_multical_camera_without_a_pose_is_left_out(folder: Path) -> None:
    rig = in_first(make_rig())
    write_multical(folder, rig)
    path = folder / "calibration.json"
    document = json.loads(path.read_text())
    del document["camera_poses"]["cam3_to_cam1"]
    path.write_text(json.dumps(document))
    clips(folder)
    project = read_project(folder)
    assert project.rig.names == ("cam1", "cam2", "cam4")
    assert any("'cam3' has no pose in camera_poses: left out" in note for note in project.notes)


@pytest.mark.parametrize("kind", ["p", "rational"])
def test_calibio(folder: Path, kind: str) -> None:
    rig = in_first(lens(make_rig(), kind))
    write_calibio(folder, rig)
    clips(folder)
    compare(folder, rig, make_rig()[0])


def test_calibio_without_serial_numbers_is_matched_in_order(folder: Path) -> None:
    rig = in_first(make_rig())
    write_calibio(folder, rig, serials=False)
    clips(folder)
    compare(folder, renamed(rig, *(f"camera_{k}" for k in range(4))), make_rig()[0])
    assert any("matched in their order: camera_0 ↔ cam1.mp4" in note for note in read_project(folder).notes)


@pytest.mark.parametrize(("old", "new", "complaint"), [
    ("libCalib::CameraModelOpenCV", "libCalib::CameraModelDivision", "the lens is a libCalib::CameraModelDivision"),
    ('"s1": {"state": 0, "val": 0.0}', '"s1": {"state": 0, "val": 0.1}', "of a thin prism or a tilted sensor"),
    ('"rx"', '"qx"', "camera 0: [transform]: [rotation]: rx is missing"),
])  # fmt: skip
def test_calibio_of_another_kind_is_refused(folder: Path, old: str, new: str, complaint: str) -> None:
    write_calibio(folder, in_first(make_rig()))
    path = folder / "rig.json"
    path.write_text(path.read_text().replace(old, new))
    clips(folder)
    with refused(CalibrationError, complaint, path):
        read_project(folder)


@pytest.mark.parametrize("suffix", [".yml", ".json"])
@pytest.mark.parametrize("kind", ["p", "rational"])
def test_opencv_files_of_each_camera(folder: Path, check: Import, suffix: str, kind: str) -> None:
    rig = lens(make_rig(), kind)
    write_opencv(folder, rig, suffix)
    clips(folder)
    checked = check(folder, rig, tolerance_px=EXACT_PX)
    assert checked.capture.up == "z"


def test_opencv_fisheye_is_named_by_the_file(folder: Path, check: Import) -> None:
    rig = lens(make_rig(), "fisheye")
    for camera in rig:
        text = storage_text({**opencv_values(camera), "fisheye_model": 1}, ".yml")
        (folder / f"{camera.name}.yml").write_text(text)
    clips(folder)
    check(folder, rig, tolerance_px=EXACT_PX)


def test_opencv_poses_of_the_cameras_are_recognised(folder: Path, check: Import) -> None:
    rig = make_rig()
    write_opencv(folder, rig, own_pose=True)
    clips(folder)
    check(folder, rig, tolerance_px=EXACT_PX).note("rvec and tvec map camera to world")


@pytest.mark.parametrize(("matrix", "distortions"), [("camera_matrix", "dist_coeffs"), ("K", "dist"), ("mtx", "D")])
def test_opencv_json_with_all_cameras(folder: Path, check: Import, matrix: str, distortions: str) -> None:
    rig = make_rig()
    document = {
        camera.name: {
            "image_size": [WIDTH, HEIGHT],
            matrix: camera.matrix.tolist(),
            distortions: camera.distortions.tolist(),
            "R": camera.rotation.tolist(),
            "t": camera.translation.tolist(),
        }
        for camera in rig
    }
    (folder / "cameras.json").write_text(json.dumps({"version": 1, "cameras": document}))
    clips(folder)
    check(folder, rig, tolerance_px=EXACT_PX)


def test_opencv_yaml_of_other_writers(folder: Path, check: Import) -> None:
    """Tables by indentation, lists in brackets over several lines, comments."""
    rig = make_rig()
    lines = []
    for camera in rig:
        rows = ",\n    ".join(str(row) for row in camera.matrix.tolist())
        lines += [
            f"{camera.name}:  # a camera",
            f"  image_width: {WIDTH}",
            f"  image_height: {HEIGHT}",
            f"  camera_matrix: [{rows}]",
            "  dist_coeffs:",
            *(f"    - {value!r}" for value in camera.distortions.tolist()),
            f"  rvec: {rodrigues(camera)}",
            f"  tvec: {camera.translation.tolist()}",
        ]
    (folder / "rig.yaml").write_text("\n".join(lines))
    clips(folder)
    check(folder, rig, tolerance_px=EXACT_PX)


def test_opencv_stereo(folder: Path) -> None:
    rig = Rig(in_first(make_rig()).cameras[:2])
    write_stereo(folder, rig)
    clips(folder, NAMES[:2])
    found = read_project(folder).rig
    X = points() @ make_rig()[0].rotation.T + make_rig()[0].translation
    for camera, true in zip(found, rig, strict=True):
        np.testing.assert_allclose(camera.project(X)[0], true.project(X)[0], atol=EXACT_PX, rtol=0)


def test_opencv_coefficients_with_numbers_are_no_pair(folder: Path, check: Import) -> None:
    rig = make_rig()
    for camera in rig:
        values = opencv_values(camera)
        text = storage_text(values, ".yml") + "k1: 0.1\nk2: 0.2\n"
        (folder / f"{camera.name}.yml").write_text(text)
    clips(folder)
    check(folder, rig, tolerance_px=EXACT_PX)


def test_opencv_names_of_digits_stay_as_they_are(folder: Path) -> None:
    for number, camera in enumerate(make_rig()):
        text = storage_text(opencv_values(camera), ".yml") + f'camera_name: "0012{number}"\n'
        (folder / f"{camera.name}.yml").write_text(text)
    clips(folder, ["00120", "00121", "00122", "00123"])
    assert read_project(folder).rig.names == ("00120", "00121", "00122", "00123")


def test_opencv_files_with_one_camera_name_are_named_by_their_files(folder: Path, check: Import) -> None:
    rig = make_rig()
    for camera in rig:
        text = storage_text(opencv_values(camera), ".yml") + "camera_name: narrow_stereo\n"
        (folder / f"{camera.name}.yml").write_text(text)
    clips(folder)
    check(folder, rig, tolerance_px=EXACT_PX)


def test_opencv_intrinsics_alone_are_refused(folder: Path) -> None:
    for camera in make_rig():
        values = opencv_values(camera)
        del values["rvec"], values["tvec"]
        (folder / f"{camera.name}.yml").write_text(storage_text(values, ".yml"))
    clips(folder)
    with refused(CalibrationError, "camera 'cam1' has no rvec and tvec, where it stands", folder):
        read_project(folder)


@pytest.mark.parametrize(("model", "kind"), [
    ("SIMPLE_PINHOLE", "none"), ("PINHOLE", "none"), ("SIMPLE_RADIAL", "k1"), ("RADIAL", "k1k2"), ("OPENCV", "p"),
    ("FULL_OPENCV", "rational"), ("OPENCV_FISHEYE", "fisheye"),
])  # fmt: skip
def test_colmap(folder: Path, check: Import, model: str, kind: str) -> None:
    """COLMAP's world is turned, shifted and has another unit; the measured distance of two cameras gives its scale."""
    rig = lens(make_rig(), kind)
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):  # one focal length
        square = [np.array([[K[0, 0], 0, K[0, 2]], [0, K[0, 0], K[1, 2]], [0, 0, 1]]) for K in (c.matrix for c in rig)]
        rig = Rig(tuple(replace(camera, matrix=K) for camera, K in zip(rig, square, strict=True)))
    turn = Rotation.from_euler("xyz", [0.4, -1.1, 0.2]).as_matrix()
    world = moved(rig, turn, np.array([0.3, -0.2, 0.5]))
    write_colmap(folder / "sparse" / "0", moved(world, np.eye(3), np.zeros(3), scale=0.37), model)
    clips(folder)
    apart = float(np.linalg.norm(rig[0].center - rig[2].center))
    found = read_project(folder, Wanted(scale=f"cam1,cam3={apart!r}")).rig
    X = points() @ turn.T + np.array([0.3, -0.2, 0.5])
    for camera, true in zip(found, rig, strict=True):
        np.testing.assert_allclose(camera.project(X)[0], true.project(points())[0], atol=EXACT_PX, rtol=0)


def test_colmap_without_scale_asks_for_it(folder: Path) -> None:
    write_colmap(folder, make_rig())
    clips(folder)
    with refused(CalibrationError, "the length of its unit is arbitrary; measure the distance", folder / "images.txt"):
        read_project(folder)
    assert read_project(folder, Wanted(unit="m")).rig.names == tuple(NAMES)


@pytest.mark.parametrize(("scale", "complaint"), [
    ("cam1,cam9=2", "must name two cameras of"), ("cam1,cam1=2", "must name two cameras of"),
    ("cam1,cam2=-1", "must be metres in one unit"), ("nan", "must be metres in one unit"), ("x", "must be metres in"),
])  # fmt: skip
def test_wrong_scale_is_refused(folder: Path, scale: str, complaint: str) -> None:
    write_colmap(folder, make_rig())
    clips(folder)
    with refused(CalibrationError, complaint):
        read_project(folder, Wanted(scale=scale))


def test_colmap_images_of_a_standing_camera_are_one_camera(folder: Path) -> None:
    write_colmap(folder, make_rig(), images=3, turn_deg=0.05)
    clips(folder)
    project = read_project(folder, Wanted(unit="m"))
    assert project.rig.names == tuple(NAMES)
    assert sum("3 images of camera" in note for note in project.notes) == 4


def test_colmap_of_a_moving_camera_is_refused(folder: Path) -> None:
    write_colmap(folder, make_rig(), images=3, turn_deg=4)
    clips(folder)
    with refused(CalibrationError, "the 3 images of camera 'cam1' have different poses, up to 8.0° apart"):
        read_project(folder, Wanted(unit="m"))


def test_binary_colmap_model_names_the_command_that_converts_it(folder: Path) -> None:
    (folder / "cameras.bin").write_bytes(b"\0" * 64)
    (folder / "images.bin").write_bytes(b"\0" * 64)
    clips(folder)
    with refused(CalibrationError, "binary model") as caught:
        read_project(folder)
    assert caught.value.hint.startswith("colmap model_converter")


@pytest.mark.parametrize("transposed", [False, True])
def test_optitrack(folder: Path, check: Import, transposed: bool) -> None:
    y_up = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    rig = renamed(make_rig(world=y_up), "C11764", "C11765", "C11766", "C11767")
    write_mcal(folder, rig, transposed)
    write_clips(
        folder / "videos", [f"Take 1-Camera {k} ({name})" for k, name in enumerate(rig.names, 1)], suffix=".avi"
    )
    checked = check(folder, rig, world=y_up, tolerance_px=EXACT_PX)
    assert checked.capture.up == "y"
    assert any("map the world to the camera's frame" in note for note in checked.imported.notes) == transposed


@pytest.mark.parametrize("translation", [False, True])
@pytest.mark.parametrize("y_down", [False, True])
def test_theia_axes_are_found_from_the_cameras(folder: Path, check: Import, translation: bool, y_down: bool) -> None:
    rig = make_rig()
    axes = np.eye(3) if y_down else Y_UP
    cameras = []
    for camera in rig:
        R, K, d = axes @ camera.rotation, camera.matrix, camera.distortions
        x, y, z = 1000 * (axes @ camera.translation if translation else camera.center)
        r = " ".join(f'r{i + 1}{j + 1}="{float(R[i, j])!r}"' for i in range(3) for j in range(3))
        cameras.append(
            f'<camera active="1" serial="{camera.name}" viewrotation="0"><transform x="{float(x)!r}" '
            f'y="{float(y)!r}" z="{float(z)!r}" {r}/><intrinsic sensorMinU="0" sensorMinV="0" sensorMaxU="{WIDTH}" '
            f'sensorMaxV="{HEIGHT}" focalLengthU="{float(K[0, 0])!r}" focalLengthV="{float(K[1, 1])!r}" '
            f'centerPointU="{float(K[0, 2])!r}" centerPointV="{float(K[1, 2])!r}" radialDistortion1="{float(d[0])!r}" '
            f'radialDistortion2="{float(d[1])!r}" tangentalDistortion1="{float(d[2])!r}" '
            f'tangentalDistortion2="{float(d[3])!r}"/></camera>'
        )
    (folder / "cal.txt").write_text(f"<calibration><cameras>{''.join(cameras)}</cameras></calibration>")
    clips(folder)
    check(folder, rig, tolerance_px=EXACT_PX)


def test_usual_reading_of_qualisys_needs_no_note(folder: Path) -> None:
    write_qca(folder / "session.qca.txt", make_rig())
    clips(folder)
    assert not any("in the first reading" in note for note in read_project(folder).notes)
