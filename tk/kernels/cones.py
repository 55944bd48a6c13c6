"""Frusta of elliptical cones and ellipsoids under perspective: occluding contours and viewing rays in closed form.

In a part's own frame ``shape`` is (a, b, h, m): a cone's cross-section at height z = u h, 0 ≤ u ≤ 1, has the semi-axes
a r and b r with r = 1 + (m - 1) u. An ellipsoid has the semi-axes a, b, h about its origin.

Seen from c, the occluding contour of a cone is two straight generators, those at the angles φ with
(cₓ/a) cos φ + (c_y/b) sin φ = 1 + (m - 1) c_z / h, and an arc of each rim, between the generators, on the side where
only one of cap and mantle faces c. With the axes of an ellipsoid scaled to 1 its contour is a circle about c. (The
silhouette paper, section 4.1, is silent about how it computes contours.)

A curve is one of these pieces; u in [0, 1] runs along it.
"""

from tk.kernels.runtime import ti
from tk.kernels.vectors import cross, norm_sqr

CONE, ELLIPSOID = range(2)
# kinds of curves: the two generators, the rims at z = 0 and z = h, the outline of an ellipsoid
SIDE_A, SIDE_B, END_NEAR, END_FAR, OUTLINE = range(5)


@ti.func
def curve_of(kind: int, shape, c):
    """Return (visible, (q0, q1)) of a curve seen from c, in the part's frame, for :func:`point_on`.

    Generators: q0 is the angle. Rims: start angle and span. Outlines: unused.
    """
    q = ti.Vector([0.0 * shape[0], 0.0 * shape[0]])
    visible = 1
    if kind == OUTLINE:
        s = ti.Vector([c[0] / shape[0], c[1] / shape[1], c[2] / shape[2]])
        if norm_sqr(s) <= 1.0:
            visible = 0
    else:
        x, y = c[0] / shape[0], c[1] / shape[1]
        w = 1.0 + (shape[3] - 1.0) * c[2] / shape[2]
        rho = ti.sqrt(x * x + y * y)
        middle = ti.atan2(y, x)
        # the mantle faces c where |φ - middle| < half
        half = 0.0 * rho
        if w <= -rho:
            half = 3.14159265358979 + 0.0 * rho
        elif w < rho:
            half = ti.acos(w / rho)
        whole = ti.abs(w) >= rho
        if kind <= SIDE_B:
            q[0] = middle + half
            if kind == SIDE_B:
                q[0] = middle - half
            if whole:
                visible = 0
        else:
            faces = c[2] < 0.0
            if kind == END_FAR:
                faces = c[2] > shape[2]
            # the cap faces c: the arc where the mantle does not; else the arc where it does
            q[0], q[1] = middle - half, 2.0 * half
            if faces:
                q[0], q[1] = middle + half, 2.0 * (3.14159265358979 - half)
            if q[1] < 1e-6:
                visible = 0
    return visible, q


@ti.func
def point_on(kind: int, shape, c, q, u):
    """Return point and tangent (d/du) of a curve at u, in the part's frame."""
    x = c * 0.0
    tangent = c * 0.0
    if kind == OUTLINE:
        radii = ti.Vector([shape[0], shape[1], shape[2]])
        s = c / radii
        k = ti.sqrt(norm_sqr(s))
        e3 = s / k
        # a direction across e3: from the coordinate axis that is farthest from it
        axis = c * 0.0
        if ti.abs(e3[2]) < 0.7:
            axis[2] += 1.0
        else:
            axis[0] += 1.0
        e1 = cross(axis, e3)
        e1 /= ti.sqrt(norm_sqr(e1))
        e2 = cross(e3, e1)
        r = ti.sqrt(ti.max(1.0 - 1.0 / (k * k), 0.0))
        angle = 6.28318530717959 * u
        x = radii * (e3 / k + r * (ti.cos(angle) * e1 + ti.sin(angle) * e2))
        tangent = 6.28318530717959 * r * radii * (ti.cos(angle) * e2 - ti.sin(angle) * e1)
    elif kind <= SIDE_B:
        r = 1.0 + (shape[3] - 1.0) * u
        X, Y = shape[0] * ti.cos(q[0]), shape[1] * ti.sin(q[0])
        x = ti.Vector([X * r, Y * r, shape[2] * u])
        tangent = ti.Vector([X * (shape[3] - 1.0), Y * (shape[3] - 1.0), shape[2]])
    else:
        r = 1.0 + 0.0 * u
        z = 0.0 * u
        if kind == END_FAR:
            r = shape[3] + 0.0 * u
            z = shape[2] + 0.0 * u
        angle = q[0] + u * q[1]
        X, Y = shape[0] * r, shape[1] * r
        x = ti.Vector([X * ti.cos(angle), Y * ti.sin(angle), z])
        tangent = q[1] * ti.Vector([-X * ti.sin(angle), Y * ti.cos(angle), 0.0 * u])
    return x, tangent


@ti.func
def unscaled(kind: int, shape, x):
    """Return a surface point in coordinates that do not depend on the shape: (x / a r, y / b r, z / h)."""
    r = 1.0 + 0.0 * shape[0]
    if kind != OUTLINE:
        r = 1.0 + (shape[3] - 1.0) * x[2] / shape[2]
    return ti.Vector([x[0] / (shape[0] * r), x[1] / (shape[1] * r), x[2] / shape[2]])


@ti.func
def interior_point(part_kind: int, shape):
    """Return a point well inside a part."""
    z = 0.0 * shape[2]
    if part_kind == CONE:
        z = 0.5 * shape[2]
    return ti.Vector([0.0 * z, 0.0 * z, z])


@ti.func
def enclosing_radius(part_kind: int, shape):
    """Return the radius of a sphere about :func:`interior_point` that encloses the part."""
    wide = ti.max(shape[0], shape[1])
    result = ti.max(wide, shape[2])
    if part_kind == CONE:
        wide *= ti.max(shape[3], 1.0)
        result = ti.sqrt(wide * wide + 0.25 * shape[2] * shape[2])
    return result


@ti.func
def enter(part_kind: int, shape, c, d, shrink):
    """Return t > 0 where the ray c + t d enters a part; -1 if it misses. ``shrink``, at most 1, scales the
    cross-section."""
    result = -1.0 + 0.0 * d[0]
    _, _, radius = capsule(part_kind, shape)
    # most rays near a part pass its axis at more than its radius
    apart = c[0] * d[1] - c[1] * d[0]
    if apart * apart <= radius * radius * (d[0] * d[0] + d[1] * d[1]):
        size = extent(part_kind, shape, shrink)
        result = enter_unit(part_kind, shape[3], c / size, d / size)
    return result


@ti.func
def capsule(part_kind: int, shape):
    """Return (z0, z1, radius) of a capsule along the axis that encloses the part."""
    radius = ti.max(shape[0], shape[1])
    z0, z1 = 0.0 * radius, shape[2]
    if part_kind == CONE:
        radius *= ti.max(shape[3], 1.0)
    else:
        z1 = ti.max(shape[2] - radius, 0.0)
        z0 = -z1
    return z0, z1, radius


@ti.func
def extent(part_kind: int, shape, shrink):
    """Return the divisors (3,) that turn a part's coordinates into the unit coordinates of :func:`enter_unit`."""
    length = shape[2]
    if part_kind == ELLIPSOID:
        length *= shrink
    return ti.Vector([shape[0] * shrink, shape[1] * shrink, length])


@ti.func
def enter_unit(part_kind: int, m, c, d):
    """Return :func:`enter` of the unit ball, or of the frustum of radius 1 at z = 0 and m at z = 1."""
    # A t² + 2 B t + C < 0 inside, for lower < t < upper
    A, B, C = d[0] * d[0] + d[1] * d[1], c[0] * d[0] + c[1] * d[1], c[0] * c[0] + c[1] * c[1]
    lower, upper = 0.0 * A, 1e9 + 0.0 * A
    result = -1.0 + 0.0 * A
    if part_kind == ELLIPSOID:
        A += d[2] * d[2]
        B += c[2] * d[2]
        C += c[2] * c[2] - 1.0
    else:
        g = m - 1.0
        r0, slope = 1.0 + g * c[2], g * d[2]
        A -= slope * slope
        B -= slope * r0
        C -= r0 * r0
        if ti.abs(d[2]) > 1e-12:
            t0, t1 = -c[2] / d[2], (1.0 - c[2]) / d[2]
            lower = ti.max(lower, ti.min(t0, t1))
            upper = ti.min(upper, ti.max(t0, t1))
        elif c[2] < 0.0 or c[2] > 1.0:
            upper = -1.0 + 0.0 * A
    if lower < upper:
        square = B * B - A * C
        if A > 0.0:
            if square > 0.0:
                root = ti.sqrt(square)
                first = ti.max(lower, (-B - root) / A)
                if first < ti.min(upper, (-B + root) / A):
                    result = first
        elif square <= 0.0:
            result = lower
        else:
            # the ray crosses both nappes: inside before the smaller and after the greater root
            root = ti.sqrt(square)
            small, great = (-B + root) / ti.min(A, -1e-30), (-B - root) / ti.min(A, -1e-30)
            if lower < small:
                result = lower
            elif ti.max(lower, great) < upper:
                result = ti.max(lower, great)
    return result
