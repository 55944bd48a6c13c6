"""Visual hull kernels: carving by per-pixel look-up lists, surface voxels, their normals and colours.

Kehl & Van Gool 2006, section 4.1. The state of a hull is two integer arrays, so that every result is exact and does
not depend on the order in which threads work:

``bits`` (V,) int32, one word a voxel
    Bit c is set where camera c does not carve the voxel: its pixel is foreground, or it lies outside the picture.
    Bit C (one above the last camera) is fixed: set where at least two cameras see the voxel at all.
    A voxel is active where all C + 1 bits are set.
``occupied`` (nx * ny * nw,) uint32, one bit a voxel
    The active voxels, packed along z: nw = ceil(nz / 32) words a column. It is kept up to date by the carving itself:
    whichever change makes a voxel's bits complete, or incomplete again, flips its bit here. Surface and visibility
    read only this array, 32 times smaller than ``bits``.

Masks enter as int64 words, eight pixels at a time; memory is little-endian (as on all platforms that Taichi runs on).
"""

import numpy as np
from numpy.typing import NDArray

from tk.kernels.runtime import ensure_runtime, ti

__all__ = ["carve", "full_mask", "occupied_words", "shade_surface", "sort_by_pixel", "surface_voxels"]

_CHUNK = 128  # mask words a parallel task: 1024 pixels
_WINDOW = 2  # normals come from the voxels within a ball around a voxel: half width of its box ...
_BALL = 6  # ... and squared radius, both in voxels
_FRONTAL = 0.1  # cosine below which a camera sees a surface only at a grazing angle, that is, not truly
_LIFT = 1.25  # voxels by which a line of sight starts off the surface, so that its own neighbours do not block it


def full_mask(cameras: int) -> int:
    """The value of ``bits`` at an active voxel, as a signed 32-bit integer, for up to 31 cameras."""
    return int(np.array([(1 << (cameras + 1)) - 1], dtype=np.uint32).view(np.int32)[0])


def occupied_words(shape: tuple[int, int, int]) -> int:
    """Length of ``occupied`` for a grid of this shape."""
    return shape[0] * shape[1] * ((shape[2] + 31) // 32)


# --- look-up lists -----------------------------------------------------------------------------------------------


@ti.kernel
def _sort_kernel(
    pixels_in: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (C, V)
    cursor: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (C, P) start of each list; its end when done
    voxels_out: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (L,)
):
    for camera in range(pixels_in.shape[0]):
        for voxel in range(pixels_in.shape[1]):
            pixel = pixels_in[camera, voxel]
            if pixel >= 0:
                slot = cursor[camera, pixel]
                cursor[camera, pixel] = slot + 1
                voxels_out[slot] = voxel


def sort_by_pixel(pixels: NDArray[np.int32], pixel_count: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Turn the voxels' pixels into the pixels' voxels (compressed rows).

    Args:
        pixels: (C, V) int32, the pixel each voxel's centre falls on in each camera; -1 outside the picture.
        pixel_count: P, pixels of one picture in the packed stack.

    Returns:
        row_offsets (C * P + 1,) int32 and voxels (L,) int32: pixel p of camera c has the voxels
        ``voxels[row_offsets[c * P + p] : row_offsets[c * P + p + 1]]``, ascending.
    """
    ensure_runtime()
    counts = np.stack([np.bincount(row[row >= 0], minlength=pixel_count) for row in pixels])
    row_offsets = np.zeros(counts.size + 1, dtype=np.int32)
    np.cumsum(counts.ravel(), out=row_offsets[1:])
    voxels = np.empty(int(row_offsets[-1]), dtype=np.int32)
    if len(voxels):
        _sort_kernel(np.ascontiguousarray(pixels), row_offsets[:-1].reshape(counts.shape).copy(), voxels)
    return row_offsets, voxels


# --- carving -----------------------------------------------------------------------------------------------------


@ti.func
def _turn(now, before, byte):
    """1 where this byte of a mask word turned to foreground, -1 to background, 0 where it stayed what it was."""
    is_set = ((now >> (8 * byte)) & 255) != 0
    was_set = ((before >> (8 * byte)) & 255) != 0
    return ti.cast(is_set, ti.i32) - ti.cast(was_set, ti.i32)


@ti.kernel
def _carve_kernel(
    row_offsets: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (C * P + 1,)
    voxels: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (L,)
    pixel_count: ti.i32,  # P
    full: ti.i32,
    nz: ti.i32,
    current: ti.types.ndarray(dtype=ti.i64, ndim=1),  # (W,) masks, eight pixels a word
    previous: ti.types.ndarray(dtype=ti.i64, ndim=1),  # (W,) in and out
    bits: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (V,) in and out
    occupied: ti.types.ndarray(dtype=ti.u32, ndim=1),  # (nx * ny * nw,) in and out
):
    words = current.shape[0]
    nw = (nz + 31) >> 5
    for chunk in range((words + _CHUNK - 1) // _CHUNK):
        for word in range(chunk * _CHUNK, ti.min((chunk + 1) * _CHUNK, words)):
            now = current[word]
            before = previous[word]
            if now != before:
                previous[word] = now
                whole = (now == -1 and before == 0) or (now == 0 and before == -1)
                end = 0
                while end < 8:
                    first = end
                    turn = _turn(now, before, first)
                    camera = (word * 8 + first) // pixel_count
                    last = ti.min(8, (camera + 1) * pixel_count - word * 8)  # a word may reach into the next picture
                    end = ti.select(whole, last, first + 1)
                    while end < last and _turn(now, before, end) == turn:
                        end += 1
                    if turn != 0:
                        # A voxel has one pixel a camera, so its bit flips at most once: adding is setting it.
                        change = turn * (1 << camera)
                        # the lists of neighbouring pixels follow each other in memory
                        for k in range(row_offsets[word * 8 + first], row_offsets[word * 8 + end]):
                            voxel = voxels[k]
                            old = ti.atomic_add(bits[voxel], change)
                            if old == full or old + change == full:
                                column = voxel // nz
                                z = voxel - column * nz
                                ti.atomic_xor(occupied[column * nw + (z >> 5)], ti.u32(1) << ti.cast(z & 31, ti.u32))


def carve(
    row_offsets: NDArray[np.int32],
    voxels: NDArray[np.int32],
    pixel_count: int,
    full: int,
    nz: int,
    current: NDArray[np.int64],
    previous: NDArray[np.int64],
    bits: NDArray[np.int32],
    occupied: NDArray[np.uint32],
) -> None:
    """Bring ``bits``, ``occupied`` and ``previous`` from the masks ``previous`` to the masks ``current``, in place.

    Only the lists of pixels that changed between background (0) and foreground (anything else) are visited. From
    scratch is the same with ``previous`` and ``occupied`` zero and ``bits`` as no foreground at all leaves them.

    Args:
        row_offsets, voxels: the look-up lists of :func:`sort_by_pixel`.
        pixel_count: P, pixels of one picture.
        full: :func:`full_mask`.
        nz: voxels along z.
        current, previous: (W,) int64, the mask stack (C, H, W) uint8 in its own order, zero-padded to whole words.
        bits: (V,) int32.
        occupied: (nx * ny * nw,) uint32.
    """
    ensure_runtime()
    _carve_kernel(row_offsets, voxels, pixel_count, full, nz, current, previous, bits, occupied)


# --- surface -----------------------------------------------------------------------------------------------------


@ti.kernel
def _surface_kernel(
    occupied: ti.types.ndarray(dtype=ti.u32, ndim=3),  # (nx, ny, nw)
    nz: ti.i32,
    found: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (V,) out: each slab's surface voxels from its own start on
    slabs: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (nx, 5) out: count, y and z range in which they lie
):
    nx, ny, nw = occupied.shape[0], occupied.shape[1], occupied.shape[2]
    for x in range(nx):
        start = x * ny * nz
        count = 0
        y_min, y_max, z_min, z_max = ny, -1, nz, -1
        for y in range(ny):
            for w in range(nw):
                here = occupied[x, y, w]
                if here != 0:
                    up = here >> ti.u32(1)  # the neighbour above each voxel, at the voxel's own place
                    down = here << ti.u32(1)
                    if w + 1 < nw:
                        up |= occupied[x, y, w + 1] << ti.u32(31)
                    if w > 0:
                        down |= occupied[x, y, w - 1] >> ti.u32(31)
                    inner = up & down
                    if x == 0 or x == nx - 1 or y == 0 or y == ny - 1:
                        inner = ti.u32(0)
                    else:
                        inner &= occupied[x - 1, y, w] & occupied[x + 1, y, w]
                        inner &= occupied[x, y - 1, w] & occupied[x, y + 1, w]
                    border = here & ~inner
                    if border != 0:
                        y_min, y_max = ti.min(y_min, y), ti.max(y_max, y)
                        for b in range(32):
                            if (border >> ti.cast(b, ti.u32)) & ti.u32(1):
                                z = w * 32 + b
                                z_min, z_max = ti.min(z_min, z), ti.max(z_max, z)
                                found[start + count] = start + y * nz + z
                                count += 1
        slabs[x, 0] = count
        slabs[x, 1], slabs[x, 2] = y_min, y_max
        slabs[x, 3], slabs[x, 4] = z_min, z_max


def surface_voxels(
    occupied: NDArray[np.uint32], shape: tuple[int, int, int], found: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Active voxels with at least one inactive neighbour of six; outside the grid counts as inactive.

    Args:
        occupied: (nx * ny * nw,) uint32.
        shape: (nx, ny, nz).
        found: (V,) int32, scratch space that the caller keeps from frame to frame.

    Returns:
        voxels (N,) int32, flat and ascending, and box (2, 3) int32: lowest and highest index along x, y, z.
    """
    ensure_runtime()
    nx, ny, nz = shape
    slabs = np.empty((nx, 5), dtype=np.int32)
    _surface_kernel(occupied.reshape(nx, ny, -1), nz, found, slabs)
    used = np.flatnonzero(slabs[:, 0])
    if len(used) == 0:
        return np.zeros(0, dtype=np.int32), np.zeros((2, 3), dtype=np.int32)
    size = ny * nz
    voxels = np.concatenate([found[x * size : x * size + slabs[x, 0]] for x in used])
    low, high = slabs[used].min(axis=0), slabs[used].max(axis=0)
    box = np.array([[used[0], low[1], low[3]], [used[-1], high[2], high[4]]], dtype=np.int32)
    return voxels, box


@ti.func
def _is_occupied(occupied: ti.template(), x, y, z, nz):
    """1 where the voxel is active, 0 where it is not or lies outside the grid."""
    result = ti.u32(0)
    if 0 <= x < occupied.shape[0] and 0 <= y < occupied.shape[1] and 0 <= z < nz:
        result = (occupied[x, y, z >> 5] >> ti.cast(z & 31, ti.u32)) & ti.u32(1)
    return ti.cast(result, ti.i32)


@ti.func
def _outward(occupied: ti.template(), x, y, z, nz):
    """Unit vector from the centroid of the active voxels in a ball to its centre; zero where they coincide."""
    moment = ti.Vector([0, 0, 0])
    for dx in range(-_WINDOW, _WINDOW + 1):
        for dy in range(-_WINDOW, _WINDOW + 1):
            for dz in range(-_WINDOW, _WINDOW + 1):
                if dx * dx + dy * dy + dz * dz <= _BALL and _is_occupied(occupied, x + dx, y + dy, z + dz, nz):
                    moment -= ti.Vector([dx, dy, dz])
    normal = ti.cast(moment, ti.f32)
    length = normal.norm()
    if length > 0.0:
        normal /= length
    return normal


@ti.func
def _in_sight(occupied: ti.template(), start, view, box: ti.template(), nz):
    """1 where no active voxel lies on the way from ``start`` along the unit vector ``view`` until out of the box.

    The line is sampled where it crosses the layers of its dominant axis; all in voxels.
    """
    step = view / ti.abs(view).max()
    layers = ti.f32(1e9)
    for axis in ti.static(range(3)):
        if step[axis] > 0:
            layers = ti.min(layers, (ti.cast(box[1, axis], ti.f32) + 0.5 - start[axis]) / step[axis])
        elif step[axis] < 0:
            layers = ti.min(layers, (ti.cast(box[0, axis], ti.f32) - 0.5 - start[axis]) / step[axis])
    clear = 1
    t = 0
    while clear == 1 and t <= layers:
        at = ti.cast(ti.floor(start + ti.cast(t, ti.f32) * step + 0.5), ti.i32)
        if _is_occupied(occupied, at[0], at[1], at[2], nz):
            clear = 0
        t += 1
    return clear


@ti.kernel
def _shade_kernel(
    occupied: ti.types.ndarray(dtype=ti.u32, ndim=3),  # (nx, ny, nw)
    nz: ti.i32,
    pixels: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (C, V)
    eyes: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (C, 3) voxels
    spacing: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (C,) pixels
    images: ti.types.ndarray(dtype=ti.u8, ndim=4),  # (C, H, W, 3), or (C, 0, 0, 3)
    masks: ti.types.ndarray(dtype=ti.u8, ndim=3),  # (C, H, W)
    voxels: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
    box: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (2, 3)
    normals: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (N, 3) out
    colors: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (N, 3) out
    seen: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,) out
):
    height, width = masks.shape[1], masks.shape[2]
    for n in range(voxels.shape[0]):
        voxel = voxels[n]
        column = voxel // nz
        z = voxel - column * nz
        x = column // occupied.shape[1]
        y = column - x * occupied.shape[1]
        center = ti.Vector([ti.cast(x, ti.f32), ti.cast(y, ti.f32), ti.cast(z, ti.f32)])
        normal = _outward(occupied, x, y, z, nz)
        undefined = normal.dot(normal) < 0.5
        color = ti.Vector([ti.f32(0.0), ti.f32(0.0), ti.f32(0.0)])
        weight = ti.f32(0.0)
        cameras = 0
        for camera in range(pixels.shape[0]):
            pixel = pixels[camera, voxel]
            if pixel >= 0:
                view = (ti.Vector([eyes[camera, 0], eyes[camera, 1], eyes[camera, 2]]) - center).normalized()
                cosine = normal.dot(view)
                start = center + _LIFT * normal
                if undefined:
                    cosine = ti.f32(1.0)
                    start = center + _LIFT * view
                if cosine > _FRONTAL and _in_sight(occupied, start, view, box, nz):
                    cameras |= 1 << camera
                    if images.shape[1] > 0:
                        # nine foreground pixels spread over the voxel's footprint
                        row = pixel // width
                        for i in range(-1, 2):
                            for j in range(-1, 2):
                                v = row + i * spacing[camera]
                                u = pixel - row * width + j * spacing[camera]
                                if 0 <= v < height and 0 <= u < width and masks[camera, v, u] != 0:
                                    weight += cosine * cosine
                                    for channel in ti.static(range(3)):
                                        color[channel] += (
                                            cosine * cosine * ti.cast(images[camera, v, u, channel], ti.f32)
                                        )
        for channel in ti.static(range(3)):
            normals[n, channel] = normal[channel]
            colors[n, channel] = color[channel] / ti.max(weight, 1e-12)
        seen[n] = cameras


def shade_surface(
    occupied: NDArray[np.uint32],
    shape: tuple[int, int, int],
    pixels: NDArray[np.int32],
    eyes: NDArray[np.float32],
    spacing: NDArray[np.int32],
    images: NDArray[np.uint8] | None,
    masks: NDArray[np.uint8],
    voxels: NDArray[np.int32],
    box: NDArray[np.int32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    """Normals and colours of surface voxels, and the cameras that truly see them.

    A camera truly sees a voxel if it lies in the picture, its surface faces the camera, and no active voxel stands
    between the two. Colours are averages over such cameras, weighted by the squared cosine between normal and line of
    sight. The paper (section 4.1) leaves texturing to its reference [19]; this is ours.

    Args:
        occupied: (nx * ny * nw,) uint32.
        shape: (nx, ny, nz).
        pixels: (C, V) int32, pixel of each voxel in each camera, -1 outside the picture.
        eyes: (C, 3) float32, centres of projection in voxels: the centre of voxel (0, 0, 0) is the origin.
        spacing: (C,) int32, pixels between the three by three samples that make up a voxel's colour.
        images: (C, H, W, 3) uint8, or None for no colours.
        masks: (C, H, W) uint8; only foreground pixels lend their colour.
        voxels: (N,) int32 flat indices.
        box: (2, 3) int32 from :func:`surface_voxels`.

    Returns:
        normals (N, 3) float32 outward and of unit length, zero where undefined; colors (N, 3) float32 0..255 in the
        images' channel order, zero where no camera sees the voxel; seen (N,) int32, bit c for camera c.
    """
    ensure_runtime()
    count = len(voxels)
    normals = np.empty((count, 3), dtype=np.float32)
    colors = np.empty((count, 3), dtype=np.float32)
    seen = np.empty(count, dtype=np.int32)
    if count:
        if images is None:
            images = np.empty((len(masks), 0, 0, 3), dtype=np.uint8)
        packed = occupied.reshape(shape[0], shape[1], -1)
        _shade_kernel(packed, shape[2], pixels, eyes, spacing, images, masks, voxels, box, normals, colors, seen)
    return normals, colors, seen
