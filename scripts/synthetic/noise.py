# No `from __future__ import annotations` here: Taichi reads the annotations of kernels.
"""Value noise for textures, as Taichi functions."""

from tk.kernels.runtime import ti


@ti.func
def hash3(x: ti.i32, y: ti.i32, z: ti.i32) -> ti.f32:
    """A number in [0, 1) that depends on a lattice point only (integer mixing, same on every machine)."""
    h = ti.cast(x, ti.u32) * ti.u32(0x8DA6B343) + ti.cast(y, ti.u32) * ti.u32(0xD8163841)
    h += ti.cast(z, ti.u32) * ti.u32(0xCB1AB31F)
    h = (h ^ (h >> 15)) * ti.u32(0x2C1B3C6D)
    h = (h ^ (h >> 12)) * ti.u32(0x297A2D39)
    h = h ^ (h >> 15)
    return ti.cast(h >> 8, ti.f32) * (1.0 / 16777216.0)


@ti.func
def noise3(p):
    """Smooth value noise in [0, 1), one cell a unit."""
    cell = ti.floor(p)
    f = p - cell
    f = f * f * (3.0 - 2.0 * f)
    i, j, k = ti.cast(cell[0], ti.i32), ti.cast(cell[1], ti.i32), ti.cast(cell[2], ti.i32)
    total = 0.0
    for corner in ti.static(range(8)):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (f[0] if a else 1.0 - f[0]) * (f[1] if b else 1.0 - f[1]) * (f[2] if c else 1.0 - f[2])
        total += weight * hash3(i + a, j + b, k + c)
    return total
