"""Products written out, against NumPy's."""

import numpy as np

from tk.kernels.runtime import ensure_runtime, ti
from tk.kernels.vectors import cross, dot, norm_sqr, product, pulled, times, transposed_times


@ti.kernel
def _all_products(
    A: ti.types.ndarray(dtype=ti.f64, ndim=2),
    B: ti.types.ndarray(dtype=ti.f64, ndim=2),
    x: ti.types.ndarray(dtype=ti.f64, ndim=1),
    out: ti.types.ndarray(dtype=ti.f64, ndim=2),
):
    for _ in range(1):
        M = ti.Matrix([[A[i, j] for j in ti.static(range(3))] for i in ti.static(range(3))])
        N = ti.Matrix([[B[i, j] for j in ti.static(range(3))] for i in ti.static(range(3))])
        J = ti.Matrix([[A[i, j] for j in ti.static(range(3))] for i in ti.static(range(2))])
        v = ti.Vector([x[i] for i in ti.static(range(3))])
        w = ti.Vector([x[3 + i] for i in ti.static(range(3))])
        MN, JN = product(M, N), product(J, N)
        a, b, c, d, e = (
            times(M, v),
            transposed_times(M, v),
            times(J, v),
            pulled(J, ti.Vector([v[0], v[1]])),
            cross(v, w),
        )
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                out[i, j] = MN[i, j]
            out[5, i], out[6, i], out[7, i], out[8, i] = a[i], b[i], d[i], e[i]
        for i in ti.static(range(2)):
            for j in ti.static(range(3)):
                out[3 + i, j] = JN[i, j]
            out[9, i] = c[i]
        out[9, 2], out[10, 0] = dot(v, w), norm_sqr(v)


def test_products_are_numpys():
    ensure_runtime()
    rng = np.random.default_rng(0)
    A, B, x = rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), rng.normal(size=6)
    v, w = x[:3], x[3:]
    out = np.zeros((11, 3))
    _all_products(A, B, x, out)
    expected = [A @ B, A[:2] @ B, [A @ v], [A.T @ v], [A[:2].T @ v[:2]], [np.cross(v, w)], [[*(A[:2] @ v), v @ w]]]
    np.testing.assert_allclose(out[:10], np.concatenate(expected), rtol=1e-13)
    np.testing.assert_allclose(out[10, 0], v @ v, rtol=1e-13)
