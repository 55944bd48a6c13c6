"""Colour-constrained nearest neighbours among the hull's surface voxels (Kehl 2006, sections 6.1.1 and 6.1.3).

The voxels are sorted into cubic cells once a frame. A query visits the cells ring by ring around its own and stops when
no nearer voxel can follow: about a hundred candidates (the paper searches all voxels of the colour). A voxel is a
candidate if its bit of the query's colour patch is set.
"""

from dataclasses import dataclass

import numpy as np

from tk.kernels.runtime import ensure_runtime, spread_of, ti


@dataclass(frozen=True)
class SurfaceIndex:
    """Surface voxels in cell order. V voxels, G cells along each axis (3,)."""

    positions: np.ndarray  # (V, 3) float32, metres
    fits: np.ndarray  # (V,) int64, bit p set where the voxel's colour fits patch p
    starts: np.ndarray  # (G0·G1·G2 + 1,) int32, first voxel of each cell
    grid: np.ndarray  # (7,) float32, lower corner of cell 0 and edge of a cell (metres), cells along each axis
    order: np.ndarray  # (V,) the voxels' indices in the arrays given to `build`

    @staticmethod
    def build(positions: np.ndarray, fits: np.ndarray, cell_m: float) -> "SurfaceIndex":
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
            fits=np.ascontiguousarray(fits, np.int64)[order],
            starts=starts,
            grid=np.array([*origin, cell_m, *cells], np.float32),
            order=order,
        )


@ti.func
def _gap(cell: int, at: ti.f32):
    """Return the distance of a coordinate from the cell, in cells; 0 inside."""
    return ti.max(ti.max(cell - at, at - cell - 1.0), 0.0)


@ti.func
def nearest_voxel(
    voxels: ti.template(),  # (V, 3)
    fits: ti.template(),  # (V,)
    starts: ti.template(),
    grid: ti.template(),  # (first + 7,)
    first: ti.template(),  # where grid's numbers begin
    x,  # query point
    patch: int,
    reach: ti.f32,
):
    """Return the index of the nearest candidate within ``reach`` metres, or -1."""
    best = -1
    best_d2 = reach * reach
    cell_m = ti.cast(grid[first + 3], ti.f32)
    cells = ti.Vector([ti.cast(grid[first + 4 + a], ti.i32) for a in ti.static(range(3))])
    origin = ti.Vector([ti.cast(grid[first + a], ti.f32) for a in ti.static(range(3))])
    point = ti.Vector([ti.cast(x[a], ti.f32) for a in ti.static(range(3))])
    local = (point - origin) / cell_m
    home = ti.cast(ti.floor(local), ti.i32)
    # distance from the query to the nearest wall of its own cell: ring r lies at least (r - 1)·cell + margin away
    inner = local - ti.cast(home, ti.f32)
    margin = ti.min(inner.min(), 1.0 - inner.max()) * cell_m
    rings = ti.cast(ti.ceil(reach / cell_m), ti.i32)
    nearly_cell2 = 0.9999 * cell_m * cell_m  # room for rounding
    ring = 0
    while ring <= rings:
        nearest_possible = (ring - 1) * cell_m + margin
        if ring > 0 and nearest_possible > 0 and nearest_possible * nearest_possible >= best_d2:
            break
        low, high = home[2] - ring, home[2] + ring
        for i in range(ti.max(home[0] - ring, 0), ti.min(home[0] + ring, cells[0] - 1) + 1):
            for j in range(ti.max(home[1] - ring, 0), ti.min(home[1] + ring, cells[1] - 1) + 1):
                # a column of cells is one run of voxels; of an inner column the ring has its two ends only
                whole = ring == 0 or ti.abs(i - home[0]) == ring or ti.abs(j - home[1]) == ring
                column = (i * cells[1] + j) * cells[2]
                across = _gap(i, local[0]) ** 2 + _gap(j, local[1]) ** 2
                for run in range(ti.select(whole, 1, 2)):
                    k0 = ti.max(ti.select(run == 0, low, high), 0)
                    k1 = ti.min(ti.select(whole or run == 1, high, low), cells[2] - 1)
                    away = ti.select(whole, 0.0, ti.min(_gap(low, local[2]), _gap(high, local[2])))
                    if k0 <= k1 and (across + away * away) * nearly_cell2 < best_d2:
                        for v in range(starts[column + k0], starts[column + k1 + 1]):
                            if (fits[v] >> patch) & 1 == 1:
                                d2 = (ti.Vector([voxels[v, a] for a in ti.static(range(3))]) - point).norm_sqr()
                                if d2 < best_d2:
                                    best_d2 = d2
                                    best = v
        ring += 1
    return best


@ti.kernel
def _nearest_kernel(
    voxels: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
    fits: ti.types.ndarray(dtype=ti.i64, ndim=1),  # (V,)
    starts: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (G + 1,)
    grid: ti.types.ndarray(dtype=ti.f32, ndim=1),  # (7,)
    points: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (N, 3)
    patch: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
    reach: ti.f32,
    spread: ti.i32,
    found: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,) out
):
    for turn in range(spread * (points.shape[0])):
        if turn % spread != 0:
            continue
        q = turn // spread
        x = ti.Vector([points[q, a] for a in ti.static(range(3))])
        found[q] = nearest_voxel(voxels, fits, starts, grid, 0, x, patch[q], reach)


def nearest(
    index: SurfaceIndex,
    points: np.ndarray,
    patch: np.ndarray,
    reach_m: float = 1.0,
) -> np.ndarray:
    """Return the nearest voxel of each query that fits its patch.

    Args:
        index: the frame's surface voxels.
        points: (N, 3) queries, metres.
        patch: (N,) colour patch of each query, 0…62.
        reach_m: greatest distance searched.

    Returns:
        (N,) int32 indices into ``index.positions``; -1 where there is none.
    """
    ensure_runtime()
    found = np.empty(len(points), np.int32)
    _nearest_kernel(
        index.positions,
        index.fits,
        index.starts,
        index.grid,
        np.ascontiguousarray(points, np.float32),
        np.ascontiguousarray(patch, np.int32),
        reach_m,
        spread_of(len(points)),
        found,
    )
    return found
