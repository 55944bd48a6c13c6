"""A body's objective in one frame (Kehl 2006, section 6.1): draw samples and voxels, evaluate them by the kernel.

The optimisers see only callables of poses (:meth:`FrameObjective.full`, :meth:`FrameObjective.chains`), no voxels,
colours or samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tk.kernels.nearest import SurfaceIndex
from tk.kernels.objective import Evaluation, Held, Linearisation, ObjectiveKernel, ObjectiveParameters
from tk.model.body.joints import CHAIN_OF_SEGMENT, CHAINS, SEGMENTS
from tk.model.body.superellipsoid_body import SuperellipsoidBody
from tk.model.cues.edge_term import RENEW, SIGMA_M, ContourTerm

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
# that still pull.
REACH_M = 0.3
# Leclerc's ν of eq. 9, in units of ½ (d/σ)². The paper prints none.
SURFACE_NU = 0.35
# Leclerc's ν of the coverage term, as a multiple of the surface term's: voxels of a limb that the body has left are far
# away.
COVERAGE_SOFTNESS = 2.0
# Minimum weight of a pair in the Hessian, so that a limb far from its data keeps some curvature; at 0 its steps grow
# without bound.
OUTLIERS = 0.1
# Voxels on which poses are compared, evenly spread. More cost time only.
EVEN_VOXELS = 600
# A voxel farther than this from the nearest piece may belong to another one, metres: voxels lie 2 to 3 cm from their
# piece.
NEAR_M = 0.05


class BodyObjective:
    """The objective of one body, for any frame.

    Args:
        body: the person.
        coverage_weight: weight of the coverage term beside the surface term's 1; 0 leaves it out, as in the paper.
        contours: the edge term; None without it.
        scale: factor of all numbers of points in the optimisation (section 7.3).
        dtype: precision of the kernel.
    """

    def __init__(
        self,
        body: SuperellipsoidBody,
        coverage_weight: float,
        contours: ContourTerm | None = None,
        scale: int = 1,
        dtype: type = np.float32,
    ) -> None:
        self.body, self.contours, self.scale = body, contours, scale
        self.settings = ObjectiveParameters(
            sigma_m=SIGMA_M,
            reach_m=REACH_M,
            nu=SURFACE_NU,
            coverage_nu=COVERAGE_SOFTNESS * SURFACE_NU,
            coverage_weight=coverage_weight,
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


def piece_patches(body: SuperellipsoidBody) -> NDArray[np.int64]:
    """Return bit masks (P,) of the colour patches on each piece; a piece without samples has its segment's patches."""
    masks = np.zeros(len(body.pieces), np.int64)
    for index, piece in enumerate(body.pieces):
        mine = body.piece == index
        if not mine.any():
            mine = body.segment == SEGMENTS.index(piece.segment)
        masks[index] = np.bitwise_or.reduce(np.int64(1) << np.unique(body.patch[mine]).astype(np.int64))
    return masks


def _present(strips: Ints) -> Ints:
    """Return the strips (K,) of all chains, from :meth:`ContourTerm.draw`."""
    return strips[strips >= 0]


def pick(rng: np.random.Generator, samples: Ints, count: int) -> Ints:
    """Draw ``count`` of the samples at random, all of them if there are no more."""
    return samples if count >= len(samples) else samples[rng.permutation(len(samples))[:count]]


def even(samples: Ints, count: int) -> Ints:
    """Return ``count`` of the samples at equal steps, all of them if there are no more."""
    return samples if count >= len(samples) else samples[(np.arange(count) * len(samples)) // count]


@dataclass(frozen=True, eq=False)
class Fit:
    """The objective of a frame at one pose, over evenly spread samples (M) and voxels (Q)."""

    frame: FrameObjective
    pose: Float  # (D,)
    value: float
    held: Held  # the assignments
    entries: Entries | None  # (1, E, 16) of the edge term

    @cached_property
    def linear(self) -> Linearisation:
        """The pairs and the Gauss-Newton Hessian, outliers weighing at least :data:`OUTLIERS`."""
        frame, body = self.frame, self.frame.objective
        return body.kernel.linearise(
            frame.index, *frame.even[:2], self.pose, self.held, body.settings, OUTLIERS, entries=self.entries
        )

    @property
    def unmatched(self) -> NDArray[np.bool_]:
        """(M,) bool, samples without a voxel within σ."""
        return self._beyond(SIGMA_M)[: len(self.frame.even[0])]

    def beyond(self, distance_m: float) -> NDArray[np.bool_]:
        """Return (Q,) True for voxels farther than this from the body, with the coverage term."""
        return self._beyond(distance_m)[len(self.frame.even[0]) :]

    def _beyond(self, distance_m: float) -> NDArray[np.bool_]:
        linear = self.linear
        return (linear.partner < 0) | (np.linalg.norm(linear.residual, axis=1) > distance_m)


class FrameObjective:
    """The objective of one body in one frame: a :class:`tk.optim.schedule.Problem`.

    Args:
        objective: the body's objective.
        index: the frame's surface voxels.
        rng: random generator of the samples.
        images: (C, H, W, 3) for the edge term; None without that term.
        cameras: (C,) bool, cameras that show the person, for the same; None: all.

    Attributes:
        even: (M,), (Q,), (K,) samples, voxels and strips, evenly spread.
    """

    def __init__(
        self,
        objective: BodyObjective,
        index: SurfaceIndex,
        rng: np.random.Generator,
        images: NDArray[np.uint8] | None = None,
        cameras: NDArray[np.bool_] | None = None,
    ) -> None:
        self.objective, self.index, self.rng, self.images, self.cameras = objective, index, rng, images, cameras
        self.contours = None if images is None else objective.contours
        self.free = objective.chain_free
        self.angular = ~objective.body.skeleton.prismatic
        self.constrain, self.damping = objective.body.skeleton.clip, objective.damping
        count = len(index.positions)
        voxels = np.arange(0, count, max(count // EVEN_VOXELS, 1), dtype=np.int32)
        self.even = objective.spread(), voxels, _present(self._strips(None))
        self._fits: dict[bytes, Fit] = {}

    def full(self) -> Callable[[Float, Float, int], Evaluation]:
        """Return the objective of all degrees of freedom; new samples, alike in all rows, each iteration number."""
        return self._objective(lambda rows: tuple(np.repeat(drawn[None], rows, 0) for drawn in self.draw_all()))

    def chains(self, owner: NDArray[np.intp], pose: Float) -> Callable[[Float, Float, int], Evaluation]:
        """Return an objective whose row b is chain ``owner[b]``, with voxels as :meth:`chain_voxels` gives them."""
        pools = self.chain_voxels(pose)
        return self._objective(lambda _: tuple(drawn[owner] for drawn in self.draw_chains(pools)))

    def _objective(self, draw: Callable[[int], tuple[Ints, ...]]) -> Callable[[Float, Float, int], Evaluation]:
        """Return an objective of poses (B, D) on samples, voxels and strips that are drawn for B rows, anew for each
        iteration number; edges are assigned anew every :data:`RENEW` calls."""
        samples = voxels = strips = np.zeros((0, 0), np.int32)
        entries: Entries | None = None
        last: int | None = None
        calls = 0

        def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
            nonlocal samples, voxels, strips, entries, last, calls
            if iteration != last:
                last, (samples, voxels, strips) = iteration, draw(len(poses))
            if calls % RENEW == 0:
                entries = self.edge_entries(poses, strips)
            calls += 1
            return self._evaluate(samples, voxels, poses, directions, entries)

        return evaluate

    def _evaluate(
        self, samples: Ints, voxels: Ints, poses: Float, directions: Float | None, entries: Entries | None
    ) -> Evaluation:
        body = self.objective
        return body.kernel.evaluate(self.index, samples, voxels, poses, directions, body.settings, entries=entries)

    def value(self, pose: Float) -> float:
        """Return the objective at ``pose`` (D,) on evenly spread samples and voxels."""
        return self.fit(pose).value

    def values(self, poses: Float) -> Float:
        """Return the objective (B,) at poses (B, D) on evenly spread samples and voxels."""
        unknown = np.array([pose for pose in poses if pose.tobytes() not in self._fits])
        if len(unknown):
            samples, voxels, strips = (np.repeat(indices[None], len(unknown), 0) for indices in self.even)
            entries = self.edge_entries(unknown, strips)
            value, _, _, held = self._evaluate(samples, voxels, unknown, None, entries)
            for b, pose in enumerate(unknown):
                own = Held(held.assigned[b : b + 1], held.covering[b : b + 1])
                edges = None if entries is None else entries[b : b + 1]
                self._fits[pose.tobytes()] = Fit(self, pose, float(value[b]), own, edges)
        return np.array([self._fits[pose.tobytes()].value for pose in poses])

    def fit(self, pose: Float) -> Fit:
        """Return the fit of ``pose`` (D,); it is stored for the next call."""
        self.values(pose[None])
        return self._fits[pose.tobytes()]

    def curvature(self, pose: Float) -> Float:
        """Return the Gauss-Newton Hessian (D, D) at ``pose`` (D,), outliers weighing at least :data:`OUTLIERS`."""
        return self.fit(pose).linear.hessian

    def chain_curvatures(self, pose: Float) -> Float:
        """Return the Gauss-Newton Hessian (chains, D, D) of each chain's objective at ``pose`` (D,): that of the mean
        over the chain's own samples, voxels and strips. Assignments are those of :meth:`fit`."""
        body, held, (samples, voxels, _) = self.objective, self.fit(pose).held, self.even
        covers = body.settings.coverage_weight > 0
        chain = CHAIN_OF_SEGMENT[body.body.segment[samples]]
        entries = self.edge_entries(np.repeat(pose[None], len(CHAINS), 0), self._strips(None))
        hessians = []
        for c, pool in enumerate(self._pools(pose)):
            own = np.flatnonzero(chain == c)
            edges = None if entries is None else entries[c : c + 1]
            part = Held(held.assigned[:, own], held.covering[:, pool] if covers else held.covering)
            points = samples[own], voxels[pool]
            found = body.kernel.linearise(self.index, *points, pose, part, body.settings, OUTLIERS, entries=edges)
            hessians.append(found.hessian)
        return np.stack(hessians)

    def chain_voxels(self, pose: Float) -> list[Ints]:
        """Return the voxels that each chain may have to cover at ``pose``: the nearest to it or to no piece."""
        return [self.even[1][pool] for pool in self._pools(pose)]

    def _pools(self, pose: Float) -> list[NDArray[np.intp]]:
        """Return the places of :meth:`chain_voxels` among the evenly spread voxels."""
        fit, every = self.fit(pose), np.arange(len(self.even[1]))
        if self.objective.settings.coverage_weight <= 0:
            return [every] * len(CHAINS)
        piece = fit.held.covering[0, :, 0].astype(np.int64)
        nearest = np.where(piece >= 0, self.objective.piece_chain[piece], -1)
        pools = [np.flatnonzero((nearest == c) | fit.beyond(NEAR_M)) for c in range(len(CHAINS))]
        return [pool if len(pool) else every for pool in pools]

    def draw_all(self) -> tuple[Ints, Ints, Ints]:
        """Draw at random: samples (M,) on the whole body, surface voxels (Q,) and strips (K,)."""
        count = self.objective.scale * COVERAGE_VOXELS
        voxels = self.rng.integers(len(self.index.positions), size=count).astype(np.int32)
        return self.objective.draw(self.rng), voxels, _present(self._strips(self.rng))

    def draw_chains(self, pools: Sequence[Ints]) -> tuple[Ints, Ints, Ints]:
        """Draw at random for each chain: samples (chains, M), voxels (chains, Q) from its pool, strips (chains, K)."""
        scale, rng = self.objective.scale, self.rng
        count, size = scale * CHAIN_SAMPLES, scale * COVERAGE_VOXELS // len(CHAINS)
        # a chain with fewer samples repeats some: all rows have one length
        samples = [np.resize(pick(rng, own, count), count) for own in self.objective.samples[1:]]
        voxels = [pool[rng.integers(len(pool), size=size)] for pool in pools]
        return np.stack(samples), np.stack(voxels), self._strips(rng)

    def _strips(self, rng: np.random.Generator | None) -> Ints:
        """Return strips (chains, K) of the edge term: at random, or evenly spread without a generator."""
        return np.zeros((len(CHAINS), 0), np.int32) if self.contours is None else self.contours.draw(rng)

    def edge_entries(self, poses: Float, strips: Ints) -> Entries | None:
        """Return the entries (B, E, 16) of the edge term at poses (B, D) for strips (B, K); None without the term."""
        if self.contours is None or self.images is None:
            return None
        return self.contours.assign(self.images, poses, strips, self.cameras)
