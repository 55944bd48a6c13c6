"""Truncated superellipsoids as Taichi functions (Kehl 2006, sections 5.2 and 5.3).

G = F^(ε₁/2), with F Barr's inside-outside function, is homogeneous of degree one: it grows linearly along every ray
from the centre and is 1 on the surface, so one Newton step along its gradient lands close to the nearest surface point.
"""

from tk.kernels.runtime import ti


@ti.func
def power(base, exponent):
    """Return |base|^exponent, with |base| of at least 1e-6."""
    return ti.exp(exponent * ti.log(ti.max(ti.abs(base), 1e-6)))


@ti.func
def is_quadric(e1, e2):
    """Return whether the piece is an ellipsoid, which needs no powers; most pieces of a body are ellipsoids."""
    return e1 == 1.0 and e2 == 1.0


@ti.func
def inside_outside(q, radii, e1, e2):
    """Return F(q): below 1 inside, above 1 outside."""
    F = (q / radii).norm_sqr()
    if not is_quadric(e1, e2):
        xy = power(q[0] / radii[0], 2.0 / e2) + power(q[1] / radii[1], 2.0 / e2)
        F = power(xy, e2 / e1) + power(q[2] / radii[2], 2.0 / e1)
    return F


@ti.func
def implicit(q, radii, e1, e2):
    """Return G(q) and its gradient as one vector (G, ∂x, ∂y, ∂z)."""
    u = q / radii
    G = ti.sqrt(ti.max(u.norm_sqr(), 1e-12))
    result = ti.Vector([G, u[0] / (radii[0] * G), u[1] / (radii[1] * G), u[2] / (radii[2] * G)])
    if not is_quadric(e1, e2):
        result = _implicit(q, radii, e1, e2)
    return result


@ti.func
def _implicit(q, radii, e1, e2):
    ax = power(q[0] / radii[0], 2.0 / e2)
    ay = power(q[1] / radii[1], 2.0 / e2)
    xy = ti.max(ax + ay, 1e-12)
    ring = power(xy, e2 / e1)
    az = power(q[2] / radii[2], 2.0 / e1)
    F = ti.max(ring + az, 1e-12)
    G = power(F, 0.5 * e1)
    # ∂G/∂x = (e1/2) F^(e1/2 - 1) · (e2/e1) xy^(e2/e1 - 1) · (2/e2) |x|^(2/e2 - 1) / a^(2/e2)
    scale = G / F
    flat = ring / xy
    gx = scale * flat * ax / _away_from_zero(q[0])
    gy = scale * flat * ay / _away_from_zero(q[1])
    gz = scale * az / _away_from_zero(q[2])
    return ti.Vector([G, gx, gy, gz])


@ti.func
def _away_from_zero(x):
    return ti.select(x < 0, ti.min(x, -1e-6), ti.max(x, 1e-6))


@ti.func
def project(q, radii, e1, e2, z_lower, z_upper):
    """Return the surface point nearest to q, to first order.

    A point beyond a cutting plane is first moved onto the plane: a truncated piece attracts to its rim.
    """
    c = ti.Vector([q[0], q[1], ti.min(ti.max(q[2], z_lower), z_upper)])
    g = implicit(c, radii, e1, e2)
    gradient = ti.Vector([g[1], g[2], g[3]])
    square = ti.max(gradient.norm_sqr(), 1e-9)
    # A point far outside takes the whole step; without a step it would count as lying on the surface. From inside, by
    # homogeneity, no step is longer than √3 of the largest radius. Within about 0.1 mm of the centre powers and norms
    # are at their floors, and the step may have any length: there none is taken.
    step = (g[0] - 1.0) / square
    s = c - step * gradient
    limit = 2.0 * ti.max(radii[0], ti.max(radii[1], radii[2]))
    if g[0] < 1.0 and (s - c).norm_sqr() > limit * limit:
        s = c
    return s
