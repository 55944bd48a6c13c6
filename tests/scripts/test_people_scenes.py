"""Scenes with several people, short and at a tiny size."""

from __future__ import annotations

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from scripts.synthetic.actor import Look
from scripts.synthetic.capture import Options, Plan, crossings, plan_capture, write_capture
from scripts.synthetic.people import SCENES, STAGE_M, Role, walk
from scripts.synthetic.skeleton import JOINTS, make_skeleton, sole_points

FRAMES = 8


def standing(x: float, y: float) -> Role:
    """Return a person who stands and looks along x."""
    way = [(0, x, y), (FRAMES, x, y)]
    look = Look(shirt=(0.06, 0.22, 0.40))
    return Role(lambda s: walk(s, "stand", FRAMES, way, [(0, 0.0)], posed=False), 1.65, look)


@pytest.fixture
def plan(monkeypatch: pytest.MonkeyPatch) -> Plan:
    """Two people 60 cm apart."""
    monkeypatch.setitem(SCENES, "short", (standing(0.0, -0.3), standing(0.0, 0.3)))
    return plan_capture(Options("short", cameras=4, size=(80, 60), seed=3))


def test_walker_follows_the_way_on_the_floor() -> None:
    skeleton = make_skeleton()
    way = [(26, -0.5, 0.0), (56, 0.9, 0.0), (60, 0.9, 0.0)]
    motion = walk(skeleton, "walk", 60, way, [(0, 0.0)])
    frames = np.arange(60.0)
    assert motion.root is not None
    from scripts.synthetic.motion import plan_path, pose_at

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


def test_people_close_together_cross_once(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    assert crossings(plan) == 1
    monkeypatch.setitem(SCENES, "short", (standing(0.0, -0.9), standing(0.0, 0.9)))
    assert crossings(plan_capture(Options("short", cameras=4, size=(80, 60), seed=3))) == 0


def test_person_alone_is_as_in_company(plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    masks = {}
    for name, alone in (("both", None), ("first", 0), ("second", 1)):
        made = plan_capture(Options("short", frames=1, cameras=4, size=(80, 60), seed=3, alone=alone))
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


def test_truth_has_rows_only_while_a_person_is_in_the_volume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCENES, "short", (standing(0.0, 0.0), standing(STAGE_M + 1.0, 0.0)))
    made = plan_capture(Options("short", frames=1, cameras=4, size=(80, 60), seed=3))
    write_capture(made, tmp_path / "capture")
    with h5py.File(tmp_path / "capture" / "truth.h5") as truth:
        assert truth["people/0/frames"][:].tolist() == [0]
        assert truth["people/1/joints/position"].shape == (0, len(JOINTS), 3)
