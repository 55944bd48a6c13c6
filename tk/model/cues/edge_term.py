"""The edge term: the model's contours against the images' colour edges (Kehl 2006, section 6.1.2).

The limbs' contour points (:mod:`tk.kernels.contour`), in the three views that show most of them, search edges along
lines (:mod:`tk.kernels.edge_search`). The results are entries of the objective (:mod:`tk.kernels.alignment`), valid
until they are assigned again. A point that is hidden, outside the image or without an edge costs 1 and pulls nowhere.

The paper takes the views with the fewest hidden points. Its cameras all see the whole person; a camera that looks away
hides no point either.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.kernels import alignment
from tk.kernels.contour import ContourKernel, ContourPoints
from tk.kernels.edge_search import LINE_NUMBERS, PAIR, SINGLE, search_edges
from tk.kernels.pieces import PIECE_DOF
from tk.kernels.projection import pack_cameras
from tk.model.body import joints
from tk.model.body.joints import CHAINS
from tk.model.body.strips import CIRCLES, LIMBS, build_strips, limb_pieces
from tk.model.body.superellipsoid_body import SuperellipsoidBody
from tk.model.cameras.camera import Rig

Float = NDArray[np.float64]
Ints = NDArray[np.int32]
Float32 = NDArray[np.float32]

# Views in which edges are searched, and pairs of contour points on each limb in each view: the paper's 3, and 10 points
# (6.1.2, 7).
VIEWS, PAIRS = 3, 5
# Iterations for which assigned edges are kept. The paper assigns edges at every iteration, which takes longer.
RENEW = 5
# σ of eqs. 10, 13 and 15, metres, for every sample and contour point. The paper takes the limb's diameter. Distances on
# the trunk and on an arm are equally uncertain: both come from the same voxels. In units of the diameter the trunk,
# five times as thick, weighs a twenty-fifth and follows the arms.
SIGMA_M = 0.1
# Leclerc's ν of eq. 9, in units of ½ (d/σ)². The paper prints none.
EDGE_NU = 0.1
# How far from the contour edges are searched, metres at the limb.
REACH_M = 0.08
# Least colour gradient of an edge, 0 to 1. The paper tuned its own by hand for each camera.
THRESHOLD = 0.12
# The chains with contour points, in the order of :data:`LIMBS`: two segments each.
_LIMB_CHAINS = [list(CHAINS).index(chain) for chain in joints.LIMBS]


class ContourTerm:
    """The edge term of one body in one rig.

    Args:
        body: the person.
        rig: the cameras.
        weight: w_e of eq. 8, beside the surface term's 1.
        scale: factor of the number of contour points (section 7.3).
        dtype: precision of the contours.
    """

    def __init__(
        self, body: SuperellipsoidBody, rig: Rig, weight: float, scale: int = 1, dtype: type = np.float32
    ) -> None:
        self.weight = weight
        self.cameras = pack_cameras(rig)
        self.sizes = np.array([(c.height, c.width) for c in rig], np.int32)
        self.strips = build_strips(body, limb_pieces(body))
        strips = self.strips.angles, self.strips.normals, self.strips.piece
        self.kernel = ContourKernel(body.arrays, *strips, self.cameras, dtype)
        self._last_dof = body.arrays.pieces[self.strips.piece, PIECE_DOF]
        self._pairs_a_limb = scale * PAIRS

    def draw(self, rng: np.random.Generator | None) -> Ints:
        """Draw strips (chains, K) of each chain: at random, or evenly spread without a generator; the head has none, -1
        (6.4). Strips are repeated if there are fewer."""
        count = self._pairs_a_limb
        if rng is None:
            picked = np.tile(((np.arange(count) + 0.5) * CIRCLES / count).astype(np.int32), (len(LIMBS), 1))
        else:
            order = rng.permuted(np.tile(np.arange(CIRCLES, dtype=np.int32), (len(LIMBS), 1)), axis=1)
            picked = np.sort(order[:, np.arange(count) % CIRCLES], axis=1)
        found = np.full((len(CHAINS), 2 * count), -1, np.int32)
        found[_LIMB_CHAINS] = (picked + CIRCLES * np.arange(len(LIMBS))[:, None]).reshape(len(_LIMB_CHAINS), -1)
        return found

    def assign(
        self, images: NDArray[np.uint8], poses: Float, chosen: Ints, cameras: NDArray[np.bool_] | None = None
    ) -> Float32:
        """Return entries (B, E, 16) at poses (B, D) from strips (B, K) and images (C, H, W, 3) of some cameras (C,),
        by default of all."""
        pose_of, entries, lines = self.pairs(self.kernel(poses, chosen), cameras)
        wanted = np.flatnonzero(entries[:, alignment.STATE] == alignment.ASSIGNED)
        found = search_edges(images, self.sizes, lines, THRESHOLD)
        entries[wanted, alignment.TARGET : alignment.TARGET + 2] = 0.5 * (found[:, 1:3] + found[:, 3:5])
        entries[wanted[found[:, 0] == 0], alignment.STATE] = alignment.UNASSIGNABLE
        return _by_pose(pose_of, entries, len(poses))

    def pairs(
        self, points: ContourPoints, cameras: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.intp], Float32, Float32]:
        """Return the pose (E,) and the entry (E, 16) of each pair, single point and hidden half of a pair; and the
        search lines (R, 11) of the entries that may have an edge, in the same order. ``cameras``: as for
        :meth:`assign`."""
        B, C = points.visible.shape[:2]
        width_height = self.sizes[:, None, None, ::-1]
        inside = ((points.pixels >= -0.5) & (points.pixels < width_height - 0.5)).all(axis=4)
        shown = points.visible.astype(bool) & inside
        count = shown.sum(axis=(2, 3)) * (1 if cameras is None else cameras)
        best = np.argsort(-count, axis=1, kind="stable")[:, :VIEWS]
        used = np.zeros((B, C), bool)
        used[np.arange(B)[:, None], best] = True
        used &= count > 0
        b, v, k = np.nonzero(points.found.any(axis=3) & used[:, :, None])
        seen = shown[b, v, k]
        both, any_seen = seen.all(axis=1), seen.any(axis=1)
        first = np.where(seen[:, 0], 0, 1)
        ends = [(b, v, k, first), (b, v, k, np.where(both, 1, first))]
        pixels_a_metre = points.scale[ends[0]].astype(np.float32)

        lines = np.zeros((len(b), LINE_NUMBERS), np.float32)
        lines[:, 0] = np.where(both, PAIR, SINGLE)
        lines[:, 1] = v
        lines[:, 2:10] = np.hstack([values[end] for values in (points.pixels, points.normals) for end in ends])
        lines[:, 10] = REACH_M * pixels_a_metre

        a = alignment
        entries = np.zeros((len(b), a.ENTRY_NUMBERS), np.float32)
        entries[:, a.POINT_A : a.POINT_A + 6] = np.hstack([points.points_zero[end] for end in ends])
        entries[:, a.LAST_DOF] = self._last_dof[points.strip[b, k]]
        entries[:, a.CAMERA] = v
        entries[:, a.NORMAL : a.NORMAL + 2] = points.normals[ends[0]]
        entries[:, a.INV_SIGMA2] = 1 / (SIGMA_M * pixels_a_metre) ** 2
        entries[:, a.STATE] = np.where(any_seen, a.ASSIGNED, a.UNASSIGNABLE)
        entries[:, a.NU] = EDGE_NU
        # every contour point has the same weight, alone or with another; the hidden one of two has its own entry
        found = points.found[b, v, k].sum(axis=1)
        share = self.weight / np.bincount(b, found, minlength=B)[b]
        entries[:, a.SCALE] = share * np.where(any_seen, seen.sum(axis=1), found)
        half = any_seen & (seen.sum(axis=1) < found)
        concealed = entries[half]
        concealed[:, a.STATE] = a.UNASSIGNABLE
        concealed[:, a.SCALE] = share[half]
        b, entries = np.concatenate([b, b[half]]), np.concatenate([entries, concealed])
        return b, entries, lines[any_seen]


def _by_pose(pose_of: NDArray[np.intp], entries: Float32, poses: int) -> Float32:
    """Return entries (B, E, 16), one row a pose, padded with absent entries."""
    counts = np.bincount(pose_of, minlength=poses)
    order = np.argsort(pose_of, kind="stable")
    place = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    result = np.zeros((poses, max(int(counts.max()), 1), entries.shape[1]), np.float32)
    result[pose_of[order], place] = entries[order]
    return result
