"""Projection in Taichi against OpenCV, its derivative against finite differences."""

import functools

import numpy as np
import pytest

from tk.kernels.projection import pack_cameras, project
from tk.kernels.runtime import ensure_runtime, ti
from tk.model.cameras.camera import Camera

# double precision, hundreds of pixels
EXACT_PX = 1e-9
# central differences with a step of a micrometre, pixels per metre
DERIVATIVE = 1e-5


@functools.cache
def _project_kernel(real):
    @ti.kernel
    def kernel(
        camera: ti.types.ndarray(dtype=real, ndim=2),  # (V, 27)
        view: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
        world: ti.types.ndarray(dtype=real, ndim=2),  # (N, 3)
        pixels: ti.types.ndarray(dtype=real, ndim=2),  # (N, 2) out
        jacobian: ti.types.ndarray(dtype=real, ndim=3),  # (N, 2, 3) out
        depth: ti.types.ndarray(dtype=real, ndim=1),  # (N,) out
    ):
        for n in range(world.shape[0]):
            x = ti.Vector([world[n, i] for i in ti.static(range(3))])
            pixel, J, z = project(camera, view[n], x)
            depth[n] = z
            for i in ti.static(range(2)):
                pixels[n, i] = pixel[i]
                for j in ti.static(range(3)):
                    jacobian[n, i, j] = J[i, j]

    return kernel


def project_points(
    cameras: np.ndarray, view: np.ndarray, p_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points, each by a camera of its own.

    Args:
        cameras: (V, 27) rows of :func:`pack_cameras`.
        view: (N,) which camera.
        p_world: (N, 3) metres, float32 or float64: the precision of the computation.

    Returns:
        pixels (N, 2), their derivatives (N, 2, 3) by the world points, depth (N,) in metres.
    """
    ensure_runtime()
    dtype = p_world.dtype
    N = len(p_world)
    pixels, jacobian, depth = np.empty((N, 2), dtype), np.empty((N, 2, 3), dtype), np.empty(N, dtype)
    _project_kernel(ti.f64 if dtype == np.float64 else ti.f32)(
        np.ascontiguousarray(cameras, dtype),
        np.ascontiguousarray(view, np.int32),
        np.ascontiguousarray(p_world),
        pixels,
        jacobian,
        depth,
    )
    return pixels, jacobian, depth


def camera_of(fisheye: bool, distortions, skew: float = 0.0) -> Camera:
    angle = 0.4
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    matrix = np.array([[510.0, skew, 300], [0, 495.0, 210], [0, 0, 1]])
    return Camera("c", 640, 480, matrix, np.array(distortions), rotation, np.array([0.1, -0.2, 3.0]), fisheye)


@pytest.mark.parametrize(
    "camera",
    [
        camera_of(False, [0.0, 0, 0, 0]),
        camera_of(False, [-0.2, 0.05, 1e-3, -2e-3, 0.01]),
        camera_of(True, [0.02, -0.01, 3e-3, -1e-3]),
        camera_of(False, [0.5, -2.6, 6e-4, -4e-4, 1.5, 0.45, -2.45, 1.42]),
        camera_of(False, [-0.2, 0.05, 1e-3, -2e-3], skew=25.0),
        camera_of(True, [0.02, -0.01, 3e-3, -1e-3], skew=-9.0),
    ],
    ids=["pinhole", "brown", "fisheye", "rational", "skew", "fisheye and skew"],
)
def test_projection_is_opencvs(camera):
    p = np.random.default_rng(3).uniform(-0.9, 0.9, (80, 3))
    row = pack_cameras([camera])
    view = np.zeros(len(p), int)
    pixels, jacobian, depth = project_points(row, view, p)
    expected, expected_depth = camera.project(p)
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(pixels, expected, rtol=0, atol=EXACT_PX)
    np.testing.assert_allclose(depth, expected_depth, rtol=0, atol=1e-12)
    h = 1e-6
    numeric = [
        (project_points(row, view, p + h * e)[0] - project_points(row, view, p - h * e)[0]) / (2 * h) for e in np.eye(3)
    ]
    np.testing.assert_allclose(jacobian, np.stack(numeric, -1), rtol=0, atol=DERIVATIVE)


def test_single_precision_stays_within_a_thousandth_of_a_pixel():
    camera = camera_of(False, [-0.2, 0.05, 1e-3, -2e-3, 0.01])
    p = np.random.default_rng(4).uniform(-0.9, 0.9, (80, 3)).astype(np.float32)
    row = pack_cameras([camera])
    pixels, _, _ = project_points(row, np.zeros(len(p), int), p)
    assert pixels.dtype == np.float32
    np.testing.assert_allclose(pixels, camera.project(p)[0], rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "camera",
    [
        camera_of(False, [-0.3, 0, 0, 0]),
        camera_of(False, [-0.3, 0.01, 6e-4, -4e-4, 0, 0.02, 0.01, 0]),
        camera_of(True, [-0.2, 0.01, 0, 0]),
    ],
    ids=["brown", "rational", "fisheye"],
)
def test_what_is_beyond_the_fold_of_a_lens_stays_outside_the_image(camera):
    reach = np.sqrt(camera.fold)
    at = np.tan(reach) if camera.fisheye else reach
    radius = at * np.array([0.9, 0.999, 1.001, 1.1, 2.0, 5.0])
    p = np.column_stack([radius, 0.3 * radius, np.ones(6)]) / [np.hypot(1, 0.3), np.hypot(1, 0.3), 1]
    p = (p - camera.translation) @ camera.rotation
    row, view = pack_cameras([camera]), np.zeros(6, int)
    pixels, jacobian, _ = project_points(row, view, p)
    expected = camera.project(p)[0]
    np.testing.assert_allclose(pixels[:2], expected[:2], rtol=0, atol=EXACT_PX)
    assert np.isnan(expected[2:]).all()
    from_middle = np.linalg.norm(pixels - camera.matrix[:2, 2], axis=1)
    assert (np.diff(from_middle) > 0).all()
    h = 1e-6
    numeric = [
        (project_points(row, view, p + h * e)[0] - project_points(row, view, p - h * e)[0]) / (2 * h) for e in np.eye(3)
    ]
    np.testing.assert_allclose(jacobian, np.stack(numeric, -1), rtol=1e-6, atol=DERIVATIVE)
