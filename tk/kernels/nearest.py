"""Colour-constrained nearest neighbours among the hull's surface voxels (Kehl 2006, sections 6.1.1 and 6.1.3).

The voxels are sorted into cubic cells once a frame. A query visits the cells ring by ring around its own and stops when
nothing nearer can follow: some hundred candidates instead of all (the paper searches all that fit the colour).
A voxel is a candidate when its bit of the query's colour patch is set and its normal agrees with the query's.
"""

from dataclasses import dataclass

import numpy as np

from tk.kernels.runtime import ensure_runtime, ti


@dataclass(frozen=True)
class SurfaceIndex:
    """Surface voxels in cell order. V voxels, G cells along each axis (3,).

    Attributes:
        positions: (V, 3) float32, metres.
        normals: (V, 3) float32; zero where unknown (such a voxel agrees with every query).
        fits: (V,) int64, bit p set where the voxel's colour fits patch p.
        starts: (G0·G1·G2 + 1,) int32, first voxel of each cell.
        cells: (3,) int32, cells along each axis.
        origin: (3,) float32, lower corner of cell 0, metres.
        cell_m: edge of a cell, metres.
        order: (V,) the voxels' places in the arrays given to :meth:`build`.
    """

    positions: np.ndarray
    normals: np.ndarray
    fits: np.ndarray
    starts: np.ndarray
    cells: np.ndarray
    origin: np.ndarray
    cell_m: float
    order: np.ndarray

    @staticmethod
    def build(positions: np.ndarray, normals: np.ndarray, fits: np.ndarray, cell_m: float) -> "SurfaceIndex":
        """Sort V ≥ 1 voxels into cells of ``cell_m`` metres."""
        p = np.ascontiguousarray(positions, np.float32)
        origin = p.min(axis=0) - np.float32(1e-4)
        ijk = ((p - origin) / np.float32(cell_m)).astype(np.int32)
        cells = ijk.max(axis=0) + 1
        flat = (ijk[:, 0] * cells[1] + ijk[:, 1]) * cells[2] + ijk[:, 2]
        order = np.argsort(flat, kind="stable")
        counts = np.bincount(flat, minlength=int(np.prod(cells)))
        starts = np.zeros(len(counts) + 1, np.int32)
        np.cumsum(counts, out=starts[1:])
        return SurfaceIndex(
            positions=p[order],
            normals=np.ascontiguousarray(normals, np.float32)[order],
            fits=np.ascontiguousarray(fits, np.int64)[order],
            starts=starts,
            cells=cells.astype(np.int32),
            origin=origin.astype(np.float32),
            cell_m=float(cell_m),
            order=order,
        )


@ti.func
def nearest_voxel(
    positions: ti.template(),  # (V, 3)
    normals: ti.template(),  # (V, 3)
    fits: ti.template(),  # (V,)
    starts: ti.template(),
    cells: ti.template(),  # (3,)
    origin: ti.template(),  # (3,)
    cell_m: ti.f32,
    x,  # query point
    n,  # query normal
    patch: int,
    min_cosine: ti.f32,
    reach: ti.f32,
):
    """Index of the nearest candidate within ``reach`` metres, or -1."""
    best = -1
    best_d2 = reach * reach
    local = ti.Vector([ti.cast(x[i], ti.f32) - origin[i] for i in ti.static(range(3))]) / cell_m
    home = ti.cast(ti.floor(local), ti.i32)
    # distance from the query to the nearest wall of its own cell: ring r lies at least (r - 1)·cell + margin away
    inner = local - ti.cast(home, ti.f32)
    margin = ti.min(inner.min(), 1.0 - inner.max()) * cell_m
    rings = ti.cast(ti.ceil(reach / cell_m), ti.i32)
    ring = 0
    while ring <= rings:
        nearest_possible = (ring - 1) * cell_m + margin
        if ring > 0 and nearest_possible > 0 and nearest_possible * nearest_possible >= best_d2:
            break
        i0, i1 = ti.max(home[0] - ring, 0), ti.min(home[0] + ring, cells[0] - 1)
        j0, j1 = ti.max(home[1] - ring, 0), ti.min(home[1] + ring, cells[1] - 1)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                on_side = ti.abs(i - home[0]) == ring or ti.abs(j - home[1]) == ring
                step = ti.select(on_side or ring == 0, 1, 2 * ring)
                k = home[2] - ring
                while k <= home[2] + ring:
                    if k >= 0 and k < cells[2]:
                        cell = (i * cells[1] + j) * cells[2] + k
                        for v in range(starts[cell], starts[cell + 1]):
                            if (fits[v] >> patch) & 1 == 1:
                                d = ti.Vector([positions[v, a] - ti.cast(x[a], ti.f32) for a in ti.static(range(3))])
                                d2 = d.norm_sqr()
                                if d2 < best_d2:
                                    m = ti.Vector([normals[v, a] for a in ti.static(range(3))])
                                    cosine = (
                                        ti.cast(n[0], ti.f32) * m[0]
                                        + ti.cast(n[1], ti.f32) * m[1]
                                        + ti.cast(n[2], ti.f32) * m[2]
                                    )
                                    if cosine >= min_cosine or m.norm_sqr() == 0.0:
                                        best_d2 = d2
                                        best = v
                    k += step
        ring += 1
    return best


@ti.kernel
def _nearest_kernel(
    positions: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
    normals: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
    fits: ti.types.ndarray(dtype=ti.i64, ndim=1),  # (V,)
    starts: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (G + 1,)
    cells: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (3,)
    origin: ti.types.ndarray(dtype=ti.f32, ndim=1),  # (3,)
    cell_m: ti.f32,
    points: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (N, 3)
    point_normals: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (N, 3)
    patch: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
    min_cosine: ti.f32,
    reach: ti.f32,
    found: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,) out
):
    for q in range(points.shape[0]):
        x = ti.Vector([points[q, a] for a in ti.static(range(3))])
        n = ti.Vector([point_normals[q, a] for a in ti.static(range(3))])
        found[q] = nearest_voxel(
            positions, normals, fits, starts, cells, origin, cell_m, x, n, patch[q], min_cosine, reach
        )


def nearest(
    index: SurfaceIndex,
    points: np.ndarray,
    normals: np.ndarray,
    patch: np.ndarray,
    min_cosine: float = -1.0,
    reach_m: float = 1.0,
) -> np.ndarray:
    """The nearest voxel of each query that fits its patch and whose normal agrees.

    Args:
        index: the frame's surface voxels.
        points, normals: (N, 3) queries, metres and unit vectors.
        patch: (N,) colour patch of each query, 0…62.
        min_cosine: least cosine between the normals of query and voxel; -1 ignores them.
        reach_m: greatest distance searched.

    Returns:
        (N,) int32 indices into ``index.positions``; -1 where there is none.
    """
    ensure_runtime()
    found = np.empty(len(points), np.int32)
    _nearest_kernel(
        index.positions,
        index.normals,
        index.fits,
        index.starts,
        index.cells,
        index.origin,
        index.cell_m,
        np.ascontiguousarray(points, np.float32),
        np.ascontiguousarray(normals, np.float32),
        np.ascontiguousarray(patch, np.int32),
        min_cosine,
        reach_m,
        found,
    )
    return found
