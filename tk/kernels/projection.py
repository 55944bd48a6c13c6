"""Perspective projection with lens distortion and its derivative, as a Taichi function: OpenCV's two models.

A camera is a row of 22 numbers: rotation (9, row by row, world to camera), translation (3, metres), fx, fy, cx, cy
(pixels), five distortion coefficients, and 1 for the fisheye model or 0. Like OpenCV, skew is ignored.
"""

import numpy as np
from numpy.typing import NDArray

from tk.kernels.runtime import ti
from tk.kernels.vectors import product, times, transposed_times

CAMERA_NUMBERS = 22


def pack_camera(
    matrix: NDArray[np.float64],
    distortions: NDArray[np.float64],
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    fisheye: bool,
) -> NDArray[np.float64]:
    """Pack a camera into a row (22,).

    Args:
        matrix: (3, 3) intrinsic matrix, pixels.
        distortions: (4,) or (5,) k1 k2 p1 p2 [k3]; (4,) k1…k4 when ``fisheye``.
        rotation: (3, 3) from world to camera.
        translation: (3,) metres.
        fisheye: OpenCV's equidistant model.
    """
    row = np.zeros(CAMERA_NUMBERS)
    row[:9] = rotation.ravel()
    row[9:12] = translation
    row[12:16] = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    row[16 : 16 + len(distortions)] = distortions
    row[21] = float(fisheye)
    return row


@ti.func
def camera_center(camera: ti.template(), v: int):
    """Return the centre of projection (3,) of camera v, world frame."""
    R = ti.Matrix([[camera[v, 3 * i + j] for j in ti.static(range(3))] for i in ti.static(range(3))])
    t = ti.Vector([camera[v, 9 + i] for i in ti.static(range(3))])
    return -transposed_times(R, t)


@ti.func
def project(camera: ti.template(), v: int, x):
    """Return pixel (2,), its derivative (2, 3) by the world point, and depth. Behind the camera only depth is valid."""
    R = ti.Matrix([[camera[v, 3 * i + j] for j in ti.static(range(3))] for i in ti.static(range(3))])
    t = ti.Vector([camera[v, 9 + i] for i in ti.static(range(3))])
    p = times(R, x) + t
    z = p[2]
    inverse = 1.0 / z
    a, b = p[0] * inverse, p[1] * inverse
    r2 = a * a + b * b
    k = ti.Vector([camera[v, 16 + i] for i in ti.static(range(5))])
    # the distorted point and the symmetric derivative ((D00, D01), (D01, D11)) of the distortion
    xd, yd = a, b
    D00, D01, D11 = 1.0 + 0.0 * a, 0.0 * a, 1.0 + 0.0 * a
    if camera[v, 21] == 0.0:
        radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
        slope = 2.0 * (k[0] + r2 * (2.0 * k[1] + 3.0 * r2 * k[4]))
        xd = a * radial + 2.0 * k[2] * a * b + k[3] * (r2 + 2.0 * a * a)
        yd = b * radial + k[2] * (r2 + 2.0 * b * b) + 2.0 * k[3] * a * b
        D00 = radial + a * a * slope + 2.0 * k[2] * b + 6.0 * k[3] * a
        D01 = a * b * slope + 2.0 * k[2] * a + 2.0 * k[3] * b
        D11 = radial + b * b * slope + 6.0 * k[2] * b + 2.0 * k[3] * a
    elif r2 > 1e-12:
        r = ti.sqrt(r2)
        angle = ti.atan2(r, 1.0 + 0.0 * r)
        q = angle * angle
        bent = angle * (1.0 + q * (k[0] + q * (k[1] + q * (k[2] + q * k[3]))))
        rate = 1.0 + q * (3.0 * k[0] + q * (5.0 * k[1] + q * (7.0 * k[2] + 9.0 * q * k[3])))
        scale = bent / r
        slope = (rate / (1.0 + r2) - scale) / r2
        xd, yd = a * scale, b * scale
        D00, D01, D11 = scale + a * a * slope, a * b * slope, scale + b * b * slope
    fx, fy = camera[v, 12], camera[v, 13]
    pixel = ti.Vector([fx * xd + camera[v, 14], fy * yd + camera[v, 15]])
    J = ti.Matrix(
        [
            [fx * D00 * inverse, fx * D01 * inverse, -fx * (D00 * a + D01 * b) * inverse],
            [fy * D01 * inverse, fy * D11 * inverse, -fy * (D01 * a + D11 * b) * inverse],
        ]
    )
    return pixel, product(J, R), z
