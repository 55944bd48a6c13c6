"""BVH, read by the package bvh; its channels applied as BVH's readers do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from bvh import Bvh

from tests.export.conftest import FPS, FRAMES, SKELETON, Write, poses
from tk.export import export, read_motion
from tk.model.body.rotations import turn
from tk.model.body.skeleton import JOINTS, build_skeleton

ARMS = tuple(f"{joint}_{side}" for joint in ("shoulder", "elbow", "wrist") for side in "lr")


def places(path: Path, at: int | None) -> dict[str, np.ndarray]:
    """(3,) of every joint in a frame, and of tips as ``tip of <joint>``; None: the rest pose."""
    file = Bvh(path.read_text())
    found: dict[str, np.ndarray] = {}
    turned: dict[str, np.ndarray] = {}
    for name in file.get_joints_names():
        parent = file.joint_parent(name)
        offset = np.array(file.joint_offset(name))
        R = np.eye(3)
        for channel in file.joint_channels(name) if at is not None else ():
            value = file.frame_joint_channel(at, name, channel)
            if channel.endswith("position"):
                offset["XYZ".index(channel[0])] += value
            else:
                R = R @ turn(channel[0].lower(), np.radians(value))
        if parent is None:
            found[name], turned[name] = offset, R
        else:
            found[name] = found[parent.name] + turned[parent.name] @ offset
            turned[name] = turned[parent.name] @ R
        for end in file.get_joint(name).filter("End"):
            found[f"tip of {name}"] = found[name] + turned[name] @ np.array([float(x) for x in end["OFFSET"]])
    return found


def test_bvh_reproduces_the_joints_within_three_millimetres(write: Write) -> None:
    path = write()
    motion, _ = read_motion(path)
    (target,) = export(path, ["bvh"]).files
    file = Bvh(target.read_text())
    assert file.nframes == FRAMES and abs(file.frame_time - 1 / FPS) < 1e-7
    for f in np.flatnonzero(motion.known):
        found = places(target, f)
        found["head_top"] = found["tip of neck"]
        for name in JOINTS:
            x, y, z = motion.point(name)[f]  # forward, left, up
            length = 3e-3 if name.endswith(ARMS) else 1e-4  # the clavicle's length varies, the format holds one
            np.testing.assert_allclose(found[name], [y, z, x], atol=length, err_msg=name)
        toe = motion.point("toe_r")[f]
        np.testing.assert_allclose(found["tip of ankle_r"], toe[[1, 2, 0]], atol=1e-4)


def test_lengths_in_centimetres(write: Write) -> None:
    path = write()
    metres = places(export(path, ["bvh"]).files[0], 3)
    centimetres = places(export(path, ["bvh"], force=True, bvh_units="cm").files[0], 3)
    for name, place in metres.items():
        np.testing.assert_allclose(centimetres[name], 100 * place, atol=1e-2, err_msg=name)


def test_rest_pose_is_a_t(write: Write) -> None:
    (target,) = export(write(), ["bvh"]).files
    rest = places(target, None)
    body = read_motion(write())[0].dimensions
    np.testing.assert_allclose(rest["wrist_l"] - rest["shoulder_l"], [body.upper_arm + body.forearm, 0, 0], atol=1e-5)
    np.testing.assert_allclose(rest["wrist_r"] - rest["shoulder_r"], [-body.upper_arm - body.forearm, 0, 0], atol=1e-5)
    np.testing.assert_allclose(rest["ankle_l"] - rest["hip_l"], [0, -body.thigh - body.calf, 0], atol=1e-5)
    assert rest["tip of ankle_l"][2] > rest["ankle_l"][2] + 0.1  # the toes point forward
    assert rest["hip_l"][0] > 0 > rest["hip_r"][0]


def test_only_the_root_has_position_channels(write: Write) -> None:
    """Programs differ: some add position channels to the OFFSET, others replace it. The root's OFFSET is 0."""
    written = export(write(), ["bvh"])
    file = Bvh(written.files[0].read_text())
    channels = {name: len(file.joint_channels(name)) for name in file.get_joints_names()}
    assert channels.pop("pelvis") == 6 and {*channels.values()} == {3}
    assert file.joint_offset("pelvis") == (0, 0, 0)
    assert file.joint_parent("shoulder_l").name == "clavicle_l" and file.joint_parent("clavicle_r").name == "lumbar"
    assert not any("off:" in note for note in written.notes)


def test_segment_whose_length_varies_is_reported(write: Write) -> None:
    def rows(f: int) -> dict[str, np.ndarray]:
        joints = SKELETON.joints(poses()[f])
        elbow, wrist = joints[JOINTS.index("elbow_l")], joints[JOINTS.index("wrist_l")]
        joints[JOINTS.index("wrist_l")] = elbow + (1.3 if f == 7 else 1.0) * (wrist - elbow)
        return {"joints/position": joints}

    path = write(rows=rows)
    target, note = export(path, ["bvh"]).files[0], export(path, ["bvh"], force=True).notes[-1]
    assert (
        note == f"{target}: joints are up to 7.8 cm off: the segments' lengths vary, and the format holds one of each"
    )


def test_another_axis_up(write: Write) -> None:
    skeleton = build_skeleton(read_motion(write())[0].dimensions, "-y")
    (target,) = export(write("y.h5", skeleton, up="-y"), ["bvh"]).files
    (other,) = export(write("z.h5", SKELETON), ["bvh"]).files
    a, b = places(target, 3), places(other, 3)
    for name, place in a.items():
        np.testing.assert_allclose(place - a["pelvis"], b[name] - b["pelvis"], atol=1e-4)
