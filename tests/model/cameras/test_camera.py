from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tk.model.cameras.camera import Camera, Rig

MATRIX = np.array([[600.0, 0.0, 321.5], [0.0, 590.0, 238.0], [0.0, 0.0, 1.0]])

#: pixels; undistortion iterates to 1e-12 in normalised coordinates, at a focal length of 600
ROUND_TRIP_PX = 1e-6


def camera(
    distortions: tuple[float, ...] = (0.0,) * 5,
    rotation: tuple[float, float, float] = (1.6, 0.3, -0.2),
    translation: tuple[float, float, float] = (0.1, 0.9, 3.5),
    fisheye: bool = False,
    skew: float = 0.0,
) -> Camera:
    return Camera(
        name="cam",
        width=640,
        height=480,
        matrix=MATRIX + skew * np.eye(3, k=1) * [0, 1, 0],
        distortions=np.array(distortions),
        rotation=cv2.Rodrigues(np.array(rotation))[0],
        translation=np.array(translation),
        fisheye=fisheye,
    )


LENSES = {
    "none": camera(),
    "barrel": camera((-0.3, 0.1, 0.001, -0.002, 0.0)),
    "pincushion": camera((0.08, 0.02, -0.001, 0.001)),
    "third order": camera((-0.2, 0.05, 0.0, 0.0, -0.02)),
    "fisheye": camera((0.05, -0.01, 0.002, -0.001), fisheye=True),
    # of an Azure Kinect: two polynomials that nearly cancel
    "rational": camera((0.5, -2.6, 0.0006, -0.0004, 1.5, 0.45, -2.45, 1.42)),
    "skew": camera((-0.3, 0.1, 0.001, -0.002, 0.0), skew=30.0),
    "fisheye, skew": camera((0.05, -0.01, 0.002, -0.001), fisheye=True, skew=-12.0),
}

pixels = st.tuples(st.floats(0, 639), st.floats(0, 479))
angles = st.floats(-3, 3)
metres = st.floats(-5, 5)


def by_hand(cam: Camera, p_world: np.ndarray) -> np.ndarray:
    """Project a point by OpenCV's published lens models, step by step: the oracle of `project`."""
    x, y, z = cam.rotation @ p_world + cam.translation
    a, b = x / z, y / z
    if cam.fisheye:
        r = np.hypot(a, b)
        theta = np.arctan(r)
        k = cam.distortions
        bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        scale = bent / r if r > 1e-9 else 1.0
        a, b = a * scale, b * scale
    else:
        k1, k2, p1, p2, *rest = cam.distortions
        k3, k4, k5, k6 = (*rest, 0.0, 0.0, 0.0, 0.0)[:4]
        r2 = a * a + b * b
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        a, b = (
            a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
            b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b,
        )
    return np.array([MATRIX[0, 0] * a + cam.matrix[0, 1] * b + MATRIX[0, 2], MATRIX[1, 1] * b + MATRIX[1, 2]])


@pytest.mark.parametrize("lens", LENSES)
def test_projection_equals_the_published_model(lens: str) -> None:
    cam = LENSES[lens]
    rng = np.random.default_rng(1)
    p_camera = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)]) * rng.uniform(1, 6, (50, 1))
    p_world = (p_camera - cam.translation) @ cam.rotation
    found, depth = cam.project(p_world)
    np.testing.assert_allclose(found, [by_hand(cam, p) for p in p_world], atol=1e-9)
    np.testing.assert_allclose(depth, p_camera[:, 2], rtol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
@given(pixel=pixels, distance_m=st.floats(0.3, 20))
def test_point_on_the_ray_of_a_pixel_projects_to_the_pixel(
    lens: str, pixel: tuple[float, float], distance_m: float
) -> None:
    cam = LENSES[lens]
    (ray,) = cam.rays([pixel])
    assert np.linalg.norm(ray) == pytest.approx(1)
    found, depth = cam.project([cam.center + distance_m * ray])
    np.testing.assert_allclose(found[0], pixel, atol=ROUND_TRIP_PX)
    assert 0 < depth[0] <= distance_m * (1 + 1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_points_behind_the_camera_are_not_visible(lens: str) -> None:
    cam = LENSES[lens]
    ahead = cam.center + cam.rotation[2]
    behind = cam.center - cam.rotation[2]
    found, depth = cam.project([behind, cam.center, ahead])
    assert np.isnan(found[:2]).all() and np.isfinite(found[2]).all()
    assert depth[0] == pytest.approx(-1)
    assert cam.sees([behind, cam.center, ahead]).tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("cam", "fold"),
    [
        # r (1 - 0.3 r²) turns back at r = 1.054 = tan 46.5°
        (camera((-0.3, 0.0, 0.0, 0.0)), np.arctan(np.sqrt(1 / 0.9))),
        # θ (1 - 0.3 θ²) turns back at θ = 1.054
        (camera((-0.3, 0.0, 0.0, 0.0), fisheye=True), np.sqrt(1 / 0.9)),
        # r / (1 + r²) turns back at r = 1 = tan 45°
        (camera((0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0)), np.pi / 4),
        # r / (1 - r²) has a pole at r = 1
        (camera((0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0)), np.pi / 4),
    ],
)
def test_points_beyond_the_fold_of_the_distortion_are_not_visible(cam: Camera, fold: float) -> None:
    """Beyond the fold a point far outside the field of view would project into the image."""
    angle = np.array([0.2, 0.95 * fold, 1.02 * fold, 1.2 * fold])
    p_camera = np.column_stack([np.sin(angle), np.zeros(4), np.cos(angle)])
    found, _ = cam.project((p_camera - cam.translation) @ cam.rotation)
    assert np.isfinite(found[:, 0]).tolist() == [True, True, False, False]


def test_sees_rounds_to_pixels() -> None:
    cam = camera()
    edges = np.array([[-0.49, 0.0], [-0.51, 0.0], [639.49, 479.49], [639.51, 0.0], [0.0, 479.51]])
    p_world = cam.center + 3 * cam.rays(edges)
    assert cam.sees(p_world).tolist() == [True, False, True, False, False]


def test_empty_arrays_pass_through() -> None:
    for cam in LENSES.values():
        found, depth = cam.project(np.zeros((0, 3)))
        assert found.shape == (0, 2) and depth.shape == (0,)
        assert cam.sees(np.zeros((0, 3))).shape == (0,)
        assert cam.rays(np.zeros((0, 2))).shape == (0, 3)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("factor", [2, 3])
def test_a_point_is_in_the_same_place_of_the_reduced_image(lens: Camera, factor: int) -> None:
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 3))
    whole, small = lens.project(points)[0], lens.reduced(factor).project(points)[0]
    # pixel 0 of the reduced image is the mean of pixels 0 … factor - 1, whose middle is (factor - 1) / 2
    np.testing.assert_allclose(small, (whole - (factor - 1) / 2) / factor, atol=1e-9)


def test_a_reduced_camera_remembers_the_recorded_image() -> None:
    odd = replace(LENSES["barrel"], width=643, height=481)
    small = odd.reduced(2)
    assert (small.width, small.height, small.reduction) == (321, 240, 2)
    whole = replace(small, translation=small.translation + 1).recorded()
    assert (whole.width, whole.height, whole.reduction) == (643, 481, 1)
    np.testing.assert_allclose(whole.matrix, odd.matrix, rtol=1e-15)
    np.testing.assert_array_equal(whole.translation, odd.translation + 1)
    assert odd.reduced(1) is odd and odd.recorded() is odd


def test_landmarks_in_pixels_of_the_recorded_images_and_back() -> None:
    rig = Rig((LENSES["barrel"].reduced(2), LENSES["barrel"], LENSES["barrel"].reduced(3)))
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (7, 3))
    seen = np.array([np.column_stack([camera.project(points)[0], np.full(7, 0.8)]) for camera in rig])
    seen[1, 2] = np.nan
    frames = np.stack([seen, seen + 1.0])
    recorded = rig.recorded_pixels(frames)
    for camera, own, known in zip(rig.recorded(), recorded[0], np.isfinite(seen[..., 0]), strict=True):
        np.testing.assert_allclose(own[known, :2], camera.project(points)[0][known], atol=1e-9)
    np.testing.assert_allclose(rig.reduced_pixels(recorded), frames, atol=1e-9)
    np.testing.assert_array_equal(recorded[..., 2], frames[..., 2])
