from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.errors import ResultError
from tk.evaluation.details import flexion_deg, normal_share
from tk.evaluation.joints import LIMB_JOINTS, evaluate, evaluate_files, trunk_axes
from tk.io.results.data import JointTrack
from tk.io.results.status import Status
from tk.model.body.skeleton import JOINTS

# a standing person, rough: forward, left, up in metres
STANDING = np.array(
    [
        [0.0, 0.0, 0.95],
        [0.0, 0.0, 1.5],
        [0.0, 0.0, 1.78],
        [0.0, 0.18, 1.45],
        [0.1, 0.3, 1.2],
        [0.2, 0.3, 1.0],
        [0.0, -0.18, 1.45],
        [0.1, -0.3, 1.2],
        [0.2, -0.3, 1.0],
        [0.0, 0.09, 0.95],
        [0.0, 0.12, 0.5],
        [0.0, 0.12, 0.1],
        [0.0, -0.09, 0.95],
        [0.0, -0.12, 0.5],
        [0.0, -0.12, 0.1],
    ]
)


def rotations(generator: np.random.Generator, count: int) -> np.ndarray:
    q, _ = np.linalg.qr(generator.normal(size=(count, 3, 3)))
    return q * np.linalg.det(q)[:, None, None]


def make_truth(count: int = 20, seed: int = 0) -> JointTrack:
    generator = np.random.default_rng(seed)
    moving = STANDING + generator.normal(scale=0.03, size=(count, 15, 3))
    positions = np.einsum("fik,fjk->fji", rotations(generator, count), moving) + generator.normal(size=(count, 1, 3))
    return JointTrack(Path("truth.h5"), np.arange(count), positions)


def as_result(truth: JointTrack, **changes: Any) -> JointTrack:
    values: dict[str, Any] = {
        "path": Path("result.h5"),
        "positions": truth.positions.copy(),
        "status": np.zeros(len(truth.frames), dtype=np.uint8),
    }
    return replace(truth, **(values | changes))


def test_ground_truth_itself_has_no_error() -> None:
    truth = make_truth()
    found = evaluate(as_result(truth, seconds=np.array([1.0] + [0.05] * 19)), truth)
    for scores in (found.raw, found.corrected):
        for score in (scores.all, scores.limbs, *scores.joints.values()):
            assert score.mean_cm == pytest.approx(0, abs=1e-12)
            assert score.median_cm == pytest.approx(0, abs=1e-12)
            assert score.pck == {5: 1.0, 10: 1.0, 15: 1.0}
    assert (found.judged, found.lost, found.nan_frames, found.missing_outside) == (20, 0, 0, 0)
    assert found.frames_per_second == pytest.approx(20 / 1.95)
    assert found.median_frames_per_second == pytest.approx(20)


def test_scores_equal_a_slow_computation() -> None:
    truth = make_truth(seed=3)
    generator = np.random.default_rng(4)
    result = as_result(truth, positions=truth.positions + generator.normal(scale=0.05, size=(20, 15, 3)))
    found = evaluate(result, truth)
    errors = {
        name: [
            100 * float(np.sqrt(sum((result.positions[f, j, k] - truth.positions[f, j, k]) ** 2 for k in range(3))))
            for f in range(20)
        ]
        for j, name in enumerate(JOINTS)
    }
    for score, names in [
        (found.raw.all, JOINTS),
        (found.raw.limbs, LIMB_JOINTS),
        (found.raw.joints["knee_r"], ("knee_r",)),
    ]:
        values = sorted(value for name in names for value in errors[name])
        assert score.mean_cm == pytest.approx(sum(values) / len(values))
        assert score.median_cm == pytest.approx((values[(len(values) - 1) // 2] + values[len(values) // 2]) / 2)
        for cm, share in score.pck.items():
            assert share == pytest.approx(sum(value < cm for value in values) / len(values))


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0, 0.5))
def test_constant_joint_offsets_are_removed_in_corrected_figures(seed: int, size: float) -> None:
    """Any constant offset of any joint in the trunk's frame, the trunk's own joints included."""
    truth = make_truth(count=7, seed=seed)
    offsets = np.random.default_rng(seed).uniform(-size, size, (15, 3))
    axes = trunk_axes(truth.positions)
    shifted = truth.positions + np.einsum("fik,jk->fji", axes, offsets)
    found = evaluate(as_result(truth, positions=shifted), truth)
    assert found.corrected.all.mean_cm == pytest.approx(0, abs=1e-10)
    np.testing.assert_allclose([found.offsets_cm[name] for name in JOINTS], 100 * offsets, atol=1e-10)
    assert found.raw.all.mean_cm == pytest.approx(100 * np.linalg.norm(offsets, axis=1).mean(), abs=1e-9)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_corrected_figures_do_not_depend_on_the_world(seed: int) -> None:
    generator = np.random.default_rng(seed)
    truth = make_truth(count=6, seed=seed)
    result = as_result(truth, positions=truth.positions + generator.normal(scale=0.05, size=(6, 15, 3)))
    turn, move = rotations(generator, 1)[0], generator.normal(size=3)
    there = evaluate(
        replace(result, positions=result.positions @ turn.T + move),
        replace(truth, positions=truth.positions @ turn.T + move),
    )
    here = evaluate(result, truth)
    assert there.corrected.all.mean_cm == pytest.approx(here.corrected.all.mean_cm, rel=1e-9)
    assert there.raw.limbs.median_cm == pytest.approx(here.raw.limbs.median_cm, rel=1e-9)


def test_trunk_axes_are_right_handed_and_point_forward_left_up() -> None:
    np.testing.assert_allclose(trunk_axes(STANDING[None])[0], np.eye(3), atol=1e-12)
    axes = trunk_axes(make_truth().positions)
    np.testing.assert_allclose(np.linalg.det(axes), 1)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-12)


def test_one_nan_joint_is_not_averaged_away() -> None:
    truth = make_truth()
    positions = truth.positions.copy()
    positions[4, JOINTS.index("wrist_l"), 1] = np.nan
    found = evaluate(as_result(truth, positions=positions), truth)
    for scores in (found.raw, found.corrected):
        assert scores.joints["wrist_l"].mean_cm == np.inf
        assert scores.all.mean_cm == scores.limbs.mean_cm == np.inf
        assert scores.joints["wrist_l"].pck[15] == pytest.approx(19 / 20)
        assert scores.joints["wrist_r"].mean_cm == pytest.approx(0, abs=1e-10)
        assert scores.all.median_cm == pytest.approx(0, abs=1e-10)
    assert found.nan_frames == 1
    plain = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert plain["raw"]["all"]["mean_cm"] is None
    assert plain["nan_share"] == pytest.approx(0.05)
    assert "inf" in found.format_table()
    assert "1 with NaN or missing joints" in found.format_table()


def test_result_of_nan_has_zero_pck() -> None:
    truth = make_truth()
    found = evaluate(as_result(truth, positions=np.full_like(truth.positions, np.nan)), truth)
    assert found.corrected.all.median_cm == found.raw.all.median_cm == np.inf
    assert found.raw.all.pck == found.corrected.all.pck == {5: 0.0, 10: 0.0, 15: 0.0}
    json.loads(
        json.dumps(found.to_dict(), allow_nan=False), parse_constant=lambda name: pytest.fail(f"{name} is not JSON")
    )


def test_lost_frame_counts_as_miss_at_any_distance() -> None:
    truth = make_truth()
    status = np.zeros(20, dtype=np.uint8)
    status[[3, 9]] = Status.LOST
    status[5] = Status.RECOVERED
    positions = truth.positions.copy()
    positions[9] += 1.0  # and its distance stays in the mean
    found = evaluate(as_result(truth, positions=positions, status=status), truth)
    assert found.lost == 2
    assert found.lost_share == pytest.approx(0.1)
    assert found.raw.all.pck[15] == pytest.approx(0.9)
    assert found.raw.all.mean_cm == pytest.approx(100 * np.sqrt(3) / 20)
    assert found.corrected.all.mean_cm == pytest.approx(100 * np.sqrt(3) / 20)  # no part in the offsets
    assert "2 lost (10.0 %)" in found.format_table()


def test_corrected_figures_are_nan_if_all_frames_are_lost() -> None:
    truth = make_truth()
    found = evaluate(as_result(truth, status=np.full(20, Status.LOST, dtype=np.uint8)), truth)
    assert found.corrected.all.mean_cm == np.inf
    assert found.raw.all.pck[15] == 0
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["offsets_cm"]["neck"] == [None, None, None]


def test_missing_frames_inside_the_range_count_and_others_are_reported() -> None:
    truth = make_truth()
    rows = [5, 6, 7, 10, 11]  # 8 and 9 are missing
    result = as_result(
        truth, frames=truth.frames[rows], positions=truth.positions[rows], status=np.zeros(5, dtype=np.uint8)
    )
    found = evaluate(result, truth)
    assert (found.judged, found.missing_inside, found.missing_outside, found.nan_frames) == (7, 2, 13, 2)
    assert found.raw.all.mean_cm == np.inf
    assert found.raw.all.pck[5] == pytest.approx(5 / 7)
    table = found.format_table()
    assert "2 frames are missing inside" in table
    assert "13 frames of the truth are outside" in table


def test_frames_without_truth_are_reported() -> None:
    truth = make_truth()
    part = replace(truth, frames=truth.frames[:8], positions=truth.positions[:8])
    found = evaluate(as_result(truth), part)
    assert (found.judged, found.without_truth) == (8, 12)


def test_order_of_frames_does_not_matter() -> None:
    truth = make_truth()
    order = np.random.default_rng(0).permutation(20)
    positions = truth.positions + np.random.default_rng(1).normal(scale=0.05, size=(20, 15, 3))
    result = as_result(truth, positions=positions)
    shuffled = replace(result, frames=result.frames[order], positions=positions[order])
    assert evaluate(shuffled, truth) == evaluate(result, truth)


def test_joints_without_truth_are_excluded_and_reported() -> None:
    truth = make_truth()
    gaps = truth.positions.copy()
    gaps[:5, JOINTS.index("wrist_l")] = np.nan
    gaps[7, JOINTS.index("neck")] = np.nan  # no trunk in this frame
    found = evaluate(as_result(truth), replace(truth, positions=gaps))
    assert found.unknown_joints == 6
    assert found.nan_frames == 0
    assert found.raw.all.mean_cm == 0
    assert found.corrected.all.mean_cm == pytest.approx(0, abs=1e-10)
    gaps[:, JOINTS.index("wrist_l")] = np.nan
    nothing = evaluate(as_result(truth), replace(truth, positions=gaps)).raw.joints["wrist_l"]
    assert np.isnan(nothing.mean_cm)


def test_absent_person_is_not_judged() -> None:
    truth = make_truth()
    gone, seen = truth.positions.copy(), truth.positions.copy()
    gone[:8] = np.nan
    seen[:4] = np.nan
    status = np.zeros(20, np.uint8)
    status[:4], status[4:6], status[9] = Status.ABSENT, Status.SUSPECT, Status.LOST
    result = as_result(truth, positions=seen, status=status)
    found = evaluate(result, replace(truth, positions=gone))
    assert (found.judged, found.lost, found.suspect, found.nan_frames) == (12, 1, 0, 0)
    assert (found.without_truth, found.unknown_joints) == (8, 0)
    assert found.lost_share == pytest.approx(1 / 12)
    part = replace(result, frames=truth.frames[4:], positions=seen[4:], status=status[4:])
    part = replace(part, **{name: np.delete(getattr(part, name), 2, 0) for name in ("frames", "positions", "status")})
    assert evaluate(part, replace(truth, positions=gone)).missing_inside == 0
    with pytest.raises(ResultError, match="no frames in the other"):
        evaluate(result, replace(truth, positions=np.full_like(gone, np.nan)))


def test_files_without_common_frames_are_refused() -> None:
    truth = make_truth()
    with pytest.raises(ResultError, match=r"result\.h5: .*truth\.h5: frames 100 to 119 .* frames 0 to 19"):
        evaluate(as_result(truth, frames=truth.frames + 100), truth)
    empty = JointTrack(Path("result.h5"), np.zeros(0, dtype=np.int64), np.zeros((0, 15, 3)))
    with pytest.raises(ResultError, match="no frames"):
        evaluate(empty, truth)


def test_table_and_json_hold_the_same(tmp_path: Path) -> None:
    truth = make_truth()
    positions = truth.positions + 0.04
    for name, values in (("truth.h5", truth.positions), ("result.h5", positions)):
        with h5py.File(tmp_path / name, "w") as file:
            file["frames"] = truth.frames
            file["joints/position"] = values
            file["joints/position"].attrs["names"] = list(JOINTS)
    found = evaluate_files(tmp_path / "result.h5", tmp_path / "truth.h5")
    plain = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert plain["raw"]["all"]["mean_cm"] == pytest.approx(4 * np.sqrt(3))
    assert plain["raw"]["joints"]["ankle_r"]["pck"] == {"5": 0.0, "10": 1.0, "15": 1.0}
    assert plain["frames_per_second"] is None
    lines = found.format_table().splitlines()
    row = next(line for line in lines if line.startswith("all 15")).split()
    assert row[2:7] == ["6.93", "6.93", "0.0", "100.0", "100.0"]
    assert max(map(len, lines)) <= 100


# --- flexion ----------------------------------------------------------------------------------------------------------


def bent(flexion: dict[str, float], count: int = 4) -> JointTrack:
    """A standing person with these joints bent by so many degrees, the lower bone turned forward or back."""
    p = STANDING.copy()
    at = {name: index for index, name in enumerate(JOINTS)}
    for side in "lr":
        p[at[f"elbow_{side}"]] = p[at[f"shoulder_{side}"]] - [0, 0, 0.3]
        p[at[f"wrist_{side}"]] = p[at[f"elbow_{side}"]] - [0, 0, 0.25]
        p[at[f"knee_{side}"]] = p[at[f"hip_{side}"]] - [0, 0, 0.45]
        p[at[f"ankle_{side}"]] = p[at[f"knee_{side}"]] - [0, 0, 0.4]
    for name, degrees in flexion.items():
        end = at[name.replace("knee", "ankle").replace("elbow", "wrist")]
        angle = np.radians(degrees)
        length = np.linalg.norm(p[end] - p[at[name]])
        p[end] = p[at[name]] + length * np.array([np.sin(angle), 0, -np.cos(angle)])
    return JointTrack(Path("truth.h5"), np.arange(count), np.repeat(p[None], count, axis=0))


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 30.0, 90.0, 150.0, 180.0])
def test_flexion_is_zero_when_straight(degrees: float) -> None:
    found = flexion_deg(bent({"knee_l": degrees, "elbow_r": -degrees}).positions)
    np.testing.assert_allclose(found["knee_l"], degrees, atol=1e-9)
    np.testing.assert_allclose(found["elbow_r"], degrees, atol=1e-9)
    np.testing.assert_allclose(found["knee_r"], 0, atol=1e-9)


def test_flexion_errors_are_reported_by_joint_and_kind() -> None:
    truth = bent({"knee_l": 20, "elbow_l": 40, "elbow_r": 60})
    result = as_result(bent({"knee_l": 35, "elbow_l": 30, "elbow_r": 60}))
    found = evaluate(result, truth).flexion
    assert found["knee_l"].mean_deg == pytest.approx(15) and found["knee_l"].bias_deg == pytest.approx(15)
    assert found["elbow_l"].mean_deg == pytest.approx(10) and found["elbow_l"].bias_deg == pytest.approx(-10)
    assert found["knees"].mean_deg == pytest.approx(7.5)
    assert found["elbows"].mean_deg == pytest.approx(5) and found["elbows"].median_deg == pytest.approx(5)
    assert set(found) == {"knee_l", "knee_r", "elbow_l", "elbow_r", "knees", "elbows"}
    assert "knees 7.5° (left 15.0°, right 0.0°)" in evaluate(result, truth).format_table()


def test_flexion_that_is_unknown_is_not_averaged_away() -> None:
    truth = bent({})
    positions = truth.positions.copy()
    positions[1, JOINTS.index("ankle_l")] = np.nan
    positions[2, JOINTS.index("wrist_l")] = positions[2, JOINTS.index("elbow_l")]  # a bone of no length
    found = evaluate(as_result(truth, positions=positions), truth).flexion
    assert found["knee_l"].mean_deg == found["knees"].mean_deg == found["elbow_l"].mean_deg == np.inf
    assert found["knee_l"].median_deg == pytest.approx(0, abs=1e-9) == found["knee_l"].bias_deg
    assert found["knee_r"].mean_deg == pytest.approx(0, abs=1e-9)
    gaps = truth.positions.copy()
    gaps[:, JOINTS.index("ankle_r")] = np.nan
    unknown = evaluate(as_result(truth), replace(truth, positions=gaps)).flexion
    assert np.isnan(unknown["knee_r"].mean_deg) and unknown["knees"].mean_deg == pytest.approx(0, abs=1e-9)


# --- longest run of limb errors ---------------------------------------------------------------------------------------


def test_longest_run_of_wrong_frames() -> None:
    truth = make_truth()
    positions = truth.positions.copy()
    positions[[2, 3, 4], JOINTS.index("wrist_l")] += 0.2
    positions[4:8, JOINTS.index("ankle_r")] += 0.2  # goes on where the wrist ends: one run from 2 to 7
    positions[10:18, JOINTS.index("neck")] += 0.5  # not a limb
    positions[12, JOINTS.index("knee_l")] += 0.2
    result = as_result(truth, positions=positions)
    found = evaluate(result, truth)
    for run in (found.longest_limb_error, found.longest_limb_error_raw):
        assert (run.frames, run.first, run.last) == (6, 2, 7)
    assert "15 cm off, without offset: 6 frames, 2 to 7" in found.format_table()
    order = np.random.default_rng(0).permutation(20)
    shuffled = replace(truth, frames=truth.frames[order], positions=truth.positions[order])
    assert evaluate(result, shuffled).longest_limb_error == found.longest_limb_error
    perfect = evaluate(as_result(truth), truth)
    assert (perfect.longest_limb_error.frames, perfect.longest_limb_error.first) == (0, None)
    assert "0 frames\n" in perfect.format_table()


def test_missing_frames_count_as_wrong_and_unknown_ones_do_not() -> None:
    truth = make_truth()
    rows = [0, 1, 2, 7, 8, 9]
    result = as_result(
        truth, frames=truth.frames[rows], positions=truth.positions[rows], status=np.zeros(6, dtype=np.uint8)
    )
    run = evaluate(result, truth).longest_limb_error
    assert (run.frames, run.first, run.last) == (4, 3, 6)
    gaps = truth.positions.copy()
    gaps[5] = np.nan
    run = evaluate(result, replace(truth, positions=gaps)).longest_limb_error_raw
    assert (run.frames, run.first, run.last) == (2, 3, 4)


# --- sigma ------------------------------------------------------------------------------------------------------------


def test_shares_within_sigma_of_a_calibrated_result() -> None:
    truth = make_truth(count=400)
    generator = np.random.default_rng(5)
    sigma = generator.uniform(0.005, 0.05, size=(400, 15))
    positions = truth.positions + sigma[..., None] * generator.normal(size=(400, 15, 3))
    found = evaluate(as_result(truth, positions=positions, sigma=sigma), truth).sigma
    assert found is not None
    for shares in found.values():
        assert shares.raw[1] == pytest.approx(shares.expected[1], abs=0.03)
        assert shares.raw[2] == pytest.approx(shares.expected[2], abs=0.03)
        assert shares.corrected[2] == pytest.approx(shares.expected[2], abs=0.03)
    assert (found["all"].judged, found["limbs"].judged, found["all"].without) == (6000, 4800, 0)
    overconfident = evaluate(as_result(truth, positions=positions, sigma=sigma / 3), truth).sigma
    assert overconfident is not None and overconfident["all"].raw[2] < 0.3


def test_joints_without_sigma_are_excluded_and_failures_count() -> None:
    truth = make_truth()
    sigma = np.full((20, 15), 0.01)
    sigma[3] = np.nan
    positions = truth.positions.copy()
    positions[5, JOINTS.index("wrist_l")] = np.nan
    result = as_result(truth, positions=positions, sigma=sigma)
    shares = evaluate(result, truth).sigma
    assert shares is not None
    assert (shares["all"].judged, shares["all"].without) == (285, 15)
    assert shares["all"].raw[2] == pytest.approx(284 / 285) and shares["all"].median_cm == pytest.approx(1)
    table = evaluate(result, truth).format_table()
    assert "12 limb: 99.6 % within 1 σ" in table and max(map(len, table.splitlines())) <= 100
    nothing = evaluate(as_result(truth, sigma=np.full((20, 15), np.nan)), truth).sigma
    assert nothing is not None and np.isnan(nothing["all"].raw[1]) and nothing["all"].judged == 0
    assert evaluate(as_result(truth), truth).sigma is None
    plain = json.loads(json.dumps(evaluate(result, truth).to_dict(), allow_nan=False))
    assert plain["sigma"]["limbs"]["expected"]["1"] == pytest.approx(0.1987, abs=1e-4)
    assert plain["longest_limb_error"] == {"frames": 1, "first": 5, "last": 5}
    assert plain["flexion"]["elbow_l"]["mean_deg"] is None


def test_normal_shares_are_those_of_three_dimensions() -> None:
    lengths = np.linalg.norm(np.random.default_rng(0).normal(size=(200_000, 3)), axis=1)
    for count in (0.5, 1, 2, 3):
        assert normal_share(count) == pytest.approx((lengths < count).mean(), abs=0.005)
