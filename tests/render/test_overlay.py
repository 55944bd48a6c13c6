"""The overlay of small results with known poses."""

from __future__ import annotations

import shutil
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from tests.conftest import Tk
from tests.io.result_files import revise_result
from tests.made_results import write_motion
from tests.model.figures import draw_silhouettes
from tk.errors import ResultError
from tk.io.captures.capture import open_capture
from tk.io.results.data import UsedCameras
from tk.io.results.reader import read_joints, read_result
from tk.io.results.status import Status
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import ConeBody, build_cone_body
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.joints import BONES
from tk.model.body.skeleton import JOINTS, build_skeleton
from tk.model.cameras.camera import Camera, Rig
from tk.render.canvas import View, dots, draw_body, draw_joints
from tk.render.figure import Figure, Seen, solids_of
from tk.render.legend import LEGEND_HEIGHT, Legend
from tk.render.overlay import Grid, Overlay, write_sheets
from tk.render.palette import BONE, LOST, LOST_BODY, SEGMENT_COLORS, person_color, sigma_colors
from tk.render.people import People
from tk.trackers.bodies import body_and_poses

DEMO = Path(__file__).resolve().parents[2] / "tk" / "data" / "demo"
BODY = build_cone_body(BodyDimensions.from_stature(1.7))
SKELETON = build_skeleton(BODY.dimensions)


def camera(distance_m: float = 4.0) -> Camera:
    """Return a camera that looks along +y at height 0."""
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    matrix = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    return Camera("cam1", 320, 240, matrix, np.zeros(5), rotation, np.array([0, 0, distance_m]))


def figure(body: ConeBody, pose: np.ndarray) -> Figure:
    """Return the figure of one pose."""
    joints, transforms = body.skeleton.joints(pose), body.skeleton.segment_transforms(pose[None])
    return Figure(np.zeros(1, int), joints[None], None, np.zeros(1, np.uint8), solids_of(body), transforms)


@pytest.fixture()
def result(tmp_path: Path) -> Path:
    """A result of three frames of the demo with the neutral pose at the true pelvis; the last frame is lost."""
    truth = read_joints(DEMO / "truth.h5").positions
    poses = np.repeat(neutral_pose(SKELETON)[None], 3, axis=0)
    poses[:, :3] = truth[:3, 0]
    model = {f"dimensions/{name}": value for name, value in asdict(BODY.dimensions).items()}
    lost = {2: {"status": Status.LOST}}
    return write_motion(tmp_path / "result.h5", SKELETON, poses, model, lambda f: lost.get(f, {}))


def test_bones_join_all_joints_into_one_tree() -> None:
    assert len(BONES) == len(JOINTS) - 1
    assert {name for bone in BONES for name in bone} == set(JOINTS)


def solids(points: np.ndarray, *parts: tuple[str, int, int]) -> Seen:
    """Solids in an image without joints."""
    return Seen(np.zeros((0, 2)), points, parts)


def test_body_is_restored_from_the_model(result: Path) -> None:
    restored = body_and_poses(read_result(result))
    assert restored is not None
    body, poses = restored
    assert poses.shape == (3, len(BODY.skeleton.names)) and body.dimensions == BODY.dimensions
    np.testing.assert_array_equal(body.arrays.parts, BODY.arrays.parts)


def test_outlines_of_cones_are_their_silhouette() -> None:
    """Filled outlines equal the silhouette that rays hit, also with bent waist and ankles."""
    body = build_cone_body(BodyDimensions.from_stature(1.7))
    pose = np.random.default_rng(0).normal(0, 0.2, len(body.skeleton.names))
    pose[:3] = 0.0
    cam = camera()
    mask = np.zeros((240, 320), np.uint8)
    seen = figure(body, pose).seen(0, cam)
    for _, begin, end in seen.solids:
        outline = cv2.convexHull(np.rint(seen.points[begin:end] * 16).astype(np.int32))
        cv2.fillConvexPoly(mask, outline, 255, cv2.LINE_8, 4)
    drawn = draw_silhouettes(body, Rig((cam,)), pose[None])[0, 0]
    assert ((drawn > 0) & (mask == 0)).sum() < 0.01 * (drawn > 0).sum()
    outside = (cv2.erode(mask, np.ones((3, 3), np.uint8)) > 0) & (drawn == 0)  # in a narrow gap between two solids
    assert outside.sum() < 0.01 * (drawn > 0).sum()


def test_results_of_the_region_tracker_are_drawn(tiny: Path, causal: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(causal, tmp_path / "region.h5"))
    capture = open_capture(tiny, masks="none")
    (sheet,) = write_sheets(Overlay(capture, read_result(path)), tmp_path, [1], full=True)
    picture = cv2.imread(str(sheet))
    with h5py.File(path, "a") as file:
        del file["people/0/model"]
        file.create_group("people/0/model")
    (bare,) = write_sheets(Overlay(capture, read_result(path)), tmp_path / "bare", [1], full=True)
    differ = (picture != cv2.imread(str(bare))).any(axis=2)
    assert 0.01 < differ.mean() < 0.5, "the body is drawn, and not everywhere"


def test_body_behind_the_camera_is_not_drawn() -> None:
    assert figure(BODY, neutral_pose(BODY.skeleton)).seen(0, camera(-5.0)).solids == ()


def test_tile_contains_its_points() -> None:
    cam = camera()
    points = np.array([[100.0, 60.0], [130.0, 180.0]])
    view = View.around(points, cam, 150, 200)
    placed = view.place(points)
    assert (placed >= 0).all() and (placed < (150, 200)).all()
    picture = np.zeros((240, 320, 3), np.uint8)
    picture[58:63, 98:103] = 255  # around the first point
    tile = np.full((200, 150, 3), 255, np.uint8)
    view.cut(picture, tile)
    y, x = np.nonzero(tile[..., 0] > 127)
    np.testing.assert_allclose((x.mean(), y.mean()), placed[0], atol=0.6)
    near_edge = View.around(np.array([[2.0, 2.0], [30.0, 60.0]]), cam, 150, 200)
    assert (near_edge.origin == 0).all()


def test_near_segment_hides_far_segment() -> None:
    tile = np.full((40, 40, 3), 200, np.uint8)
    square = np.array([[5.0, 5.0], [35.0, 5.0], [35.0, 35.0], [5.0, 35.0]])
    both = np.concatenate([square, square])
    view = View(np.zeros(2), 1.0, 40, 40)
    near = np.array(SEGMENT_COLORS["calf_l"])
    draw_body(tile, view, solids(both, ("thigh_r", 0, 4), ("calf_l", 4, 8)), SEGMENT_COLORS.__getitem__)
    assert (tile[0, 0] == 200).all()
    share = (tile[20, 20].astype(float) - 200) / (near - 200.0)
    assert share.min() > 0.2 and share.max() < 0.6, "the near one's colour, and the picture shines through"
    np.testing.assert_allclose(share, share.mean(), atol=0.02)
    np.testing.assert_array_equal(tile[4, 20], near, err_msg="the contour is opaque")
    grey = np.full((40, 40, 3), 200, np.uint8)
    draw_body(grey, view, solids(square, ("calf_l", 0, 4)), lambda _: LOST_BODY)
    assert len(set(grey[20, 20].tolist())) == 1, "a lost body has no colour"


def test_body_is_clipped_at_the_tile() -> None:
    whole, part = (np.full((60, 60, 3), 90, np.uint8) for _ in range(2))
    polygon = np.array([[-20.0, 10.0], [80.0, 10.0], [80.0, 200.0], [-20.0, 200.0]])
    view, trunk = View(np.zeros(2), 1.0, 60, 60), ("torso", 0, 4)
    draw_body(whole, view, solids(polygon, trunk), SEGMENT_COLORS.__getitem__)
    assert (whole[5] == 90).all() and (whole[15:, 1:-1] != 90).any(axis=2).all()
    draw_body(part, view, solids(polygon + 500, trunk), SEGMENT_COLORS.__getitem__)
    assert (part == 90).all()


def test_joint_colour_shows_standard_deviation() -> None:
    xy = np.full((len(JOINTS), 2), np.nan)
    xy[:4] = [[10.0, 10.0], [30.0, 10.0], [10.0, 30.0], [30.0, 30.0]]
    sigma = np.full(len(JOINTS), 0.01)
    sigma[1], sigma[3] = 0.04, np.nan
    tile = np.full((40, 40, 3), 100, np.uint8)
    draw_joints(tile, xy, dots(replace(figure(BODY, neutral_pose(BODY.skeleton)), sigma=sigma[None]), 0))
    certain, uncertain = sigma_colors([0.01, 0.04])
    np.testing.assert_array_equal(tile[10, 10], certain)
    np.testing.assert_array_equal(tile[10, 30], uncertain)
    assert certain.sum() > uncertain.sum(), "what is uncertain is darker"
    assert tile[30, 30].max() < 60 and tile[30, 33].min() > 180, "without evidence: a ring"


def test_cameras_fill_a_grid_of_even_size() -> None:
    for count, size in ((1, (641, 481)), (2, (160, 120)), (5, (640, 480)), (6, (288, 320)), (9, (1920, 1080))):
        cameras = [replace(camera(), name=f"c{k}", width=size[0], height=size[1]) for k in range(count)]
        grid = Grid.of(Rig(tuple(cameras)))
        assert grid.width % 2 == grid.height % 2 == 0
        assert grid.width <= 1281 and grid.height <= 721
        tile = (int(size[1] * grid.scale), int(size[0] * grid.scale))
        corners = [grid.corner(k, tile) for k in range(count)]
        assert len(set(corners)) == count
        assert (
            max(y for y, _ in corners) + tile[0] <= grid.height and max(x for _, x in corners) + tile[1] <= grid.width
        )


def test_sheets_are_written(result: Path, tmp_path: Path, tk: Tk) -> None:
    ran = tk("render", result, DEMO, "--png", tmp_path / "out", "--cameras", "cam1,cam5")
    (sheet,) = (Path(line.removeprefix("wrote ")) for line in ran.err.splitlines())
    assert ran.code == 0 and sheet.name == "overlay-000000-000002.png"
    picture = cv2.imread(str(sheet))
    assert picture.shape == (3 * 360 + 2 * 6, 2 * 270 + 6, 3)
    names = picture[2 * 366 : 2 * 366 + 20].astype(int)
    assert (names[..., 2] - names[..., 0] > 60).any(), "a lost frame says so in red"
    assert tk("render", result, DEMO, "--png", tmp_path / "out", "--full", "--frames", "1").code == 0
    whole = cv2.imread(str(tmp_path / "out" / "overlay-000001-000001.png"))
    assert whole.shape == (360, 5 * 480 + 4 * 6, 3)
    tk("render", result, DEMO, "--png", tmp_path / "out").complaint("overlay-000000-000002.png", "exists", "--force")


def test_lost_frames_are_marked_red(result: Path) -> None:
    overlay = Overlay(open_capture(DEMO, masks="none"), read_result(result))
    pictures = {frame: overlay.mosaic(frame, images).copy() for frame, images in overlay.pictures([0, 2])}
    height = overlay.grid.height
    assert (pictures[2][height + 2, 2] == LOST).all() and (pictures[2][2, 300] == LOST).all()
    assert not (pictures[0][height + 2, 2] == LOST).all() and not (pictures[0][2, 300] == LOST).all()
    bar = pictures[0][-1]
    assert (bar[-100] == LOST).all() and not (bar[300] == LOST).all(), "the bar of time has the lost third in red"


def test_second_person_is_drawn_in_one_colour(result: Path) -> None:
    one = read_result(result)
    aside = np.zeros(one.pose.shape[1])
    aside[0] = 0.5
    other = replace(one, person=1, pose=one.pose + aside, joints=one.joints + aside[:3])
    colored = []
    for shown in (one, replace(one, others=(other,))):
        overlay = Overlay(open_capture(DEMO), shown, full=True)
        ((frame, images),) = overlay.pictures([0])
        colored.append(np.count_nonzero((overlay.mosaic(frame, images) == person_color(1)).all(axis=2)))
    assert colored[1] > colored[0] + 100


def shows(picture: np.ndarray, color: tuple[int, int, int]) -> bool:
    """Return whether a square of a colour is in a legend."""
    return np.count_nonzero((picture == color).all(axis=2)) >= 50


def test_legend_names_the_colours_that_are_seen(result: Path) -> None:
    one = read_result(result)
    two = replace(one, others=(replace(one, person=1),))
    with_sigma = replace(one, sigma=np.full((3, len(JOINTS)), 0.01))
    strips = []
    for shown in (one, two, replace(one, model={}), with_sigma):
        strips.append(np.zeros((LEGEND_HEIGHT, 960, 3), np.uint8))
        Legend(People(shown.people), 960).draw(strips[-1], 0)
    limbs = [SEGMENT_COLORS[name] for name in ("upper_arm_l", "thigh_l", "upper_arm_r", "thigh_r", "torso")]
    assert [[shows(strip, color) for color in limbs] for strip in strips] == [[True] * 5] * 2 + [[False] * 5] + [
        [True] * 5
    ]
    assert [shows(strip, person_color(1)) for strip in strips] == [False, True, False, False]
    ramp = sigma_colors([0.0])[0]
    assert [bool((strip == ramp).all(axis=2).any()) for strip in strips] == [False] * 3 + [True]
    narrow = np.zeros((LEGEND_HEIGHT, 320, 3), np.uint8)
    Legend(People(two.people), 320).draw(narrow, 0)
    assert not shows(narrow, limbs[0]), "no room"


def test_camera_that_was_left_out_is_dark_and_named(result: Path) -> None:
    capture, one = open_capture(DEMO, masks="none"), read_result(result)
    residual = np.full((3, 5, 2), 0.05)
    residual[0, 1] = np.nan
    meta = replace(one.meta, residual_cameras=capture.rig.names)
    overlay, plain = (
        Overlay(capture, replace(one, meta=meta, residual=values)) for values in (residual, np.full((3, 5, 2), 0.05))
    )
    for frame, images in overlay.pictures([0, 1]):
        height, width = overlay.grid.cell
        tiles = [o.mosaic(frame, images)[:height, width : 2 * width].copy() for o in (overlay, plain)]
        sheets = [o.sheet_row(frame, images)[:, 276:546] for o in (overlay, plain)]
        for marked, usual in (tiles, sheets):
            if frame == 1:
                np.testing.assert_array_equal(marked, usual)
                continue
            assert np.median(marked[20:]) < 0.5 * np.median(usual[20:])
            name = marked[:20].astype(int)
            assert (name[..., 2] - name[..., 0] > 60).any(), "its name is red"
    assert People(replace(one, meta=meta, residual=residual).people).left_out.sum() == 1


def test_videos_show_where_the_person_moves(result: Path) -> None:
    capture = open_capture(DEMO, masks="none")
    near, whole = (Overlay(capture, read_result(result), full=full) for full in (False, True))
    for camera, view, all_of_it in zip(near.rig, near._views, whole._views, strict=True):
        assert (view.width, view.height) == (all_of_it.width, all_of_it.height)
        assert view.scale >= all_of_it.scale == near.grid.scale
        xy = view.place(camera.project(near.people.figures[0].joints[:2].reshape(-1, 3))[0])
        assert (xy > 0).all() and (xy < (view.width, view.height)).all()
    assert max(view.scale for view in near._views) > 1.1 * near.grid.scale


def test_overlay_uses_cameras_and_time_offsets_of_the_run(result: Path) -> None:
    """The run has refined the rotation and the time offset of a camera."""
    capture = open_capture(DEMO, ("cam1", "cam2"), masks="none")
    turn = cv2.Rodrigues(np.array([0.0, 0.05, 0.0]))[0]
    turned = replace(capture.rig[0], rotation=turn @ capture.rig[0].rotation)
    revise_result(result, cameras=UsedCameras(Rig((turned,)), np.array([-1 / capture.fps])))
    overlay = Overlay(capture, read_result(result), full=True)
    assert overlay.rig[0].rotation == pytest.approx(turned.rotation) and overlay.rig[1] is capture.rig[1]
    with capture.frames(0, 3) as recorded:
        pictures = [frame.images.copy() for frame in recorded]
    shown = dict(overlay.pictures([0, 1]))
    for k in (0, 1):
        np.testing.assert_array_equal(
            shown[k][0], pictures[k + 1][0], err_msg="the picture that was taken a frame later"
        )
        np.testing.assert_array_equal(shown[k][1], pictures[k][1])
    drawn, view = overlay.mosaic(0, shown[0]), overlay._views[0]
    old, new = (
        np.rint(view.place(c.project(overlay.people.figures[0].joints[0])[0])).astype(int)
        for c in (capture.rig[0], turned)
    )
    assert (drawn[new[:, 1], new[:, 0]] == BONE).all()
    assert (drawn[old[:, 1], old[:, 0]] == BONE).all(axis=1).mean() < 0.5


def test_missing_frame_is_named(result: Path, tmp_path: Path, tk: Tk) -> None:
    ran = tk("render", result, DEMO, "--png", tmp_path, "--frames", "1,7")
    ran.complaint("frame 7 is not in it; it has frames 0 to 2")
    tk("render", tmp_path / "nothing.h5", DEMO).complaint("nothing.h5: no such file")
    tk("render", result, DEMO, "--png", tmp_path, "--frames", "one").complaint("--frames one: give A:B")
    tk("render", result, "--view", "overlay").complaint("needs the images")
    tk("render", result, "--view", "hull").complaint("holds no hull")


def test_result_of_another_capture_is_refused(result: Path, tiny: Path) -> None:
    with h5py.File(result, "a") as file:
        file["frames"][...] = [100, 101, 102]
    with pytest.raises(ResultError, match="name the capture that was tracked"):
        Overlay(open_capture(tiny, masks="none"), read_result(result))
