"""Pixels and silhouettes by view, compared with direct computations."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from tests.conftest import QUICK, Tk, track
from tests.io.result_files import revise_result
from tests.model.figures import draw_silhouettes
from tk.evaluation.views import capture_of, evaluate_views
from tk.export import export
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.io.results.data import UsedCameras
from tk.io.results.reader import read_joints, read_result
from tk.io.results.status import Status
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import BODIES
from tk.model.body.skeleton import JOINTS, Skeleton, skeleton_of_names
from tk.model.cameras.camera import Rig
from tk.trackers.bodies import body_and_poses


@pytest.fixture(scope="module")
def three_views(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("views") / "r.h5"
    capture = open_capture(tiny, open_capture(tiny).rig.names[:3])
    track(capture, path, settings_file.from_toml(QUICK), method="silhouette", frames=(0, 3))
    return path


def test_scores_of_all_views_equal_a_direct_computation(tiny: Path, three_views: Path) -> None:
    found = evaluate_views(three_views, tiny / "truth.h5", tiny, ("wrist_l",))
    result, truth = read_result(three_views), read_joints(tiny / "truth.h5")
    capture = open_capture(tiny)
    restored = body_and_poses(result)
    assert restored is not None
    body, poses = restored
    # the poses are whole: their joints are those of the file
    np.testing.assert_allclose([body.skeleton.joints(pose) for pose in poses], result.joints, atol=1e-9)
    with capture.frames(0, 3) as frames:
        masks = np.array([frame.masks for frame in frames])
    drawn = draw_silhouettes(body, capture.rig, poses)
    wrist = JOINTS.index("wrist_l")
    assert [view.tracked for view in found.views] == [True, True, True, False]
    for v, (camera, view) in enumerate(zip(capture.rig, found.views, strict=True)):
        a, b = (camera.project(p[:, wrist])[0] for p in (result.joints, truth.positions[:3]))
        assert view.joint_px == pytest.approx(np.linalg.norm(a - b, axis=1).mean())
        wrong = [(drawn[i, v] >= 128) != (masks[i, v] >= 128) for i in range(3)]
        shares = [w.sum() / (masks[i, v] >= 128).sum() for i, w in enumerate(wrong)]
        assert view.silhouette_error == pytest.approx(np.mean(shares))
    assert found.joint_px == pytest.approx(np.mean([view.joint_px for view in found.views[:3]]))
    assert found.silhouette_error == pytest.approx(np.mean([view.silhouette_error for view in found.views]))


def test_silhouettes_are_those_of_the_cameras_of_the_run(tiny: Path, three_views: Path, tmp_path: Path) -> None:
    """The run has refined the rotation of one camera and the time offset of another; lost frames are omitted."""
    path = Path(shutil.copy(three_views, tmp_path / "refined.h5"))
    capture, (body, poses) = open_capture(tiny), body_and_poses(read_result(three_views)) or pytest.fail("no body")
    turned = replace(capture.rig[0], rotation=cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))[0] @ capture.rig[0].rotation)
    used = Rig((turned, *capture.rig[1:3]))
    revise_result(path, cameras=UsedCameras(used, np.array([0.0, -1 / capture.fps, 0.0])))
    with h5py.File(path, "a") as file:
        file["status"][2] = Status.LOST
        file["pose"][2, 0] += 1.0
    with capture.frames(0, 3) as frames:
        masks = np.array([frame.masks for frame in frames]) >= 128
    drawn = draw_silhouettes(body, Rig((*used, capture.rig[3])), poses) >= 128
    late = (0, 1, 0, 0)
    for v, view in enumerate(evaluate_views(path, tiny / "truth.h5", tiny).views):
        seen = [masks[i + late[v], v] for i in range(2)]
        shares = [(drawn[i, v] != seen[i]).sum() / seen[i].sum() for i in range(2)]
        assert view.silhouette_error == pytest.approx(np.mean(shares))


def test_command_finds_the_capture_beside_the_truth(tk: Tk, tiny: Path, three_views: Path, tmp_path: Path) -> None:
    ran = tk("evaluate", three_views, tiny / "truth.h5", "--json")
    views = json.loads(ran.out)["views"]
    assert ran.code == 0 and len(views["views"]) == 4 and views["joints"] == ["ankle_l", "ankle_r"]
    assert "E_S %" in tk("evaluate", three_views, tiny / "truth.h5").out
    shutil.copy(tiny / "truth.h5", tmp_path)
    assert capture_of(tmp_path / "truth.h5") is None
    assert "E_S" not in tk("evaluate", three_views, tmp_path / "truth.h5").out
    assert "E_S %" in tk("evaluate", three_views, tmp_path / "truth.h5", "--capture", tiny).out


def test_results_of_both_body_models_are_evaluated(tk: Tk, tiny: Path, tracked: Path) -> None:
    """The volumetric tracker's are: its body is the contours'."""
    found = evaluate_views(tracked, tiny / "truth.h5", tiny)
    assert found.note == "" and found.joint_px > 0
    assert all(view.silhouette_error is not None and 0 < view.silhouette_error < 0.5 for view in found.views)
    assert "E_S %" in tk("evaluate", tracked, tiny / "truth.h5").out


def test_body_of_a_result_without_parts_follows_from_its_dimensions(tiny: Path, tracked: Path, tmp_path: Path) -> None:
    older = Path(shutil.copy(tracked, tmp_path / "older.h5"))
    with h5py.File(older, "a") as file:
        del file["people/0/model/parts"]
    restored = body_and_poses(read_result(older))
    assert restored is not None
    body, poses = restored
    np.testing.assert_allclose([body.skeleton.joints(pose) for pose in poses], read_result(tracked).joints, atol=1e-9)
    assert evaluate_views(older, tiny / "truth.h5", tiny).silhouette_error is not None


def test_results_without_a_body_have_pixels_only(tiny: Path, tracked: Path, tmp_path: Path) -> None:
    bare = Path(shutil.copy(tracked, tmp_path / "bare.h5"))
    with h5py.File(bare, "a") as file:
        del file["people/0/model"]
        file.create_group("people/0/model")
    found = evaluate_views(bare, tiny / "truth.h5", tiny)
    assert found.silhouette_error is None and str(bare) in found.note and found.joint_px > 0


def test_unusable_input_is_reported(tk: Tk, tiny: Path, three_views: Path, copy: Path, tmp_path: Path) -> None:
    tk("evaluate", three_views, tiny / "truth.h5", "--joints", "toe").complaint("joint 'toe' is unknown")
    tk("evaluate", three_views, tiny / "truth.h5", "--capture", tmp_path).complaint(str(tmp_path))
    shutil.rmtree(copy / "videos")
    ran = tk("evaluate", three_views, copy / "truth.h5")
    assert ran.code == 0 and "no comparison in the images" in ran.err and "PCK5" in ran.out


def is_ankle(skeleton: Skeleton) -> np.ndarray:
    return skeleton.is_straight & ~skeleton.is_waist


def test_waist_and_ankles_are_drawn(tiny: Path, three_views: Path, tmp_path: Path) -> None:
    """A body whose ankles or waist are bent otherwise covers other pixels; without them it is drawn straight."""
    straight = evaluate_views(three_views, tiny / "truth.h5", tiny)
    skeleton = skeleton_of_names(read_result(three_views).meta.pose_names, BodyDimensions.from_stature(1.7), "z")
    for name, bent_dofs in (("ankles", is_ankle(skeleton)), ("waist", skeleton.is_waist)):
        bent = Path(shutil.copy(three_views, tmp_path / f"{name}.h5"))
        with h5py.File(bent, "a") as file:
            file["pose"][...] = file["pose"][()] + 0.4 * bent_dofs
        found = evaluate_views(bent, tiny / "truth.h5", tiny)
        assert found.silhouette_error is not None and straight.silhouette_error is not None
        assert found.silhouette_error > straight.silhouette_error + 0.005, name


def without_columns(path: Path, names: tuple[str, ...]) -> Path:
    """Remove columns of /pose."""
    with h5py.File(path, "a") as file:
        kept = [k for k, name in enumerate(file["pose"].attrs["names"]) if name not in names]
        values, attributes = file["pose"][:, kept], dict(file["pose"].attrs)
        del file["people/0/pose"]
        file["people/0/pose"] = values
        for key, value in attributes.items():
            file["pose"].attrs[key] = value[kept]
        del file["people/0/smoothed"]
    return path


@pytest.mark.parametrize("names", BODIES[1:])
def test_degrees_of_freedom_that_a_file_lacks_are_straight(
    names: tuple[str, ...], three_views: Path, tmp_path: Path
) -> None:
    """Those of the paper's body, and those of files from before the head turned."""
    lacking = tuple(name for name in BODIES[0] if name not in names)
    result = read_result(without_columns(Path(shutil.copy(three_views, tmp_path / "r.h5")), lacking))
    restored = body_and_poses(result)
    assert restored is not None and result.paper_pose().shape == (len(result), 24)
    body, poses = restored
    assert not poses[:, np.isin(body.skeleton.names, lacking)].any() and poses.any()
    assert export(result.path, ["bvh", "csv"]).files


def test_poses_of_another_body_are_refused(tk: Tk, tiny: Path, three_views: Path, tmp_path: Path) -> None:
    spoilt = without_columns(Path(shutil.copy(three_views, tmp_path / "r.h5")), ("waist_yaw",))
    tk("evaluate", spoilt, tiny / "truth.h5", "--capture", tiny).complaint("r.h5", "waist_yaw")
