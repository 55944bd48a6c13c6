"""C3D, read by ezc3d."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
import pytest

from tests.export.conftest import FPS, FRAMES, LOST, Write
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


def words_of(path: Path) -> np.ndarray:
    """(F, P, 4) x, y, z and residual with cameras, read without ezc3d."""
    data = path.read_bytes()
    count, (first, last) = struct.unpack_from("<H", data, 2)[0], struct.unpack_from("<HH", data, 6)
    scale, block = struct.unpack_from("<fH", data, 12)
    assert scale < 0, "floats"
    frames = last - first + 1
    assert 512 * (block - 1) + 16 * frames * count > len(data) - 512, "nothing after the points but their block's rest"
    return np.frombuffer(data, "<f4", frames * count * 4, 512 * (block - 1)).reshape(frames, count, 4)


def test_missing_points_have_residual_minus_one(write: Write) -> None:
    words = words_of(export(write(), ["c3d"]).files[0])
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
    words = words_of(path.with_suffix(".c3d"))
    assert [int(word) & 0xFF for word in words[0, 3:5, 3]] == [0, 127] and (words[list(LOST), :, 3] == -1).all()


@pytest.mark.parametrize(("count", "first"), [(FRAMES, 30), (65535, 30), (65536, 30), (FRAMES, 65520), (FRAMES, 70000)])
def test_frames_have_their_numbers_in_the_recording(write: Write, tmp_path: Path, count: int, first: int) -> None:
    """The numbers of 32 bits and, where they fit, of 16 bits; every frame is read back. One point and segment: fast."""
    motion, _ = read_motion(write())
    rows = np.arange(count) % FRAMES
    motion = replace(
        motion,
        result=replace(motion.result.at_rows(rows), frames=first + np.arange(count)),
        point_names=("pelvis",),
        points=motion.points[rows][:, [motion.point_names.index("pelvis")]],
        sigma=np.zeros((count, 1)),
        segments=("pelvis",),
        rotations=motion.rotations[rows][:, [motion.segments.index("pelvis")]],
        known=motion.known[rows],
    )
    note = write_c3d(motion, tmp_path / "long.c3d")
    assert (note is None) == (count <= 65535), "only a long file lacks the segments"
    file = ezc3d.c3d(str(tmp_path / "long.c3d"))
    assert file["data"]["points"].shape == (4, 1, count)
    np.testing.assert_allclose(file["data"]["points"][:3, :, -1].T / 1000, motion.points[-1], atol=1e-6)
    assert file["data"]["rotations"].shape[3] == (count if note is None else 0)
    start, end = (file["parameters"]["TRIAL"][f"ACTUAL_{name}_FIELD"]["value"] for name in ("START", "END"))
    assert [int(low) % 65536 + 65536 * int(high) for low, high in (start, end)] == [first + 1, first + count]
    header = file["header"]["points"]
    assert header["last_frame"] - header["first_frame"] + 1 == count
    begin, end = struct.unpack_from("<HH", (tmp_path / "long.c3d").read_bytes(), 6)
    fits = first + count <= 65535
    assert (begin, end) == ((first + 1, first + count) if fits else (1, min(count, 65535)))
