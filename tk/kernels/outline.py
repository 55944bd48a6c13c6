"""The body's outline against the masks' boundary: contour points, tests and search in one launch; entries come out.

For each pose, camera and strip this finds the contour points (:mod:`tk.kernels.contour`), keeps those on the outline of
the whole body, and looks from each along the contour's normal for the mask's boundary (:mod:`tk.kernels.edge_search`).
Where the mask ends in pixels that may be a shadow or a cloth, its boundary is not the body's, and there is no entry.
A point's entry (:mod:`tk.kernels.alignment`) has a place of its own, by camera, strip and slot, and is absent where the
strip has no such point: nothing is gathered, and an absent entry costs its readers a comparison.
"""

import functools
from dataclasses import dataclass

import numpy as np

from tk.kernels import alignment
from tk.kernels.contour import (
    OUTER_MARGIN_M,
    ContourKernel,
    behind,
    image_normal,
    rim_crossings,
    rim_point,
    strip_piece,
    to_zero_configuration,
)
from tk.kernels.edge_search import is_doubtful, outline_at
from tk.kernels.kinematics import forward_tree
from tk.kernels.launch import Launcher
from tk.kernels.objective import PIECE_DOF
from tk.kernels.occlusion import PLACED_CAMERA, is_occluded, load_placed_vector, pieces_beside, place_pieces
from tk.kernels.projection import CAMERA_NUMBERS, camera_center, project
from tk.kernels.runtime import ensure_runtime, spread_of, ti

# Parallel tasks that a launch is divided into, or more: at least one a pose, each with its own forward kinematics.
TASKS = 8


@dataclass(frozen=True)
class OutlineSettings:
    """Constants of the outline cue.

    Attributes:
        reach_m: how far from the contour the mask's boundary is looked for, metres at the limb.
        sigma_m: σ of eq. 15, metres at the limb; 0 takes the limb's diameter.
        nu: Leclerc's ν; weight: the cue's share of f, which its entries divide among them.
    """

    reach_m: float
    sigma_m: float
    nu: float
    weight: float


@functools.cache
def _outline_kernel(real):
    @ti.kernel
    def outline(
        tree: ti.types.ndarray(dtype=real, ndim=2),  # (D, 11)
        pieces: ti.types.ndarray(dtype=real, ndim=2),  # (P, 21) as in tk.kernels.contour, and the diameter
        strips: ti.types.ndarray(dtype=real, ndim=3),  # (S, N + 1, 5)
        cameras: ti.types.ndarray(dtype=real, ndim=2),  # (C, 24) as in tk.kernels.projection, and height, width
        spread: ti.i32,
        reach_m: real,
        sigma_m: real,
        nu: real,
        masks: ti.types.ndarray(dtype=ti.u8, ndim=3),  # (C, H, W)
        chosen: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, K)
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        joints: ti.types.ndarray(dtype=real, ndim=3),  # (T, D, 18) scratch
        placed: ti.types.ndarray(dtype=real, ndim=3),  # (T, P, 20) scratch
        entries: ti.types.ndarray(dtype=real, ndim=3),  # (B, C K 2, 17) out; SCALE is 1 or 0
    ):
        for turn in range(spread * joints.shape[0]):
            if turn % spread != 0:
                continue
            c = turn // spread
            K = chosen.shape[1]
            lines = cameras.shape[0] * K  # a camera's strips, then the next one's
            tasks = joints.shape[0] // pose.shape[0]
            b, part = c // tasks, c % tasks
            forward_tree(tree, pose, b, c, joints)
            center = camera_center(cameras, 0)
            near = ti.cast(0, ti.i64)
            placed_for, near_to = -1, -1
            for line in range(lines * part // tasks, lines * (part + 1) // tasks):
                v, m = line // K, line % K
                if v != placed_for:
                    center = camera_center(cameras, v)
                    place_pieces(joints, c, pieces, center, placed)
                    placed_for, near_to = v, -1
                s = chosen[b, m]
                i = strip_piece(strips, s)
                if i != near_to:
                    near, near_to = pieces_beside(placed, c, pieces, i, OUTER_MARGIN_M), i
                crossings = rim_crossings(strips, s, load_placed_vector(placed, c, i, PLACED_CAMERA))
                for slot in range(2):
                    e = line * 2 + slot
                    for a in range(alignment.ENTRY_NUMBERS):
                        entries[b, e, a] = 0.0
                    # a dynamic index into a vector would spill it to memory
                    here = ti.select(slot == 0, crossings[0], crossings[3])
                    eta = ti.select(slot == 0, crossings[1], crossings[4])
                    omega = ti.select(slot == 0, crossings[2], crossings[5])
                    if here > 0:
                        q, x, n = rim_point(placed, c, pieces, i, eta, omega)
                        pixel, J, depth = project(cameras, v, x)
                        clear = depth > 1e-6
                        # first the ray just beyond the point: it passes the whole body and meets something sooner
                        for end in range(2):
                            if clear:
                                target = ti.select(end == 0, behind(x, n, center), x)
                                clear = is_occluded(placed, c, pieces, near, target, center) == 0
                        zero = 0.0 * depth  # of the kernel's type
                        normal = ti.Vector([zero, zero])
                        pixels_a_metre, at, found = zero, zero, 0
                        if clear:
                            normal = image_normal(J, n)
                            pixels_a_metre = ti.sqrt(0.5 * J.norm_sqr())
                            width = ti.cast(cameras[v, CAMERA_NUMBERS + 1], ti.i32)
                            height = ti.cast(cameras[v, CAMERA_NUMBERS], ti.i32)
                            found, at = outline_at(
                                masks, v, width, height,
                                pixel[0], pixel[1], normal[0], normal[1], reach_m * pixels_a_metre,
                            )  # fmt: skip
                            if found == 1:
                                clear = is_doubtful(masks, v, width, height, pixel + at * normal, normal) == 0
                        if clear:
                            x_zero = to_zero_configuration(pieces, i, q)
                            for a in ti.static(range(3)):
                                entries[b, e, alignment.POINT_A + a] = x_zero[a]
                                entries[b, e, alignment.POINT_B + a] = x_zero[a]
                            for a in ti.static(range(2)):
                                entries[b, e, alignment.NORMAL + a] = normal[a]
                                if found == 1:
                                    entries[b, e, alignment.TARGET + a] = pixel[a] + at * normal[a]
                            sigma = ti.select(sigma_m > 0, sigma_m, pieces[i, PIECE_DOF + 1]) * pixels_a_metre
                            entries[b, e, alignment.LAST_DOF] = pieces[i, PIECE_DOF]
                            entries[b, e, alignment.CAMERA] = ti.cast(v, real)
                            entries[b, e, alignment.INV_SIGMA2] = 1.0 / (sigma * sigma)
                            entries[b, e, alignment.STATE] = ti.select(
                                found == 1, alignment.ASSIGNED, alignment.UNASSIGNABLE
                            )
                            entries[b, e, alignment.SCALE] = 1.0
                            entries[b, e, alignment.NU] = nu

    return outline


class OutlineKernel:
    """The outline cue of one body in a rig's cameras.

    Args:
        contours: the body's contours.
        sizes: (C, 2) height and width of each picture in its zero-padded place.
        diameter: (P,) of each piece's limb, metres.
    """

    def __init__(self, contours: ContourKernel, sizes: np.ndarray, diameter: np.ndarray) -> None:
        ensure_runtime()
        dtype = contours.dtype
        self._contours = contours
        self._launch = Launcher(
            _outline_kernel(ti.f64 if dtype == np.float64 else ti.f32),
            contours.tree,
            np.ascontiguousarray(np.column_stack([contours.pieces, diameter]), dtype),
            contours.strips,
            np.ascontiguousarray(np.column_stack([contours.cameras, sizes]), dtype),
        )

    def __call__(
        self, masks: np.ndarray, pose: np.ndarray, chosen: np.ndarray, settings: OutlineSettings
    ) -> np.ndarray:
        """Entries (B, C·K·2, 17) of B poses, by camera, strip and slot; absent where a strip has no outline there.

        Args:
            masks: (C, H, W) uint8: 255 the person, 0 the scene, :data:`~tk.kernels.edge_search.DOUBTFUL` either.
            pose: (B, D).
            chosen: (B, K) strips of each pose.
            settings: constants.
        """
        chosen = self._contours.checked(chosen)
        B, K = chosen.shape
        C = len(self._contours.cameras)
        dtype = self._contours.dtype
        entries = np.empty((B, C * K * 2, alignment.ENTRY_NUMBERS), dtype)
        if entries.size:
            tasks = B * min(-(-TASKS // B), C * K)
            self._launch(
                spread_of(tasks),
                settings.reach_m,
                settings.sigma_m,
                settings.nu,
                masks,
                chosen,
                np.ascontiguousarray(pose, dtype),
                *self._contours.scratch_of(tasks),
                entries,
            )
            scale = entries[:, :, alignment.SCALE]
            scale *= settings.weight / np.maximum(scale.sum(axis=1, keepdims=True), 1)
        return entries
