"""The objective f(p), its gradient and Gauss-Newton products, batched over poses: one launch an evaluation.

Two terms share one form, ρ(e) = 1 − exp(−e / ν) with e = ½ (‖x − x̄‖ / σ)² (Kehl 2006, eqs. 8-10):

surface
    model to data: a surface sample x and its nearest surface voxel x̄, which fits x's colour patch (6.1.1, 6.1.3).
coverage
    data to model: a surface voxel x̄ and the nearest point x of the nearest superellipsoid. Not in the paper: it keeps
    a limb from hiding inside the trunk, where every sample of it still finds a voxel.

Where the paper is silent: a sample without any candidate within reach counts as an outlier (ρ = 1, no gradient), and
the Hessian of eq. 19 is approximated, as Schraudolph does, by the positive semi-definite part Σ ρ'(e)/σ² JᵀJ.
"""

import functools
from dataclasses import dataclass

import numpy as np

from tk.kernels.kinematics import forward, load_rotation, load_translation, load_vector3, point_velocity
from tk.kernels.nearest import SurfaceIndex, nearest_voxel
from tk.kernels.runtime import ensure_runtime, ti
from tk.kernels.superellipsoid import project

# Points that one parallel task handles: few enough to share 160 points among threads, many enough that each task's own
# forward kinematics (about 2 µs) stays in the noise.
POINTS_PER_TASK = 16


@ti.func
def _nearest_piece(
    frames: ti.template(),
    c: int,
    piece_dof: ti.template(),  # (P,)
    piece_frame: ti.template(),  # (P, 12) piece to zero configuration
    piece_shape: ti.template(),  # (P, 7) a1 a2 a3 e1 e2 z_lower z_upper
    y,  # voxel, world
    y_normal,
    min_cosine,
    reach,
):
    """(index or -1, x, y, z of the projection in the zero configuration) of the piece nearest to a voxel."""
    best = -1
    best_d = reach
    best_x = y * 0.0
    for i in range(piece_dof.shape[0]):
        R = load_rotation(frames, c, piece_dof[i])
        Rp = ti.Matrix([[piece_frame[i, 4 * a + b] for b in ti.static(range(3))] for a in ti.static(range(3))])
        tp = ti.Vector([piece_frame[i, 4 * a + 3] for a in ti.static(range(3))])
        q = Rp.transpose() @ (R.transpose() @ (y - load_translation(frames, c, piece_dof[i])) - tp)
        radii = ti.Vector([piece_shape[i, a] for a in ti.static(range(3))])
        z_lower, z_upper = piece_shape[i, 5], piece_shape[i, 6]
        # a box about the piece: what lies further outside it than the best so far cannot win
        over = ti.Vector(
            [
                ti.max(ti.abs(q[0]) - radii[0], 0.0),
                ti.max(ti.abs(q[1]) - radii[1], 0.0),
                ti.max(ti.max(z_lower - q[2], q[2] - z_upper), 0.0),
            ]
        )
        if over.norm_sqr() < best_d * best_d:
            s = project(q, radii, piece_shape[i, 3], piece_shape[i, 4], z_lower, z_upper)
            on = ti.Vector([s[0], s[1], s[2]])
            d = (q - on).norm()
            if d < best_d:
                n = R @ (Rp @ ti.Vector([s[3], s[4], s[5]]))
                if n.dot(y_normal) >= min_cosine or y_normal.norm_sqr() == 0.0:
                    best = i
                    best_d = d
                    best_x = Rp @ on + tp
    return best, best_x


@ti.func
def _add_residual(
    prismatic: ti.template(),
    parent: ti.template(),
    twists: ti.template(),
    direction: ti.template(),
    sums: ti.template(),
    b: int,
    c: int,
    k_last: int,
    x,
    r,
    y_normal,
    share,
    inv_sigma2,
    nu,
    scale,
):
    """Add scale·ρ(e) of one pair, its gradient and its Hessian-vector product to row c of the sums."""
    D = (sums.shape[1] - 1) // 2
    # Mr = (share·I + (1 − share)·y yᵀ) r: with share = 1 the paper's distance, with 0 the one along the normal
    Mr = share * r + (1.0 - share) * y_normal.dot(r) * y_normal
    decay = ti.exp(-0.5 * r.dot(Mr) * inv_sigma2 / nu)
    sums[c, 0] += scale * (1.0 - decay)
    weight = scale * decay / nu * inv_sigma2
    Jv = x * 0.0
    k = k_last
    while k >= 0:
        J = point_velocity(prismatic, twists, c, k, x)
        sums[c, 1 + k] += weight * J.dot(Mr)
        Jv += J * direction[b, k]
        k = parent[k]
    MJv = share * Jv + (1.0 - share) * y_normal.dot(Jv) * y_normal
    k = k_last
    while k >= 0:
        sums[c, 1 + D + k] += weight * point_velocity(prismatic, twists, c, k, x).dot(MJv)
        k = parent[k]


@functools.cache
def _objective_kernel(real):
    @ti.kernel
    def objective(
        # the body
        axis: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        point: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        prismatic: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        parent: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        local: ti.types.ndarray(dtype=real, ndim=2),  # (N, 3)
        normal: ti.types.ndarray(dtype=real, ndim=2),  # (N, 3)
        last_dof: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
        inv_sigma2: ti.types.ndarray(dtype=real, ndim=1),  # (N,)
        patch: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
        piece_dof: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,)
        piece_frame: ti.types.ndarray(dtype=real, ndim=2),  # (P, 12)
        piece_shape: ti.types.ndarray(dtype=real, ndim=2),  # (P, 7)
        piece_inv_sigma2: ti.types.ndarray(dtype=real, ndim=1),  # (P,)
        # the frame
        v_position: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
        v_normal: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
        fits: ti.types.ndarray(dtype=ti.i64, ndim=1),  # (V,)
        starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
        cells: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (3,)
        origin: ti.types.ndarray(dtype=ti.f32, ndim=1),  # (3,)
        cell_m: ti.f32,
        # settings
        nu: real,
        tangential: real,
        min_cosine: real,
        reach: real,
        coverage_nu: real,
        coverage_cosine: real,
        coverage_reach: real,
        surface_scale: real,  # w_s / M
        coverage_scale: real,  # w_c / Q
        hold: ti.i32,
        # the poses
        chosen: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, M) samples
        voxels: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, Q) voxels of the coverage term
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        direction: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        surface_tasks: ti.i32,
        coverage_tasks: ti.i32,
        frames: ti.types.ndarray(dtype=real, ndim=3),  # (C, D, 12) scratch
        twists: ti.types.ndarray(dtype=real, ndim=3),  # (C, D, 6) scratch
        assigned: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, M) out, in when hold = 1
        covering: ti.types.ndarray(dtype=real, ndim=3),  # (B, Q, 4) piece and projection, out, in when hold = 1
        sums: ti.types.ndarray(dtype=real, ndim=2),  # (C, 1 + 2 D) out
    ):
        for c in range(pose.shape[0] * (surface_tasks + coverage_tasks)):
            b = c // (surface_tasks + coverage_tasks)
            task = c % (surface_tasks + coverage_tasks)
            for s in range(sums.shape[1]):
                sums[c, s] = 0.0
            forward(axis, point, prismatic, parent, pose, b, c, frames, twists)
            if task < surface_tasks:
                first = task * POINTS_PER_TASK
                for m in range(first, ti.min(first + POINTS_PER_TASK, chosen.shape[1])):
                    n = chosen[b, m]
                    k = last_dof[n]
                    R = load_rotation(frames, c, k)
                    x = R @ load_vector3(local, n) + load_translation(frames, c, k)
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
                            R @ load_vector3(normal, n),
                            patch[n],
                            ti.cast(min_cosine, ti.f32),
                            ti.cast(reach, ti.f32),
                        )
                        assigned[b, m] = v
                    if v < 0:
                        sums[c, 0] += surface_scale
                    else:
                        y = ti.Vector([ti.cast(v_position[v, a], real) for a in ti.static(range(3))])
                        y_normal = ti.Vector([ti.cast(v_normal[v, a], real) for a in ti.static(range(3))])
                        share = tangential
                        if y_normal.norm_sqr() == 0.0:
                            share = tangential * 0.0 + 1.0
                        _add_residual(
                            prismatic, parent, twists, direction, sums, b, c, k, x, x - y, y_normal, share,
                            inv_sigma2[n], nu, surface_scale,
                        )  # fmt: skip
            else:
                first = (task - surface_tasks) * POINTS_PER_TASK
                for m in range(first, ti.min(first + POINTS_PER_TASK, voxels.shape[1])):
                    v = voxels[b, m]
                    y = ti.Vector([ti.cast(v_position[v, a], real) for a in ti.static(range(3))])
                    y_normal = ti.Vector([ti.cast(v_normal[v, a], real) for a in ti.static(range(3))])
                    i = ti.cast(covering[b, m, 0], ti.i32)
                    x0 = ti.Vector([covering[b, m, 1 + a] for a in ti.static(range(3))])
                    if hold == 0:
                        i, x0 = _nearest_piece(
                            frames, c, piece_dof, piece_frame, piece_shape, y, y_normal, coverage_cosine, coverage_reach
                        )
                        covering[b, m, 0] = ti.cast(i, real)
                        for a in ti.static(range(3)):
                            covering[b, m, 1 + a] = x0[a]
                    if i < 0:
                        sums[c, 0] += coverage_scale
                    else:
                        k = piece_dof[i]
                        x = load_rotation(frames, c, k) @ x0 + load_translation(frames, c, k)
                        _add_residual(
                            prismatic, parent, twists, direction, sums, b, c, k, x, x - y, y_normal,
                            tangential * 0.0 + 1.0, piece_inv_sigma2[i], coverage_nu, coverage_scale,
                        )  # fmt: skip

    return objective


@functools.cache
def _linearise_kernel(real):
    @ti.kernel
    def linearise(
        axis: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        point: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        prismatic: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        parent: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        local: ti.types.ndarray(dtype=real, ndim=2),  # (N, 3)
        last_dof: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
        piece_dof: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,)
        v_position: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (1, D)
        chosen: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (M,)
        voxels: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (Q,)
        assigned: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (M,)
        covering: ti.types.ndarray(dtype=real, ndim=2),  # (Q, 4)
        pairs: ti.i32,  # M, or M + Q
        frames: ti.types.ndarray(dtype=real, ndim=3),  # (tasks, D, 12) scratch
        twists: ti.types.ndarray(dtype=real, ndim=3),  # (tasks, D, 6) scratch
        residual: ti.types.ndarray(dtype=real, ndim=2),  # (M + Q, 3) out, metres
        jacobian: ti.types.ndarray(dtype=real, ndim=3),  # (M + Q, D, 3) out
        partner: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (M + Q,) out, the voxel or -1
    ):
        for c in range((pairs + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
            forward(axis, point, prismatic, parent, pose, 0, c, frames, twists)
            for m in range(c * POINTS_PER_TASK, ti.min((c + 1) * POINTS_PER_TASK, pairs)):
                k = 0
                v = -1
                x0 = ti.Vector([pose[0, 0] * 0.0, pose[0, 0] * 0.0, pose[0, 0] * 0.0])
                if m < chosen.shape[0]:
                    k = last_dof[chosen[m]]
                    x0 = load_vector3(local, chosen[m])
                    v = assigned[m]
                else:
                    q = m - chosen.shape[0]
                    i = ti.cast(covering[q, 0], ti.i32)
                    if i >= 0:
                        k = piece_dof[i]
                        v = voxels[q]
                        x0 = ti.Vector([covering[q, 1 + a] for a in ti.static(range(3))])
                partner[m] = v
                x = load_rotation(frames, c, k) @ x0 + load_translation(frames, c, k)
                for a in ti.static(range(3)):
                    residual[m, a] = 0.0
                if v >= 0:
                    for a in ti.static(range(3)):
                        residual[m, a] = x[a] - ti.cast(v_position[v, a], real)
                    for d in range(jacobian.shape[1]):
                        for a in ti.static(range(3)):
                            jacobian[m, d, a] = 0.0
                    while k >= 0:
                        J = point_velocity(prismatic, twists, c, k, x)
                        for a in ti.static(range(3)):
                            jacobian[m, k, a] = J[a]
                        k = parent[k]

    return linearise


@dataclass(frozen=True)
class ObjectiveSettings:
    """Constants of the objective.

    Attributes:
        nu: Leclerc's ν of the surface term, in units of ½ (d/σ)².
        tangential: weight of the distance along the data's surface; 1 is the paper's distance, 0 point-to-plane.
        min_cosine: least cosine between a sample's normal and its voxel's; -1 ignores normals, as the paper does.
        reach_m: greatest distance at which a voxel is looked for.
        coverage_weight: w_c of the coverage term beside the surface term's 1; 0 leaves it out, as the paper does.
        coverage_nu, coverage_cosine, coverage_reach_m: the same for the coverage term.
    """

    nu: float = 0.5
    tangential: float = 1.0
    min_cosine: float = 0.0
    reach_m: float = 0.3
    coverage_weight: float = 1.0
    coverage_nu: float = 1.0
    coverage_cosine: float = 0.0
    coverage_reach_m: float = 0.5


@dataclass(frozen=True)
class Held:
    """Assignments of one evaluation: voxels (B, M) of the samples, pieces and points (B, Q, 4) of the voxels."""

    assigned: np.ndarray
    covering: np.ndarray


class ObjectiveKernel:
    """The objective of one body: constants and scratch are laid out once, a frame's voxels are handed in.

    Args:
        axis, point: (D, 3) twists; prismatic, parent: (D,).
        local, normal: (N, 3) surface samples in the zero configuration; last_dof, patch: (N,).
        sigma: (N,) σ of eq. 10 at the samples, metres.
        piece_dof: (P,) last degree of freedom above each superellipsoid.
        piece_frame: (P, 3, 4) from its frame to the zero configuration.
        piece_shape: (P, 7) a1 a2 a3 ε1 ε2 z_lower z_upper.
        piece_sigma: (P,) σ of voxels that the piece covers, metres.
        dtype: np.float32, or np.float64 for checks of derivatives.
    """

    def __init__(
        self,
        *,
        axis: np.ndarray,
        point: np.ndarray,
        prismatic: np.ndarray,
        parent: np.ndarray,
        local: np.ndarray,
        normal: np.ndarray,
        last_dof: np.ndarray,
        sigma: np.ndarray,
        patch: np.ndarray,
        piece_dof: np.ndarray,
        piece_frame: np.ndarray,
        piece_shape: np.ndarray,
        piece_sigma: np.ndarray,
        dtype: type = np.float32,
    ) -> None:
        ensure_runtime()
        self.dtype = dtype
        self.degrees = len(axis)
        self.launches = 0
        self._kernel = _objective_kernel(ti.f64 if dtype == np.float64 else ti.f32)

        def real(array: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(array, dtype)

        def whole(array: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(array, np.int32)

        self._body = (
            real(axis),
            real(point),
            whole(prismatic),
            whole(parent),
            real(local),
            real(normal),
            whole(last_dof),
            real(1.0 / np.asarray(sigma, np.float64) ** 2),
            whole(patch),
            whole(piece_dof),
            real(np.reshape(piece_frame, (-1, 12))),
            real(piece_shape),
            real(1.0 / np.asarray(piece_sigma, np.float64) ** 2),
        )
        self._scratch: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def evaluate(
        self,
        index: SurfaceIndex,
        chosen: np.ndarray,
        voxels: np.ndarray,
        pose: np.ndarray,
        direction: np.ndarray | None,
        settings: ObjectiveSettings,
        held: Held | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Held]:
        """Value, gradient and Hessian-vector product at B poses.

        Args:
            index: the frame's surface voxels.
            chosen: (B, M) int32 surface samples used by each pose.
            voxels: (B, Q) int32 voxels used by the coverage term, indices into ``index``.
            pose: (B, D).
            direction: (B, D) the v of H·v; None for zeros.
            settings: constants.
            held: assignments to keep instead of searching anew.

        Returns:
            f (B,): mean ρ over the samples plus ``coverage_weight`` times mean ρ over the voxels; its gradient (B, D);
            H·v (B, D); the assignments made.
        """
        B, D = pose.shape
        M, Q = chosen.shape[1], voxels.shape[1] if settings.coverage_weight > 0 else 0
        surface_tasks, coverage_tasks = -(-M // POINTS_PER_TASK), -(-Q // POINTS_PER_TASK)
        rows = B * (surface_tasks + coverage_tasks)
        if rows not in self._scratch:
            self._scratch[rows] = np.empty((rows, D, 12), self.dtype), np.empty((rows, D, 6), self.dtype)
        sums = np.empty((rows, 1 + 2 * D), self.dtype)
        if held is None:
            found = Held(np.empty((B, M), np.int32), np.empty((B, max(Q, 1), 4), self.dtype))
        else:
            found = Held(np.array(held.assigned, np.int32), np.array(held.covering, self.dtype))
        s = settings
        self._kernel(
            *self._body,
            index.positions,
            index.normals,
            index.fits,
            index.starts,
            index.cells,
            index.origin,
            index.cell_m,
            s.nu,
            s.tangential,
            s.min_cosine,
            s.reach_m,
            s.coverage_nu,
            s.coverage_cosine,
            s.coverage_reach_m,
            1.0 / max(M, 1),
            s.coverage_weight / max(Q, 1),
            int(held is not None),
            np.ascontiguousarray(chosen, np.int32),
            np.ascontiguousarray(voxels, np.int32),
            np.ascontiguousarray(pose, self.dtype),
            np.zeros((B, D), self.dtype) if direction is None else np.ascontiguousarray(direction, self.dtype),
            surface_tasks,
            coverage_tasks,
            *self._scratch[rows],
            found.assigned,
            found.covering,
            sums,
        )
        self.launches += 1
        # the tasks' sums are added in a fixed order: the same input gives the same bits
        total = sums.reshape(B, surface_tasks + coverage_tasks, -1).sum(axis=1, dtype=np.float64)
        return total[:, 0], total[:, 1 : 1 + D], total[:, 1 + D :], found

    def linearise(
        self,
        index: SurfaceIndex,
        chosen: np.ndarray,
        voxels: np.ndarray,
        pose: np.ndarray,
        held: Held,
        settings: ObjectiveSettings,
    ) -> "Linearisation":
        """Residuals and their Jacobian at one pose, for methods that want more than a gradient.

        Args:
            chosen: (M,) samples; voxels: (Q,) voxels of the coverage term.
            pose: (D,).
            held: assignments of :meth:`evaluate` at this pose, with B = 1.
        """
        M, Q = len(chosen), len(voxels) if settings.coverage_weight > 0 else 0
        tasks = -(-(M + Q) // POINTS_PER_TASK)
        D = self.degrees
        axis, point, prismatic, parent, local, _, last_dof, inv_sigma2, _, piece_dof, _, _, piece_inv_sigma2 = (
            self._body
        )
        residual: np.ndarray = np.zeros((M + Q, 3), self.dtype)
        jacobian: np.ndarray = np.zeros((M + Q, D, 3), self.dtype)
        partner = np.empty(M + Q, np.int32)
        _linearise_kernel(ti.f64 if self.dtype == np.float64 else ti.f32)(
            axis,
            point,
            prismatic,
            parent,
            local,
            last_dof,
            piece_dof,
            index.positions,
            np.ascontiguousarray(pose[None], self.dtype),
            np.ascontiguousarray(chosen, np.int32),
            np.ascontiguousarray(voxels, np.int32),
            np.ascontiguousarray(held.assigned[0], np.int32),
            np.ascontiguousarray(held.covering[0], self.dtype),
            M + Q,
            np.empty((tasks, D, 12), self.dtype),
            np.empty((tasks, D, 6), self.dtype),
            residual,
            jacobian,
            partner,
        )
        self.launches += 1
        covering_piece = held.covering[0, :Q, 0].astype(np.int64)
        return Linearisation(
            residual=residual.astype(np.float64),
            jacobian=jacobian.transpose(0, 2, 1).astype(np.float64),
            partner=partner,
            inv_sigma2=np.concatenate([inv_sigma2[chosen], piece_inv_sigma2[covering_piece]]).astype(np.float64),
            nu=np.repeat([settings.nu, settings.coverage_nu], [M, Q]),
            scale=np.repeat([1.0 / max(M, 1), settings.coverage_weight / max(Q, 1)], [M, Q]),
        )


@dataclass(frozen=True)
class Linearisation:
    """K = M + Q pairs at one pose.

    Attributes:
        residual: (K, 3) x − x̄, metres; zero where a pair is missing.
        jacobian: (K, 3, D) ∂x/∂p.
        partner: (K,) the voxel, -1 where missing.
        inv_sigma2: (K,) 1/σ², 1/m².
        nu: (K,) Leclerc's ν; scale: (K,) the pair's share of f.
    """

    residual: np.ndarray
    jacobian: np.ndarray
    partner: np.ndarray
    inv_sigma2: np.ndarray
    nu: np.ndarray
    scale: np.ndarray

    @property
    def decay(self) -> np.ndarray:
        """(K,) exp(−e/ν): near 1 for inliers, 0 for outliers and missing pairs."""
        e = 0.5 * np.sum(self.residual**2, axis=1) * self.inv_sigma2
        return np.where(self.partner >= 0, np.exp(-e / self.nu), 0.0)

    def gauss_newton(self, floor: float = 0.0) -> np.ndarray:
        """(D, D) the Gauss-Newton Hessian of f, outliers weighing at least ``floor``."""
        weight = self.scale / self.nu * self.inv_sigma2 * np.maximum(self.decay, floor) * (self.partner >= 0)
        rows = (self.jacobian * np.sqrt(weight)[:, None, None]).reshape(-1, self.jacobian.shape[2])
        return rows.T @ rows
