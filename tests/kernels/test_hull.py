"""Hull kernels against slow, obvious NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.kernels import hull as kernels

shapes = st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 70))
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=25)


def pack_oracle(active):
    """(nx, ny, nz) bool to packed words, by the documented layout."""
    nx, ny, nz = active.shape
    words = np.zeros((nx, ny, (nz + 31) // 32), dtype=np.uint32)
    for x, y, z in np.argwhere(active):
        words[x, y, z // 32] |= np.uint32(1 << (z % 32))
    return words.ravel()


def surface_oracle(active):
    """Flat indices of active voxels with an inactive neighbour, and the box around them."""
    padded = np.pad(active, 1)
    inner = np.ones_like(active)
    for axis in range(3):
        for shift in (-1, 1):
            inner &= np.roll(padded, shift, axis)[1:-1, 1:-1, 1:-1]
    surface = active & ~inner
    where = np.argwhere(surface)
    box = np.array([where.min(0), where.max(0)]) if len(where) else np.zeros((2, 3), int)
    return np.flatnonzero(surface), box


def normals_oracle(active, voxels):
    ball = [d for d in np.ndindex(5, 5, 5) if np.sum((np.array(d) - 2) ** 2) <= 6]
    padded = np.pad(active, 2)
    normals = np.zeros((len(voxels), 3))
    for n, (x, y, z) in enumerate(zip(*np.unravel_index(voxels, active.shape), strict=True)):
        for d in ball:
            if padded[x + d[0], y + d[1], z + d[2]]:
                normals[n] -= np.array(d) - 2
        length = np.linalg.norm(normals[n])
        normals[n] /= length if length else 1.0
    return normals


def blob(shape, seed, share=0.5):
    return np.random.default_rng(seed).random(shape) < share


def shade(active, eyes, pixels=None, images=None, masks=None, spacing=1, used=None):
    eyes = np.atleast_2d(np.asarray(eyes, dtype=np.float32))
    count = len(eyes)
    if pixels is None:
        pixels = np.zeros((active.size, count), dtype=np.int32)
    if masks is None:
        masks = np.full((count, 4, 4), 255, dtype=np.uint8)
    masks = masks.reshape(count, -1)
    occupied = pack_oracle(active)
    voxels, box = kernels.surface_voxels(occupied, active.shape, np.empty(active.size, dtype=np.int32))
    spacings = np.full(count, spacing, dtype=np.int32)
    used = np.ones(count, bool) if used is None else used
    shaded = kernels.shade_surface(occupied, active.shape, pixels, used, eyes, spacings, images, masks, voxels, box)
    return voxels, *shaded


@few
@given(st.integers(1, 4), shapes, st.sampled_from([5, 8, 30]), seeds)
def test_look_up_lists_are_the_inverse_of_the_projection(cameras, shape, pixel_count, seed):
    count = int(np.prod(shape))
    pixels = np.random.default_rng(seed).integers(-1, pixel_count, (cameras, count)).astype(np.int32)
    words = -(-pixel_count // 8)
    row_offsets, entries = kernels.look_up_lists(pixels, words, shape[2])
    place = kernels.places(np.arange(count, dtype=np.int32), shape[2])
    assert row_offsets[0] == 0 and row_offsets[-1] == len(entries)
    for camera in range(cameras):
        for word in range(words):
            row = entries[slice(*row_offsets[camera * words + word :][:2])]
            expected = [(place[v], p % 8) for v, p in enumerate(pixels[camera]) if p >= 0 and p // 8 == word]
            assert [(e >> 3, e & 7) for e in row] == expected


@few
@given(shapes, seeds)
def test_packing_follows_the_documented_layout(shape, seed):
    active = blob(shape, seed)
    plane = kernels.pack(active)
    np.testing.assert_array_equal(plane, pack_oracle(active))
    np.testing.assert_array_equal(kernels.unpack(plane, shape), active)
    place = kernels.places(np.arange(active.size, dtype=np.int32), shape[2])
    np.testing.assert_array_equal((plane[place >> 5] >> (place & 31).astype(np.uint32)) & 1, active.ravel())


@few
@given(st.integers(1, 31), shapes, st.sampled_from([7, 16, 3000]), seeds)
def test_carving_follows_any_sequence_of_masks(cameras, shape, pixel_count, seed):
    """Planes and occupancy after each of several frames equal the definition."""
    rng = np.random.default_rng(seed)
    count = int(np.prod(shape))
    pixels = rng.integers(-1, pixel_count, (cameras, count)).astype(np.int32)
    row_offsets, entries = kernels.look_up_lists(pixels, -(-pixel_count // 8), shape[2])
    enough = (pixels >= 0).sum(0) >= 2
    outside = [kernels.pack((row < 0).reshape(shape)) for row in pixels]
    planes = np.stack([p for one in outside for p in (one, np.zeros_like(one))])
    occupied = np.zeros_like(outside[0])
    previous = np.zeros((cameras, -(-pixel_count // 8)), dtype=np.int64)
    for share in (0.9, 1.0, 0.95, 0.0, 1.0):
        masks = np.zeros((cameras, previous.shape[1] * 8), dtype=np.uint8)
        foreground = rng.random((cameras, pixel_count)) < share
        masks[:, :pixel_count] = foreground * rng.choice([1, 128, 255], foreground.shape)
        carving = rng.random(cameras) < 0.8
        kernels.carve(
            row_offsets,
            entries,
            carving,
            kernels.pack(enough.reshape(shape)),
            masks.view(np.int64),
            previous,
            planes,
            occupied,
        )
        passed = [(pixels[c] < 0) | foreground[c, pixels[c]] for c in range(cameras)]
        for camera in range(cameras):
            both = kernels.unpack(planes[2 * camera] | planes[2 * camera + 1], shape)
            np.testing.assert_array_equal(both.ravel(), passed[camera])
        expected = np.all(np.array(passed)[carving], axis=0) & enough
        np.testing.assert_array_equal(kernels.unpack(occupied, shape).ravel(), expected)
        np.testing.assert_array_equal(previous, masks.view(np.int64))


@few
@given(shapes, seeds, st.sampled_from([0.0, 0.02, 0.5, 0.95, 1.0]))
def test_surface_voxels_and_normals(shape, seed, share):
    active = blob(shape, seed, share)
    voxels, normals, colors, seen = shade(active, [[100.0, 0.0, 0.0]])
    expected, box = surface_oracle(active)
    np.testing.assert_array_equal(voxels, expected)
    np.testing.assert_array_equal(
        kernels.surface_voxels(pack_oracle(active), shape, np.empty(active.size, np.int32))[1], box
    )
    np.testing.assert_allclose(normals, normals_oracle(active, voxels), atol=1e-6)
    assert not colors.any() and len(seen) == len(voxels)


def in_sight_oracle(active, start, eye, samples_per_layer):
    """Whether a sampled line from ``start`` to ``eye`` meets no active voxel."""
    step = (eye - start) / np.abs(eye - start).max() / samples_per_layer
    t = np.arange(np.abs(eye - start).max() * samples_per_layer)
    at = np.floor(start + t[:, None] * step + 0.5).astype(int)
    inside = ((at >= 0) & (at < active.shape)).all(axis=1)
    return not active[tuple(at[inside].T)].any()


@pytest.mark.parametrize("eye", [(70.0, 15.0, 12.0), (-25.0, 40.0, 60.0), (15.0, 15.0, -50.0)])
def test_visibility_agrees_with_sampled_lines_of_sight(eye):
    """Two balls, one before the other in the first view."""
    eye = np.array(eye)
    grid = np.stack(np.meshgrid(*[np.arange(31.0)] * 3, indexing="ij"), axis=-1)
    active = (np.linalg.norm(grid - (8, 15, 15), axis=-1) < 6.4) | (np.linalg.norm(grid - (23, 15, 14), axis=-1) < 4.2)
    voxels, normals, _, seen = shade(active, [eye])
    centers = grid.reshape(-1, 3)[voxels]
    view = eye - centers
    cosine = (normals * view).sum(1) / np.linalg.norm(view, axis=1)
    starts = centers + 1.25 * normals

    def expected(samples_per_layer):
        # the kernel keeps the direction of the voxel's centre
        return (cosine > 0.1) & [
            in_sight_oracle(active, s, s + v, samples_per_layer) for s, v in zip(starts, view, strict=True)
        ]

    assert 0.1 < expected(1).mean() < 0.6
    assert (seen.astype(bool) != expected(1)).mean() < 0.005  # float32 rounds a sample to another voxel now and then
    assert (seen.astype(bool) != expected(20)).mean() < 0.04  # one sample a layer passes by the corner of a voxel
    assert seen[cosine > 0.6].sum() > 0 and not seen[cosine < 0].any()


def test_colours_come_from_the_footprint_and_only_from_foreground():
    active = np.ones((1, 1, 1), dtype=bool)
    images = np.random.default_rng(3).integers(0, 256, (1, 9, 9, 3)).astype(np.uint8)
    masks = np.full((1, 9, 9), 255, dtype=np.uint8)
    masks[0, 1, 4] = 0
    masks[0, 7, 7] = 0
    pixels = np.array([[4 * 9 + 4]], dtype=np.int32)
    _, normals, colors, seen = shade(active, [[50.0, 0.0, 0.0]], pixels, images, masks, spacing=3)
    patch = images[0, 1::3, 1::3].astype(float)[masks[0, 1::3, 1::3] != 0]
    assert len(patch) == 7
    assert not normals.any() and seen.tolist() == [1]
    np.testing.assert_allclose(colors[0], patch.mean(axis=0), rtol=1e-5)


def test_colours_of_two_cameras_are_weighted_by_squared_cosines():
    active = np.zeros((7, 7, 7), dtype=bool)
    active[:, :, :3] = True  # a floor; its middle voxel has the normal (0, 0, 1)
    eyes = [[3.0, 3.0, 80.0], [3.0 + 60.0, 3.0, 2.0 + 60.0]]
    images = np.zeros((2, 4, 4, 3), dtype=np.uint8)
    images[0], images[1] = (200, 100, 0), (50, 100, 250)
    pixels = np.full((active.size, 2), 5, dtype=np.int32)
    voxels, normals, colors, seen = shade(active, eyes, pixels, images)
    middle = np.flatnonzero(voxels == np.ravel_multi_index((3, 3, 2), active.shape))[0]
    np.testing.assert_allclose(normals[middle], [0, 0, 1])
    assert seen[middle] == 0b11
    np.testing.assert_allclose(
        colors[middle], (np.array([200, 100, 0]) + 0.5 * np.array([50, 100, 250])) / 1.5, rtol=1e-5
    )


def test_a_voxel_outside_the_picture_has_no_colour_from_it():
    active = np.ones((1, 1, 1), dtype=bool)
    images = np.full((2, 4, 4, 3), 90, dtype=np.uint8)
    pixels = np.array([[-1, -1]], dtype=np.int32)
    _, _, colors, seen = shade(active, [[50.0, 0, 0], [0, 50.0, 0]], pixels, images)
    assert seen.tolist() == [0] and colors.tolist() == [[0.0, 0.0, 0.0]]
