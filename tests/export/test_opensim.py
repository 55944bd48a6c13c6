"""TRC and MOT, read field by field as OpenSim's documentation lays them out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.export.conftest import BODY, FIRST, FPS, FRAMES, LOST, SKELETON, Write, poses
from tk.export import export, read_motion
from tk.export.mot import coordinates
from tk.model.body.rotations import compose, follow_rotations, turn
from tk.model.body.skeleton import JOINTS, build_skeleton


@dataclass(frozen=True)
class Trc:
    header: dict[str, str]
    markers: tuple[str, ...]
    frames: np.ndarray
    times: np.ndarray
    points: np.ndarray  # (F, M, 3), NaN where blank


def read_trc(path: Path) -> Trc:
    """Three header lines, two of column labels, a blank one, the rows; tabs between fields."""
    lines = path.read_text().split("\n")
    assert lines[0].split("\t")[:3] == ["PathFileType", "4", "(X/Y/Z)"] and lines[0].split("\t")[3] == path.name
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    labels = lines[3].split("\t")
    assert labels[:2] == ["Frame#", "Time"]
    count = int(header["NumMarkers"])
    markers = tuple(labels[2 + 3 * m] for m in range(count))
    assert all(label == "" for k, label in enumerate(labels[2:]) if k % 3)
    assert lines[4].split("\t") == ["", "", *(f"{axis}{m + 1}" for m in range(count) for axis in "XYZ")]
    assert lines[5].strip() == "" and lines[-1] == ""
    rows = [line.split("\t") for line in lines[6:-1]]
    # OpenSim 4.6 takes a tab at a line's end for its end
    rows = [row[:-1] if row[-1] == "" else row for row in rows]
    assert len(rows) == int(header["NumFrames"]) and {len(row) for row in rows} == {2 + 3 * count}
    values = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
    return Trc(header, markers, values[:, 0], values[:, 1], values[:, 2:].reshape(len(rows), count, 3))


def read_mot(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """A name, key=value lines up to endheader, labels, rows."""
    lines = path.read_text().splitlines()
    end = lines.index("endheader")
    header = dict(line.split("=") for line in lines[1:end])
    labels = lines[end + 1].split("\t")
    rows = np.array([[float(cell) for cell in line.split("\t")] for line in lines[end + 2 :]])
    assert int(header["nRows"]) == len(rows) and int(header["nColumns"]) == len(labels) == rows.shape[1]
    assert labels[0] == "time"
    return header, dict(zip(labels, rows.T, strict=True))


def known() -> np.ndarray:
    return np.setdiff1d(np.arange(FRAMES), LOST)


def test_trc_holds_the_joints(write: Write) -> None:
    path = write()
    (target,) = export(path, ["trc"]).files
    assert target == path.with_suffix(".trc")
    found = read_trc(target)
    assert found.header["Units"] == "mm" and found.markers[:15] == JOINTS
    assert [float(found.header[name]) for name in ("DataRate", "CameraRate", "OrigDataRate")] == [FPS] * 3
    assert (found.header["OrigDataStartFrame"], found.header["OrigNumFrames"]) == (str(FIRST + 1), str(FRAMES))
    np.testing.assert_array_equal(found.frames, np.arange(1, FRAMES + 1))
    np.testing.assert_allclose(found.times, (FIRST + np.arange(FRAMES)) / FPS, atol=1e-6)
    assert np.isnan(found.points[list(LOST)]).all()
    joints = np.array([SKELETON.joints(pose) for pose in poses()])[known()]
    x, y, z = np.moveaxis(1000 * joints, -1, 0)
    np.testing.assert_allclose(found.points[known(), :15], np.stack([x, z, -y], axis=-1), atol=1e-3)


def test_trc_is_upright_whatever_the_world(write: Write) -> None:
    skeleton = build_skeleton(read_motion(write())[0].dimensions, "-y")
    a = read_trc(export(write("a.h5"), ["trc"]).files[0]).points
    b = read_trc(export(write("b.h5", skeleton, up="-y"), ["trc"]).files[0]).points
    # the same pose: about the pelvis the same points; the root's coordinates are along the world's axes in both
    np.testing.assert_allclose(a - a[:, :1], b - b[:, :1], atol=1e-3)
    assert np.nanmean(b[:, JOINTS.index("head_top"), 1] - b[:, JOINTS.index("ankle_l"), 1]) > 500


def test_mot_has_opensims_header_and_leaves_lost_frames_out(write: Write) -> None:
    header, columns = read_mot(export(write(), ["mot"]).files[0])
    assert header["inDegrees"] == "yes" and header["version"] == "1"
    np.testing.assert_allclose(columns["time"], (FIRST + known()) / FPS, atol=1e-6)
    for name in ("pelvis_tilt", "pelvis_tx", "lumbar_extension", "hip_flexion_r", "arm_rot_l", "elbow_flex_r"):
        assert name in columns
    for side in "lr":
        flexion = np.degrees(poses()[known(), SKELETON.index(f"knee_{side}_flexion")])
        np.testing.assert_allclose(columns[f"knee_angle_{side}"], flexion, atol=1e-4)
        elbow = np.degrees(poses()[known(), SKELETON.index(f"elbow_{side}_flexion")])
        np.testing.assert_allclose(columns[f"elbow_flex_{side}"], elbow, atol=1e-4)


def test_mot_angles_reproduce_the_limb_directions(write: Write) -> None:
    """The joints again from the coordinates, as OpenSim's model turns: Z-X-Y, the left side's X and Y mirrored."""
    motion, _ = read_motion(write())
    at = {name: np.radians(values) for name, values in coordinates(motion).items()}

    def ball(z: str, x: str, y: str, sign: float = 1.0) -> np.ndarray:
        return turn("z", at[z]) @ turn("x", sign * at[x]) @ turn("y", sign * at[y])

    pelvis = ball("pelvis_tilt", "pelvis_list", "pelvis_rotation")
    torso = pelvis @ ball("lumbar_extension", "lumbar_bending", "lumbar_rotation")
    points = {name: motion.point(name)[:, [0, 2, 1]] * [1, 1, -1] for name in motion.point_names}
    down = np.array([0.0, -1.0, 0.0])
    for side, sign in (("_r", 1.0), ("_l", -1.0)):
        thigh = pelvis @ ball(f"hip_flexion{side}", f"hip_adduction{side}", f"hip_rotation{side}", sign)
        calf = thigh @ turn("z", -at[f"knee_angle{side}"])
        arm = torso @ ball(f"arm_flex{side}", f"arm_add{side}", f"arm_rot{side}", sign)
        forearm = arm @ turn("z", at[f"elbow_flex{side}"])
        for R, upper, lower in (
            (thigh, "hip", "knee"), (calf, "knee", "ankle"), (arm, "shoulder", "elbow"), (forearm, "elbow", "wrist"),
        ):  # fmt: skip
            bone = points[lower + side] - points[upper + side]
            np.testing.assert_allclose(R @ down, bone / np.linalg.norm(bone, axis=1)[:, None], atol=1e-6)


def test_mot_pelvis_is_rajagopals_origin(write: Write) -> None:
    """The hip centres of the model, placed by the coordinates and scaled to the body, are those of the result."""
    motion, _ = read_motion(write())
    at = coordinates(motion)
    turns = [np.radians(at[f"pelvis_{name}"]) for name in ("tilt", "list", "rotation")]
    R = turn("z", turns[0]) @ turn("x", turns[1]) @ turn("y", turns[2])
    origin = np.stack([at[f"pelvis_t{axis}"] for axis in "xyz"], axis=1)
    scale = BODY.hip_half_width / 0.07726
    for side, sign in (("r", 1.0), ("l", -1.0)):
        hip = origin + R @ (scale * np.array([-0.056276, -0.07849, sign * 0.07726]))
        x, y, z = motion.point(f"hip_{side}").T
        np.testing.assert_allclose(hip, np.stack([x, z, -y], axis=1), atol=1e-6)


def test_mot_angles_of_a_level_arm_do_not_jump() -> None:
    """An arm held level to the side is singular in Z-X-Y; noise of half a degree moves the angles by a few degrees."""
    level, frames = compose("zxy", np.radians([0.0, -90.0, 0.0])), 60
    noise = Rotation.from_rotvec(np.random.default_rng(0).normal(0, np.radians(0.5), (frames, 3))).as_matrix()
    found = follow_rotations("zxy", level @ noise)
    assert np.degrees(np.abs(np.diff(found, axis=0)).max()) < 5
    error = Rotation.from_matrix(np.swapaxes(compose("zxy", found), 1, 2) @ level @ noise).magnitude()
    assert np.degrees(error.max()) < 1.5
    hanging = np.repeat(compose("zxy", np.radians([[10.0, -20.0, 5.0]])), 100, axis=0)
    found = np.degrees(follow_rotations("zxy", np.concatenate([level @ noise, hanging])))
    np.testing.assert_allclose(found[-1], [10.0, -20.0, 5.0], atol=1e-6)
    steep = compose("zxy", np.radians([[10.0, -75.0, 20.0], [30.0, 60.0, -20.0]]))
    np.testing.assert_allclose(compose("zxy", follow_rotations("zxy", steep)), steep, atol=1e-12)


@pytest.mark.parametrize(("level", "lowered"), [(-90.0, True), (-87.0, True), (-87.0, False), (-84.0, False)])
def test_recording_may_begin_with_level_arms(level: float, lowered: bool) -> None:
    """Turned arms that are lowered later, or are at least 3° from level, have their angles from the first frame."""
    angles = np.repeat([[0.0, level, 60.0]], 60, axis=0)
    angles[30:, 1] += np.arange(30) * 3.0 * lowered
    found = np.degrees(follow_rotations("zxy", compose("zxy", np.radians(angles))))
    np.testing.assert_allclose(found, angles, atol=4.0)


def test_person_at_rest_has_constant_angles_from_the_first_frame() -> None:
    """Arms 3° from level, which are then lowered past the singular direction."""
    at_rest = np.repeat(compose("zxy", np.radians([[-50.0, -93.0, -40.0]])), 12, axis=0)
    lowered = compose("zxy", np.radians([[0.0, -80.0 + 5 * f, 20.0] for f in range(12)]))
    found = np.degrees(follow_rotations("zxy", np.concatenate([at_rest, lowered])))
    np.testing.assert_allclose(found[:12], np.repeat([[-50.0, -93.0, -40.0]], 12, axis=0), atol=4.0)
    np.testing.assert_allclose(found[13:], [[0.0, -80.0 + 5 * f, 20.0] for f in range(1, 12)], atol=4.0)


def test_mot_angles_are_continuous(write: Write) -> None:
    motion, _ = read_motion(write())
    turning = {name: values for name, values in coordinates(motion).items() if not name.startswith("pelvis_t")}
    assert np.ptp(turning["pelvis_rotation"]) > 270  # a whole turn of the trunk; the waist turns, too
    for name, values in turning.items():
        assert np.abs(np.diff(values)).max() < 120, name
