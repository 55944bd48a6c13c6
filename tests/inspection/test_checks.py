"""`tk inspect` and `tk calibrate --level` on the tiny capture, and on damaged copies."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scripts.synthetic.capture import write_calibration
from tests.conftest import Tk
from tests.io.conftest import write_video
from tests.model.figures import BODY, draw_silhouettes
from tests.model.ring import turned
from tests.walkers import RIG, stroll, write_masks
from tk.errors import CaptureError
from tk.inspection.checks import inspect
from tk.inspection.delays import best_shift
from tk.inspection.leveling import Leveling, find_up, write_up
from tk.io.captures.capture import open_capture
from tk.io.captures.frames import FrameSet
from tk.io.results.reader import read_joints
from tk.model.body.body_points import LANDMARKS
from tk.model.body.joints import JOINTS
from tk.model.cameras.camera import Rig
from tk.model.cameras.mounting import FoundUp, infer_up
from tk.model.cameras.up import up_vector
from tk.run.segmentation import Labeller, Labels, make_labeller
from tk.run.task import Task
from tk.settings import Settings


def turn_camera(folder: Path, camera: int, degrees: float) -> None:
    """Turn a camera of the calibration to the side."""
    write_calibration(turned(open_capture(folder).rig, camera, degrees), folder / "calibration.toml")


def test_good_capture_has_no_findings_and_gets_a_sheet(tk: Tk, tiny: Path, tmp_path: Path) -> None:
    ran = tk("inspect", tiny, "-o", tmp_path / "sheets")
    assert ran.code == 0, ran.err
    assert "No problems found." in ran.out and all(f"cam{c}" in ran.out for c in range(1, 5))
    sheet = cv2.imread(str(tmp_path / "sheets" / "inspect.png"))
    # a row of four cameras for each of three frames, below the text
    assert sheet.shape[0] > 900 and sheet.shape[1] > 1600
    tk("inspect", tiny, "-o", tmp_path / "sheets").complaint("inspect.png", "exists", "--force")


def test_stages_and_shares_are_reported(tiny: Path, caplog: pytest.LogCaptureFixture) -> None:
    shares: list[float] = []
    with caplog.at_level("INFO", "tk"):
        inspect(open_capture(tiny), Settings(), within=shares.append)
    stages = [record.getMessage() for record in caplog.records if record.name == "tk.inspection.checks"]
    assert stages[0] == "making masks of the first frame" and stages[-1].startswith("comparing the masks of ")
    assert shares == sorted(shares) and shares[0] > 0 and shares[-1] == 1


def test_turned_camera_is_named(tk: Tk, copy: Path) -> None:
    turn_camera(copy, 1, 6.0)
    ran = tk("inspect", copy, "--json")
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert [bool(c["verdict"]) for c in found["cameras"]] == [False, True, False, False]
    assert found["findings"][0].startswith("camera cam2 is inconsistent with the others: off by ")
    assert found["cameras"][1]["shift_px"] > 5 and found["cameras"][1]["outside"] > 0.1
    assert np.argmax([c["pairs_px"] for c in found["cameras"]]) == 1


@pytest.mark.parametrize("wrong", ["mask", "camera"])
def test_a_wrong_mask_blames_no_camera_whose_landmarks_agree(copy: Path, monkeypatch, wrong: str) -> None:
    """The masks of cam2 show something else; or cam2 is turned, so that its landmarks contradict the others', too."""
    rig, truth = open_capture(copy).rig, read_joints(copy / "truth.h5").positions

    def labeller(task: Task, note: Callable[[str], None]) -> Labeller:
        label = make_labeller(task, note)

        def labelled(frame: FrameSet) -> Labels:
            seen = np.full((1, len(rig), len(LANDMARKS), 4), np.nan)
            for k, name in enumerate(LANDMARKS):
                if name in JOINTS:
                    points = truth[frame.index, JOINTS.index(name)][None]
                    seen[0, :, k, :2] = [camera.project(points)[0][0] for camera in rig]
                    seen[0, :, k, 2] = 0.95
            found = label(frame)
            if wrong == "mask":
                found.masks[1] = np.roll(found.masks[1], 14, axis=1)
            return found._replace(landmarks=seen)

        return labelled

    monkeypatch.setattr("tk.inspection.checks.make_labeller", labeller)
    if wrong == "camera":
        turn_camera(copy, 1, 6.0)
    found, _ = inspect(open_capture(copy), Settings())
    blamed = [line for line in found.findings if "cam2 is inconsistent" in line]
    assert bool(blamed) == (wrong == "camera")
    assert ("the landmarks of the cameras agree" in " ".join(found.findings)) == (wrong == "mask")


def test_inspect_and_track_refuse_the_cameras_of_another_recording(
    tk: Tk, quick: Path, copy: Path, tmp_path: Path
) -> None:
    for camera, degrees in enumerate((8.0, -9.0, -8.0, 9.0)):
        turn_camera(copy, camera, degrees)
    ran = tk("inspect", copy, "--json")
    (first, *_) = json.loads(ran.out)["findings"]
    assert first.startswith("the cameras cam1, cam2, cam3 and cam4 do not belong together")
    tk("track", copy, "-o", tmp_path / "r.h5", "--config", quick).complaint(first)


def swap_first_two(folder: Path) -> None:
    (one,), (other,) = (folder.glob(f"cam{c}*") for c in (1, 2))
    between = one.with_name("between")
    one.rename(between)
    other.rename(one)
    between.rename(other)


def test_inspect_and_track_refuse_videos_that_show_another_cameras_empty_scene(
    tk: Tk, quick: Path, copy: Path, tmp_path: Path
) -> None:
    swap_first_two(copy / "videos")
    expected = "the video of cam1 shows the empty scene of cam2, the video of cam2 shows the empty scene of cam1"
    for command in (["inspect", copy], ["track", copy, "-o", tmp_path / "r.h5", "--config", quick]):
        tk(*command, "--masks", "none").complaint(str(copy), expected)


def test_inspect_and_track_name_swapped_videos(tk: Tk, quick: Path, copy: Path, tmp_path: Path) -> None:
    for folder in ("videos", "masks"):
        swap_first_two(copy / folder)
    ran = tk("inspect", copy, "--json")
    assert "the videos of cam1 and cam2 look swapped" in json.loads(ran.out)["findings"][0]
    tk("track", copy, "-o", tmp_path / "r.h5", "--config", quick).complaint("the videos of cam1 and cam2 look swapped")


def test_inspect_and_track_refuse_masks_of_other_frames(tk: Tk, copy: Path, tmp_path: Path) -> None:
    for folder in (copy / "masks").iterdir():
        paths = sorted(folder.iterdir())
        images = [path.read_bytes() for path in paths]
        for i, path in enumerate(paths):
            path.write_bytes(images[i - len(paths) // 2])
    expected = "the masks belong to other frames"
    ran = tk("inspect", copy, "--json")
    assert expected in json.loads(ran.out)["findings"][0]
    settings = tmp_path / "s.toml"
    settings.write_text("ahead = 0\n")
    tk("track", copy, "-o", tmp_path / "r.h5", "--config", settings).complaint(str(copy), expected)


def test_camera_that_was_moved_after_its_empty_scene_is_named(tk: Tk, copy: Path) -> None:
    background = open_capture(copy).background()
    assert background is not None
    (clip,) = (copy / "background").glob("cam2*")
    clip.unlink()
    write_video(clip.with_suffix(".avi"), list(np.roll(background[1], 3, axis=2)))
    (first, *_) = json.loads(tk("inspect", copy, "--json").out)["findings"]
    assert first.startswith("camera cam2 was moved or zoomed, by 3 px, between its empty scene and the recording")


@pytest.mark.parametrize("named", [True, False])
def test_person_in_the_empty_scene_is_named(tiny: Path, monkeypatch: pytest.MonkeyPatch, named: bool) -> None:
    """A network sees landmarks of somebody in the volume; or of somebody in one image only, and beside the volume."""
    capture = open_capture(tiny, masks="none")
    body = np.random.default_rng(0).normal(scale=0.3, size=(len(LANDMARKS), 3))
    body += [*capture.volume.center[:2], 1.0]
    places = [(4, body)] if named else [(1, body), (4, body + np.array([1.5, 1.5, 0.0]))]
    found = np.full((len(places), len(capture.rig), len(LANDMARKS), 4), np.nan)
    for person, (seen_by, points) in zip(found, places, strict=True):
        for seen, camera in zip(person[:seen_by], capture.rig, strict=False):
            seen[:, :2], seen[:, 2:] = camera.project(points)[0], (1.0, 0.0)
    monkeypatch.setattr("tk.inspection.checks.people_in_scene", lambda task, images: found)
    lines = [line for line in inspect(capture, Settings())[0].findings if "empty scene" in line]
    expected = "the empty scene shows a person (cam1, cam2, cam3, cam4): record it again when nobody is there"
    assert lines == ([expected] if named else [])


def test_delay_of_a_video_is_found_in_frames(tk: Tk, tmp_path: Path) -> None:
    """The masks are rendered; those of one camera are three frames ahead."""
    count, late = 24, 3
    drawn = draw_silhouettes(BODY, RIG, stroll(0.05 * np.arange(count + late) - 0.6, 15))
    masks = drawn[:count].copy()
    masks[:, 2] = drawn[late:, 2]
    write_masks(tmp_path, masks)
    ran = tk("inspect", tmp_path, "--json")
    assert ran.code == 0, ran.err
    assert [c["late_frames"] for c in json.loads(ran.out)["cameras"]] == [0, 0, late, 0]


def test_delay_is_certain_only_if_no_single_frame_decides_it() -> None:
    area = np.full((3, 5), 100.0)
    late = np.tile([30.0, 20.0, 10.0, 1.0, 10.0], (3, 1))
    assert best_shift(late, area) == (1, pytest.approx(0.09), True)
    # two frames show no delay, the third one a large one
    one = np.array([[9.0, 5.0, 4.0, 5.0, 9.0], [9.0, 5.0, 4.0, 5.0, 9.0], [90.0, 80.0, 70.0, 9.0, 60.0]])
    assert best_shift(one, area) == (1, pytest.approx((78 - 19) / 300), False)
    assert best_shift(np.ones((3, 5)), area) == (0, 0.0, True)
    assert best_shift(np.roll(late, 1, axis=1), area)[:2] == (0, 0.0), "an optimum at the edge is none"
    assert best_shift(np.zeros((3, 5)), np.zeros((3, 5))) == (0, 0.0, True)


def test_a_video_that_begins_late_is_compared_where_all_cameras_have_images(tk: Tk, copy: Path) -> None:
    late, path = 6, copy / "calibration.toml"
    capture = open_capture(copy)
    with capture.frames() as frames:
        images = [frame.images[1].copy() for frame in frames]
    capture.clips[1].path.unlink()
    write_video(copy / "videos" / "cam2.avi", images[late:], capture.fps)
    masks = sorted((copy / "masks" / "cam2").iterdir())
    for k, mask in enumerate(masks):
        mask.replace(masks[k - late]) if k >= late else mask.unlink()
    path.write_text(path.read_text().replace("[cam2]\n", f"[cam2]\ntime_offset = {late / capture.fps}\n", 1))
    found = json.loads(tk("inspect", copy, "--json").out)
    assert found["frames"][0] == late and found["people"][0]["frames"][0] >= late
    assert [c["verdict"] for c in found["cameras"]] == ["", "", "", ""]
    assert not any("cam2" in line for line in found["findings"])
    assert any(line.startswith("time offsets: ") and "cam2" in line for line in found["notes"])


def test_empty_masks_are_reported(tk: Tk, copy: Path) -> None:
    for path in (copy / "masks").rglob("*.png"):
        cv2.imwrite(str(path), np.zeros((120, 160), np.uint8))
    ran = tk("inspect", copy)
    assert ran.code == 0, ran.err
    assert "no visual hull in common" in ran.out and "shows nobody in 100% of the frames" in ran.out


# --- up ---------------------------------------------------------------------------------------------------------------


def standing(count: int = 8) -> list[np.ndarray]:
    """Return points of a person who stands at random places."""
    rng = np.random.default_rng(0)
    body = rng.uniform([-0.25, -0.15, 0.0], [0.25, 0.15, 1.75], (2000, 3))
    return [body + np.array([x, y, 0.0]) for x, y in rng.uniform(-0.8, 0.8, (count, 2))]


@pytest.mark.parametrize("seed", range(5))
def test_up_is_estimated_in_a_rotated_world(seed: int) -> None:
    R = Rotation.random(random_state=seed).as_matrix()
    rig = Rig(tuple(replace(c, rotation=c.rotation @ R.T) for c in RIG))
    found = find_up(infer_up(rig), "z", [hull @ R.T for hull in standing()])
    assert np.degrees(np.arccos(up_vector(found.up) @ R[:, 2])) < 1.5
    assert abs(found.floor_m) < 0.1


def test_standing_person_overrules_cameras_mounted_sideways() -> None:
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    cameras = []
    for c in RIG:
        cameras.append(replace(c, rotation=quarter @ c.rotation, translation=quarter @ c.translation))
    found = find_up(infer_up(Rig(tuple(cameras))), "z", standing())
    assert found.up == "z" and found.decided


def test_level_writes_up_and_keeps_the_rest(tk: Tk, copy: Path) -> None:
    R = Rotation.from_euler("xyz", [-1.2, 0.3, 0.5]).as_matrix()
    original = open_capture(copy)
    write_calibration(
        Rig(tuple(replace(c, rotation=c.rotation @ R.T) for c in original.rig)), copy / "calibration.toml"
    )
    center = (R @ original.volume.center).tolist()
    text = f"# mine\nfps = 15.0  # as it was\n[volume]\ncenter = {center}\nsize = [3.2, 3.2, 3.2]\n"
    (copy / "capture.toml").write_text(text)
    inferred = open_capture(copy)
    assert any("gives no up" in warning and "--level" in warning for warning in inferred.warnings)
    assert np.degrees(np.arccos(inferred.up_axis @ R[:, 2])) < 6
    ran = tk("calibrate", copy, "--level")
    assert ran.code == 0 and ran.out.startswith("up = "), ran.err
    opened = open_capture(copy)
    assert not any("up" in warning for warning in opened.warnings)
    assert np.degrees(np.arccos(opened.up_axis @ R[:, 2])) < 4
    written = (copy / "capture.toml").read_text()
    assert written.startswith("up = [") and written.endswith(text)
    shutil.rmtree(copy / "videos")
    tk("calibrate", copy, "--level").complaint("videos")


@pytest.mark.parametrize(
    "text",
    [
        "",
        'up = "y"\n',
        "up = [0.0,\n  1.0, # rows\n  0.0]  # old\nfps = 3.0\n",
        'fps = 3.0\r\nup = "y"\r\n[init]\r\nframe = 0\r\n',
        'up = "y"  # of Windows\r\nfps = 3.0\r\n',
        "fps = 3.0\n[volume]\ncenter = [\n 0.0, 0.0, 1.0\n]\nsize = [2.0, 2.0, 2.0]\n",
        "[subject]\nheight = 1.8",
    ],
)
@pytest.mark.parametrize("up", ["z", "[0.6, 0.0, 0.8]"])
def test_up_is_written_before_the_first_table(tmp_path: Path, text: str, up: str) -> None:
    from tk.io.toml import load_toml

    path = tmp_path / "capture.toml"
    path.write_text(text, newline="")
    before = load_toml(path)
    write_up(tmp_path, Leveling(up, "how", 0.0, ""))
    after = load_toml(path)
    np.testing.assert_allclose(up_vector(str(after.pop("up"))), up_vector(up))
    before.pop("up", None)
    assert after == before


def test_broken_capture_toml_is_not_changed(tmp_path: Path) -> None:
    (tmp_path / "capture.toml").write_text("up = \n")
    with pytest.raises(CaptureError, match=r"capture.toml: invalid TOML"):
        write_up(tmp_path, Leveling("z", "how", 0.0, ""))
    assert (tmp_path / "capture.toml").read_text() == "up = \n"


UPRIGHT = infer_up(RIG)
UNSURE = FoundUp("z", "mounted differently", sure=False)
LYING = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def test_person_who_lies_changes_no_up_direction() -> None:
    hulls = [hull @ LYING.T for hull in standing()]
    found = find_up(UPRIGHT, "z", hulls)
    assert (found.up, found.decided) == ("z", True) and "who may lie or sit, differs by 9" in found.how
    for cameras, given in ((UNSURE, "z"), (UPRIGHT, "x"), (UPRIGHT, "y"), (UPRIGHT, "[0.6, 0.8, 0.0]")):
        found = find_up(cameras, given, hulls)
        assert (found.up, found.decided) == (given, False) and found.how.startswith("it cannot be decided: ")


def test_two_people_are_no_vertical() -> None:
    pairs = [np.concatenate([hull, hull + np.array([2.5, 0.0, 0.0])]) for hull in standing()]
    for one_person, wide in ((False, standing()), (True, pairs)):
        found = find_up(UNSURE, "z", wide, one_person)
        assert (found.up, found.person, found.decided) == ("z", "", False)
        assert find_up(UPRIGHT, "z", wide, one_person).decided


def test_rolled_cameras_alone_do_not_overrule_up() -> None:
    rolled = FoundUp("[0.0, -0.6, 0.8]", "the mean", level=False)
    assert not find_up(rolled, "z", []).decided
    assert find_up(replace(rolled, level=True), "z", []).up == "[0.0, -0.6, 0.8]"


def test_level_writes_nothing_that_is_not_decided(tk: Tk, copy: Path) -> None:
    """The cameras hang on their side, and up is wrong: the person does not stand along it."""
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    rig = open_capture(copy).rig
    turned = [replace(c, rotation=quarter @ c.rotation, translation=quarter @ c.translation) for c in rig]
    with pytest.raises(CaptureError, match=r"up = y stays: it cannot be decided: .*; write the right one yourself"):
        write_up(copy, find_up(infer_up(Rig(tuple(turned))), "y", standing()))
    assert 'up = "z"' in (copy / "capture.toml").read_text()
