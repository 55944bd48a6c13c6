"""How far a camera's image has moved, measured beside the person."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from scripts.fault_kinds import zoomed
from tk.model.masks.image_shift import ImageShift, exchanged_scenes

H, W = 240, 320
SCENE = cv2.resize(
    np.random.default_rng(0).integers(40, 200, (36, 48), np.uint8), (480, 360), interpolation=cv2.INTER_CUBIC
)


def view(shift: tuple[float, float] = (0.0, 0.0), person: int = 0, gain: float = 1.0, seed: int = 0) -> np.ndarray:
    """Return an image (H, W, 3) of a scene with details, with noise and a person in front."""
    warp = np.array([[1.0, 0.0, shift[0] - 80.0], [0.0, 1.0, shift[1] - 60.0]])
    image = gain * cv2.warpAffine(SCENE, warp, (W, H)).astype(np.float64)
    image[60:200, 60 + person : 110 + person] = 250.0
    image += np.random.default_rng(seed).normal(0.0, 4.0, image.shape)
    return np.repeat(image.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def mask(person: int = 0) -> np.ndarray:
    shown = np.zeros((H, W), np.uint8)
    shown[60:200, 60 + person : 110 + person] = 255
    return shown


def measured(now: np.ndarray, of: np.ndarray, count: int = 1) -> float:
    """Return the shift of an image, pixels, after so many frames in which it was seen."""
    shift = ImageShift()
    shift.look(view()[None], mask()[None])
    return [W * float(shift.look(now[None], of[None])[0]) for _ in range(count)][-1]


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.7, 0.0), (-3.0, 2.0), (6.0, -4.0), (50.0, 0.0), (-30.0, 25.0)])
@pytest.mark.parametrize("gain", [1.0, 0.6])
def test_shift_is_measured_to_a_fifth_of_a_pixel(shift: tuple[float, float], gain: float) -> None:
    now = view(shift, person=20, gain=gain, seed=1)
    assert measured(now, mask(20)) == pytest.approx(np.hypot(*shift), abs=0.2)


@pytest.mark.parametrize("zoom", [1.02, 1.2, 0.85])
def test_zoom_moves_the_image_by_the_mean_over_its_pixels(zoom: float) -> None:
    now = zoomed(view(person=20, seed=1), zoom)
    away = abs(zoom - 1) * np.hypot(W, H) / np.sqrt(12)
    assert measured(now, zoomed(mask(20), zoom)) == pytest.approx(away, abs=0.05 * away + 0.3)


def test_person_and_what_moves_beside_do_not_move_the_image() -> None:
    now = view(person=60, seed=1)
    now[20:120, 200:240] = 30  # a chair that was not there
    assert measured(now, mask(60)) < 0.2


@pytest.mark.parametrize("gain", [0.8, 0.3])
def test_light_that_changes_moves_no_image_whose_few_details_lie_at_its_border(gain: float) -> None:
    room = np.full((1, H, W, 3), 90.0)
    room[:, :, :8], room[:, 225:], room[:, 30:60, 250:300] = 200.0, 200.0, 40.0
    rng, nobody, shift = np.random.default_rng(2), np.zeros((1, H, W), np.uint8), ImageShift()
    bright, *dim = [(k * room + rng.normal(0.0, 1.5, room.shape)).astype(np.uint8) for k in (1.0, gain, gain, gain)]
    shift.look(bright, nobody)
    assert max(W * float(shift.look(image, nobody)[0]) for image in dim) < 0.1


def test_person_outside_a_doubtful_mask_does_not_move_the_image() -> None:
    shift, doubtful = ImageShift(), np.ones(1, np.bool_)
    shift.look(view()[None], np.zeros((1, H, W), np.uint8), doubtful)
    shift.look(view(person=10)[None], mask(10)[None], ~doubtful)
    moved = [W * float(shift.look(view(person=k)[None], mask(k)[None], doubtful)[0]) for k in (12, 14, 16, 18)]
    assert max(moved) < 0.2


@pytest.mark.parametrize("levels", [0.0, 20.0])
def test_image_without_details_has_no_shift(levels: float) -> None:
    rng = np.random.default_rng(2)
    plain = [(128 + rng.normal(0.0, levels, (1, H, W, 3))).clip(0, 255).astype(np.uint8) for _ in range(4)]
    shift = ImageShift()
    nobody = np.zeros((1, H, W), np.uint8)
    shifts = [float(shift.look(image, nobody)[0]) for image in plain]
    assert shifts[0] == 0.0 and np.isnan(shifts[1:]).all()


def test_noise_moves_no_image_of_planks_in_one_direction() -> None:
    rng, nobody, shift = np.random.default_rng(3), np.zeros((1, H, W), np.uint8), ImageShift()
    planks = 128.0 + cv2.GaussianBlur(rng.normal(0.0, 150.0, (1, W)), (0, 0), 4.0)
    floor = cv2.GaussianBlur(rng.normal(0.0, 60.0, (H, W)), (0, 0), 4.0) + planks
    images = [(floor + rng.normal(0.0, 30.0, (H, W))).clip(0, 255).astype(np.uint8) for _ in range(41)]
    shifts = [W * float(shift.look(np.repeat(image[None, ..., None], 3, axis=3), nobody)[0]) for image in images]
    assert max(shifts) == 0.0


def test_other_scene_has_no_shift() -> None:
    assert np.isnan(measured(view()[::-1, ::-1].copy(), mask()))


def test_each_camera_is_measured_in_its_turn_also_after_a_restart() -> None:
    images, masks = np.stack([view()] * 3), np.stack([mask()] * 3)
    shift, again = ImageShift(), ImageShift()
    shift.look(images, masks)
    images[1] = view((8.0, 0.0))
    moved = [W * shift.look(images, masks)]
    again.state = shift.state
    moved += [(again.look(images, masks), W * again.look(images, masks))[1] for _ in range(2)]
    np.testing.assert_allclose(moved, [[0.0, 0.0, 0.0], [0.0, 8.0, 0.0], [0.0, 8.0, 0.0]], atol=0.2)


def test_exchanged_videos_show_each_others_empty_scene() -> None:
    rng = np.random.default_rng(4)
    scenes = [cv2.resize(rng.integers(40, 200, (24, 32, 3), np.uint8), (W, H)) for _ in range(4)]
    images = np.stack(scenes)
    images[:, 60:200, 60:110] = 250
    masks = np.broadcast_to(mask(), (4, H, W))
    assert exchanged_scenes(scenes, images, masks) == {}
    assert exchanged_scenes(scenes, images[[0, 2, 1, 3]], masks) == {1: 2, 2: 1}
    assert exchanged_scenes(scenes, images[[1, 2, 0, 3]], masks) == {0: 1, 1: 2, 2: 0}
    images[3] = 0
    assert exchanged_scenes(scenes, images, masks) == {}
