"""Perspective projection with lens distortion and its derivative, as a Taichi function: OpenCV's models, and skew.

A camera is a row of 27 numbers: the 3×4 transform from world to camera (metres), fx, fy, cx, cy (pixels), five
distortion coefficients, the model (0 Brown's with these five, 1 fisheye, 2 rational), skew (pixels), the rational
model's k4, k5, k6, and :attr:`tk.model.cameras.camera.Camera.fold`.

Far outside the image a distortion's polynomial folds back into it. Beyond the fold the image goes on at a constant
scale instead, so that a point there stays outside the image.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.kernels.kinematics import rotation_of, translation_of
from tk.kernels.runtime import ti
from tk.kernels.vectors import product, times, transposed_times

CAMERA_NUMBERS = 27


def pack_cameras(cameras: Iterable[Any]) -> NDArray[np.float64]:
    """Pack cameras (:class:`tk.model.cameras.camera.Camera`) into one array (C, 27)."""
    rows = []
    for c in cameras:
        row = np.zeros(CAMERA_NUMBERS)
        row[:12] = np.column_stack([c.rotation, c.translation]).ravel()
        row[12:16] = c.matrix[0, 0], c.matrix[1, 1], c.matrix[0, 2], c.matrix[1, 2]
        row[16 : 16 + len(c.distortions[:5])] = c.distortions[:5]
        row[21] = 1.0 if c.fisheye else 2.0 if len(c.distortions) == 8 else 0.0
        row[22] = c.matrix[0, 1]
        if len(c.distortions) == 8:
            row[23:26] = c.distortions[5:]
        row[26] = c.fold
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
    if camera[v, 21] != 1.0:
        s = ti.min(r2, camera[v, 26])
        radial = 1.0 + s * (k[0] + s * (k[1] + s * k[4]))
        slope = 2.0 * (k[0] + s * (2.0 * k[1] + 3.0 * s * k[4]))
        if camera[v, 21] == 2.0:
            k4, k5, k6 = camera[v, 23], camera[v, 24], camera[v, 25]
            below = 1.0 / (1.0 + s * (k4 + s * (k5 + s * k6)))
            radial = radial * below
            slope = (slope - 2.0 * radial * (k4 + s * (2.0 * k5 + 3.0 * s * k6))) * below
        if r2 > s:
            slope *= 0.0
        xd = a * radial + 2.0 * k[2] * a * b + k[3] * (r2 + 2.0 * a * a)
        yd = b * radial + k[2] * (r2 + 2.0 * b * b) + 2.0 * k[3] * a * b
        D00 = radial + a * a * slope + 2.0 * k[2] * b + 6.0 * k[3] * a
        D01 = a * b * slope + 2.0 * k[2] * a + 2.0 * k[3] * b
        D11 = radial + b * b * slope + 6.0 * k[2] * b + 2.0 * k[3] * a
    elif r2 > 1e-12:
        r = ti.sqrt(r2)
        angle = ti.atan2(r, 1.0 + 0.0 * r)
        q = ti.min(angle * angle, camera[v, 26])
        bent = ti.sqrt(q) * (1.0 + q * (k[0] + q * (k[1] + q * (k[2] + q * k[3]))))
        rate = 1.0 + q * (3.0 * k[0] + q * (5.0 * k[1] + q * (7.0 * k[2] + 9.0 * q * k[3])))
        if angle * angle > q:
            bent += angle - ti.sqrt(q)
            rate = 1.0 + 0.0 * rate
        scale = bent / r
        slope = (rate / (1.0 + r2) - scale) / r2
        xd, yd = a * scale, b * scale
        D00, D01, D11 = scale + a * a * slope, a * b * slope, scale + b * b * slope
    fx, fy, skew = camera[v, 12], camera[v, 13], camera[v, 22]
    pixel = ti.Vector([fx * xd + skew * yd + camera[v, 14], fy * yd + camera[v, 15]])
    X0, X1 = fx * D00 + skew * D01, fx * D01 + skew * D11
    J = ti.Matrix(
        [
            [X0 * inverse, X1 * inverse, -(X0 * a + X1 * b) * inverse],
            [fy * D01 * inverse, fy * D11 * inverse, -fy * (D01 * a + D11 * b) * inverse],
        ]
    )
    return pixel, product(J, R), z
