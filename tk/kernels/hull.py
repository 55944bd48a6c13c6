"""Visual hull kernels: carving by per-pixel look-up lists, surface voxels, their normals and colours.

Kehl & Van Gool 2006, section 4.1. The paper gives each voxel a mask with one bit per camera. Here the same bits are
stored in planes, one bit per voxel, packed along z into words of 32: voxel (x, y, z) is bit ``z % 32`` of word
``(x * ny + y) * nw + z // 32`` with nw = ceil(nz / 32). A plane has W = nx * ny * nw words; a voxel's "place" in it is
32 times its word plus its bit.

Masks enter as int64 words of eight pixels (little-endian, like all platforms of Taichi), M words an image. Each word
has a look-up list of the voxels that project to its pixels, stored as ``place << 3 | pixel % 8``. So changes are found
and applied eight pixels at a time.

``planes`` (2C, W) uint32
    Rows 2c and 2c + 1 together are camera c's bits: set where the camera does not carve the voxel, because its pixel is
    foreground or it lies outside the image. Two threads work on a camera, each on every other stretch of its pixels and
    each in its own row. So no memory is shared, no atomics are needed, and a plane stays in the processor's cache.
``occupied`` (W,) uint32
    The active voxels: the bitwise and of all cameras that carve. Surface and visibility read only this.

All values are integers: results are exact and do not depend on the order of the threads.
"""

import numpy as np
from numpy.typing import NDArray

from tk.kernels.runtime import ensure_runtime, spread_of, ti

__all__ = [
    "SHARES",
    "carve",
    "look_up_lists",
    "pack",
    "places",
    "shade_surface",
    "surface_voxels",
    "unpack",
    "words_per_column",
]

SHARES = 2  # tasks, and planes, per camera; affects speed only
_STRETCH = 128  # mask words, 1024 pixels, of one thread before the other's turn; affects speed only
_WINDOW = 2  # normals come from the voxels within a ball around a voxel: half width of its box ...
_BALL = 6  # ... and squared radius, both in voxels
_FRONTAL = 0.1  # cosine (84°) below which a camera sees a surface at a grazing angle and gives it no colour; chosen
_LIFT = 1.25  # voxels between the surface and a line of sight's start, so that neighbours do not block it; chosen


# --- layout ------------------------------------------------------------------------------------------------------


def words_per_column(nz: int) -> int:
    """Return the number of words of a column of voxels along z."""
    return (nz + 31) // 32


def places(voxels: NDArray[np.int32], nz: int) -> NDArray[np.int32]:
    """Return the places in a packed plane of voxels given by flat index (z fastest)."""
    gap = 32 * words_per_column(nz) - nz
    return voxels if gap == 0 else voxels + voxels // np.int32(nz) * np.int32(gap)


def pack(flags: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Pack (nx, ny, nz) bool into a plane (W,) uint32."""
    nx, ny, nz = flags.shape
    padded = np.zeros((nx, ny, 32 * words_per_column(nz)), dtype=np.bool_)
    padded[:, :, :nz] = flags
    return np.packbits(padded, bitorder="little").view(np.uint32)


def unpack(plane: NDArray[np.uint32], shape: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Unpack a plane (W,) uint32 into (nx, ny, nz) bool."""
    octets = np.ascontiguousarray(plane).view(np.uint8).reshape(shape[0], shape[1], -1)
    return np.unpackbits(octets, axis=-1, count=shape[2], bitorder="little").view(np.bool_)


# --- look-up lists -----------------------------------------------------------------------------------------------


@ti.kernel
def _sort_kernel(
    pixels: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (C, V)
    places_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (V,)
    cursor: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (C, M) start of each list; its end when done
    entries: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (L,) out
):
    for camera in range(pixels.shape[0]):
        for voxel in range(pixels.shape[1]):
            pixel = pixels[camera, voxel]
            if pixel >= 0:
                slot = cursor[camera, pixel >> 3]
                cursor[camera, pixel >> 3] = slot + 1
                entries[slot] = places_in[voxel] << 3 | (pixel & 7)


def look_up_lists(pixels: NDArray[np.int32], mask_words: int, nz: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Convert the voxels' pixels to the pixels' voxels, in compressed rows of eight pixels.

    Args:
        pixels: (C, V) int32, the pixel of each voxel's centre in each camera; -1 outside the image.
        mask_words: M, words of eight pixels in an image.
        nz: voxels along z.

    Returns:
        row_offsets (C * M + 1,) int32 and entries (L,) int32: word w of camera c has the voxels
        ``entries[row_offsets[c * M + w] : row_offsets[c * M + w + 1]]``, ascending, ``place << 3 | pixel % 8`` each.
    """
    ensure_runtime()
    counts = np.stack([np.bincount(row[row >= 0] >> 3, minlength=mask_words) for row in pixels])
    row_offsets = np.zeros(counts.size + 1, dtype=np.int32)
    np.cumsum(counts.ravel(), out=row_offsets[1:])
    entries = np.empty(int(row_offsets[-1]), dtype=np.int32)
    if len(entries):
        all_places = places(np.arange(pixels.shape[1], dtype=np.int32), nz)
        cursor = row_offsets[:-1].reshape(counts.shape).copy()
        _sort_kernel(np.ascontiguousarray(pixels), all_places, cursor, entries)
    return row_offsets, entries


# --- carving -----------------------------------------------------------------------------------------------------


@ti.func
def _foreground(word: ti.i64) -> ti.i64:
    """Return a word with the lowest bit of each byte set where the byte is not zero."""
    low = (ti.i64(0x7F7F7F7F) << 32) | ti.i64(0x7F7F7F7F)
    return ((((word & low) + low) | word) >> 7) & ((ti.i64(0x01010101) << 32) | ti.i64(0x01010101))


@ti.kernel
def _carve_kernel(
    row_offsets: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (C * M + 1,)
    entries: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (L,)
    cameras: ti.i32,  # C
    spread: ti.i32,
    carving: ti.types.ndarray(dtype=ti.u8, ndim=1),  # (C,)
    enough: ti.types.ndarray(dtype=ti.u32, ndim=1),  # (W,)
    current: ti.types.ndarray(dtype=ti.i64, ndim=1),  # (C * M,) masks, eight pixels a word
    previous: ti.types.ndarray(dtype=ti.i64, ndim=1),  # (C * M,) in and out
    planes: ti.types.ndarray(dtype=ti.u32, ndim=1),  # (2C * W,) in and out
    occupied: ti.types.ndarray(dtype=ti.u32, ndim=1),  # (W,) out
):
    # flat arrays: the shape of a two-dimensional array would be read at every access
    mask_words = current.shape[0] // cameras
    plane_words = enough.shape[0]
    stretches = (mask_words + SHARES * _STRETCH - 1) // (SHARES * _STRETCH)
    for turn in range(spread * (cameras * SHARES)):
        if turn % spread != 0:
            continue
        task = turn // spread
        first = task // SHARES * mask_words
        plane = task * plane_words
        for stretch in range(stretches):
            start = (stretch * SHARES + task % SHARES) * _STRETCH
            for word in range(first + start, first + ti.min(start + _STRETCH, mask_words)):
                now = current[word]
                before = previous[word]
                if now != before:
                    previous[word] = now
                    changed = _foreground(now) ^ _foreground(before)
                    for k in range(row_offsets[word], row_offsets[word + 1]):
                        entry = entries[k]
                        flip = ti.cast(changed >> ((entry & 7) << 3), ti.u32) & ti.u32(1)
                        at = plane + (entry >> 8)
                        # not ^=: Taichi's atomic operation takes four times as long
                        planes[at] = planes[at] ^ (flip << ti.cast((entry >> 3) & 31, ti.u32))
    for w in range(plane_words):
        active = enough[w]
        camera = 0
        while active != 0 and camera < cameras:
            if carving[camera] != 0:
                passed = ti.u32(0)
                for share in ti.static(range(SHARES)):
                    passed |= planes[(camera * SHARES + share) * plane_words + w]
                active &= passed
            camera += 1
        occupied[w] = active


def carve(
    row_offsets: NDArray[np.int32],
    entries: NDArray[np.int32],
    carving: NDArray[np.bool_],
    enough: NDArray[np.uint32],
    current: NDArray[np.int64],
    previous: NDArray[np.int64],
    planes: NDArray[np.uint32],
    occupied: NDArray[np.uint32],
) -> None:
    """Update ``planes``, ``occupied`` and ``previous`` in place from the masks ``previous`` to the masks ``current``.

    Only the lists of words with a changed pixel are visited. A pixel is background where 0, else foreground. To carve
    from scratch, ``previous`` is zero and ``planes`` have no foreground: row 2c has the voxels outside camera c's
    image, row 2c + 1 is empty.

    Args:
        row_offsets, entries: the look-up lists of :func:`look_up_lists`.
        carving: (C,) bool, the cameras that carve. The planes of the others follow their masks, too.
        enough: (W,) uint32, the voxels in enough images to be active.
        current, previous: (C, M) int64, each camera's mask (H * W,) uint8, zero-padded to whole words.
        planes: (2C, W) uint32.
        occupied: (W,) uint32.
    """
    ensure_runtime()
    cameras = len(current)
    flat = (current.reshape(-1), previous.reshape(-1), planes.reshape(-1))
    carves = carving.view(np.uint8)
    _carve_kernel(row_offsets, entries, cameras, spread_of(cameras * SHARES), carves, enough, *flat, occupied)


# --- surface -----------------------------------------------------------------------------------------------------


@ti.kernel
def _surface_kernel(
    occupied: ti.types.ndarray(dtype=ti.u32, ndim=3),  # (nx, ny, nw)
    nz: ti.i32,
    spread: ti.i32,
    found: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (V,) out: each slab's surface voxels from its own start on
    slabs: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (nx, 5) out: count, y and z range in which they lie
):
    nx, ny, nw = occupied.shape[0], occupied.shape[1], occupied.shape[2]
    for turn in range(spread * (nx)):
        if turn % spread != 0:
            continue
        x = turn // spread
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
    """Return the active voxels with at least one inactive neighbour of six; outside the grid counts as inactive.

    Args:
        occupied: (W,) uint32.
        shape: (nx, ny, nz).
        found: (V,) int32, scratch that the caller reuses.

    Returns:
        voxels (N,) int32, flat and ascending, and box (2, 3) int32: lowest and highest index along x, y, z.
    """
    ensure_runtime()
    nx, ny, nz = shape
    slabs = np.empty((nx, 5), dtype=np.int32)
    _surface_kernel(occupied.reshape(nx, ny, -1), nz, spread_of(nx), found, slabs)
    used = np.flatnonzero(slabs[:, 0])
    if len(used) == 0:
        return np.zeros(0, dtype=np.int32), np.zeros((2, 3), dtype=np.int32)
    size = ny * nz
    voxels = np.concatenate([found[x * size : x * size + slabs[x, 0]] for x in used])
    low, high = slabs[used].min(axis=0), slabs[used].max(axis=0)
    box = np.array([[used[0], low[1], low[3]], [used[-1], high[2], high[4]]], dtype=np.int32)
    return voxels, box


@ti.func
def _is_occupied(occupied: ti.template(), x: ti.i32, y: ti.i32, z: ti.i32, nz: ti.i32) -> ti.i32:
    """Return 1 if the voxel is active, 0 if it is inactive or outside the grid."""
    result = ti.u32(0)
    if 0 <= x < occupied.shape[0] and 0 <= y < occupied.shape[1] and 0 <= z < nz:
        result = (occupied[x, y, z >> 5] >> ti.cast(z & 31, ti.u32)) & ti.u32(1)
    return ti.cast(result, ti.i32)


@ti.func
def _outward(occupied: ti.template(), x: ti.i32, y: ti.i32, z: ti.i32, nz: ti.i32) -> ti.math.vec3:
    """Return the unit vector from the centroid of the active voxels in a ball to its centre; zero if they coincide."""
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
def _in_sight(
    occupied: ti.template(), start: ti.math.vec3, view: ti.math.vec3, box: ti.template(), nz: ti.i32
) -> ti.i32:
    """Return 1 if no active voxel lies on the line from ``start`` along the unit vector ``view`` within the box.

    The line is sampled where it crosses the layers of its dominant axis. All in voxels.
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
    pixels: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (V, C)
    used: ti.types.ndarray(dtype=ti.u8, ndim=1),  # (C,)
    eyes: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (C, 3) voxels
    spacing: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (C,) pixels
    images: ti.types.ndarray(dtype=ti.u8, ndim=4),  # (C, H, W, 3), or (C, 0, 0, 3)
    masks: ti.types.ndarray(dtype=ti.u8, ndim=2),  # (C, at least H * W)
    voxels: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
    box: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (2, 3)
    normals: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (N, 3) out
    colors: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (N, 3) out
    seen: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,) out
):
    height, width = images.shape[1], images.shape[2]
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
        for camera in range(pixels.shape[1]):
            pixel = pixels[voxel, camera]
            if pixel >= 0 and used[camera] != 0:
                view = (ti.Vector([eyes[camera, 0], eyes[camera, 1], eyes[camera, 2]]) - center).normalized()
                cosine = normal.dot(view)
                start = center + _LIFT * normal
                if undefined:
                    cosine = ti.f32(1.0)
                    start = center + _LIFT * view
                if cosine > _FRONTAL and _in_sight(occupied, start, view, box, nz):
                    cameras |= 1 << camera
                    if height > 0:
                        # nine foreground pixels spread over the voxel's footprint
                        row = pixel // width
                        for i in range(-1, 2):
                            for j in range(-1, 2):
                                v = row + i * spacing[camera]
                                u = pixel - row * width + j * spacing[camera]
                                if 0 <= v < height and 0 <= u < width and masks[camera, v * width + u] != 0:
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
    used: NDArray[np.bool_],
    eyes: NDArray[np.float32],
    spacing: NDArray[np.int32],
    images: NDArray[np.uint8] | None,
    masks: NDArray[np.uint8],
    voxels: NDArray[np.int32],
    box: NDArray[np.int32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    """Return normals and colours of surface voxels, and the cameras that see them.

    A camera sees a voxel if it lies in the image, its surface faces the camera, and no active voxel hides it. Colours
    are averages over such cameras, weighted by the squared cosine between normal and line of sight. (The paper, section
    4.1, refers to its reference [19] for texturing; this method is not from there.)

    Args:
        occupied: (W,) uint32.
        shape: (nx, ny, nz).
        pixels: (V, C) int32, pixel of each voxel in each camera, -1 outside the image.
        used: (C,) bool, the cameras that may see a voxel.
        eyes: (C, 3) float32, centres of projection in voxels: the centre of voxel (0, 0, 0) is the origin.
        spacing: (C,) int32, pixels between the three by three samples of a voxel's colour.
        images: (C, H, W, 3) uint8, or None for no colours.
        masks: (C, at least H * W) uint8; only foreground pixels count.
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
        given = pixels, used.view(np.uint8), eyes, spacing, images, masks, voxels, box
        _shade_kernel(packed, shape[2], *given, normals, colors, seen)
    return normals, colors, seen
