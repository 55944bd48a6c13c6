"""Scenes with several people, short and at a tiny size."""

from __future__ import annotations

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from scripts.synthetic.actor import Look
from scripts.synthetic.capture import Options, Plan, crossings, plan_capture, write_capture
from scripts.synthetic.motion import plan_path, pose_at
from scripts.synthetic.people import STAGE_M, Role, Scene, walk
from scripts.synthetic.render import distances
from scripts.synthetic.scenes import SCENES
from scripts.synthetic.skeleton import JOINTS, make_skeleton, sole_points
from tk.io.toml import load_toml

FRAMES = 8


def standing(x: float, y: float) -> Role:
    """Return a person who stands and looks along x."""
    return Role([(0, x, y), (FRAMES, x, y)], stature_m=1.65, look=Look(shirt=(0.06, 0.22, 0.40)), posed=False)


def plan_of(monkeypatch: pytest.MonkeyPatch, *roles: Role, only: tuple[int, ...] | None = None) -> Plan:
    """Return the plan of a scene with these roles."""
    monkeypatch.setitem(SCENES, "short", Scene(FRAMES, roles))
    return plan_capture(Options("short", frames=None if only is None else 1, cameras=4, size=(80, 60), only=only))


def test_walker_follows_the_way_on_the_floor() -> None:
    skeleton = make_skeleton()
    motion = walk(skeleton, "walk", 60, Role([(26, -0.5, 0.0), (56, 0.9, 0.0), (60, 0.9, 0.0)]))
    frames = np.arange(60.0)
    assert motion.root is not None
    pose = pose_at(motion, skeleton, plan_path(motion, skeleton, 60), frames)
    pelvis = pose.origin[:, skeleton.index("pelvis")]
    assert pelvis[0, 0] == pytest.approx(-0.5, abs=0.05) and pelvis[-1, 0] == pytest.approx(0.9, abs=0.05)
    soles = sole_points(skeleton, pose)
    lowest = soles[..., 2].min(axis=(1, 2))
    assert lowest.min() > -0.04 and lowest.max() < 0.01
    # one foot or the other stands still
    slid = np.linalg.norm(np.diff(soles[:, :, 2, :2], axis=0), axis=2).min(axis=1)
    assert np.percentile(slid, 90) < 0.02
    assert (pose.rotation[:, skeleton.index("pelvis"), 0, 0] > 0.9).all()  # looks along x


def test_people_close_together_cross_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert crossings(plan_of(monkeypatch, standing(0.0, -0.3), standing(0.0, 0.3))) == 1
    assert crossings(plan_of(monkeypatch, standing(0.0, -0.9), standing(0.0, 0.9))) == 0


def test_person_alone_is_as_in_company(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    masks = {}
    for name, only in (("both", (0, 1)), ("first", (0,)), ("second", (1,))):
        made = plan_of(monkeypatch, standing(0.0, -0.3), standing(0.0, 0.3), only=only)
        write_capture(made, tmp_path / name, masks=True)
        files = [tmp_path / name / "masks" / camera.name / "000000.png" for camera in made.rig]
        masks[name] = np.array([cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]) > 0
    for name in ("first", "second"):
        calibration = (tmp_path / name / "calibration.toml").read_text()
        assert calibration == (tmp_path / "both" / "calibration.toml").read_text()
    either = masks["first"] | masks["second"]
    assert (either & ~masks["both"]).sum() == 0
    assert (masks["both"] & ~either).sum() < 0.05 * either.sum()  # pixels that each covers a part of
    with h5py.File(tmp_path / "both" / "truth.h5") as both, h5py.File(tmp_path / "second" / "truth.h5") as second:
        assert sorted(both["people"]) == ["0", "1"]
        np.testing.assert_array_equal(both["people/1/joints/position"][:], second["joints/position"][:])
        np.testing.assert_array_equal(both["people/0/joints/position"][:], both["joints/position"][:])


def test_unknown_person_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="short has the people 0 to 1, not 2"):
        plan_of(monkeypatch, standing(0.0, -0.3), standing(0.0, 0.3), only=(2,))


def test_truth_has_rows_only_while_a_person_is_in_the_volume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = plan_of(monkeypatch, standing(0.0, 0.0), standing(STAGE_M + 1.0, 0.0), only=(0, 1))
    write_capture(made, tmp_path / "capture")
    with h5py.File(tmp_path / "capture" / "truth.h5") as truth:
        assert truth["people/0/frames"][:].tolist() == [0]
        assert truth["people/1/joints/position"].shape == (0, len(JOINTS), 3)
    assert load_toml(tmp_path / "capture" / "capture.toml")["init"]["pose"] == "any"


@pytest.mark.slow  # planning a scene takes 2 to 5 s
@pytest.mark.parametrize("name", ["circling", "crouching", "embrace", "entering", "handshake", "similar"])
def test_people_of_a_scene_meet_without_walking_through_each_other(name: str) -> None:
    plan = plan_capture(Options(name, cameras=5, size=(160, 120)))
    a, b = plan.people.values()
    apart = np.linalg.norm(a.joints[:, JOINTS.index("pelvis")] - b.joints[:, JOINTS.index("pelvis")], axis=1)
    embraced = apart < 0.45
    assert embraced.any() == (name == "embrace")
    assert apart.min() > 0.4
    assert crossings(plan, step=1) >= 3
    for frame in np.flatnonzero((apart < 1.0) & (apart > 0.6))[::3]:  # elbows, wrists and knees stay outside
        ends = b.joints[
            frame, [JOINTS.index(joint + side) for joint in ("elbow", "wrist", "knee") for side in ["_l", "_r"]]
        ]
        assert distances(a.body(frame), a.poses[frame : frame + 1], ends).min() > -0.02, frame
    speed = [np.linalg.norm(np.diff(p.joints[:, 0, :2], axis=0), axis=1).max() * plan.fps for p in (a, b)]
    assert max(speed) < 1.6
