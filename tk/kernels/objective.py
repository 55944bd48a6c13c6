"""The objective f(p), its gradient and Gauss-Newton products, batched over poses, in one launch (Kehl 2006, 6.1).

Three terms share one form, ρ(e) = 1 − exp(−e / ν) with e = ½ (‖x − x̄‖ / σ)² (Kehl 2006, eqs. 8-10):

surface
    model to data: a surface sample x and its nearest surface voxel x̄, which fits x's colour patch (6.1.1, 6.1.3).
coverage
    data to model: a surface voxel x̄ and the nearest point x of the nearest superellipsoid that has the voxel's colour
    on it. Not in the paper: a limb inside the trunk still finds a voxel for every sample; this term pulls it out.
alignment
    model contour to image: entries made before the launch, see :mod:`tk.kernels.alignment` (6.1.2).

Parts of a body do not penetrate each other: a sample deep inside a part that it may not enter finds no voxel. Without
this, upper arms fold into the trunk, whose surface fits them, and a leg missing from the hull moves to the other leg.

Where the paper is silent: a sample without any candidate within reach counts as an outlier (ρ = 1, no gradient), and
the Hessian of eq. 19 is approximated, as Schraudolph does, by the positive semi-definite part Σ ρ'(e)/σ² JᵀJ.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tk.kernels.alignment import ENTRY_NUMBERS, add_alignment, add_curvature
from tk.kernels.kinematics import forward_tree, load_rotation, load_translation
from tk.kernels.nearest import SurfaceIndex
from tk.kernels.objective_pairs import (
    INV_SIGMA2,
    PATCH_BITS,
    add_residual,
    assign,
    load_pair,
    load_voxel,
    place_pieces,
)
from tk.kernels.pieces import PieceArrays
from tk.kernels.projection import CAMERA_NUMBERS
from tk.kernels.runtime import ensure_runtime, spread_of, ti
from tk.kernels.taichi_internals import Launcher
from tk.kernels.vectors import norm_sqr, times
from tk.kernels.wrench import (
    SCRATCH_NUMBERS,
    add_inertia,
    collect_inertias,
    collect_wrenches,
    start_inertias,
    start_wrenches,
)

# Points of one parallel task, and entries of the alignment term that count as one point (many are absent): 310 points
# of a pose are shared among threads, the 50 of a chain are not, and each task's own forward kinematics (some µs) stays
# small. Affects speed and the order of sums only.
POINTS_PER_TASK = 52
ENTRIES_PER_POINT = 4


@functools.cache
def _objective_kernel(real):
    @ti.kernel
    def objective(
        tree: ti.types.ndarray(dtype=real, ndim=2),  # (D, 11)
        samples: ti.types.ndarray(dtype=real, ndim=2),  # (N, 6)
        pieces: ti.types.ndarray(dtype=real, ndim=2),  # (P, 24)
        cameras: ti.types.ndarray(dtype=real, ndim=2),  # (C, 27)
        voxels: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
        fits: ti.types.ndarray(dtype=ti.i64, ndim=1),  # (V,)
        starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
        settings: ti.types.ndarray(dtype=real, ndim=1),  # (13,)
        spread: ti.i32,
        M: ti.i32,
        Q: ti.i32,
        E: ti.i32,
        chosen: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, M + Q) samples, then voxels of the coverage term
        entries: ti.types.ndarray(dtype=real, ndim=3),  # (B, E, 16) of the alignment term
        state: ti.types.ndarray(dtype=real, ndim=2),  # (2 B, D) poses, then directions
        scratch: ti.types.ndarray(dtype=real, ndim=3),  # (T, D + P, 39)
        assigned: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, M) out
        covering: ti.types.ndarray(dtype=real, ndim=3),  # (B, Q, 4) piece and projection, out
        sums: ti.types.ndarray(dtype=real, ndim=2),  # (T, 1 + 2 D) out
    ):
        for turn in range(spread * sums.shape[0]):
            if turn % spread != 0:
                continue
            c = turn // spread
            D = tree.shape[0]
            tasks = sums.shape[0] // (state.shape[0] // 2)
            b, part = c // tasks, c % tasks
            sums[c, 0] = 0.0
            forward_tree(tree, state, b, c, scratch)
            start_wrenches(tree, state, state.shape[0] // 2 + b, c, scratch)
            place_pieces(scratch, c, D, pieces)
            for e in range(E * part // tasks, E * (part + 1) // tasks):
                add_alignment(scratch, cameras, entries, sums, b, c, e)
            for m in range((M + Q) * part // tasks, (M + Q) * (part + 1) // tasks):
                assign(
                    samples, pieces, voxels, fits, starts, settings, chosen, scratch, b, c, D, m, M, assigned, covering,
                )  # fmt: skip
                v, k, x0, nu, scale = load_pair(samples, pieces, settings, chosen, assigned, covering, b, m, M)
                if v < 0:
                    sums[c, 0] = sums[c, 0] + scale
                else:
                    x = times(load_rotation(scratch, c, k), x0) + load_translation(scratch, c, k)
                    r = x - load_voxel(voxels, v, nu)
                    add_residual(scratch, sums, c, k, x, r, settings[INV_SIGMA2], nu, scale)
            collect_wrenches(tree, c, scratch, sums)

    return objective


# Pairs of one parallel task of the linearisation: fewer and longer tasks, because each passes its inertias down the
# tree. Affects speed and the order of sums only.
PAIRS_PER_TASK = 256


@functools.cache
def _linearise_kernel(real):
    @ti.kernel
    def linearise(
        tree: ti.types.ndarray(dtype=real, ndim=2),  # (D, 11)
        samples: ti.types.ndarray(dtype=real, ndim=2),  # (N, 6)
        pieces: ti.types.ndarray(dtype=real, ndim=2),  # (P, 24)
        cameras: ti.types.ndarray(dtype=real, ndim=2),  # (C, 27)
        voxels: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
        settings: ti.types.ndarray(dtype=real, ndim=1),  # (13,)
        spread: ti.i32,
        floor: real,
        M: ti.i32,
        Q: ti.i32,
        E: ti.i32,
        chosen: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (1, M + Q)
        entries: ti.types.ndarray(dtype=real, ndim=3),  # (1, E, 16)
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (1, D)
        scratch: ti.types.ndarray(dtype=real, ndim=3),  # (T, D or more, 39)
        assigned: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (1, M)
        covering: ti.types.ndarray(dtype=real, ndim=3),  # (1, Q, 4)
        residual: ti.types.ndarray(dtype=real, ndim=2),  # (M + Q, 4) out, metres, and the voxel or -1
        hessian: ti.types.ndarray(dtype=real, ndim=3),  # (T, D, D) out, zeroed by the caller
    ):
        for turn in range(spread * hessian.shape[0]):
            if turn % spread != 0:
                continue
            c = turn // spread
            tasks = hessian.shape[0]
            forward_tree(tree, pose, 0, c, scratch)
            start_inertias(tree, c, scratch)
            # near the body, once the root has been translated; any point would do
            origin = load_translation(scratch, c, ti.min(2, tree.shape[0] - 1))
            for e in range(E * c // tasks, E * (c + 1) // tasks):
                add_curvature(scratch, cameras, entries, c, e, floor, origin)
            for m in range((M + Q) * c // tasks, (M + Q) * (c + 1) // tasks):
                v, k, x0, nu, scale = load_pair(samples, pieces, settings, chosen, assigned, covering, 0, m, M)
                residual[m, 3] = v
                for a in ti.static(range(3)):
                    residual[m, a] = 0.0
                if v >= 0:
                    x = times(load_rotation(scratch, c, k), x0) + load_translation(scratch, c, k)
                    r = x - load_voxel(voxels, v, nu)
                    for a in ti.static(range(3)):
                        residual[m, a] = r[a]
                    inv_sigma2 = settings[INV_SIGMA2]
                    decay = ti.exp(-0.5 * norm_sqr(r) * inv_sigma2 / nu)
                    add_inertia(scratch, c, k, x - origin, scale * inv_sigma2 / nu * ti.max(decay, floor))
            collect_inertias(tree, c, scratch, origin, hessian)

    return linearise


@dataclass(frozen=True)
class ObjectiveParameters:
    """Constants of the objective."""

    sigma_m: float  # σ of eq. 10, metres
    reach_m: float  # search radius of a sample for its voxel, and of a voxel for the body, metres
    # nu, coverage_nu: Leclerc's ν of the surface and of the coverage term, in units of ½ (d/σ)²
    nu: float
    coverage_nu: float
    coverage_weight: float  # w_c of the coverage term; 0 removes it, as in the paper


@dataclass(frozen=True)
class Held:
    """Assignments of one evaluation."""

    assigned: np.ndarray  # (B, M) voxel of each sample, -1 without
    # (B, Q, 4) piece of each voxel, -1 without, and the nearest point in the zero configuration, metres
    covering: np.ndarray


class Evaluation(NamedTuple):
    """The objective at B poses."""

    value: np.ndarray  # (B,) mean ρ of the samples, plus the weighted mean ρ of the voxels, plus the entries' shares
    gradient: np.ndarray  # (B, D)
    hessian_vector: np.ndarray  # (B, D)
    held: Held  # the assignments made


@dataclass(frozen=True)
class Linearisation:
    """K = M + Q pairs and the Gauss-Newton Hessian at one pose."""

    residual: np.ndarray  # (K, 3) x − x̄, metres; zero where a voxel or sample is missing
    hessian: np.ndarray  # (D, D) Gauss-Newton Hessian of f; outliers weigh at least the given floor
    partner: np.ndarray  # (K,) the voxel, -1 where missing


class ObjectiveKernel:
    """The objective of one body. Constants and scratch are prepared once; each call takes a frame's voxels.

    Args:
        body: the body.
        local: (N, 3) surface samples in the zero configuration, metres.
        last_dof: (N,) last degree of freedom above each sample.
        patch: (N,) colour patch of each sample.
        barred: (N,) bit masks of the parts of the body that a sample may not enter: inside it finds no voxel.
        piece_part: (P,) the part that each piece belongs to.
        piece_patches: (P,) int64 bit masks of the colour patches on each piece: a voxel that fits none of them is not
            covered by the piece.
        cameras: (C, 27) of :func:`tk.kernels.projection.pack_cameras`, for the alignment term; None without it.
        dtype: np.float32, or np.float64 for checks of derivatives.
    """

    def __init__(
        self,
        body: PieceArrays,
        *,
        local: np.ndarray,
        last_dof: np.ndarray,
        patch: np.ndarray,
        barred: np.ndarray,
        piece_part: np.ndarray,
        piece_patches: np.ndarray,
        cameras: np.ndarray | None,
        dtype: type = np.float32,
    ) -> None:
        ensure_runtime()
        self.dtype = dtype
        self.degrees, self._rows = len(body.tree), len(body.tree) + len(body.pieces)
        patches = [piece_patches >> PATCH_BITS * part & (1 << PATCH_BITS) - 1 for part in range(3)]
        constants = (
            body.tree,
            np.column_stack([local, last_dof, patch, barred]),
            np.column_stack([body.pieces, piece_part, *patches]),
            np.zeros((1, CAMERA_NUMBERS)) if cameras is None else cameras,
        )
        real: list[np.ndarray] = [np.ascontiguousarray(array, dtype) for array in constants]
        precision = ti.f64 if dtype == np.float64 else ti.f32
        self._kernel = Launcher(_objective_kernel(precision), *real)
        self._linearise = Launcher(_linearise_kernel(precision), *real)
        self._scratch: dict[int, np.ndarray] = {}

    def _scratch_of(self, tasks: int) -> np.ndarray:
        """Return the scratch of T tasks: joints and pieces (T, D + P, 39)."""
        if tasks not in self._scratch:
            self._scratch[tasks] = np.empty((tasks, self._rows, SCRATCH_NUMBERS), self.dtype)
        return self._scratch[tasks]

    def _entries(self, entries: np.ndarray | None) -> np.ndarray:
        if entries is None or not entries.shape[1]:
            return np.zeros((1, 1, ENTRY_NUMBERS), self.dtype)
        return np.ascontiguousarray(entries, self.dtype)

    def _packed(self, s: ObjectiveParameters, M: int, Q: int, index: SurfaceIndex) -> np.ndarray:
        """Pack the settings in the kernels' order, from INV_SIGMA2 to GRID."""
        values = 1 / s.sigma_m**2, s.reach_m, s.nu, s.coverage_nu
        shares = 1 / max(M, 1), s.coverage_weight / max(Q, 1)
        return np.array([*values, *shares, *index.grid.tolist()], self.dtype)

    def evaluate(
        self,
        index: SurfaceIndex,
        chosen: np.ndarray,
        voxels: np.ndarray,
        pose: np.ndarray,
        direction: np.ndarray | None,
        settings: ObjectiveParameters,
        entries: np.ndarray | None = None,
    ) -> Evaluation:
        """Return value, gradient and Hessian-vector product at B poses.

        Args:
            index: the frame's surface voxels.
            chosen: (B, M) int32 surface samples used by each pose.
            voxels: (B, Q) int32 voxels used by the coverage term, indices into ``index``.
            pose: (B, D).
            direction: (B, D) the v of H·v; None for zeros.
            settings: constants.
            entries: (B, E, 16) of the alignment term (:mod:`tk.kernels.alignment`), if it counts.
        """
        E = 0 if entries is None else entries.shape[1]
        B, D = pose.shape
        M, Q = chosen.shape[1], voxels.shape[1] if settings.coverage_weight > 0 else 0
        tasks = max(-(-(M + Q + E // ENTRIES_PER_POINT) // POINTS_PER_TASK), 1)
        sums = np.empty((B * tasks, 1 + 2 * D), self.dtype)
        state: np.ndarray = np.zeros((2 * B, D), self.dtype)
        state[:B] = pose
        if direction is not None:
            state[B:] = direction
        found = Held(np.empty((B, M), np.int32), np.empty((B, max(Q, 1), 4), self.dtype))
        self._kernel(
            index.positions,
            index.fits,
            index.starts,
            self._packed(settings, M, Q, index),
            spread_of(len(sums)),
            M,
            Q,
            E,
            np.ascontiguousarray(np.concatenate([chosen, voxels[:, :Q]], axis=1), np.int32),
            self._entries(entries),
            state,
            self._scratch_of(B * tasks),
            found.assigned,
            found.covering,
            sums,
        )
        # the tasks' sums are added in a fixed order: the same input gives the same bits
        total = sums.reshape(B, tasks, -1).sum(axis=1, dtype=np.float64)
        return Evaluation(total[:, 0], total[:, 1 : 1 + D], total[:, 1 + D :], found)

    def linearise(
        self,
        index: SurfaceIndex,
        chosen: np.ndarray,
        voxels: np.ndarray,
        pose: np.ndarray,
        held: Held,
        settings: ObjectiveParameters,
        floor: float = 0.0,
        entries: np.ndarray | None = None,
    ) -> Linearisation:
        """Return residuals and the Gauss-Newton Hessian at one pose.

        Args:
            index: the frame's surface voxels.
            chosen: (M,) samples.
            voxels: (Q,) voxels of the coverage term.
            pose: (D,).
            held: assignments of :meth:`evaluate` at this pose, with B = 1.
            settings: constants.
            floor: minimum weight of an outlier in the Hessian.
            entries: (1, E, 16) of the alignment term; they count in the Hessian and are no pairs.
        """
        E = 0 if entries is None else entries.shape[1]
        M, Q = len(chosen), len(voxels) if settings.coverage_weight > 0 else 0
        tasks = max(-(-(M + Q + E // ENTRIES_PER_POINT) // PAIRS_PER_TASK), 1)
        D = self.degrees
        found: np.ndarray = np.empty((M + Q, 4), self.dtype)
        hessian: np.ndarray = np.zeros((tasks, D, D), self.dtype)
        self._linearise(
            index.positions,
            self._packed(settings, M, Q, index),
            spread_of(tasks),
            floor,
            M,
            Q,
            E,
            np.ascontiguousarray(np.concatenate([chosen, voxels[:Q]])[None], np.int32),
            self._entries(entries),
            np.ascontiguousarray(pose[None], self.dtype),
            self._scratch_of(tasks),
            np.ascontiguousarray(held.assigned, np.int32),
            np.ascontiguousarray(held.covering, self.dtype),
            found,
            hessian,
        )
        return Linearisation(
            residual=found[:, :3].astype(np.float64),
            hessian=hessian.sum(axis=0, dtype=np.float64),
            partner=found[:, 3].astype(np.int32),
        )
