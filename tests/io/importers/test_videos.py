from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tk.io.importers.videos import CameraNames, in_order_of_names, match_clips, natural


def named(*names: str) -> list[CameraNames]:
    return [CameraNames(name, name) for name in names]


@pytest.mark.parametrize(
    ("cameras", "stems"),
    [
        (["cam1", "cam2"], ["cam1", "cam2"]),
        (["cam_01", "cam_02"], ["cam01", "cam02"]),
        (["cam1", "cam2", "cam10"], ["walk_cam1", "walk_cam2", "walk_cam10"]),
        (["int_cam01_img", "int_cam02_img"], ["cam01", "cam02"]),
        (["0", "1", "2"], ["port_0", "port_1", "port_2"]),
        (["cam_0", "cam_1"], ["Camera_000_synchronized", "Camera_001_synchronized"]),
        (["00_00", "00_11", "00_01"], ["hd_00_00", "hd_00_11", "hd_00_01"]),
        (["21234", "21235"], ["Walk 03_Miqus_1_21234", "Walk 03_Miqus_2_21235"]),
        (["A", "B", "C"], ["trial1-camA", "trial1-camB", "trial1-camC"]),
        (["8", "9", "10"], ["view08", "view09", "view10"]),
        (["left", "right"], ["subject left", "subject right"]),
    ],
)
def test_names_are_matched(cameras: list[str], stems: list[str]) -> None:
    assert match_clips(named(*cameras), stems[::-1]) == stems


@pytest.mark.parametrize(
    ("cameras", "stems"),
    [
        (["cam1", "cam2", "cam3"], ["0", "1", "2"]),  # shifted by one? nobody knows
        (["0", "1", "2", "3"], ["port_1", "port_2", "port_3", "port_4"]),
        (["cam1", "cam2"], ["walk_cam1", "walk_cam2", "run_cam1", "run_cam2"]),
        (["a", "b"], ["front", "back"]),
        (["cam1", "cam2", "cam3", "cam4"], ["cam0", "cam1", "cam2", "cam3"]),  # shifted by one, perhaps
        (["cam1", "cam2"], ["cam1"]),
        (["cam1", "cam2"], []),
    ],
)
def test_ambiguous_names_are_not_matched(cameras: list[str], stems: list[str]) -> None:
    assert match_clips(named(*cameras), stems) is None


def test_missing_video_leaves_its_camera_unmatched() -> None:
    found = match_clips(named("cam1", "cam2", "cam3", "cam4"), ["x_cam4", "x_cam2", "x_cam1"])
    assert found == ["x_cam1", "x_cam2", None, "x_cam4"]


def test_in_order_sorts_numbers_by_value() -> None:
    found = in_order_of_names(named("north", "east", "west"), ["clip 10", "clip 2", "clip 1"])
    assert found == ["clip 2", "clip 1", "clip 10"]  # east, north, west
    assert sorted(["cam10", "cam2", "cam"], key=natural) == ["cam", "cam2", "cam10"]


names = st.lists(st.text("abcz019_-", min_size=1, max_size=6), min_size=2, max_size=6, unique=True)


@given(cameras=names, stems=names)
def test_no_video_belongs_to_two_cameras(cameras: list[str], stems: list[str]) -> None:
    found = match_clips(named(*cameras), stems)
    if found is not None:
        taken = [stem for stem in found if stem is not None]
        assert len(found) == len(cameras) and len(taken) == len(set(taken)) >= 2
        assert set(taken) <= set(stems)


@given(cameras=names)
def test_equal_names_always_match(cameras: list[str]) -> None:
    bare = {"".join(c for c in name if c.isalnum()) for name in cameras}
    if len(bare) == len(cameras):
        assert match_clips(named(*cameras), cameras[::-1]) == cameras
