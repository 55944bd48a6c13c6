"""The visual hull of synthetic rigs and shared captures against a brute-force projection hull."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.conftest import development_capture
from tk.errors import ConfigError, VolumeError
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.volume import Volume, VoxelGrid
from tk.model.hull.hull import VisualHull

VOLUME = Volume((0.0, 0.0, 1.0), (1.0, 0.8, 1.2))
few = settings(max_examples=15)


def look_at(name, eye, target=(0.0, 0.0, 1.0), size=(48, 40), focal=44.0, distortions=(0.05, -0.02, 0.001, -0.001)):
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0) if abs(forward[2]) < 0.9 else (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    width, height = size
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    return Camera(name, width, height, matrix, np.asarray(distortions, float), rotation, -rotation @ eye)


def make_rig(count=4):
    """Cameras around the volume; every third is smaller than the frame, every fourth cuts the volume off."""
    cameras = []
    for i in range(count):
        angle = 2.4 * i
        eye = (2.0 * np.cos(angle), 2.0 * np.sin(angle), 1.0 + 0.5 * (-1) ** i)
        size = (31, 40) if i % 3 == 1 else (48, 40)
        cameras.append(look_at(f"c{i}", eye, size=size, focal=90.0 if i % 4 == 3 else 44.0))
    return Rig(tuple(cameras))


def hull_oracle(rig, grid, masks):
    """Project every voxel into every picture with foreground: active if foreground in all that hold it, and two do."""
    passed = np.ones(grid.count, dtype=bool)
    holders = np.zeros(grid.count, dtype=int)
    centers = grid.centers()
    for camera, mask in zip(rig, masks, strict=True):
        if not mask.any():
            continue
        inside = camera.sees(centers)
        xy = np.floor(camera.project(centers)[0][inside] + 0.5).astype(int)
        passed[inside] &= mask[xy[:, 1], xy[:, 0]] != 0
        holders += inside
    return (passed & (holders >= 2)).reshape(grid.shape)


def silhouettes(rig, solid):
    """(C, H, W) masks of the points (N, 3) of a solid, filled by small discs."""
    masks = np.zeros((len(rig), *rig.frame_shape), dtype=np.uint8)
    for camera, mask in zip(rig, masks, strict=True):
        for x, y in np.rint(camera.project(solid)[0]).astype(int):
            cv2.circle(mask, (int(x), int(y)), 1, 255, -1)
        mask[:, camera.width :] = 0
    return masks


def ball(center=(0.0, 0.0, 1.0), radius=0.25, count=4000, seed=0):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(center) + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@few
@given(st.integers(2, 7), st.integers(2, 24), st.integers(0, 2**32 - 1))
def test_incremental_equals_from_scratch_equals_oracle(cameras, voxels, seed):
    rng = np.random.default_rng(seed)
    rig, grid = make_rig(cameras), VoxelGrid.cover(VOLUME, voxels)
    followed = VisualHull(rig, grid)
    anew = VisualHull(rig, grid)
    masks = np.full((cameras, *rig.frame_shape), 255, dtype=np.uint8)
    for _ in range(5):
        flip = rng.random(masks.shape) < rng.choice([0.0, 0.02, 0.5])
        masks = np.where(flip, 255 - masks, masks).astype(np.uint8)
        followed.update(masks)
        anew.carve(masks)
        np.testing.assert_array_equal(followed.occupancy, hull_oracle(rig, grid, masks))
        np.testing.assert_array_equal(anew.occupancy, followed.occupancy)
        np.testing.assert_array_equal(anew._planes, followed._planes)


@pytest.mark.parametrize("width", [47, 48])  # 4 * 40 * 47 bytes are whole words, 3 * 41 * 47 are not
@pytest.mark.parametrize("height", [40, 41])
def test_image_widths_that_are_no_multiple_of_a_word(width, height):
    rig = Rig(
        tuple(look_at(f"c{i}", e, size=(width, height)) for i, e in enumerate([(2, 0, 1), (0, 2, 1), (-2, 1, 1)]))
    )
    grid = VoxelGrid.cover(VOLUME, 20)
    hull = VisualHull(rig, grid)
    rng = np.random.default_rng(1)
    for share in (0.9, 0.8):
        masks = ((rng.random((3, height, width)) < share) * 255).astype(np.uint8)
        hull.update(masks)
        np.testing.assert_array_equal(hull.occupancy, hull_oracle(rig, grid, masks))


def test_masks_in_any_memory_layout():
    rig, grid = make_rig(3), VoxelGrid.cover(VOLUME, 16)
    masks = silhouettes(rig, ball())
    hull = VisualHull(rig, grid)
    hull.carve(masks)
    expected = hull.occupancy
    assert expected.any()
    shifted = np.empty(masks.size + 1, dtype=np.uint8)[1:].reshape(masks.shape)  # not aligned to a word
    shifted[:] = masks
    for other in (np.asfortranarray(masks), shifted, np.stack([masks, masks], axis=-1)[..., 0], masks // 255):
        hull.carve(other)
        np.testing.assert_array_equal(hull.occupancy, expected)


def test_reset_forgets_the_frame():
    rig, grid = make_rig(3), VoxelGrid.cover(VOLUME, 16)
    hull = VisualHull(rig, grid)
    fresh = hull._planes.copy()
    assert not hull.occupancy.any() and len(hull.surface()) == 0
    hull.update(silhouettes(rig, ball()))
    assert hull.occupancy.any()
    hull.reset()
    assert not hull.occupancy.any()
    np.testing.assert_array_equal(hull._planes, fresh)


def test_voxels_outside_a_picture_are_not_carved_by_it_and_need_two_others():
    """A narrow camera keeps what lies beside its picture; what only one camera holds is never active."""
    narrow = look_at("narrow", (2, 0, 1), focal=200.0)
    wide = look_at("wide", (0, 2, 1))
    third = look_at("third", (-1.5, -1.5, 1.2))
    grid = VoxelGrid.cover(VOLUME, 20)
    centers = grid.centers()
    held = np.array([camera.sees(centers) for camera in (narrow, wide, third)]).sum(0).reshape(grid.shape)
    hull = VisualHull(Rig((narrow, wide)), grid)
    everything = np.full((2, 40, 48), 255, dtype=np.uint8)
    hull.carve(everything)
    both = (narrow.sees(centers) & wide.sees(centers)).reshape(grid.shape)
    assert 0 < both.sum() < grid.count
    np.testing.assert_array_equal(hull.occupancy, both)
    hull = VisualHull(Rig((narrow, wide, third)), grid)
    hull.carve(np.full((3, 40, 48), 255, dtype=np.uint8))
    np.testing.assert_array_equal(hull.occupancy, held >= 2)
    assert hull.occupancy.sum() > both.sum()


def test_a_camera_without_foreground_neither_carves_nor_sees():
    """As if it were not in the rig, while it is empty; with one camera left there is no depth, and no hull."""
    rig, grid = make_rig(5), VoxelGrid.cover(VOLUME, 20)
    hull, masks = VisualHull(rig, grid), silhouettes(rig, ball())
    images = np.full((*masks.shape, 3), 90, np.uint8)
    for empty in ((), (4,), (3, 4), (), (0, 2, 3), (0, 1, 2, 3), (2,)):
        shown = masks.copy()
        shown[list(empty)] = 0
        hull.update(shown)
        np.testing.assert_array_equal(hull.occupancy, hull_oracle(rig, grid, shown))
        assert hull.occupancy.any() == (len(empty) < 4)
        surface = hull.surface(images)
        assert not any((surface.seen & 1 << c).any() for c in empty)
        np.testing.assert_allclose(surface.colors[surface.seen != 0], 90, rtol=1e-5)


def test_surface_of_a_two_coloured_ball():
    """Red where x > 0, blue elsewhere, as every camera sees it; normals and positions fit the ball."""
    eyes = [(3, 0.4, 1.2), (-3, 0.5, 1.0), (0.5, 3, 1.1), (-0.4, -3, 0.9), (0.3, 0.2, 4.0)]
    rig = Rig(tuple(look_at(f"c{i}", e, size=(160, 120), focal=200.0) for i, e in enumerate(eyes)))
    grid = VoxelGrid.cover(Volume((0, 0, 1), (0.8, 0.8, 0.8)), 40)
    solid = ball(radius=0.3, count=20000)
    masks = silhouettes(rig, solid)
    images = np.full((*masks.shape, 3), 128, dtype=np.uint8)
    red, blue = (0, 0, 255), (255, 0, 0)
    for camera, image in zip(rig, images, strict=True):
        facing = ((solid - (0, 0, 1)) * (camera.center - solid)).sum(axis=1) > 0
        for (x, y), p in zip(np.rint(camera.project(solid[facing])[0]).astype(int), solid[facing], strict=True):
            cv2.circle(image, (int(x), int(y)), 1, red if p[0] > 0 else blue, -1)
    hull = VisualHull(rig, grid)
    hull.carve(masks)
    surface = hull.surface(images)
    assert (np.diff(surface.voxels) > 0).all()
    np.testing.assert_allclose(surface.positions, grid.centers(surface.voxels), atol=1e-6)
    radial = surface.positions - (0, 0, 1)
    distance = np.linalg.norm(radial, axis=1)
    assert 0.27 < np.median(distance) < 0.34
    assert np.median((surface.normals * radial).sum(1) / distance) > 0.95
    seen = surface.seen != 0
    assert seen.mean() > 0.7 and not surface.colors[~seen].any()
    clear = seen & (np.abs(radial[:, 0]) > 0.06)
    is_red = surface.colors[:, 2] > surface.colors[:, 0]
    assert (is_red == (radial[:, 0] > 0))[clear].mean() > 0.98
    again = hull.surface(images)
    np.testing.assert_array_equal(again.colors, surface.colors)
    plain = hull.surface()
    np.testing.assert_array_equal(plain.seen, surface.seen)
    assert not plain.colors.any()


def test_wrong_shapes_are_refused():
    rig, grid = make_rig(3), VoxelGrid.cover(VOLUME, 8)
    hull = VisualHull(rig, grid)
    with pytest.raises(ValueError, match="expected uint8"):
        hull.update(np.zeros((3, 40, 47), dtype=np.uint8))
    with pytest.raises(ValueError, match="expected uint8"):
        hull.update(np.zeros((3, 40, 48), dtype=bool))
    with pytest.raises(ValueError, match="expected uint8"):
        hull.surface(np.zeros((3, 40, 48), dtype=np.uint8))


def test_thirty_one_cameras_and_no_more():
    grid = VoxelGrid.cover(VOLUME, 8)
    rig = make_rig(31)
    hull = VisualHull(rig, grid)
    masks = np.full((31, *rig.frame_shape), 255, dtype=np.uint8)
    masks[30, 15:25, 15:30] = 0
    hull.update(masks)
    np.testing.assert_array_equal(hull.occupancy, hull_oracle(rig, grid, masks))
    with pytest.raises(ConfigError, match=r"32 cameras.*31"):
        VisualHull(make_rig(32), grid)


def test_a_volume_that_no_two_cameras_see():
    grid = VoxelGrid.cover(Volume((50.0, 50.0, 1.0), (1.0, 1.0, 1.0)), 8)
    with pytest.raises(VolumeError, match=r"capture\.toml: no two cameras see"):
        VisualHull(make_rig(3), grid)


# --- shared captures -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["walk", "dance"])
def test_incremental_hull_of_exact_masks_equals_the_hull_from_scratch(name):
    """For twenty frames, voxel for voxel; and the volume is a person's."""
    from scripts import bench_hull

    capture = bench_hull.load_masks(development_capture(name), range(20, 40))
    grid = VoxelGrid.cover(capture.volume, 64)
    followed = VisualHull(capture.rig, grid)
    anew = VisualHull(capture.rig, grid)
    for masks in capture.masks:
        followed.update(masks)
        anew.carve(masks)
        np.testing.assert_array_equal(followed._planes, anew._planes)
        np.testing.assert_array_equal(followed.occupancy, anew.occupancy)
    np.testing.assert_array_equal(followed.occupancy, hull_oracle(capture.rig, grid, capture.masks[-1]))
    litres = followed.occupancy.sum() * grid.voxel_m**3 * 1000
    assert 50 < litres < 200
    surface = followed.surface()
    assert (surface.seen != 0).mean() > 0.8
