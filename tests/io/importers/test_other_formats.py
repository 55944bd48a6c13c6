"""EasyMocap, OpenCap, CMU Panoptic and plain projection matrices."""

from __future__ import annotations

import json
import pickle
import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.io.conftest import picture, write_picture
from tests.io.importers.conftest import (
    FRAMES,
    HEIGHT,
    WIDTH,
    Y_DOWN,
    Import,
    make_rig,
    projection_matrix,
    renamed,
    write_clips,
)
from tk.errors import CalibrationError, CaptureError
from tk.io.importers import import_project
from tk.io.importers.projections import factorise
from tk.model.cameras.camera import Rig

CONVERTER = Path(__file__).resolve().parents[3] / "docs" / "examples" / "convert_opencap.py"


def write_yml(path: Path, names: list[str], matrices: dict[str, np.ndarray], numbers: dict[str, int]) -> None:
    """Write YAML as EasyMocap does."""
    lines = ["%YAML:1.0", "---", "names:", *(f'  - "{name}"' for name in names)]
    for key, values in matrices.items():
        flat = ", ".join(f"{value:.10f}" for value in values.ravel())
        rows, columns = values.shape
        lines += [f"{key}: !!opencv-matrix", f"  rows: {rows}", f"  cols: {columns}", "  dt: d", f"  data: [{flat}]"]
    lines += [f"{key}: {value}" for key, value in numbers.items()]
    path.write_text("\r\n".join(lines) + "\r\n")


def write_easymocap(folder: Path, rig: Rig, sizes: bool = True, vectors: bool = True) -> None:
    names = [camera.name for camera in rig]
    intri, extri, numbers = {}, {}, {}
    for camera in rig:
        intri[f"K_{camera.name}"] = camera.matrix
        intri[f"dist_{camera.name}"] = camera.distortions[None]
        if sizes:
            numbers |= {f"H_{camera.name}": HEIGHT, f"W_{camera.name}": WIDTH}
        if vectors:
            extri[f"R_{camera.name}"] = cv2.Rodrigues(camera.rotation)[0]
        else:
            extri[f"Rot_{camera.name}"] = camera.rotation
        extri[f"T_{camera.name}"] = camera.translation[:, None]
    write_yml(folder / "intri.yml", names, intri, numbers)
    write_yml(folder / "extri.yml", names, extri, {})


@pytest.mark.parametrize(("sizes", "vectors"), [(True, True), (False, False)])
def test_easymocap(folder: Path, check: Import, sizes: bool, vectors: bool) -> None:
    rig = renamed(make_rig(), "1", "2", "3", "04")
    write_easymocap(folder, rig, sizes, vectors)
    write_clips(folder / "videos", ["1", "2", "3", "04"])
    assert check(folder, rig).capture.rig.names == ("1", "2", "3", "04")


def test_easymocap_with_pictures(folder: Path, check: Import) -> None:
    rig = renamed(make_rig(), "01", "02", "03", "04")
    write_easymocap(folder, rig)
    for index, camera in enumerate(rig):
        for k in range(FRAMES):
            write_picture(folder / "images" / camera.name / f"{k:06d}.png", picture(index, k, (WIDTH, HEIGHT)))
    checked = check(folder, rig)
    assert sorted(path.name for path in checked.imported.path.iterdir()) == [
        "calibration.toml",
        "capture.toml",
        "images",
    ]


def test_easymocap_files_written_by_opencv(folder: Path, check: Import) -> None:
    """Numbers like `1.`, lines that are wrapped, names within brackets."""
    rig = make_rig()
    for file, keys in (("intri.yml", ("K", "dist")), ("extri.yml", ("Rot", "T"))):
        storage = cv2.FileStorage(str(folder / file), cv2.FILE_STORAGE_WRITE)
        storage.startWriteStruct("names", cv2.FileNode_SEQ | (cv2.FileNode_FLOW if file == "intri.yml" else 0))
        for camera in rig:
            storage.write("", camera.name)
        storage.endWriteStruct()
        for camera in rig:
            for key in keys:
                values = {
                    "K": camera.matrix,
                    "dist": camera.distortions,
                    "Rot": camera.rotation,
                    "T": camera.translation,
                }
                storage.write(f"{key}_{camera.name}", values[key])
        storage.release()
    write_clips(folder / "videos", [camera.name for camera in rig])
    check(folder, rig)


def test_easymocap_camera_without_a_pose(folder: Path, check: Import) -> None:
    rig = make_rig()
    write_easymocap(folder, rig)
    text = (folder / "extri.yml").read_text().replace("T_cam4:", "S_cam4:")
    (folder / "extri.yml").write_text(text)
    write_clips(folder / "videos", ["cam1", "cam2", "cam3", "cam4"])
    check(folder, Rig(rig.cameras[:3])).note("'cam4' has no R_cam4 and T_cam4 in extri.yml: left out")


class Trap:
    """An object that makes a file when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self.trace,)


def test_opencap_is_refused_unopened(folder: Path, check: Import) -> None:
    trace = folder / "trace"
    camera = folder / "Videos" / "Cam0"
    camera.mkdir(parents=True)
    (camera / "cameraIntrinsicsExtrinsics.pickle").write_bytes(pickle.dumps(Trap(trace)))
    with pytest.raises(CalibrationError) as caught:
        import_project(folder, check.output)
    assert not trace.exists()
    text = str(caught.value)
    assert "cameraIntrinsicsExtrinsics.pickle: is a Python pickle" in text and "docs/import.md" in text
    assert "\n" not in text


def write_panoptic(folder: Path, rig: Rig, names: list[str]) -> Path:
    cameras = [
        {
            "name": name,
            "type": "hd",
            "resolution": [WIDTH, HEIGHT],
            "panel": 0,
            "node": index,
            "K": camera.matrix.tolist(),
            "distCoef": camera.distortions.tolist(),
            "R": camera.rotation.tolist(),
            "t": (100 * camera.translation[:, None]).tolist(),
        }
        for index, (name, camera) in enumerate(zip(names, rig, strict=True))
    ]
    others = [
        {**cameras[0], "name": f"{panel:02d}_{node:02d}", "type": "vga"} for panel in (1, 2) for node in range(1, 25)
    ]
    path = folder / "calibration_171204_pose1.json"
    path.write_text(json.dumps({"calibDataSource": "160922_calib_norm", "cameras": [*others, *cameras]}))
    return path


def test_panoptic(folder: Path, check: Import) -> None:
    names = ["00_00", "00_03", "00_12", "00_23"]
    rig = make_rig(world=Y_DOWN)
    write_panoptic(folder, rig, names)
    write_clips(folder / "hdVideos", [f"hd_{name}" for name in names])
    checked = check(folder, rig, world=Y_DOWN)
    assert checked.capture.up == "-y" and checked.capture.rig.names == tuple(names)
    checked.note("up = -y: as CMU Panoptic defines it")
    checked.note("lengths are in cm, as the format says")
    checked.note("48 of its 52 cameras have no video here: left out")


@pytest.mark.parametrize("kind", ["txt", "npy", "contour"])
def test_projection_matrices(folder: Path, check: Import, kind: str) -> None:
    rig = make_rig(distorted=False)
    (folder / "calibration").mkdir()
    for index, camera in enumerate(rig):
        P = (-1.0) ** index * (0.3 + index) * projection_matrix(camera)  # its scale and sign mean nothing
        path = folder / "calibration" / camera.name
        if kind == "npy":
            np.save(path.with_suffix(".npy"), P)
        else:
            header = "CONTOUR" if kind == "contour" else "# P of this camera"
            np.savetxt(path.with_suffix(".txt"), P, header=header, comments="")
    (folder / "calibration" / "notes.txt").write_text("recorded on Monday")
    write_clips(folder / "videos", [camera.name for camera in rig])
    check(folder, rig).note("notes.txt: holds no 3×4 matrix: left out")


def test_factorise_refuses_singular_matrices() -> None:
    with pytest.raises(CalibrationError, match="left 3×3 part is singular"):
        factorise(np.ones((3, 4)), "P.txt")
    skewed = make_rig(distorted=False)[0]
    K = skewed.matrix + np.array([[0, 3.0, 0], [0, 0, 0], [0, 0, 0]])
    P = K @ np.column_stack([skewed.rotation, skewed.translation])
    found, rotation, translation = factorise(P, "P.txt")
    np.testing.assert_allclose(found, K, atol=1e-9)
    np.testing.assert_allclose(rotation, skewed.rotation, atol=1e-12)
    np.testing.assert_allclose(translation, skewed.translation, atol=1e-9)


def test_folder_of_texts_is_not_a_project(folder: Path, check: Import) -> None:
    (folder / "a.txt").write_text("1 2 3")
    (folder / "b.txt").write_text("1 2 3 4 5 6 7 8 9 10 11 nan")
    (folder / "c.npy").write_bytes(pickle.dumps(np.zeros((3, 4))))  # no array file
    with pytest.raises(CaptureError, match=r"has no calibration of a tool .*: it holds .*; searched: "):
        import_project(folder, check.output)


def test_conversion_script_of_the_docs_works(folder: Path, check: Import, monkeypatch: pytest.MonkeyPatch) -> None:
    """The script that docs/import.md links to converts the pickles to a project that tk reads."""
    rig = renamed(make_rig(), "Cam0", "Cam1", "Cam2", "Cam3")
    for camera in rig:
        kept = {
            "imageSize": np.array([[HEIGHT], [WIDTH]]),
            "intrinsicMat": camera.matrix,
            "distortion": camera.distortions[None],
            "rotation": camera.rotation,
            "translation": 1000 * camera.translation[:, None],
        }
        path = folder / "Videos" / camera.name / "cameraIntrinsicsExtrinsics.pickle"
        path.parent.mkdir(parents=True)
        path.write_bytes(pickle.dumps(kept))
    monkeypatch.setattr(sys, "argv", [CONVERTER.name, str(folder)])
    runpy.run_path(str(CONVERTER), run_name="__main__")
    write_clips(folder / "videos-raw", [camera.name for camera in rig], suffix=".mov")
    check(folder, rig).note("lengths are in mm, as the file says")
