"""3D colour segmentation: the colour patches that each surface voxel fits (Kehl 2006, section 6.1.3)."""

import numpy as np

from tk.kernels.runtime import ensure_runtime, ti


@ti.kernel
def _segment_kernel(
    mean: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (P, 3)
    bound: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (P, 3) maximum distance from the mean, by channel
    colors: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (V, 3)
    seen: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (V,)
    fits: ti.types.ndarray(dtype=ti.i64, ndim=1),  # (V,) out
):
    for v in range(colors.shape[0]):
        bits = ti.i64(0)
        for p in range(mean.shape[0]):
            inside = True
            for a in ti.static(range(3)):
                inside = inside and ti.abs(colors[v, a] - mean[p, a]) <= bound[p, a]
            # a voxel that no camera sees has no colour
            if inside or seen[v] == 0:
                bits |= ti.i64(1) << p
        fits[v] = bits


def segment(mean: np.ndarray, bound: np.ndarray, colors: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return bit masks of the patches that each voxel's colour fits.

    Args:
        mean: (P ≤ 63, 3) each patch's mean in YUV, 0…255.
        bound: (P, 3) maximum distance from the mean in each channel.
        colors: (V, 3) YUV.
        seen: (V,) 0 where no camera sees the voxel; it then fits every patch.

    Returns:
        (V,) int64, bit p set where the voxel fits patch p.
    """
    ensure_runtime()
    fits = np.empty(len(colors), np.int64)
    _segment_kernel(
        np.ascontiguousarray(mean, np.float32),
        np.ascontiguousarray(bound, np.float32),
        np.ascontiguousarray(colors, np.float32),
        np.ascontiguousarray(seen, np.int32),
        fits,
    )
    return fits
