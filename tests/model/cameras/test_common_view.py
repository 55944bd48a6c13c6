from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.io.conftest import look_at
from tk.errors import VolumeError
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.common_view import (
    closest_to_axes,
    determine_depth,
    infer_volume,
    sample_box,
    views_of,
)
from tk.model.cameras.volume import Volume

TARGET = np.array([0.4, -0.3, 1.1])


def ring(count: int, radius_m: float = 3.0, height_m: float = 0.6, focal_px: float = 60.0) -> Rig:
    """Cameras of 64×48 pixels around :data:`TARGET`, pointing at it."""
    cameras = []
    for angle in 2 * np.pi * np.arange(count) / count:
        center = TARGET + np.array([radius_m * np.cos(angle), radius_m * np.sin(angle), height_m])
        rotation, translation = look_at(center, TARGET)
        matrix = np.array([[focal_px, 0.0, 31.5], [0.0, focal_px, 23.5], [0.0, 0.0, 1.0]])
        cameras.append(Camera(f"c{angle:.2f}", 64, 48, matrix, np.zeros(5), rotation, translation))
    return Rig(tuple(cameras))


@pytest.mark.parametrize("count", [2, 3, 7])
def test_axes_meet_at_the_target(count: int) -> None:
    np.testing.assert_allclose(closest_to_axes(ring(count)), TARGET, atol=1e-9)


@pytest.mark.parametrize("angle_deg", [10, 24, 26, 90, 154, 156, 175])
def test_two_cameras_at_25_to_155_degrees_determine_depth(angle_deg: float) -> None:
    centers = np.array([[np.cos(angle), np.sin(angle), 0.0] for angle in np.radians([0.0, angle_deg, 90.0])])
    points = np.zeros((2, 3))
    two, three = np.array([True, True, False]), np.ones(3, np.bool_)
    assert determine_depth(centers, points, np.stack([two, three])).tolist() == [25 < angle_deg < 155, True]
    assert not determine_depth(centers, np.full(3, np.nan), three)
    assert not determine_depth(centers, points[0], np.array([True, False, False]))


def test_inferred_volume_bounds_the_common_view() -> None:
    rig = ring(5)
    volume = infer_volume(rig)
    assert (volume.lower < TARGET).all() and (volume.upper > TARGET).all()
    # the points that all cameras see near the target are inside, up to the spacing of the samples
    around = sample_box(Volume(tuple(TARGET), (3.0, 3.0, 3.0)))
    common = around[(views_of(rig, around) == 5) & (np.linalg.norm(around - TARGET, axis=1) < 1.5)]
    spacing_m = 0.08
    assert len(common) > 100
    assert (common > volume.lower - spacing_m).all() and (common < volume.upper + spacing_m).all()
    # the box is tight: each face touches a point that all cameras see
    inside = sample_box(volume, 40)
    seen = inside[views_of(rig, inside) == 5]
    np.testing.assert_allclose(seen.min(axis=0), volume.lower, atol=spacing_m)
    np.testing.assert_allclose(seen.max(axis=0), volume.upper, atol=spacing_m)


def test_cameras_that_see_a_point_are_counted() -> None:
    rig = ring(4)
    assert views_of(rig, np.array([TARGET, TARGET + np.array([0, 0, 50]), rig.centers[0]])).tolist() == [4, 0, 1]


def test_rig_without_a_common_view_is_refused() -> None:
    rig = ring(2)
    twin = dataclasses.replace(rig[0], name="twin", translation=rig[0].translation + np.array([0.5, 0.0, 0.0]))
    with pytest.raises(VolumeError, match="parallel"):
        infer_volume(Rig((rig[0], twin)))
    # cameras turned round: the axes meet behind them
    turned = [
        dataclasses.replace(c, rotation=c.rotation * [[-1], [1], [-1]], translation=c.translation * [-1, 1, -1])
        for c in ring(3)
    ]
    with pytest.raises(VolumeError, match="no region"):
        infer_volume(Rig(tuple(turned)))
