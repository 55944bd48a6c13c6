"""Perspective projection with lens distortion and its derivative, as a Taichi function: OpenCV's two models.

A camera is a row of 22 numbers: the 3×4 transform from world to camera (metres), fx, fy, cx, cy (pixels), five
distortion coefficients, and 1 for the fisheye model or 0. Like OpenCV, skew is ignored.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.kernels.kinematics import rotation_of, translation_of
from tk.kernels.runtime import ti
from tk.kernels.vectors import product, times, transposed_times

CAMERA_NUMBERS = 22


def pack_cameras(cameras: Iterable[Any]) -> NDArray[np.float64]:
    """Pack cameras (:class:`tk.model.cameras.camera.Camera`) into one array (C, 22)."""
    rows = []
    for c in cameras:
        row = np.zeros(CAMERA_NUMBERS)
        row[:12] = np.column_stack([c.rotation, c.translation]).ravel()
        row[12:16] = c.matrix[0, 0], c.matrix[1, 1], c.matrix[0, 2], c.matrix[1, 2]
        row[16 : 16 + len(c.distortions)] = c.distortions
        row[21] = float(c.fisheye)
        rows.append(row)
    return np.array(rows)


@ti.func
def camera_center(camera: ti.template(), v: int):
    """Return the centre of projection (3,) of camera v, world frame."""
    return -transposed_times(rotation_of(camera, v, 0), translation_of(camera, v, 0))


@ti.func
def project(camera: ti.template(), v: int, x):
    """Return pixel (2,), its derivative (2, 3) by the world point, and depth. Behind the camera only depth is valid."""
    R = rotation_of(camera, v, 0)
    p = times(R, x) + translation_of(camera, v, 0)
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
