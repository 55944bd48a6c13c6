"""A body's objective in one frame (Kehl 2006, section 6.1): draw samples and voxels, evaluate them by the kernel.

The optimisers see only callables of poses (:meth:`FrameObjective.full`, :meth:`FrameObjective.chains`), no voxels,
colours or samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.nearest import SurfaceIndex
from tk.kernels.objective import Held, Linearisation, ObjectiveKernel, ObjectiveParameters
from tk.model.body.joints import CHAIN_OF_SEGMENT, CHAINS, SEGMENTS
from tk.model.body.superellipsoid_body import SuperellipsoidBody
from tk.model.cues.edge_term import RENEW, SIGMA_M, ContourTerm
from tk.settings import ObjectiveSettings

Float = NDArray[np.float64]
Ints = NDArray[np.int32]
Entries = NDArray[np.floating]

CHAIN_NAMES = tuple(CHAINS)


def _barred() -> Ints:
    """Return bit masks (S,) of the parts (0 the torso, 1 + c chain c) that a segment's surface may not enter."""
    bits = {name: 1 << 1 + c for c, name in enumerate(CHAIN_NAMES)}
    trunk = 1 | bits["head"]
    enters_not = {
        "arm_l": trunk | bits["arm_r"],
        "arm_r": trunk | bits["arm_l"],
        "leg_l": bits["leg_r"],
        "leg_r": bits["leg_l"],
    }
    return np.array([enters_not.get(CHAIN_NAMES[c], 0) if c >= 0 else 0 for c in CHAIN_OF_SEGMENT], np.int32)


BARRED = _barred()

# Surface samples on the torso, and on the head and each limb (section 6.4), and voxels of the coverage term in the
# optimisation of all degrees of freedom; each chain has its share of the last.
TORSO_SAMPLES, CHAIN_SAMPLES, COVERAGE_VOXELS = 60, 20, 150
# Search radius of a sample for its voxel, and of a voxel for the body, metres: three σ. A smaller one ignores pairs
# that still pull. With 0.5 for voxels the mean errors of five captures (60 frames, three seeds) change by 0.03 cm.
REACH_M = 0.3
# Leclerc's ν of eq. 9, in units of ½ (d/σ)². The paper prints none. With half and twice the value the mean errors of
# walk and dance (45 frames) change by 0.06 cm at most.
SURFACE_NU = 0.35
# Leclerc's ν of the coverage term, as a multiple of the surface term's: voxels of a limb that the body has left are
# far away. At 1 an arm stays lost in one of three runs of dance; with 4 the mean errors of walk and dance change by
# 0.03 cm.
COVERAGE_SOFTNESS = 2.0
# Minimum weight of a pair in the Hessian, so that a limb far from its data keeps some curvature; at 0 its steps grow
# without bound. With half and twice the value the mean errors of walk and dance (45 frames) change by 0.04 cm at most.
OUTLIERS = 0.1
# Distance from the body above which a voxel is unexplained, metres: σ.
UNEXPLAINED_M = SIGMA_M
# A voxel farther than this from the nearest piece may belong to another one, metres: voxels lie 2 to 3 cm from their
# piece. With half and twice the value the mean errors of walk and dance (45 frames) change by 0.03 cm at most.
NEAR_M = 0.05


class Evaluation(NamedTuple):
    """An objective at B poses: value (B,), gradient (B, D), Hessian-vector product (B, D)."""

    value: Float
    gradient: Float
    hessian_vector: Float


class BodyObjective:
    """The objective of one body, for any frame.

    Args:
        body: the person.
        weights: of the terms.
        contours: the edge term; None without it.
        scale: factor of all numbers of points in the optimisation (section 7.3).
        waist_stiffness: see :data:`tk.trackers.volumetric.WAIST_COST`.
        dtype: precision of the kernel.
    """

    def __init__(
        self,
        body: SuperellipsoidBody,
        weights: ObjectiveSettings,
        contours: ContourTerm | None = None,
        scale: int = 1,
        waist_stiffness: float = 0.0,
        dtype: type = np.float32,
    ) -> None:
        self.body, self.contours, self.scale = body, contours, scale
        self.stiffness = waist_stiffness * body.skeleton.stiffness
        self.settings = ObjectiveParameters(
            sigma_m=SIGMA_M,
            reach_m=REACH_M,
            nu=SURFACE_NU,
            coverage_nu=COVERAGE_SOFTNESS * SURFACE_NU,
            surface_weight=weights.surface_weight,
            coverage_weight=weights.coverage_weight,
        )
        self.piece_chain = CHAIN_OF_SEGMENT[[SEGMENTS.index(piece.segment) for piece in body.pieces]]
        self.kernel = ObjectiveKernel(
            body.arrays,
            local=body.points,
            last_dof=body.skeleton.segment_dof[body.segment],
            patch=body.patch,
            barred=BARRED[body.segment],
            piece_part=self.piece_chain + 1,
            piece_patches=piece_patches(body),
            cameras=None if contours is None else contours.cameras,
            dtype=dtype,
        )
        chain = CHAIN_OF_SEGMENT[body.segment]
        # the torso's samples, then each chain's
        self.samples = [np.flatnonzero(chain == c).astype(np.int32) for c in range(-1, len(CHAINS))]
        self._counts = (TORSO_SAMPLES, *len(CHAINS) * (CHAIN_SAMPLES,))
        self.chain_free = np.array([body.skeleton.chain_dofs(c) for c in CHAIN_NAMES])

    def draw(self, rng: np.random.Generator) -> Ints:
        """Draw surface samples (M,) at random in the proportions of section 6.4."""
        return np.concatenate(
            [pick(rng, samples, self.scale * n) for samples, n in zip(self.samples, self._counts, strict=True)]
        )

    def spread(self) -> Ints:
        """Return surface samples (M,) evenly over the body, twice as many as are drawn, the same at every call."""
        return np.concatenate([even(samples, 2 * n) for samples, n in zip(self.samples, self._counts, strict=True)])

    def damping(self, lever_m: float) -> Float:
        """Return the curvature (D,) of f along each parameter if all points lay ``lever_m`` from its axis."""
        s = self.settings
        unit = (1 / s.nu + s.coverage_weight / s.coverage_nu) / s.sigma_m**2
        return unit * np.where(self.body.skeleton.prismatic, 1.0, lever_m**2)

    def evaluate(
        self,
        index: SurfaceIndex,
        samples: Ints,
        voxels: Ints,
        poses: Float,
        directions: Float | None,
        entries: Entries | None,
    ) -> tuple[Evaluation, Held]:
        """Return the objective at poses (B, D), the waist's springs included, and the assignments made.

        Arguments as for :meth:`ObjectiveKernel.evaluate`.
        """
        value, gradient, product, held = self.kernel.evaluate(
            index, samples, voxels, poses, directions, self.settings, entries=entries
        )
        k = self.stiffness
        if k.any():
            value, gradient = value + 0.5 * np.square(poses) @ k, gradient + k * poses
            product = product if directions is None else product + k * directions
        return Evaluation(value, gradient, product), held


def piece_patches(body: SuperellipsoidBody) -> NDArray[np.int64]:
    """Return bit masks (P,) of the colour patches on each piece; a piece without samples has its segment's patches."""
    masks = np.zeros(len(body.pieces), np.int64)
    for index, piece in enumerate(body.pieces):
        mine = body.piece == index
        if not mine.any():
            mine = body.segment == SEGMENTS.index(piece.segment)
        masks[index] = np.bitwise_or.reduce(np.int64(1) << np.unique(body.patch[mine]).astype(np.int64))
    return masks


def pick(rng: np.random.Generator, samples: Ints, count: int) -> Ints:
    """Draw ``count`` of the samples at random, all of them if there are no more."""
    return samples if count >= len(samples) else samples[rng.permutation(len(samples))[:count]]


def even(samples: Ints, count: int) -> Ints:
    """Return ``count`` of the samples at equal steps, all of them if there are no more."""
    return samples if count >= len(samples) else samples[(np.arange(count) * len(samples)) // count]


@dataclass(frozen=True)
class Fit:
    """The pairs and the objective of a frame at one pose."""

    value: float  # the objective over evenly spread samples and voxels
    linear: Linearisation  # the linearisation at the pose (M + Q pairs)
    samples: Ints  # (M,) the samples used
    voxels: Ints  # (Q,) the voxels used
    held: Held

    @property
    def unmatched(self) -> NDArray[np.bool_]:
        """(M,) bool, samples without a voxel within σ."""
        return self._beyond(SIGMA_M)[: len(self.samples)]

    def beyond(self, distance_m: float) -> NDArray[np.bool_]:
        """Return (Q,) True for voxels farther than this from the body; without the coverage term for none."""
        found = self._beyond(distance_m)[len(self.samples) :]
        return found if len(found) else np.zeros(len(self.voxels), bool)

    def _beyond(self, distance_m: float) -> NDArray[np.bool_]:
        linear = self.linear
        return (linear.partner < 0) | (np.linalg.norm(linear.residual, axis=1) > distance_m)

    @property
    def unexplained_share(self) -> float:
        """Share of the voxels that are farther than :data:`UNEXPLAINED_M` from the body."""
        return float(self.beyond(UNEXPLAINED_M).mean())


class _Look(NamedTuple):
    """A pose's value on the evenly spread samples, with its assignments."""

    value: float
    held: Held
    entries: Entries | None


class FrameObjective:
    """The objective of one body in one frame: a :class:`tk.optim.schedule.Problem`.

    Args:
        objective: the body's objective.
        index: the frame's surface voxels.
        rng: random generator of the samples.
        images: (C, H, W, 3) for the edge term; None without that term.
    """

    def __init__(
        self,
        objective: BodyObjective,
        index: SurfaceIndex,
        rng: np.random.Generator,
        images: NDArray[np.uint8] | None = None,
    ) -> None:
        self.objective, self.index, self.rng, self.images = objective, index, rng, images
        self.contours = None if images is None else objective.contours
        self.voxel_count = len(index.positions)
        self.free = objective.chain_free
        self.angular = ~objective.body.skeleton.prismatic
        self.constrain, self.damping = objective.body.skeleton.clip, objective.damping
        self._even_samples = objective.spread()
        self._even_voxels = np.arange(0, self.voxel_count, max(self.voxel_count // 600, 1), dtype=np.int32)
        self._looks: dict[bytes, _Look] = {}
        self._fits: dict[bytes, Fit] = {}
        self._pools: list[Ints] = []

    def full(self) -> Callable[[Float, Float, int], Evaluation]:
        """Return the objective of all degrees of freedom; new samples, alike in all rows, each iteration number."""

        def draw(rows: int) -> tuple[Ints, Ints]:
            samples, voxels = self.draw_all()
            return np.repeat(samples[None], rows, 0), np.repeat(voxels[None], rows, 0)

        return self._objective(draw, lambda term, rows: np.repeat(term.draw(self.rng)[None], rows, 0))

    def chains(self, owner: NDArray[np.intp], pose: Float) -> Callable[[Float, Float, int], Evaluation]:
        """Return an objective whose row b is chain ``owner[b]``, with voxels as :meth:`assign_voxels` gives them."""
        self.assign_voxels(pose)

        def draw(_: int) -> tuple[Ints, Ints]:
            samples, voxels = zip(*(self.draw_chain(c) for c in range(len(CHAINS))), strict=True)
            return np.stack(samples)[owner], np.stack(voxels)[owner]

        return self._objective(draw, lambda term, _: term.draw_chains(self.rng)[owner])

    def _objective(
        self, draw: Callable[[int], tuple[Ints, Ints]], draw_strips: Callable[[ContourTerm, int], Ints]
    ) -> Callable[[Float, Float, int], Evaluation]:
        """Return an objective of poses (B, D) on points drawn for B rows, anew for each iteration number, and with
        edges that are assigned anew every :data:`RENEW` calls."""
        drawn: tuple[int, tuple[Ints, Ints]] | None = None
        strips: tuple[int, Ints] | None = None
        entries: Entries | None = None
        calls = 0

        def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
            nonlocal drawn, strips, entries, calls
            if drawn is None or drawn[0] != iteration:
                drawn = iteration, draw(len(poses))
            if self.contours is not None and calls % RENEW == 0:
                if strips is None or strips[0] != iteration:
                    strips = iteration, draw_strips(self.contours, len(poses))
                entries = self.edge_entries(poses, strips[1])
            calls += 1
            return self.objective.evaluate(self.index, *drawn[1], poses, directions, entries)[0]

        return evaluate

    def value(self, pose: Float) -> float:
        """Return the objective at ``pose`` (D,) on evenly spread samples and voxels."""
        return float(self.values(pose[None])[0])

    def values(self, poses: Float) -> Float:
        """Return the objective (B,) at poses (B, D) on evenly spread samples and voxels."""
        unknown = [pose for pose in poses if pose.tobytes() not in self._looks]
        if unknown:
            self._look(np.array(unknown))
        return np.array([self._looks[pose.tobytes()].value for pose in poses])

    def curvature(self, pose: Float) -> Float:
        """Return the Gauss-Newton Hessian (D, D) at ``pose`` (D,), outliers weighing at least :data:`OUTLIERS`."""
        return self.fit(pose).linear.hessian + np.diag(self.objective.stiffness)

    def fit(self, pose: Float) -> Fit:
        """Return the fit of ``pose`` (D,) on samples that do not change from call to call."""
        key = pose.tobytes()
        if key not in self._fits:
            value, samples, voxels = self.value(pose), self._even_samples, self._even_voxels
            _, held, entries = self._looks[key]
            linear = self.objective.kernel.linearise(
                self.index, samples, voxels, pose, held, self.objective.settings, OUTLIERS, entries=entries
            )
            self._fits[key] = Fit(value, linear, samples, voxels, held)
        return self._fits[key]

    def _look(self, poses: Float) -> None:
        """Evaluate poses (B, D) on the evenly spread samples and store the results."""
        B = len(poses)
        entries = None
        if self.contours is not None:
            entries = self.edge_entries(poses, np.repeat(self.contours.draw(None)[None], B, 0))
        points = np.repeat(self._even_samples[None], B, 0), np.repeat(self._even_voxels[None], B, 0)
        found, held = self.objective.evaluate(self.index, *points, poses, None, entries)
        for b, pose in enumerate(poses):
            own = Held(held.assigned[b : b + 1], held.covering[b : b + 1])
            edges = None if entries is None else entries[b : b + 1]
            self._looks[pose.tobytes()] = _Look(float(found.value[b]), own, edges)

    def assign_voxels(self, pose: Float) -> None:
        """Give each chain the voxels that it may have to cover at ``pose``: the voxels nearest to it or to no piece."""
        fit = self.fit(pose)
        if self.objective.settings.coverage_weight <= 0:
            self._pools = [np.zeros(1, np.int32)] * len(CHAINS)
            return
        piece = fit.held.covering[0, : len(fit.voxels), 0].astype(np.int64)
        nearest = np.where(piece >= 0, self.objective.piece_chain[piece], -1)
        pools = [fit.voxels[(nearest == c) | fit.beyond(NEAR_M)] for c in range(len(CHAINS))]
        self._pools = [pool if len(pool) else fit.voxels for pool in pools]

    def draw_all(self) -> tuple[Ints, Ints]:
        """Draw at random: return indices (M,) of samples on the whole body and (Q,) of surface voxels."""
        objective = self.objective
        voxels = self.rng.integers(self.voxel_count, size=objective.scale * COVERAGE_VOXELS).astype(np.int32)
        return objective.draw(self.rng), voxels

    def draw_chain(self, chain: int) -> tuple[Ints, Ints]:
        """Draw at random: return indices (M,) of a chain's samples and (Q,) of voxels that it may have to cover.

        See :meth:`assign_voxels`.
        """
        # a chain with fewer samples repeats some: all rows have one length
        count, pool = self.objective.scale * CHAIN_SAMPLES, self._pools[chain]
        samples = np.resize(pick(self.rng, self.objective.samples[1 + chain], count), count)
        size = self.objective.scale * COVERAGE_VOXELS // len(CHAINS)
        return samples, pool[self.rng.integers(len(pool), size=size)]

    def edge_entries(self, poses: Float, chosen: Ints) -> Entries:
        """Return the entries (B, E, 16) of the edge term at poses (B, D) for the chosen strips (B, K)."""
        assert self.images is not None and self.contours is not None
        return self.contours.assign(self.images, poses, chosen)
