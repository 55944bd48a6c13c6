"""2D keypoints as a start: files as OpenPose and Pose2Sim write them, and damaged ones."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scripts.synthetic.keypoints import write_keypoints
from tests.conftest import QUICK, Tk, refused, track, without_first_pose
from tk.errors import CaptureError
from tk.io import settings_file
from tk.io.captures.capture import Capture, open_capture
from tk.io.captures.clock import Resampled
from tk.io.captures.keypoints import LAYOUTS, keypoint_pose, read_people
from tk.io.results.reader import read_joints, read_result
from tk.model.body.skeleton import JOINTS

FRAME = 4


@pytest.fixture(scope="module")
def capture(tiny: Path) -> Capture:
    return open_capture(tiny)


@pytest.fixture(scope="module")
def true_joints(tiny: Path) -> np.ndarray:
    return np.asarray(read_joints(tiny / "truth.h5").positions[FRAME])


@pytest.fixture(scope="module")
def detected(tmp_path_factory: pytest.TempPathFactory, capture: Capture, true_joints: np.ndarray) -> Path:
    """Keypoints of frame 4 in pictures 160 wide, off by a pixel, one in ten wrong, with a bystander. Not to be
    changed."""
    folder = tmp_path_factory.mktemp("keypoints") / "pose"
    people = [true_joints, true_joints + np.array([2.2, 0.3, 0.0])]
    write_keypoints(folder, capture.rig, FRAME, people, np.random.default_rng(3), noise_px=1.0)
    return folder


@pytest.mark.parametrize("count", LAYOUTS)
def test_every_keypoint_layout_is_read(tmp_path: Path, capture: Capture, true_joints: np.ndarray, count: int) -> None:
    write_keypoints(tmp_path / "pose", capture.rig, FRAME, [true_joints], np.random.default_rng(0), count, 0.0, 0.0)
    pose = keypoint_pose(tmp_path / "pose", capture, FRAME)
    assert set(pose.joints) == set(LAYOUTS[count]) and pose.frame == FRAME
    for name, place in pose.joints.items():
        np.testing.assert_allclose(place, true_joints[JOINTS.index(name)], atol=1e-4)


def test_layouts_have_left_and_right_at_the_right_index() -> None:
    """As the tools' documents number them."""
    assert [LAYOUTS[25][name] for name in ("shoulder_r", "elbow_r", "wrist_r", "hip_r", "knee_r", "ankle_r")] == [
        *(2, 3, 4, 9, 10, 11)
    ]
    assert [LAYOUTS[25][name] for name in ("shoulder_l", "wrist_l", "pelvis", "hip_l", "ankle_l")] == [5, 7, 8, 12, 14]
    for count in (17, 26):
        assert [LAYOUTS[count][name] for name in ("shoulder_l", "shoulder_r", "wrist_r")] == [5, 6, 10]
        assert [LAYOUTS[count][name] for name in ("hip_l", "knee_l", "ankle_l", "ankle_r")] == [11, 13, 15, 16]


def test_triangulation_survives_noise_wrong_points_and_a_bystander(
    detected: Path, capture: Capture, true_joints: np.ndarray
) -> None:
    pose = keypoint_pose(detected, capture, FRAME)
    error = [np.linalg.norm(place - true_joints[JOINTS.index(name)]) for name, place in pose.joints.items()]
    assert len(error) >= 10
    assert np.median(error) < 0.04  # a pixel is 3 cm wide there


def test_tracking_starts_from_keypoints(detected: Path, tiny: Path, tmp_path: Path, tk: Tk, quick: Path) -> None:
    folder = Path(shutil.copytree(tiny, tmp_path / "capture"))
    shutil.copytree(detected, folder / "pose")
    without_first_pose(
        folder, ('pose = "da-vinci"', 'pose = "any"\nkeypoints = "pose"'), ("frame = 0", f"frame = {FRAME}")
    )
    results = []
    opened = open_capture(folder)
    assert opened.init_keypoints == folder / "pose"
    for name, init in (("settings", None), ("option", detected)):
        capture = opened if init is None else replace(opened, init_keypoints=None)
        config = settings_file.from_toml(QUICK)
        track(capture, tmp_path / f"{name}.h5", config, frames=(FRAME, FRAME + 1), init_pose=init, causal=True)
        results.append(read_result(tmp_path / f"{name}.h5"))
    np.testing.assert_array_equal(results[0].pose, results[1].pose)
    truth = read_joints(tiny / "truth.h5").positions[results[0].frames]
    assert results[0].frames[0] == FRAME
    assert np.linalg.norm(results[0].joints - truth, axis=2).mean() < 0.08
    shutil.rmtree(folder / "pose")
    tk("track", folder, "-o", tmp_path / "r.h5", "--config", quick).complaint("pose: is no folder")


def test_keypoints_follow_time_offsets(detected: Path, capture: Capture, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(detected, tmp_path / "pose"))
    first = capture.rig.names[0]
    (file,) = (folder / first).iterdir()
    file.rename(file.with_name(f"{first}_{FRAME - 2:06d}.json"))
    late = replace(capture, time_offset_s=(2 / capture.fps, *[0.0] * (len(capture.rig) - 1)))
    assert keypoint_pose(folder, late, FRAME).joints.keys() == keypoint_pose(detected, capture, FRAME).joints.keys()
    with pytest.raises(CaptureError, match="has no keypoints of picture 4"):
        keypoint_pose(folder, capture, FRAME)


def test_keypoints_are_those_of_the_image_that_a_frame_on_a_clock_shows(detected: Path, capture: Capture) -> None:
    pictures = [FRAME, FRAME, -1]
    clocked = replace(capture, clips=tuple(Resampled.of(clip, np.array(pictures)) for clip in capture.clips))
    np.testing.assert_equal(keypoint_pose(detected, clocked, 0).joints, keypoint_pose(detected, capture, FRAME).joints)
    with pytest.raises(CaptureError, match="has no image near frame 2"):
        keypoint_pose(detected, clocked, 2)


def test_hidden_files_beside_keypoints_are_ignored(detected: Path, capture: Capture, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(detected, tmp_path / "pose"))
    for file in list(folder.rglob("*.json")):
        file.with_name(f"._{file.name}").write_bytes(b"of macOS")
    np.testing.assert_equal(
        keypoint_pose(folder, capture, FRAME).joints, keypoint_pose(detected, capture, FRAME).joints
    )


def person(**changes: Any) -> dict[str, Any]:
    return {"people": [{"pose_keypoints_2d": [10.0, 20.0, 0.9] * 25, **changes}]}


@pytest.mark.parametrize(
    ("document", "parts"),
    [
        ([], ['no list "people"']),
        ({"people": {}}, ['no list "people"']),
        ({"people": [3]}, ['person 0 has no list "pose_keypoints_2d"']),
        ({"people": [{}] * 31}, ["31 people"]),
        (person(pose_keypoints_2d="no"), ['no list "pose_keypoints_2d"']),
        (person(pose_keypoints_2d=[1.0, 2.0]), ["2 numbers", "BODY_25"]),
        (person(pose_keypoints_2d=[1.0] * 54), ["54 numbers", "HALPE_26"]),
        (person(pose_keypoints_2d=["a"] * 75), ["'a' is no number"]),
        (person(pose_keypoints_2d=[True] * 75), ["True is no number"]),
        (person(pose_keypoints_2d=[1e300] * 75), ["too large"]),
        (person(pose_keypoints_2d=[float("inf")] * 75), ["inf is too large"]),
        (person(pose_keypoints_2d=[10**400] * 75), ["too large"]),
        (person(pose_keypoints_2d=[1.0, 1.0, -0.5] * 25), ["-0.5 is no confidence"]),
    ],
)
def test_mistakes_are_reported_in_one_line(tmp_path: Path, document: object, parts: list[str]) -> None:
    file = tmp_path / "cam1_000000.json"
    file.write_text(json.dumps(document))
    with refused(CaptureError, *parts) as caught:
        read_people(file)
    assert str(caught.value).startswith(str(file))


def test_missing_people_and_keypoints_are_nan(tmp_path: Path) -> None:
    file = tmp_path / "cam1_000000.json"
    for people in ([], [{"pose_keypoints_2d": []}], [{"pose_keypoints_2d": [0.0] * 75}]):
        file.write_text(json.dumps({"people": people}))
        assert read_people(file).shape == (0, 15, 3)
    file.write_text(json.dumps(person(pose_keypoints_2d=[float("nan")] * 3 + [5.0, 6.0, 0.9] * 24)))
    assert np.isfinite(read_people(file)[0]).all(axis=1).sum() == len(LAYOUTS[25])  # the nose is no joint of ours


def test_folders_without_matching_files_are_refused(tmp_path: Path, capture: Capture, detected: Path) -> None:
    names = capture.rig.names
    with pytest.raises(CaptureError, match="nowhere: is no folder"):
        keypoint_pose(tmp_path / "nowhere", capture, FRAME)
    with pytest.raises(CaptureError, match=f"camera '{names[0]}' has no folder of keypoints; there are no folders"):
        keypoint_pose(tmp_path, capture, FRAME)
    with pytest.raises(CaptureError, match="has no keypoints of picture 9, but of 4 to 4"):
        keypoint_pose(detected, capture, 9)
    folder = Path(shutil.copytree(detected, tmp_path / "pose"))
    (folder / names[0]).rename(folder / f"{names[0]}_json")  # as Pose2Sim names it
    keypoint_pose(folder, capture, FRAME)
    (file,) = (folder / names[1]).iterdir()
    shutil.copy(file, file.with_name("again_4.json"))
    with pytest.raises(CaptureError, match="has the number of"):
        keypoint_pose(folder, capture, FRAME)
    (file.with_name("again_4.json")).rename(file.with_name("notes.json"))
    with pytest.raises(CaptureError, match=r"notes\.json: its name does not end with the picture's number"):
        keypoint_pose(folder, capture, FRAME)


def test_people_outside_the_volume_are_refused(tmp_path: Path, capture: Capture, true_joints: np.ndarray) -> None:
    far = [true_joints + np.array([40.0, 0.0, 0.0])]
    write_keypoints(tmp_path / "pose", capture.rig, FRAME, far, np.random.default_rng(0), noise_px=0.0, wrong=0.0)
    with pytest.raises(CaptureError, match="in frame 4 cameras agree on 0 joints of one person in the working volume"):
        keypoint_pose(tmp_path / "pose", capture, FRAME)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_give_one_line_or_a_pose(
    data: st.DataObject, detected: Path, capture: Capture, tmp_path: Path
) -> None:
    """Bytes changed, cut off or put in: a pose with finite joints, or one line that names what it is about."""
    folder = tmp_path / "pose"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(detected, folder)
    name = data.draw(st.sampled_from(capture.rig.names))
    (file,) = (folder / name).iterdir()
    raw = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(raw)))
        kind = data.draw(st.sampled_from(["change", "cut", "insert", "repeat"]))
        if kind == "cut":
            del raw[at : at + data.draw(st.integers(1, 400))]
        elif kind == "repeat":
            raw[at:at] = raw[at : at + 200]
        else:
            replaced = data.draw(
                st.binary(min_size=1, max_size=4) | st.sampled_from([b"-", b"e99", b"[", b"NaN", b"9"])
            )
            raw[at : at + (kind == "change")] = replaced
    file.write_bytes(bytes(raw))
    try:
        pose = keypoint_pose(folder, capture, FRAME)
    except CaptureError as error:
        assert "\n" not in str(error) and str(folder) in str(error)
    else:
        assert np.isfinite(list(pose.joints.values())).all()
