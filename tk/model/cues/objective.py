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

from tk.errors import ConfigError
from tk.kernels.linearisation import Linearisation
from tk.kernels.nearest import SurfaceIndex
from tk.kernels.objective import Held, ObjectiveKernel, ObjectiveParameters
from tk.model.body.joints import CHAIN_OF_SEGMENT, CHAINS, SEGMENTS
from tk.model.body.superellipsoid_body import SuperellipsoidBody
from tk.model.cues.edge_term import RENEW, ContourTerm
from tk.settings import ObjectiveSettings

Float = NDArray[np.float64]
Ints = NDArray[np.int32]

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


# Search radius of a sample for its voxel, and of a voxel for the body, metres. At 0.3 m and σ = 0.1 m a pair's weight
# is e^-13, so a larger radius costs time only; a smaller one ignores pairs that still pull.
REACH_M, COVERAGE_REACH_M = 0.3, 0.5
# Leclerc's ν of the coverage term, as a multiple of the surface term's: voxels of a limb that the body has left are far
# away. Chosen on the development captures; sensitivity not measured.
COVERAGE_SOFTNESS = 2.0
# Minimum weight of a pair in the Hessian, so that a limb far from its data keeps some curvature; at 0 its steps grow
# without bound. Chosen on the development captures; sensitivity not measured.
OUTLIERS = 0.1
# Leclerc's ν of eq. 9, in units of ½ (d/σ)². The paper prints none; chosen on the development captures, sensitivity not
# measured.
SURFACE_NU = 0.35


def objective_parameters(settings: ObjectiveSettings) -> ObjectiveParameters:
    """Return what the kernel takes."""
    return ObjectiveParameters(
        nu=SURFACE_NU,
        reach_m=REACH_M,
        coverage_weight=settings.coverage_weight,
        coverage_nu=COVERAGE_SOFTNESS * SURFACE_NU,
        coverage_reach_m=COVERAGE_REACH_M,
        surface_weight=settings.surface_weight,
    )


@dataclass(frozen=True)
class SamplingSettings:
    """How many points an evaluation uses (section 6.4: 60 on the torso, 20 on each limb and the head).

    Attributes:
        torso: surface samples on the torso.
        chain: surface samples on the head and on each limb.
        voxels: voxels of the coverage term in the optimisation of all degrees of freedom; each chain has its share.
        sigma_m: σ of eq. 10 for every sample, metres; 0 takes the limb's diameter, as the paper does. Distances on the
            trunk and on an arm are equally uncertain: both come from the same voxels. In units of the diameter the
            trunk, five times as thick, weighs a twenty-fifth and follows the arms.
        scale: factor of all numbers of points in the optimisation, contour points included (section 7.3).
    """

    torso: int = 60
    chain: int = 20
    voxels: int = 150
    sigma_m: float = 0.1
    scale: int = 1

    def __post_init__(self) -> None:
        if min(self.torso, self.chain, self.voxels // len(CHAINS), self.scale) < 1 or self.sigma_m < 0:
            raise ConfigError("sampling: numbers of points and scale must be at least 1, sigma_m at least 0")


class BodyObjective:
    """The objective of one body, for any frame.

    Args:
        body: the person.
        settings: constants of the objective's kernel.
        sampling: numbers of points.
        contours: the edge term, if it counts.
        dtype: precision of the kernel.
        waist_stiffness: see :data:`tk.trackers.volumetric.WAIST_COST`.
    """

    def __init__(
        self,
        body: SuperellipsoidBody,
        settings: ObjectiveParameters,
        sampling: SamplingSettings,
        contours: ContourTerm | None = None,
        dtype: type = np.float32,
        waist_stiffness: float = 0.0,
    ) -> None:
        self.body = body
        self.stiffness = waist_stiffness * body.skeleton.stiffness
        self.settings = settings
        self.sampling = sampling
        self.contours = contours
        skeleton, pieces = body.skeleton, body.pieces
        fixed = sampling.sigma_m
        self.piece_segment = np.array([SEGMENTS.index(p.segment) for p in pieces])
        self.kernel = ObjectiveKernel(
            body.arrays,
            local=body.points,
            last_dof=skeleton.segment_dof[body.segment],
            sigma=np.full(len(body.points), fixed) if fixed else body.diameter,
            patch=body.patch,
            piece_sigma=np.array([fixed or p.diameter_m for p in pieces]),
            piece_patches=piece_patches(body),
            barred=BARRED[body.segment],
            piece_part=CHAIN_OF_SEGMENT[self.piece_segment] + 1,
            cameras=None if contours is None else contours.cameras,
            dtype=dtype,
        )
        chain = CHAIN_OF_SEGMENT[body.segment]
        self.torso_samples = np.flatnonzero(chain < 0).astype(np.int32)
        self.chain_samples = [np.flatnonzero(chain == c).astype(np.int32) for c in range(len(CHAINS))]
        self.chain_free = np.array([skeleton.chain_dofs(c) for c in CHAIN_NAMES])

    def draw(self, rng: np.random.Generator, scale: int = 1) -> Ints:
        """Draw surface samples (M,) at random in the proportions of section 6.4, ``scale`` times as many."""
        parts = [pick(rng, self.torso_samples, scale * self.sampling.torso)]
        parts += [pick(rng, samples, scale * self.sampling.chain) for samples in self.chain_samples]
        return np.concatenate(parts)

    def spread(self, scale: int = 2) -> Ints:
        """Return surface samples (M,) evenly over the body, the same at every call."""
        parts = [even(self.torso_samples, scale * self.sampling.torso)]
        parts += [even(samples, scale * self.sampling.chain) for samples in self.chain_samples]
        return np.concatenate(parts)

    def damping(self, lever_m: float) -> Float:
        """Return the curvature (D,) of f along each parameter if all points lay ``lever_m`` from its axis."""
        s = self.settings
        sigma = self.sampling.sigma_m or float(np.median(self.body.diameter))
        unit = (1 / s.nu + s.coverage_weight / s.coverage_nu) / sigma**2
        return unit * np.where(self.body.skeleton.prismatic, 1.0, lever_m**2)

    def with_stiffness(
        self, poses: Float, directions: Float | None, value: Float, gradient: Float, product: Float
    ) -> Evaluation:
        """Return an evaluation at poses (B, D) with the cost of the waist's angles added."""
        k = self.stiffness
        if not k.any():
            return Evaluation(value, gradient, product)
        return Evaluation(
            value + 0.5 * np.square(poses) @ k,
            gradient + k * poses,
            product if directions is None else product + k * directions,
        )


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
    if count >= len(samples):
        return samples
    return samples[rng.permutation(len(samples))[:count]]


def even(samples: Ints, count: int) -> Ints:
    """Return ``count`` of the samples at equal steps, all of them if there are no more."""
    if count >= len(samples):
        return samples
    return samples[(np.arange(count) * len(samples)) // count]


class Evaluation(NamedTuple):
    """An objective at B poses: value (B,), gradient (B, D), Hessian-vector product (B, D)."""

    value: Float
    gradient: Float
    hessian_vector: Float


# Distance from the body above which a voxel is unexplained, metres: the σ of a sample (SamplingSettings.sigma_m).
UNEXPLAINED_M = 0.1
# Distance from the nearest piece above which a voxel may belong to another piece, metres: voxels lie 2 to 3 cm from the
# piece that they belong to.
UNCLAIMED_M = 0.05


@dataclass(frozen=True)
class Fit:
    """The pairs and the objective of a frame at one pose.

    Attributes:
        value: the objective over evenly spread samples and voxels.
        linear: the linearisation at the pose (M + Q pairs).
        held: its assignments.
        samples: (M,) the samples used.
        voxels: (Q,) the voxels used.
        entries: (1, E, 16) of the edge term, if it counts.
    """

    value: float
    linear: Linearisation
    held: Held
    samples: Ints
    voxels: Ints
    entries: NDArray[np.floating] | None = None

    @property
    def unmatched(self) -> NDArray[np.bool_]:
        """(M,) bool, samples without a voxel within σ."""
        M = len(self.samples)
        distance2 = np.sum(self.linear.residual[:M] ** 2, axis=1)
        return (self.linear.partner[:M] < 0) | (distance2 * self.linear.inv_sigma2[:M] > 1)

    @property
    def unexplained(self) -> NDArray[np.bool_]:
        """(Q,) bool, voxels farther than :data:`UNEXPLAINED_M` from the body."""
        M = len(self.samples)
        if len(self.linear.residual) == M:
            return np.zeros(len(self.voxels), bool)
        return (self.linear.partner[M:] < 0) | (np.linalg.norm(self.linear.residual[M:], axis=1) > UNEXPLAINED_M)

    @property
    def unexplained_share(self) -> float:
        """Share of the voxels that are unexplained."""
        unexplained = self.unexplained
        return float(unexplained.mean()) if len(unexplained) else 0.0


class _Look(NamedTuple):
    """A pose's value on the evenly spread samples, with its assignments."""

    value: float
    held: Held
    entries: NDArray[np.floating] | None


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
        self.objective = objective
        self.index = index
        self.rng = rng
        self.contours = None if images is None else objective.contours
        self.images = images
        self.voxel_count = len(index.positions)
        self.free = objective.chain_free
        self.angular = ~objective.body.skeleton.prismatic
        self._even_samples = objective.spread()
        self._even_voxels = np.arange(0, self.voxel_count, max(self.voxel_count // 600, 1), dtype=np.int32)
        self._looks: dict[bytes, _Look] = {}
        self._fits: dict[bytes, Fit] = {}
        self._pools: list[Ints] = []

    def constrain(self, poses: Float) -> Float:
        """Map poses (B, D) into the joints' limits (eq. 22)."""
        return self.objective.body.skeleton.clip(poses)

    def damping(self, lever_m: float) -> Float:
        """See :meth:`BodyObjective.damping`."""
        return self.objective.damping(lever_m)

    def full(self) -> Callable[[Float, Float, int], Evaluation]:
        """Return the objective of all degrees of freedom; new samples, alike in all rows, each iteration number."""
        draws = _Draws(self.draw_all)
        renewed = self._renewing(lambda B: np.repeat(self._term.draw(self.rng)[None], B, 0))

        def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
            samples, voxels = draws(iteration)
            B = len(poses)
            rows = np.repeat(samples[None], B, 0), np.repeat(voxels[None], B, 0)
            return self._evaluate(*rows, poses, directions, renewed(poses, iteration))

        return evaluate

    def chains(self, owner: NDArray[np.intp], pose: Float) -> Callable[[Float, Float, int], Evaluation]:
        """Return an objective whose row b is chain ``owner[b]``, with voxels as :meth:`assign_voxels` gives them."""
        self.assign_voxels(pose)
        draws = _Draws(lambda: self._draw_chains(owner))
        renewed = self._renewing(lambda _: self._term.draw_chains(self.rng)[owner])

        def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
            return self._evaluate(*draws(iteration), poses, directions, renewed(poses, iteration))

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
        return self._linearise(pose).hessian + np.diag(self.objective.stiffness)

    def fit(self, pose: Float) -> Fit:
        """Return the fit of ``pose`` (D,) on samples that do not change from call to call."""
        key = pose.tobytes()
        if key not in self._fits:
            linear = self._linearise(pose)
            look = self._looks[key]
            self._fits[key] = Fit(look.value, linear, look.held, self._even_samples, self._even_voxels, look.entries)
        return self._fits[key]

    def _look(self, poses: Float) -> None:
        """Evaluate poses (B, D) on the evenly spread samples and store the results."""
        B = len(poses)
        entries = None
        if self.contours:
            entries = self.edge_entries(poses, np.repeat(self._term.draw(None)[None], B, 0))
        value, gradient, product, held = self.objective.kernel.evaluate(
            self.index,
            np.repeat(self._even_samples[None], B, 0),
            np.repeat(self._even_voxels[None], B, 0),
            poses,
            None,
            self.objective.settings,
            entries=entries,
        )
        value = self.objective.with_stiffness(poses, None, value, gradient, product).value
        for b, pose in enumerate(poses):
            own = Held(held.assigned[b : b + 1], held.covering[b : b + 1])
            self._looks[pose.tobytes()] = _Look(float(value[b]), own, None if entries is None else entries[b : b + 1])

    def _linearise(self, pose: Float) -> Linearisation:
        self.values(pose[None])
        look = self._looks[pose.tobytes()]
        return self.objective.kernel.linearise(
            self.index,
            self._even_samples,
            self._even_voxels,
            pose,
            look.held,
            self.objective.settings,
            OUTLIERS,
            entries=look.entries,
        )

    def assign_voxels(self, pose: Float) -> None:
        """Give each chain the voxels that it may have to cover at ``pose``: the voxels nearest to it or to no piece."""
        fit = self.fit(pose)
        if self.objective.settings.coverage_weight <= 0:
            self._pools = [np.zeros(1, np.int32)] * len(CHAINS)
            return
        piece = fit.held.covering[0, : len(fit.voxels), 0].astype(np.int64)
        nearest = np.where(piece >= 0, CHAIN_OF_SEGMENT[self.objective.piece_segment[piece]], -1)
        M = len(fit.samples)
        unclaimed = np.linalg.norm(fit.linear.residual[M:], axis=1) > UNCLAIMED_M
        pools = [fit.voxels[(nearest == c) | fit.unexplained | unclaimed] for c in range(len(CHAINS))]
        self._pools = [pool if len(pool) else fit.voxels for pool in pools]

    def draw_all(self) -> tuple[Ints, Ints]:
        """Draw at random: return indices (M,) of samples on the whole body and (Q,) of surface voxels."""
        s = self.objective.sampling
        voxels = self.rng.integers(self.voxel_count, size=s.scale * s.voxels).astype(np.int32)
        return self.objective.draw(self.rng, s.scale), voxels

    def draw_chain(self, chain: int) -> tuple[Ints, Ints]:
        """Draw at random: return indices (M,) of a chain's samples and (Q,) of voxels that it may have to cover.

        See :meth:`assign_voxels`.
        """
        s = self.objective.sampling
        # a chain with fewer samples repeats some: all rows have one length
        count = s.scale * s.chain
        samples = np.resize(pick(self.rng, self.objective.chain_samples[chain], count), count)
        pool = self._pools[chain]
        return samples, pool[self.rng.integers(len(pool), size=s.scale * s.voxels // len(CHAINS))]

    def _draw_chains(self, owner: NDArray[np.intp]) -> tuple[Ints, Ints]:
        samples, voxels = zip(*(self.draw_chain(c) for c in range(len(CHAINS))), strict=True)
        return np.stack(samples)[owner], np.stack(voxels)[owner]

    @property
    def _term(self) -> ContourTerm:
        assert self.contours is not None
        return self.contours

    def edge_entries(self, poses: Float, chosen: Ints) -> NDArray[np.floating]:
        """Return the entries (B, E, 16) of the edge term at poses (B, D) for the chosen strips (B, K)."""
        assert self.images is not None
        return self._term.assign(self.images, poses, chosen)

    def _renewing(self, draw: Callable[[int], Ints]) -> Callable[[Float, int], NDArray[np.floating] | None]:
        """Return the edge term's entries as a function of poses and iteration; assigned again every RENEW calls."""
        drawn: tuple[int, Ints] | None = None
        last: NDArray[np.floating] | None = None
        calls = 0

        def entries(poses: Float, iteration: int) -> NDArray[np.floating] | None:
            nonlocal drawn, last, calls
            if self.contours is None:
                return None
            # calls are counted: without shuffling the iteration number does not change
            if last is None or calls % RENEW == 0:
                if drawn is None or drawn[0] != iteration:
                    drawn = iteration, draw(len(poses))
                last = self.edge_entries(poses, drawn[1])
            calls += 1
            return last

        return entries

    def _evaluate(
        self,
        samples: Ints,
        voxels: Ints,
        poses: Float,
        directions: Float | None,
        entries: NDArray[np.floating] | None = None,
    ) -> Evaluation:
        value, gradient, product, _ = self.objective.kernel.evaluate(
            self.index, samples, voxels, poses, directions, self.objective.settings, entries=entries
        )
        return self.objective.with_stiffness(poses, directions, value, gradient, product)


class _Draws:
    """The samples of an iteration number; the same number gives the same samples."""

    def __init__(self, draw: Callable[[], tuple[Ints, Ints]]) -> None:
        self._draw = draw
        self._iteration: int | None = None
        self._last: tuple[Ints, Ints] | None = None

    def __call__(self, iteration: int) -> tuple[Ints, Ints]:
        if self._last is None or iteration != self._iteration:
            self._last, self._iteration = self._draw(), iteration
        return self._last
