"""The edge term: the model's contours against the images' colour edges (Kehl 2006, section 6.1.2).

The limbs' contour points (:mod:`tk.kernels.contour`), in the three views with the fewest hidden points, search edges
along lines (:mod:`tk.kernels.edge_search`). The results are entries of the objective (:mod:`tk.kernels.alignment`),
valid until they are assigned again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.kernels import alignment
from tk.kernels.contour import ContourPoints
from tk.kernels.edge_search import LINE_NUMBERS, PAIR, SINGLE, search_edges
from tk.kernels.edges import EdgeSettings
from tk.kernels.projection import pack_cameras
from tk.model.body.skeleton import CHAINS
from tk.model.body.strips import LIMBS, Strips, build_strips, contour_kernel
from tk.model.body.superellipsoid_body import SuperellipsoidBody
from tk.model.cameras.camera import Rig
from tk.settings import ContourSettings

Float = NDArray[np.float64]
Ints = NDArray[np.int32]
Entries = NDArray[np.float32]


# Iterations for which assigned edges are kept. The paper assigns edges at every iteration, which takes longer.
RENEW = 5
# σ of eqs. 13 and 15, metres at the limb: as SamplingSettings.sigma_m; the paper takes the limb's diameter.
SIGMA_M = 0.1
# Leclerc's ν of eq. 9, in units of ½ (d/σ)². The paper prints none; chosen on rendered captures, sensitivity not
# measured.
EDGE_NU = 0.1
# How far from the contour edges are searched, metres at the limb. Chosen on rendered captures; sensitivity not
# measured.
REACH_M = 0.08


class ContourTerm:
    """The edge term of one body in one rig.

    Args:
        body: the person.
        rig: the cameras.
        config: settings.
        scale: factor of the number of contour points (section 7.3).
        dtype: precision of the contours.
    """

    def __init__(
        self, body: SuperellipsoidBody, rig: Rig, config: ContourSettings, scale: int = 1, dtype: type = np.float32
    ) -> None:
        self.config = config
        self.gradient = EdgeSettings()
        self.strips: Strips = build_strips(body)
        self.kernel = contour_kernel(body, self.strips, rig, dtype)
        self.cameras = pack_cameras(rig)
        self.sizes = np.array([(c.height, c.width) for c in rig], np.int32)
        self._last_dof = body.skeleton.segment_dof[self.strips.segment]
        self._diameter = np.array([p.diameter_m for p in body.pieces])[self.strips.piece]
        self._is_limb = np.isin(self.strips.piece, self.strips.limb_piece)
        self._pairs_a_limb = scale * config.pairs
        # the circles of latitude of each limb's tapered piece, and of the head
        head = next(i for i, p in enumerate(body.pieces) if p.segment == "head")
        pieces = dict(zip((*LIMBS, "head"), (*self.strips.limb_piece, head), strict=True))
        per_piece, within = self.strips.circles + self.strips.meridians, np.arange(self.strips.circles)
        self._circles = {segment: piece * per_piece + within for segment, piece in pieces.items()}

    def draw(self, rng: np.random.Generator | None) -> Ints:
        """Draw strips (K,) of all limbs: at random, or evenly spread without a generator."""
        return np.concatenate([_some(self._circles[s], self._pairs_a_limb, rng) for s in LIMBS])

    def draw_chains(self, rng: np.random.Generator | None) -> Ints:
        """Draw strips (chains, K) of each chain. The head's strips find no edges (6.4); all rows have one length."""
        chains = [[s for s in chain if s in self._circles] for chain in CHAINS.values()]
        return np.stack(
            [
                np.concatenate([_some(self._circles[s], 2 * self._pairs_a_limb // len(chain), rng) for s in chain])
                for chain in chains
            ]
        )

    def assign(self, images: NDArray[np.uint8], poses: Float, chosen: Ints) -> Entries:
        """Return entries (B, E, 16) at poses (B, D) from strips (B, K) and images (C, H, W, 3)."""
        (pose_of, entries), lines = self._pairs(self.kernel(poses, chosen))
        found = search_edges(images, self.sizes, lines, self.config.threshold, self.gradient)
        wanted = entries[:, alignment.STATE] == alignment.ASSIGNED
        entries[:, alignment.TARGET : alignment.TARGET + 2] = 0.5 * (found[:, 1:3] + found[:, 3:5])
        entries[wanted & (found[:, 0] == 0), alignment.STATE] = alignment.UNASSIGNABLE
        return _by_pose(pose_of, entries, len(poses))

    def _pairs(self, points: ContourPoints) -> tuple[tuple[Ints, NDArray[np.float32]], NDArray[np.float32]]:
        """Return the pose and the entry of each contour point or pair, and the search lines."""
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
        entries, lines, pixels_a_metre = self._rows(points, b, v, k, first, second)
        lines[:, 0] = np.where(both, PAIR, SINGLE)
        lines[:, 10] = REACH_M * pixels_a_metre
        diameter = np.where(
            both, np.hypot(*(lines[:, 2:4] - lines[:, 4:6]).T), self._diameter[points.strip[b, k]] * pixels_a_metre
        )
        sigma = SIGMA_M * pixels_a_metre if SIGMA_M else np.maximum(diameter, 1.0)
        entries[:, alignment.INV_SIGMA2] = 1 / sigma**2
        entries[:, alignment.STATE] = np.where(any_seen, alignment.ASSIGNED, alignment.UNASSIGNABLE)
        entries[:, alignment.NU] = EDGE_NU
        # every contour point has the same weight, alone or in a pair; the hidden half of a pair has its own entry
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
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return entries with points, camera and normal, their search lines, and the pixels a metre there."""
        entries = np.zeros((len(b), alignment.ENTRY_NUMBERS), np.float32)
        lines = np.zeros((len(b), LINE_NUMBERS), np.float32)
        a = alignment
        entries[:, a.POINT_A : a.POINT_A + 3] = points.points_zero[b, v, k, first]
        entries[:, a.POINT_B : a.POINT_B + 3] = points.points_zero[b, v, k, second]
        entries[:, a.LAST_DOF] = self._last_dof[points.strip[b, k]]
        entries[:, a.CAMERA] = v
        entries[:, a.NORMAL : a.NORMAL + 2] = points.normals[b, v, k, first]
        lines[:, 1] = v
        lines[:, 2:4] = points.pixels[b, v, k, first]
        lines[:, 4:6] = points.pixels[b, v, k, second]
        lines[:, 6:8] = points.normals[b, v, k, first]
        lines[:, 8:10] = points.normals[b, v, k, second]
        return entries, lines, points.scale[b, v, k, first].astype(np.float32)


def _some(row: NDArray[np.integer], count: int, rng: np.random.Generator | None) -> Ints:
    """Return ``count`` of the strips, at random or evenly spread."""
    if rng is None:
        picked = ((np.arange(count) + 0.5) * len(row) / count).astype(np.int64)
    else:
        # repeats strips if there are fewer: all rows have one length
        picked = np.sort(np.resize(rng.permutation(len(row)), count))
    return row[picked].astype(np.int32)


def _by_pose(pose_of: Ints, entries: NDArray[np.float32], poses: int) -> NDArray[np.float32]:
    """Return entries (B, E, 16), one row a pose, padded with absent entries."""
    if poses == 1:
        return entries[None]
    counts = np.bincount(pose_of, minlength=poses)
    order = np.argsort(pose_of, kind="stable")
    place = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    result = np.zeros((poses, max(int(counts.max()), 1), entries.shape[1]), np.float32)
    result[pose_of[order], place] = entries[order]
    return result
