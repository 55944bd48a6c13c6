"""Makes a capture of a walk of the CMU Motion of Body (MoBo) database, the recordings of the paper on silhouettes.

    python -m scripts.paper.mobo ROOT/moboJpg/04002/slowWalk CAPTURE

The capture links to the pictures and masks.

R. Gross and J. Shi, *The CMU Motion of Body (MoBo) Database*, CMU-RI-TR-01-18, 2001: 25 subjects on a treadmill, four
walks, six cameras (vr03_7, vr05_7, vr07_7, vr13_7, vr16_7, vr17_7), 30 frames/s, masks from a background subtraction.

    ROOT/moboJpg/04002/slowWalk/vr03_7/*.jpg       images: the capture is the folder of the walk
    ROOT/moboBgSub/04002/slowWalk/vr03_7/*         masks, in a tree beside it; optional
    ROOT/calibration/vr03_7.cal                    cameras; or beside the images, or in any folder between

A camera file holds the parameters of Tsai's model, one number after the other, as R. Willson's programs order them:
Ncx, Nfx, dx, dy, dpx, dpy, Cx, Cy, sx, f, kappa1, Tx, Ty, Tz, Rx, Ry, Rz (millimetres, radians).

Neither the database nor the report's section on files was at hand when this was written: the names of folders and
files, the order of the numbers and the vertical axis (z) are from memory, and tested on generated data only.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray

from tk.errors import CalibrationError, CaptureError, TkError
from tk.io.captures.calibration import camera_table
from tk.io.paths import c_name
from tk.model.cameras.camera import Camera, Rig

#: the walks begin in any pose
_SETTINGS = 'fps = 30.0\nup = "z"\n\n[init]\npose = "any"\n'

_PICTURES, _MASKS = "moboJpg", "moboBgSub"
_NUMBERS = (
    *("Ncx", "Nfx", "dx", "dy", "dpx", "dpy", "Cx", "Cy", "sx"),
    *("f", "kappa1", "Tx", "Ty", "Tz", "Rx", "Ry", "Rz"),
)


@dataclass(frozen=True)
class MoboWalk:
    """One walk of one subject.

    Attributes:
        path: folder with a folder of images for each camera.
        files: camera files, by camera.
        masks: folder of the masks; None if there is none.
    """

    path: Path
    files: dict[str, Path]
    masks: Path | None


def find_walk(path: Path) -> MoboWalk | None:
    """Return the walk at ``path``; None if the folder has no ``vr…`` folders."""
    cameras = sorted(folder.name for folder in path.glob("vr[0-9][0-9]*") if folder.is_dir())
    if not cameras:
        return None
    files: dict[str, Path] = {}
    full = path.resolve()
    for folder in [full, *full.parents[:3]]:
        for name in cameras:
            for file in (folder / f"{name}.cal", folder / "calibration" / f"{name}.cal", folder / name / f"{name}.cal"):
                if name not in files and file.is_file():
                    files[name] = file
    parts = list(full.parts)
    masks = None
    if _PICTURES in parts:
        parts[parts.index(_PICTURES)] = _MASKS
        masks = Path(*parts) if Path(*parts).is_dir() else None
    return MoboWalk(path, files, masks)


def read_cameras(walk: MoboWalk) -> Rig:
    """Return the cameras of a walk that have a camera file; their sizes are those of the images.

    Raises:
        CalibrationError: fewer than two cameras have one, or a file cannot be read.
    """
    if len(walk.files) < 2:
        raise CalibrationError(
            f"{walk.path}: looks like a MoBo walk, but {len(walk.files)} of its vr… folders have a camera file; put "
            "vr03_7.cal and so on beside them"
        )
    return Rig(tuple(_read_camera(name, file, _picture_size(walk.path / name)) for name, file in walk.files.items()))


def write_capture(path: Path, output: Path) -> None:
    """Write the capture of the walk at a path: calibration, settings, and links to pictures and masks.

    Raises:
        CaptureError: there is no walk, or the capture exists.
        CalibrationError: see :func:`read_cameras`.
    """
    walk = find_walk(path)
    if walk is None:
        raise CaptureError(f"{path}: is no MoBo walk: it has no folders vr03_7 and so on")
    if output.exists():
        raise CaptureError(f"{output}: exists; give another folder")
    rig = read_cameras(walk)
    trees = {"images": walk.path, **({"masks": walk.masks} if walk.masks else {})}
    for tree, folder in trees.items():
        (output / tree).mkdir(parents=True)
        for name in rig.names:
            (output / tree / name).symlink_to((folder / name).resolve(), target_is_directory=True)
    tables = {camera.name: camera_table(camera) for camera in rig}
    (output / "calibration.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
    (output / "capture.toml").write_text(_SETTINGS, encoding="utf-8")


def _read_camera(name: str, file: Path, size: tuple[int, int]) -> Camera:
    try:
        values = np.array([float(word) for word in file.read_text(encoding="utf-8").split()])
    except (OSError, ValueError) as error:
        raise CalibrationError(f"{file}: cannot be read as numbers: {error}") from None
    if len(values) != len(_NUMBERS) or not np.isfinite(values).all():
        raise CalibrationError(f"{file}: holds {len(values)} numbers; the {len(_NUMBERS)} are {' '.join(_NUMBERS)}")
    return camera_from_tsai(name, dict(zip(_NUMBERS, values.tolist(), strict=True)), size, file)


def camera_from_tsai(name: str, tsai: dict[str, float], size: tuple[int, int], file: Path) -> Camera:
    """Return a camera from Tsai's parameters (millimetres, radians).

    Tsai undistorts by 1 + kappa1 r² in the sensor's plane; the camera here distorts. The inverse's series gives
    k1 = -κf², k2 = 3κ²f⁴, k3 = -12κ³f⁶.

    Raises:
        CalibrationError: a length that must be positive is not.
    """
    for key in ("dpx", "dpy", "sx", "f"):
        if not tsai[key] > 0:
            raise CalibrationError(f"{file}: {key} = {tsai[key]} must be positive")
    f = tsai["f"]
    K = np.array([[tsai["sx"] * f / tsai["dpx"], 0, tsai["Cx"]], [0, f / tsai["dpy"], tsai["Cy"]], [0, 0, 1.0]])
    k = tsai["kappa1"] * f * f
    rotation = rotation_zyx(tsai["Rx"], tsai["Ry"], tsai["Rz"])
    translation = 1e-3 * np.array([tsai["Tx"], tsai["Ty"], tsai["Tz"]])
    distortions = np.array([-k, 3 * k * k, 0.0, 0.0, -12 * k**3])
    return Camera(name, size[0], size[1], K, distortions, rotation, translation)


def rotation_zyx(x: float, y: float, z: float) -> NDArray[np.float64]:
    """Return the matrix Rz Ry Rx (3, 3)."""
    axes = np.diag([x, y, z])
    Rx, Ry, Rz = (cv2.Rodrigues(axis)[0] for axis in axes)
    return np.asarray(Rz @ Ry @ Rx, np.float64)


def _picture_size(folder: Path) -> tuple[int, int]:
    for file in sorted(folder.iterdir()):
        picture = cv2.imread(c_name(file, CalibrationError)) if file.is_file() and file.suffix != ".cal" else None
        if picture is not None:
            return picture.shape[1], picture.shape[0]
    raise CalibrationError(f"{folder}: holds no pictures")


def main() -> None:
    """Make the capture that the arguments name."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("walk", type=Path, help="folder with a folder of images for each camera")
    parser.add_argument("capture", type=Path, help="folder to make")
    given = parser.parse_args()
    try:
        write_capture(given.walk, given.capture)
    except TkError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
