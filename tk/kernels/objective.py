"""The surface term of the objective, its gradient and Gauss-Newton products, batched over poses.

Kehl 2006, eqs. 8-10: f(p) = w Σ ρ(e), ρ(e) = 1 − exp(−e / ν), e = ½ (‖x − x̄‖ / σ)². Two readings where the paper is
silent: a point without any candidate within reach counts as an outlier (ρ = 1, no gradient), and the Hessian of eq. 19
is approximated as Schraudolph does, by the positive semi-definite Gauss-Newton part Σ ρ'(e)/σ² JᵀJ.
"""

import functools

import numpy as np

from tk.kernels.kinematics import forward, load_rotation, load_translation, load_vector3, point_velocity
from tk.kernels.nearest import SurfaceIndex, nearest_voxel
from tk.kernels.runtime import ensure_runtime, ti

# Points that one parallel task handles: small enough to share 160 points among threads, large enough that each task's
# own forward kinematics (about 2 µs) stays in the noise.
POINTS_PER_TASK = 16


@functools.cache
def _surface_kernel(real):
    @ti.kernel
    def surface(
        axis: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        point: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        prismatic: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        parent: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        local: ti.types.ndarray(dtype=real, ndim=2),  # (N, 3)
        normal: ti.types.ndarray(dtype=real, ndim=2),  # (N, 3)
        last_dof: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
        inv_sigma2: ti.types.ndarray(dtype=real, ndim=1),  # (N,)
        patch: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
        v_position: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
        v_normal: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
        fits: ti.types.ndarray(dtype=ti.i64, ndim=1),  # (V,)
        starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
        cells: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (3,)
        origin: ti.types.ndarray(dtype=ti.f32, ndim=1),  # (3,)
        cell_m: ti.f32,
        min_cosine: ti.f32,
        reach: ti.f32,
        nu: real,
        tangential: real,
        hold: ti.i32,
        chosen: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, M)
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        direction: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        tasks: ti.i32,  # tasks a pose
        frames: ti.types.ndarray(dtype=real, ndim=3),  # (B·tasks, D, 12) scratch
        twists: ti.types.ndarray(dtype=real, ndim=3),  # (B·tasks, D, 6) scratch
        assigned: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, M) out, in when hold = 1
        sums: ti.types.ndarray(dtype=real, ndim=2),  # (B·tasks, 1 + 2 D) out: f, gradient, H·direction
    ):
        for c in range(pose.shape[0] * tasks):
            b = c // tasks
            D = pose.shape[1]
            M = chosen.shape[1]
            for s in range(1 + 2 * D):
                sums[c, s] = 0.0
            forward(axis, point, prismatic, parent, pose, b, c, frames, twists)
            first = (c % tasks) * POINTS_PER_TASK
            for m in range(first, ti.min(first + POINTS_PER_TASK, M)):
                n = chosen[b, m]
                k_last = last_dof[n]
                R = load_rotation(frames, c, k_last)
                x = R @ load_vector3(local, n) + load_translation(frames, c, k_last)
                x_normal = R @ load_vector3(normal, n)
                v = assigned[b, m]
                if hold == 0:
                    v = nearest_voxel(
                        v_position,
                        v_normal,
                        fits,
                        starts,
                        cells,
                        origin,
                        cell_m,
                        x,
                        x_normal,
                        patch[n],
                        min_cosine,
                        reach,
                    )
                    assigned[b, m] = v
                if v < 0:
                    sums[c, 0] += 1.0
                else:
                    r = x - ti.Vector([ti.cast(v_position[v, a], real) for a in ti.static(range(3))])
                    y = ti.Vector([ti.cast(v_normal[v, a], real) for a in ti.static(range(3))])
                    # M = tangential·I + (1 − tangential)·y yᵀ: with tangential = 1 the paper's point distance
                    share = tangential
                    if y.norm_sqr() == 0.0:
                        share = tangential * 0.0 + 1.0
                    Mr = share * r + (1.0 - share) * y.dot(r) * y
                    e = 0.5 * r.dot(Mr) * inv_sigma2[n]
                    decay = ti.exp(-e / nu)
                    sums[c, 0] += 1.0 - decay
                    weight = decay / nu * inv_sigma2[n]
                    Jv = x * 0.0
                    k = k_last
                    while k >= 0:
                        Jk = point_velocity(prismatic, twists, c, k, x)
                        sums[c, 1 + k] += weight * Jk.dot(Mr)
                        Jv += Jk * direction[b, k]
                        k = parent[k]
                    MJv = share * Jv + (1.0 - share) * y.dot(Jv) * y
                    k = k_last
                    while k >= 0:
                        Jk = point_velocity(prismatic, twists, c, k, x)
                        sums[c, 1 + D + k] += weight * Jk.dot(MJv)
                        k = parent[k]

    return surface


class SurfaceTerm:
    """Eqs. 8-10 for one body: constants and scratch are laid out once, a frame's voxels are handed in.

    Args:
        axis, point: (D, 3) twists; prismatic, parent: (D,).
        local, normal: (N, 3) surface samples in the zero configuration; last_dof, patch: (N,).
        sigma: (N,) limb diameters, metres.
        dtype: np.float32, or np.float64 for checks of derivatives.
    """

    def __init__(
        self,
        axis: np.ndarray,
        point: np.ndarray,
        prismatic: np.ndarray,
        parent: np.ndarray,
        local: np.ndarray,
        normal: np.ndarray,
        last_dof: np.ndarray,
        sigma: np.ndarray,
        patch: np.ndarray,
        dtype: type = np.float32,
    ) -> None:
        ensure_runtime()
        self.dtype = dtype
        self._kernel = _surface_kernel(ti.f64 if dtype == np.float64 else ti.f32)
        self._model = (
            np.ascontiguousarray(axis, dtype),
            np.ascontiguousarray(point, dtype),
            np.ascontiguousarray(prismatic, np.int32),
            np.ascontiguousarray(parent, np.int32),
            np.ascontiguousarray(local, dtype),
            np.ascontiguousarray(normal, dtype),
            np.ascontiguousarray(last_dof, np.int32),
            np.ascontiguousarray(1.0 / np.asarray(sigma, np.float64) ** 2, dtype),
            np.ascontiguousarray(patch, np.int32),
        )
        self._scratch: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def evaluate(
        self,
        index: SurfaceIndex,
        chosen: np.ndarray,
        pose: np.ndarray,
        direction: np.ndarray | None = None,
        *,
        nu: float,
        min_cosine: float = -1.0,
        reach_m: float = 0.5,
        tangential: float = 1.0,
        assigned: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """One launch: value, gradient, Hessian-vector product and assignments of B poses.

        Args:
            index: the frame's surface voxels.
            chosen: (B, M) int32 samples used by each pose.
            pose: (B, D).
            direction: (B, D) the v of H·v, zeros by default.
            nu: Leclerc's ν, in units of ½ (d/σ)².
            min_cosine, reach_m: see :func:`tk.kernels.nearest.nearest`.
            tangential: weight of the distance along the surface; 1 is the paper's, 0 point-to-plane.
            assigned: (B, M) voxels to hold the samples to instead of searching.

        Returns:
            f (B,) the mean of ρ over the samples; gradient (B, D); H·v (B, D); assigned (B, M), -1 for none.
        """
        B, D = pose.shape
        M = chosen.shape[1]
        tasks = -(-M // POINTS_PER_TASK)
        rows = B * tasks
        if rows not in self._scratch:
            self._scratch[rows] = np.empty((rows, D, 12), self.dtype), np.empty((rows, D, 6), self.dtype)
        sums = np.empty((rows, 1 + 2 * D), self.dtype)
        held = assigned is not None
        found = np.ascontiguousarray(assigned, np.int32) if assigned is not None else np.empty((B, M), np.int32)
        self._kernel(
            *self._model,
            index.positions,
            index.normals,
            index.fits,
            index.starts,
            index.cells,
            index.origin,
            index.cell_m,
            min_cosine,
            reach_m,
            nu,
            tangential,
            int(held),
            np.ascontiguousarray(chosen, np.int32),
            np.ascontiguousarray(pose, self.dtype),
            np.zeros((B, D), self.dtype) if direction is None else np.ascontiguousarray(direction, self.dtype),
            tasks,
            *self._scratch[rows],
            found,
            sums,
        )
        # the tasks' sums are added in a fixed order: the same input gives the same bits
        total = sums.reshape(B, tasks, -1).sum(axis=1, dtype=np.float64) / M
        return total[:, 0], total[:, 1 : 1 + D], total[:, 1 + D :], found
