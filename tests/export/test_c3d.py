"""C3D, read by ezc3d."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import ezc3d
import numpy as np
import pytest

from tests.conftest import Tk
from tests.export.conftest import FPS, FRAMES, LOST, Write
from tk.errors import ExportError, ResultError
from tk.export import export, read_motion
from tk.export.c3d import write_c3d
from tk.model.body.skeleton import JOINTS, SEGMENTS


def test_points_and_segments(write: Write) -> None:
    path = write()
    motion, _ = read_motion(path)
    (target,) = export(path, ["c3d"]).files
    file = ezc3d.c3d(str(target))
    parameters = file["parameters"]["POINT"]
    assert parameters["LABELS"]["value"] == list(motion.point_names) and parameters["UNITS"]["value"] == ["mm"]
    assert parameters["RATE"]["value"][0] == FPS and parameters["FRAMES"]["value"][0] == FRAMES
    points = file["data"]["points"][:3].transpose(2, 1, 0) / 1000
    np.testing.assert_allclose(points[motion.known], motion.points[motion.known], atol=1e-6)
    residuals = file["data"]["meta_points"]["residuals"][0]
    assert (residuals[:, list(LOST)] == -1).all() and (residuals[:, motion.known] == 0).all()
    assert np.isnan(points[list(LOST)]).all()

    assert file["parameters"]["ROTATION"]["LABELS"]["value"] == list(SEGMENTS)
    T = file["data"]["rotations"]
    assert T.shape == (4, 4, len(SEGMENTS), FRAMES)
    np.testing.assert_allclose(T[:3, :3].transpose(3, 2, 0, 1)[motion.known], motion.rotations[motion.known], atol=1e-6)
    knee = motion.points[motion.known, JOINTS.index("knee_r")]
    np.testing.assert_allclose(T[:3, 3, SEGMENTS.index("calf_r")].T[motion.known] / 1000, knee, atol=1e-6)
    assert np.isnan(T[:3, :3, :, list(LOST)]).all()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, where every write fails")
def test_full_disk_is_reported(write: Write) -> None:
    motion, _ = read_motion(write())
    with pytest.raises(OSError, match="No space left"):
        write_c3d(motion, Path("/dev/full"))


def test_missing_points_have_residual_minus_one(write: Write) -> None:
    """The words of a point, read without ezc3d: x, y, z and residual with cameras, as 32-bit floats."""
    path = write()
    data = export(path, ["c3d"]).files[0].read_bytes()
    count, (first, last) = struct.unpack_from("<H", data, 2)[0], struct.unpack_from("<HH", data, 6)
    scale, block = struct.unpack_from("<fH", data, 12)
    assert scale < 0, "floats"
    frames = last - first + 1
    words = np.frombuffer(data, "<f4", frames * count * 4, 512 * (block - 1)).reshape(frames, count, 4)
    assert 512 * (block - 1) + 16 * frames * count > len(data) - 512, (
        "nothing after the points but the last block's rest"
    )
    missing = np.isin(np.arange(FRAMES), LOST)
    assert (words[missing] == [0, 0, 0, -1]).all()
    assert (words[~missing, :, 3] >= 0).all() and (words[~missing, :, :3] != 0).any(axis=2).all()


def test_residual_is_the_standard_deviation(write: Write) -> None:
    sigma = np.full(15, 0.012)
    sigma[3], sigma[4] = np.nan, 0.3
    path = write(meta={"sigma": True}, rows=lambda f: {"joints/sigma": sigma})
    file = ezc3d.c3d(str(export(path, ["c3d"]).files[0]))
    residuals = file["data"]["meta_points"]["residuals"][0]
    assert residuals[0, 0] == 12 and residuals[3, 0] == 0 and residuals[0, LOST[0]] == -1
    assert residuals[4, 0] == 127, "as much as the format holds, and not what is left over from 256"


def test_missing_package_stops_its_format_only(tk: Tk, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write()
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(ExportError, match=r"c3d: needs the package ezc3d: pip install 'tk-mocap\[export\]'"):
        export(path, ["c3d"])
    assert not list(path.parent.glob("*c3d*"))
    assert not issubclass(ExportError, ResultError)
    ran = tk("export", path, "--to", "c3d,trc,bvh")
    assert ran.code == 1 and ran.err.splitlines()[-1].startswith("tk: not written: c3d: needs the package ezc3d")
    assert path.with_suffix(".trc").exists() and path.with_suffix(".bvh").exists()
