"""The overlay at a small size: a body drawn where it is, in pictures made for it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from scripts import overlay
from scripts.overlay import BONES, View, draw_body, main, outlines, write_sheets
from tests.conftest import QUICK, Silent
from tk.config import Config
from tk.io.capture import open_capture
from tk.io.result import FrameResult, ResultMeta, ResultWriter, Status, read_joints, read_result
from tk.model.anthropometry import BodyDimensions
from tk.model.body import build_body, neutral_pose
from tk.model.camera import Camera, Rig
from tk.model.cone_body import build_cone_body
from tk.model.silhouettes import draw_silhouettes
from tk.model.skeleton import JOINTS
from tk.session import track
from tk.trackers.volumetric import restore_body

DEMO = Path(__file__).resolve().parents[2] / "tk" / "data" / "demo"
BODY = build_body(BodyDimensions.from_stature(1.7))


def camera(distance_m: float = 4.0) -> Camera:
    """Looks along +y at the origin's height 0."""
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    matrix = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    return Camera("cam1", 320, 240, matrix, np.zeros(5), rotation, np.array([0, 0, distance_m]))


@pytest.fixture()
def result(tmp_path: Path) -> Path:
    """A result of three frames of the demo: the neutral pose at the true pelvis; the last frame is lost."""
    path = tmp_path / "result.h5"
    skeleton, truth = BODY.skeleton, read_joints(DEMO / "truth.h5")
    pose = neutral_pose(skeleton)
    meta = ResultMeta(
        skeleton.names, skeleton.units, ("all",), ("total",), 15.0, "z", "demo", "made", 0, Config().to_toml()
    )
    with ResultWriter.create(path, meta) as writer:
        writer.write_model({f"dimensions/{name}": value for name, value in asdict(BODY.dimensions).items()})
        for frame in range(3):
            pose[:3] = truth.positions[frame, 0]
            status = Status.LOST if frame == 2 else Status.TRACKED
            joints = skeleton.joints(pose)
            writer.append(FrameResult(frame, frame / 15, pose, joints, status, 0.1, np.array([1]), {"total": 0.1}))
    return path


def test_bones_join_all_joints_into_one_tree() -> None:
    assert len(BONES) == len(JOINTS) - 1
    assert {name for bone in BONES for name in bone} == set(JOINTS)


def test_body_is_built_anew_from_the_model(result: Path) -> None:
    restored = restore_body(read_result(result))
    assert restored is not None
    body, poses = restored
    assert poses.shape == (3, 24) and body.dimensions == BODY.dimensions
    np.testing.assert_array_equal(body.points, BODY.points)


def test_outlines_hold_the_surface_samples() -> None:
    pose = neutral_pose(BODY.skeleton)
    cam = camera()
    mask = np.zeros((240, 320), np.uint8)
    found = outlines(BODY, pose, cam)
    assert [depth for _, depth, _ in found] == sorted((depth for _, depth, _ in found), reverse=True)
    for _, _, polygons in found:
        for polygon in polygons:
            cv2.fillConvexPoly(mask, np.rint(polygon).astype(np.int32), 255)
    xy = np.rint(cam.project(BODY.place(pose)[0])[0]).astype(int)
    grown = cv2.dilate(mask, np.ones((3, 3), np.uint8))  # the outline has corners: a sample may lie just outside
    assert (grown[xy[:, 1], xy[:, 0]] > 0).all()
    assert (mask > 0).sum() < 1.3 * cv2.contourArea(cv2.convexHull(xy.astype(np.int32)))


def test_outlines_of_cones_are_their_silhouette() -> None:
    """With waist and ankles bent: filled, they are what rays through the pixels meet."""
    body = build_cone_body(BodyDimensions.from_stature(1.7))
    pose = np.random.default_rng(0).normal(0, 0.2, len(body.skeleton.names))
    pose[:3] = 0.0
    cam = camera()
    mask = np.zeros((240, 320), np.uint8)
    for _, _, polygons in outlines(body, pose, cam):
        for polygon in polygons:
            cv2.fillConvexPoly(mask, np.rint(polygon * 16).astype(np.int32), 255, cv2.LINE_8, 4)
    drawn = draw_silhouettes(body, Rig((cam,)), pose[None])[0, 0]
    assert not ((drawn > 0) & (mask == 0)).sum() > 0.01 * (drawn > 0).sum()
    assert not ((cv2.erode(mask, np.ones((3, 3), np.uint8)) > 0) & (drawn == 0)).any()


def test_results_of_the_region_tracker_are_drawn(tiny: Path, tmp_path: Path) -> None:
    path = tmp_path / "region.h5"
    track(open_capture(tiny), path, Config.from_toml(QUICK), Silent(), frames=(0, 2))
    (sheet,) = write_sheets(open_capture(tiny, masks="none"), read_result(path), tmp_path, [1], full=True)
    picture = cv2.imread(str(sheet))
    with h5py.File(path, "a") as file:
        del file["model"]
        file.create_group("model")
    (bare,) = write_sheets(open_capture(tiny, masks="none"), read_result(path), tmp_path / "bare", [1], full=True)
    differ = (picture != cv2.imread(str(bare))).any(axis=2)
    assert 0.01 < differ.mean() < 0.5, "the body is drawn, and not everywhere"


def test_what_is_behind_the_camera_is_not_drawn() -> None:
    assert outlines(BODY, neutral_pose(BODY.skeleton), camera(-5.0)) == []


def test_a_tile_shows_what_it_is_cut_around() -> None:
    cam = camera()
    points = np.array([[100.0, 60.0], [130.0, 180.0]])
    view = View.around(points, cam, 150, 200)
    placed = view.place(points)
    assert (placed >= 0).all() and (placed < (150, 200)).all()
    picture = np.zeros((240, 320, 3), np.uint8)
    picture[58:63, 98:103] = 255  # around the first point
    y, x = np.nonzero(view.cut(picture)[..., 0] > 127)
    np.testing.assert_allclose((x.mean(), y.mean()), placed[0], atol=0.6)
    near_edge = View.around(np.array([[2.0, 2.0], [30.0, 60.0]]), cam, 150, 200)
    assert (near_edge.origin == 0).all()


def test_the_near_segment_is_drawn_over_the_far_one() -> None:
    tile = np.full((40, 40, 3), 200, np.uint8)
    square = [np.array([[5.0, 5.0], [35.0, 5.0], [35.0, 35.0], [5.0, 35.0]])]
    view = View(np.zeros(2), 1.0, 40, 40)
    draw_body(tile, view, [("thigh_r", 5.0, square), ("calf_l", 2.0, square)])
    assert (tile[0, 0] == 200).all()
    under = 0.65 * 200 + 0.35 * np.array(overlay._COLORS["thigh_r"])
    np.testing.assert_allclose(tile[20, 20], 0.65 * under + 0.35 * np.array(overlay._COLORS["calf_l"]), atol=2)
    np.testing.assert_allclose(tile[5, 20], overlay._COLORS["calf_l"], atol=12, err_msg="outline, smoothed")


def test_sheets_are_written(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(DEMO), str(result), "-o", str(tmp_path / "out"), "--height", "120", "--rows", "2"]
    main([*arguments, "--cameras", "cam1", "cam5"])
    sheets = [Path(line) for line in capsys.readouterr().out.split()]
    assert [sheet.name for sheet in sheets] == ["overlay-000000-000001.png", "overlay-000002-000002.png"]
    first, last = (cv2.imread(str(sheet)) for sheet in sheets)
    assert first.shape == (2 * 120 + 6, 2 * 90 + 6, 3) and last.shape == (120, 186, 3)
    red = (last[:20].astype(int)[..., 2] - last[:20].astype(int)[..., 0]) > 60
    assert red.any(), "a lost frame says so in red"
    main([*arguments, "--full", "--frames", "1"])
    whole = cv2.imread(str(tmp_path / "out" / "overlay-000001-000001.png"))
    assert whole.shape == (120, 5 * 160 + 4 * 6, 3)


def test_a_frame_that_is_not_there_is_named(result: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="frame 7 is not there; it has frames 0 to 2"):
        main([str(DEMO), str(result), "-o", str(tmp_path), "--frames", "1", "7"])
    with pytest.raises(SystemExit, match=r"nothing\.h5: no such file"):
        main([str(DEMO), str(tmp_path / "nothing.h5"), "-o", str(tmp_path)])
