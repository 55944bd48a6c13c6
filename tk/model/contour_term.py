"""The model's contours against the pictures: which contour points are used, and what edges they get (Kehl 2006, 6.1.2).

Two cues share the contour points (:mod:`tk.kernels.contour`):

edges
    the paper's: colour edges for the limbs' symmetric pairs, in the three views with the fewest hidden points.
outline
    the foreground masks' boundary for contour points on the outline of the whole body, trunk and head too, in every
    view (:mod:`tk.kernels.outline`). Not in the paper: what the hull says of a limb is as coarse as its voxels, and
    bulky where views are few.

Both come out as entries (:mod:`tk.kernels.alignment`) that hold until they are assigned anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.kernels import alignment
from tk.kernels.contour import ContourPoints
from tk.kernels.edge_search import LINE_NUMBERS, PAIR, SINGLE, search_edges
from tk.kernels.edges import EdgeConfig
from tk.kernels.outline import OutlineKernel, OutlineSettings
from tk.kernels.projection import pack_camera
from tk.model.body import Body
from tk.model.camera import Rig
from tk.model.skeleton import CHAINS
from tk.model.strips import LIMBS, Strips, build_strips, contour_kernel

Float = NDArray[np.float64]
Ints = NDArray[np.int32]


@dataclass(frozen=True)
class ContourConfig:
    """Settings of the contour cues.

    Attributes:
        edge_weight: w_e (eq. 8) of colour edges beside the surface term's 1; 0 leaves them out.
        outline_weight: the same for the masks' outlines.
        views: how many views colour edges are looked for in: those with the fewest hidden contour points.
        pairs: circles of latitude on each limb; the paper takes 10 contour points a limb and view.
        trunk_circles, head_circles: circles on each half of the trunk and on the head, for the outline.
        extremity_circles: on each hand and foot, for the outline; 0 for bodies without.
        reach_m: how far from the contour edges are looked for, metres at the limb.
        outline_reach_m: the same for the outline.
        threshold: least colour gradient of an edge, 0…1.
        mask_edge: strength of a mask's boundary among colour edges; 0 keeps to the paper.
        sigma_m: σ of eqs. 13 and 15, metres at the limb; 0 takes the limb's diameter, as the paper does.
        edge_nu, outline_nu: Leclerc's ν, in units of ½ (d/σ)².
        along: weight of the distance along the contour; 1 is the paper's distance.
        hidden: ρ of a hidden contour point in the edge term; 1 is the paper's.
        renew: iterations after which edges are assigned anew.
    """

    edge_weight: float = 0.0
    outline_weight: float = 1.5
    views: int = 3
    pairs: int = 3
    trunk_circles: int = 3
    head_circles: int = 3
    extremity_circles: int = 2
    reach_m: float = 0.08
    outline_reach_m: float = 0.15
    threshold: float = 0.12
    mask_edge: float = 0.0
    sigma_m: float = 0.1
    edge_nu: float = 0.1
    outline_nu: float = 0.1
    along: float = 0.0
    hidden: float = 1.0
    renew: int = 5

    def __post_init__(self) -> None:
        for name in ("edge_weight", "outline_weight", "threshold", "mask_edge", "sigma_m", "extremity_circles"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"contours.{name} = {getattr(self, name)} must not be negative")
        for name in (
            "views",
            "pairs",
            "trunk_circles",
            "head_circles",
            "reach_m",
            "outline_reach_m",
            "edge_nu",
            "outline_nu",
            "renew",
        ):
            if not getattr(self, name) > 0:
                raise ConfigError(f"contours.{name} = {getattr(self, name)} must be positive")
        if not 0 <= self.along <= 1:
            raise ConfigError(f"contours.along = {self.along} must lie in [0, 1]")

    def scaled(self, scale: int) -> ContourConfig:
        """The same with ``scale`` times as many contour points."""
        circles = {
            name: scale * getattr(self, name)
            for name in ("pairs", "trunk_circles", "head_circles", "extremity_circles")
        }
        return replace(self, **circles)

    @property
    def enabled(self) -> bool:
        """Whether any of the two cues counts."""
        return self.edge_weight > 0 or self.outline_weight > 0


@dataclass(frozen=True)
class Pictures:
    """One frame's pictures (C, H, W, 3) uint8 and foreground masks (C, H, W) uint8: 255 the person, 0 the scene,
    :data:`~tk.kernels.edge_search.DOUBTFUL` either."""

    images: NDArray[np.uint8]
    masks: NDArray[np.uint8]


class ContourTerm:
    """The contour cues of one body in one rig.

    Args:
        body: the person.
        rig: the cameras.
        config, edges: settings.
        dtype: precision of the contours.
    """

    def __init__(
        self, body: Body, rig: Rig, config: ContourConfig, edges: EdgeConfig, dtype: type = np.float32
    ) -> None:
        self.config = config
        self.edges = edges
        self.strips: Strips = build_strips(body)
        self.kernel = contour_kernel(body, self.strips, rig, dtype)
        self.cameras = np.array(
            [pack_camera(c.matrix, c.distortions, c.rotation, c.translation, c.fisheye) for c in rig]
        )
        self.sizes = np.array([(c.height, c.width) for c in rig], np.int32)
        self._last_dof = body.skeleton.segment_dof[self.strips.segment]
        diameter = np.array([p.diameter_m for p in body.pieces])
        self.outline = OutlineKernel(self.kernel, self.sizes, diameter)
        self._diameter = diameter[self.strips.piece]
        self._is_limb = np.isin(self.strips.piece, self.strips.limb_piece)  # hands and feet are not
        per_piece = self.strips.circles + self.strips.meridians

        def circles(segment: str, pieces: int) -> NDArray[np.int64]:
            """(pieces, circles) strips of the longest pieces of a segment."""
            longest = sorted(
                (i for i, p in enumerate(body.pieces) if p.segment == segment),
                key=lambda i: body.pieces[i].z_lower - body.pieces[i].z_upper,
            )[:pieces]
            return np.array(longest)[:, None] * per_piece + np.arange(self.strips.circles)

        # Strips come from these rows: so many of each
        limb = {s: [(circles(s, 1)[0], config.pairs)] for s in LIMBS}
        for s in LIMBS if config.extremity_circles else ():
            if s.startswith(("forearm", "calf")):  # the hand and the foot are the second longest pieces there
                limb[s].append((circles(s, 2)[1], config.extremity_circles))
            else:  # rows of one length for all chains but the head's
                limb[s].append((circles(s, 1)[0], 0))
        head = [(circles("head", 1)[0], config.head_circles)]
        self._all = (
            [(row, config.trunk_circles) for row in np.concatenate([circles("torso", 1), circles("pelvis", 1)])]
            + head
            + [row for s in LIMBS for row in limb[s]]
        )
        self._chains = [
            [(circles("head", 1)[0], 2 * config.pairs + config.extremity_circles)]
            if chain == ("head",)
            else [row for s in chain for row in limb[s]]
            for chain in CHAINS.values()
        ]

    def draw(self, rng: np.random.Generator | None) -> Ints:
        """(K,) strips of the whole body: at random, or evenly spread without a generator."""
        return np.concatenate([_some(row, count, rng) for row, count in self._all])

    def draw_chains(self, rng: np.random.Generator | None, scale: int = 1) -> Ints:
        """(chains, K) strips of each chain, ``scale`` times as many."""
        return np.stack(
            [np.concatenate([_some(row, scale * count, rng) for row, count in chain]) for chain in self._chains]
        )

    def assign(self, pictures: Pictures, poses: Float, chosen: Ints, softness: float = 1.0) -> NDArray[np.floating]:
        """(B, E, 17) entries at poses (B, D) from strips (B, K)."""
        c = self.config
        cues = []
        if c.outline_weight > 0:
            settings = OutlineSettings(c.outline_reach_m, c.sigma_m, softness * c.outline_nu, c.outline_weight)
            cues.append(self.outline(pictures.masks, poses, chosen, settings))
        if c.edge_weight > 0:
            cues.append(self._edge_entries(pictures, poses, chosen, softness))
        return cues[0] if len(cues) == 1 else np.concatenate(cues, axis=1)

    def _edge_entries(self, pictures: Pictures, poses: Float, chosen: Ints, softness: float) -> NDArray[np.floating]:
        """The colour edges' entries."""
        (pose_of, entries), lines = self._pairs(self.kernel(poses, chosen))
        found = search_edges(
            pictures.images,
            pictures.masks,
            self.sizes,
            lines,
            self.config.threshold,
            self.config.mask_edge,
            self.edges,
        )
        wanted = entries[:, alignment.STATE] == alignment.ASSIGNED
        entries[:, alignment.TARGET : alignment.TARGET + 2] = 0.5 * (found[:, 1:3] + found[:, 3:5])
        entries[wanted & (found[:, 0] == 0), alignment.STATE] = alignment.UNASSIGNABLE
        entries[:, alignment.NU] *= softness
        return _by_pose(pose_of, entries, len(poses))

    def _pairs(self, points: ContourPoints) -> tuple[tuple[Ints, NDArray[np.float32]], NDArray[np.float32]]:
        """Entries and search lines of the colour edges."""
        c = self.config
        B, C = points.visible.shape[:2]
        limb = self._is_limb[points.strip]
        hidden = np.sum((points.found != points.visible) & limb[:, None, :, None], axis=(2, 3))
        best = np.argsort(hidden, axis=1, kind="stable")[:, : c.views]
        used = np.zeros((B, C), bool)
        used[np.arange(B)[:, None], best] = True
        b, v, k = np.nonzero((points.found.any(axis=3)) & limb[:, None, :] & used[:, :, None])
        seen = points.visible[b, v, k].astype(bool)
        both, any_seen = seen.all(axis=1), seen.any(axis=1)
        first = np.where(seen[:, 0], 0, 1)
        second = np.where(both, 1, first)
        entries, lines = self._rows(points, b, v, k, first, second)
        lines[:, 0] = np.where(both, PAIR, SINGLE)
        lines[:, 10] = c.reach_m * entries[:, alignment.SHARE]  # pixels a metre, until below
        pixels_a_metre = entries[:, alignment.SHARE].copy()
        diameter = np.where(
            both, np.hypot(*(lines[:, 2:4] - lines[:, 4:6]).T), self._diameter[points.strip[b, k]] * pixels_a_metre
        )
        sigma = c.sigma_m * pixels_a_metre if c.sigma_m else np.maximum(diameter, 1.0)
        entries[:, alignment.INV_SIGMA2] = 1 / sigma**2
        entries[:, alignment.STATE] = np.where(any_seen, alignment.ASSIGNED, alignment.UNASSIGNABLE)
        entries[:, alignment.SHARE] = c.along
        entries[:, alignment.NU] = c.edge_nu
        # every contour point counts the same, whether it stands for itself or in a pair;
        # the hidden half of a half-hidden pair has an entry of its own
        found = points.found[b, v, k].sum(axis=1)
        total = np.bincount(b, found, minlength=B)
        share = c.edge_weight / total[b]
        entries[:, alignment.SCALE] = share * np.where(any_seen, seen.sum(axis=1), c.hidden * found)
        half = any_seen & (seen.sum(axis=1) < found)
        concealed = entries[half]
        concealed[:, alignment.STATE] = alignment.UNASSIGNABLE
        concealed[:, alignment.SCALE] = c.hidden * share[half]
        b = np.concatenate([b, b[half]])
        entries = np.concatenate([entries, concealed])
        lines = np.concatenate([lines, lines[half]])
        return (b.astype(np.int32), entries), lines

    def _rows(
        self,
        points: ContourPoints,
        b: NDArray[np.intp],
        v: NDArray[np.intp],
        k: NDArray[np.intp],
        first: NDArray[np.intp],
        second: NDArray[np.intp],
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Entries with points, camera, normal; their SHARE holds the pixels a metre. And the lines of the same
        points."""
        entries = np.zeros((len(b), alignment.ENTRY_NUMBERS), np.float32)
        lines = np.zeros((len(b), LINE_NUMBERS), np.float32)
        a = alignment
        entries[:, a.POINT_A : a.POINT_A + 3] = points.points_zero[b, v, k, first]
        entries[:, a.POINT_B : a.POINT_B + 3] = points.points_zero[b, v, k, second]
        entries[:, a.LAST_DOF] = self._last_dof[points.strip[b, k]]
        entries[:, a.CAMERA] = v
        entries[:, a.NORMAL : a.NORMAL + 2] = points.normals[b, v, k, first]
        entries[:, a.SHARE] = points.scale[b, v, k, first]
        lines[:, 1] = v
        lines[:, 2:4] = points.pixels[b, v, k, first]
        lines[:, 4:6] = points.pixels[b, v, k, second]
        lines[:, 6:8] = points.normals[b, v, k, first]
        lines[:, 8:10] = points.normals[b, v, k, second]
        return entries, lines


def _some(row: NDArray[np.int64], count: int, rng: np.random.Generator | None) -> Ints:
    """``count`` of the strips, at random or evenly spread."""
    if rng is None:
        picked = ((np.arange(count) + 0.5) * len(row) / count).astype(np.int64)
    else:
        # some strips twice where there are fewer than asked for: rows are of one length
        picked = np.sort(np.resize(rng.permutation(len(row)), count))
    return row[picked].astype(np.int32)


def _by_pose(pose_of: Ints, entries: NDArray[np.float32], poses: int) -> NDArray[np.float32]:
    """(B, E, 17): each pose's entries in a row, padded with absent ones."""
    if poses == 1:
        return entries[None]
    counts = np.bincount(pose_of, minlength=poses)
    order = np.argsort(pose_of, kind="stable")
    place = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    result = np.zeros((poses, max(int(counts.max()), 1), entries.shape[1]), np.float32)
    result[pose_of[order], place] = entries[order]
    return result
