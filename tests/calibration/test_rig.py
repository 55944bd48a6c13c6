"""Whole calibrations from points: truth is found, and each fault is refused or judged with the camera's name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scripts.board_rigs import compare
from scripts.synthetic.boards import make_rig, place_boards, true_world
from tests.calibration.rigs import BOARD, POSES, QUICK, RECIPE, RIG, footages, keep, see
from tk.calibration.boards import make_board
from tk.calibration.bundle import View, adjust
from tk.calibration.footage import Footage
from tk.calibration.intrinsics import Fitted, fit_lens
from tk.calibration.lens import CHOICE, PINHOLE8, Model
from tk.calibration.poses import Pose, exp
from tk.calibration.rig import Calibrated, Options, calibrate, rig_of
from tk.calibration.verdict import Verdict, judge
from tk.calibration.world import place_world
from tk.calibration.zoom import largest_change
from tk.errors import CalibrationError, ConfigError
from tk.model.cameras.camera import Camera


def run(recorded: list[Footage], options: Options = QUICK) -> tuple[Calibrated, Verdict]:
    done = calibrate(recorded, BOARD, options, lambda _: None)
    return done, judge(done)


@pytest.fixture(scope="module")
def good() -> tuple[Calibrated, Verdict]:
    return run(footages())


def test_true_cameras_are_found_and_called_good(good: tuple[Calibrated, Verdict]) -> None:
    done, verdict = good
    errors = compare(done.rig, true_world(RIG, RECIPE, BOARD))
    assert errors.place_mm < 3 and errors.turn_deg < 0.1 and errors.focal_percent < 0.3
    assert verdict.word == "good", verdict.reasons
    assert errors.person_mm < 3 * 1000 * verdict.error_m  # the expected error is no promise, but near
    assert done.world.floor == 0  # recognised
    np.testing.assert_allclose(done.rig.centers, true_world(RIG, RECIPE, BOARD).centers, atol=0.02)


LENSES = replace(RECIPE, cameras=((30, 3.2, 1.4, "action wide"), (85, 3.4, 2.0, "webcam")))


def fit(c: int, camera: Camera, models: Sequence[Model]) -> Fitted:
    """Fit a lens to the views of the board that a camera in the place of camera ``c`` has."""
    poses = place_boards(LENSES, make_rig(LENSES), BOARD)
    found = {i: seen.detection for i, seen in see(camera, poses, c, noise_px=0.02).seen.items()}
    views = [View(0, i, BOARD.points[one.ids], one.pixels, one.ids) for i, one in found.items()]
    return fit_lens(views, LENSES.size, models, None)


@pytest.mark.slow
@pytest.mark.parametrize(("c", "model"), [(0, "fisheye"), (1, "pinhole5")])
def test_lens_is_chosen_by_held_out_views(c: int, model: str) -> None:
    assert fit(c, make_rig(LENSES)[c], CHOICE).lens.model.name == model


def test_rational_distortion_is_estimated() -> None:
    camera = make_rig(LENSES)[1]
    rational = np.array([7.5, 3.2, 0.0004, -0.0007, 0.12, 7.9, 5.7, 0.8])
    camera = replace(camera, matrix=camera.matrix * [[0.65, 1, 1], [1, 0.65, 1], [1, 1, 1]], distortions=rational)
    lens = fit(1, camera, [PINHOLE8]).lens
    assert abs(lens.values[0] / camera.matrix[0, 0] - 1) < 0.003 and len(lens.values) == 12


def test_given_intrinsics_stay_and_are_scaled() -> None:
    half = {camera.name: camera.reduced(2) for camera in RIG}
    done, verdict = run(footages(), replace(QUICK, intrinsics=half))
    for found, camera in zip(done.rig, RIG, strict=True):
        np.testing.assert_allclose(found.matrix, camera.matrix, rtol=1e-9)
    assert {one.how for one in verdict.cameras} == {"given"} and verdict.level == 0


def test_similar_distances_hold_part_of_the_intrinsics() -> None:
    recorded = footages()
    far = [i for i in recorded[1].seen if 0 < i < 100]
    recorded[1] = keep(recorded[1], *far)
    _, verdict = run(recorded)
    one = verdict.cameras[1]
    assert one.how == "held" and {"p1", "p2", "k3", "cx", "cy"} <= set(one.by_prior)
    assert verdict.word != "good" and any(
        "camera cam2" in text and "factor of 2" in text for _, text in verdict.reasons
    )


def late(recorded: list[Footage]) -> None:
    shared = [i for i in POSES if i < 100]
    recorded[1] = see(RIG[1], {i: POSES[shared[k - 5]] if i in shared else POSES[i] for k, i in enumerate(POSES)}, 1)


def smaller_board(recorded: list[Footage]) -> None:
    """The first poses of its boards agree roughly, so that only the adjustment shows the contradiction."""
    recorded[2] = see(RIG[2], POSES, 2, make_board("charuco", None, 0.09))


def mirrored(recorded: list[Footage]) -> None:
    """A chessboard looks alike in a mirror, so that only other cameras show it; a ChArUco board is not even found."""
    for seen in recorded[1].seen.values():
        seen.detection.pixels[:, 0] = RIG[1].width - 1 - seen.detection.pixels[:, 0]


def copied(recorded: list[Footage]) -> None:
    """Encoding again moves the points by some tenths of a pixel."""
    copy = see(RIG[0], {i: pose for i, pose in POSES.items() if i < 100}, 0, noise_px=0.3)
    recorded[2] = replace(copy, name="cam3", path=Path("boards/cam3"))


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (lambda r: r.insert(2, keep(r.pop(), *range(140, 160))), QUICK,
         "camera cam3: connected to nobody: it sees the board in 6 images"),
        (lambda r: r.insert(0, keep(r.pop(0), 100, 101)), QUICK,
         "camera cam1: too few views: the board charuco 7x5 of 4x4_50 is in 2 of"),
        (late, QUICK, "camera cam2: contradicts"),
        (smaller_board, replace(QUICK, instants=22), "camera cam3: contradicts the others"),
        (mirrored, QUICK, "camera cam2"),
        (copied, QUICK, "camera cam3: has the same images as camera cam1: .* was a file copied"),
        (lambda _: None, replace(QUICK, intrinsics={camera.name: replace(camera, height=400) for camera in RIG}),
         "camera cam1 has images of 800×400"),
    ],
    ids=["nothing shared", "two views", "late", "smaller board", "mirrored", "copied", "other shape"],
)  # fmt: skip
def test_fault_is_refused_with_the_name_of_the_camera(
    spoil: Callable[[list[Footage]], object], options: Options, message: str
) -> None:
    recorded = footages()
    spoil(recorded)
    with pytest.raises(CalibrationError, match=message):
        run(recorded, options)


@pytest.mark.slow
def test_camera_that_was_moved_is_named() -> None:
    own = Pose(RIG[1].rotation, RIG[1].translation)
    turn = own.inverse() @ Pose(exp(np.radians([0.0, 2.0, 0.0])), np.zeros(3)) @ own
    recorded = footages()
    recorded[1] = see(RIG[1], {i: turn @ pose if 9 <= i < 100 else pose for i, pose in POSES.items()}, 1)
    _, verdict = run(recorded)
    assert verdict.word != "good"
    blamed = [text for _, text in verdict.reasons if "contradict" in text]
    assert blamed and all(text.startswith("camera cam2") for text in blamed), verdict.reasons


def test_two_cameras_that_agree_show_which_one_is_wrong(good: tuple[Calibrated, Verdict]) -> None:
    done, _ = good
    all_three = {i for i in done.world.state.boards if sum(view.instant == i for view in done.views) == 3}
    wrong = max(range(3), key=lambda c: sum(view.camera == c for view in done.views))  # others are rarer, not wrong
    dropped = tuple(view for view in done.views if view.camera == wrong and view.instant in all_three)
    kept = tuple(view for view in done.views if all(view is not other for other in dropped))
    verdict = judge(replace(done, views=kept, dropped=dropped))
    assert [one.contradicting for one in verdict.cameras] == [len(dropped) if c == wrong else 0 for c in range(3)]


@pytest.mark.parametrize("begin", [7, 100])
def test_zoom_in_a_part_of_the_views_is_named(good: tuple[Calibrated, Verdict], begin: int) -> None:
    """From the seventh place on, or in the views close to the camera only."""
    done, _ = good
    assert largest_change(done) is None
    middle = np.array([RIG[1].width - 1, RIG[1].height - 1]) / 2
    views = tuple(
        replace(view, pixels=middle + 1.03 * (view.pixels - middle))
        if view.camera == 1 and view.instant >= begin
        else view
        for view in done.views
    )
    zoomed = replace(done, views=views, solved=adjust(done.solved.state, views))
    found = largest_change(zoomed)
    assert found is not None and found[0] == 1 and abs(found[1] - 0.03) < 0.015
    reasons = [text for _, text in judge(zoomed).reasons]
    assert any("camera cam2: its focal length is" in text and "zoomed or focused" in text for text in reasons), reasons


def test_zoom_since_an_earlier_calibration_is_named() -> None:
    known = {camera.name: camera for camera in RIG}
    matrix = RIG[1].matrix * [[1.03, 1, 1], [1, 1.03, 1], [1, 1, 1]]
    _, verdict = run(footages(), replace(QUICK, intrinsics={**known, "cam2": replace(RIG[1], matrix=matrix)}))
    assert verdict.level > 0
    assert any("camera cam2: its focal length is" in text and "--intrinsics" in text for _, text in verdict.reasons)


def test_noise_lowers_the_verdict() -> None:
    _, verdict = run(footages(noise_px=0.7))
    assert verdict.word == "usable" and any("px off" in text for _, text in verdict.reasons)


def test_floor_can_be_named_and_is_checked(good: tuple[Calibrated, Verdict]) -> None:
    state = good[0].solved.state
    named = rig_of(place_world(state, BOARD, 0).state, good[0].footages)
    np.testing.assert_allclose(named.centers, good[0].rig.centers)
    with pytest.raises(CalibrationError, match="--floor 77: no camera finds a sharp board at this instant"):
        place_world(state, BOARD, 77)
    with pytest.raises(CalibrationError, match=r"--floor 5: .* below this board"):
        place_world(state, BOARD, 5)


def test_without_a_board_on_the_floor_the_cameras_give_up(good: tuple[Calibrated, Verdict]) -> None:
    state = good[0].solved.state
    world = place_world(replace(state, boards={i: pose for i, pose in state.boards.items() if i}), BOARD, None)
    assert world.floor is None and "no board lies on the floor" in world.how
    up = world.state.cameras[0].rotation @ np.array([0.0, 0, 1])
    assert np.degrees(np.arccos(up @ RIG[0].rotation @ np.array([0.0, 0, 1]))) < 3


def test_one_camera_has_intrinsics_only() -> None:
    done, verdict = run(footages()[:1])
    assert abs(done.rig[0].matrix[0, 0] / RIG[0].matrix[0, 0] - 1) < 0.003
    assert verdict.pairs == () and np.isnan(verdict.error_m) and verdict.to_dict()["error_mm"] is None


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("charuco", None, 200.0), "a square of 200 m; give its side in metres: --square 0.2 if it is in mm"),
        (("charuco", None, 0.0), "--square 0"),
        (("charuco", "7by5", 0.1), "--size 7by5"),
        (("chessboard", "9x7", 0.1), "looks the same after half a turn"),
        (("charuco", "30x30", 0.1), "--dictionary 4x4_50: has 50 markers"),
        (("charuco", None, 0.1, 75.0), "--marker 75"),
        (("charuco", None, 0.1, None, "7x9_50"), "--dictionary 7x9_50"),
    ],
)
def test_impossible_boards_are_refused(arguments: tuple[str, str | None, float], part: str) -> None:
    with pytest.raises(ConfigError, match=r".") as caught:
        make_board(*arguments)
    assert part in caught.value.line
