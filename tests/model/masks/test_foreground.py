"""Segmentation: synthetic scenes with known masks, and the shared captures where they are at hand."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.errors import CaptureError
from tk.model.masks.background import median_plate
from tk.model.masks.foreground import CollinearityForeground
from tk.model.masks.mog2 import Mog2Foreground
from tk.model.masks.regions import clean_by_area

CAPTURES = Path(__file__).parents[4] / "shared" / "captures"
SHAPE = (120, 160)
SIZES = np.array([[160, 120], [140, 100]])
PERSON = (slice(25, 85), slice(60, 85))
SHADOW = (slice(78, 95), slice(20, 66))  # runs under the person's feet


def plates(rng):
    """(2, H, W, 3) float: smooth walls with some texture; the second camera is smaller."""
    result = np.zeros((2, *SHAPE, 3))
    for c, (width, height) in enumerate(SIZES):
        texture = cv2.GaussianBlur(rng.normal(0, 60, (height, width, 3)), (0, 0), 2)
        result[c, :height, :width] = np.clip(np.array([150, 140, 120]) + texture, 60, 220)
    return result


def expose(scene, rng, noise=1.5, gain=(1.0, 1.0, 1.0)):
    image = scene * np.asarray(gain)
    image = image + rng.normal(0, noise, image.shape) * (scene > 0)
    return np.clip(image.round(), 0, 255).astype(np.uint8)


def with_person(scene, color, shadow=0.8):
    """The scene with a soft-edged cast shadow and a person of one colour; and the person's masks."""
    scene = scene.copy()
    shade = np.ones(SHAPE)
    shade[SHADOW] = shadow
    scene *= cv2.GaussianBlur(shade, (0, 0), 2)[..., None]
    mask = np.zeros((2, *SHAPE), bool)
    mask[:, PERSON[0], PERSON[1]] = True
    scene[mask] = np.asarray(color)
    return scene, mask


def background(rng, frames=12, **kwargs):
    scene = plates(np.random.default_rng(5))
    stack = np.stack([expose(scene, rng, **kwargs) for _ in range(frames)])
    return scene, [stack[:, c, :h, :w] for c, (w, h) in enumerate(SIZES)]


def iou(mask, truth):
    return np.sum((mask > 0) & truth) / np.sum((mask > 0) | truth)


@pytest.fixture(scope="module")
def learned():
    rng = np.random.default_rng(0)
    scene, clips = background(rng)
    return scene, clips, CollinearityForeground.learn(clips, SHAPE, SIZES)


@pytest.mark.parametrize("noise", [1.0, 3.0, 6.0])
@pytest.mark.parametrize("color", [(40, 40, 200), (20, 20, 20), (230, 230, 230)], ids=["red", "black", "white"])
def test_finds_the_person_and_not_the_shadow(noise, color):
    rng = np.random.default_rng(1)
    scene, clips = background(rng, noise=noise)
    image, truth = with_person(scene, color)
    masks = CollinearityForeground.learn(clips, SHAPE, SIZES).segment(expose(image, rng, noise=noise))
    assert masks.shape == (2, *SHAPE) and masks.dtype == np.uint8 and set(np.unique(masks)) == {0, 255}
    for c in range(2):
        assert iou(masks[c], truth[c]) > 0.93


def test_clothes_of_the_wall_s_colour_leave_no_hole(learned):
    scene, _, foreground = learned
    # 0.8 of the wall: a shadow, as far as the colour can tell
    image, truth = with_person(scene, (120, 112, 96))
    masks = foreground.segment(expose(image, np.random.default_rng(2)))
    inner = cv2.erode(truth[0].astype(np.uint8), np.ones((5, 5))) > 0
    assert np.mean(masks[0][inner] > 0) > 0.97
    assert iou(masks[0], truth[0]) > 0.85


@pytest.mark.parametrize("learner", [CollinearityForeground, Mog2Foreground])
def test_a_shadow_is_doubtful_and_the_scene_and_the_person_are_not(learner):
    """A shadow may be a cloth as well: one camera cannot tell. What equals the scene, and the person, it can."""
    rng = np.random.default_rng(4)
    scene, clips = background(rng)
    image, truth = with_person(scene, (40, 40, 200), shadow=0.75)
    picture = expose(image, rng)
    foreground = learner.learn(clips, SHAPE, SIZES)
    masks, uncertain = foreground.label(picture)
    np.testing.assert_array_equal(masks, foreground.segment(picture))
    assert uncertain.shape == masks.shape and uncertain.dtype == bool
    assert not (uncertain & (masks > 0)).any()
    assert not uncertain[1, :, SIZES[1][0] :].any() and not uncertain[1, SIZES[1][1] :].any()
    shade, elsewhere = np.zeros(SHAPE, bool), np.ones(SHAPE, bool)
    shade[82:91, 52:56] = True  # next to the person, without its soft edge
    elsewhere[65:105, :95] = False
    assert uncertain[0][shade].mean() > 0.9
    assert uncertain[0][elsewhere & ~truth[0]].mean() < 0.02


def test_a_sleeve_brighter_than_the_floor_by_less_than_its_noise_is_found():
    rng = np.random.default_rng(11)
    scene, clips = background(rng, noise=2.0)
    image, truth = with_person(scene, (40, 40, 200))
    sleeve = np.zeros_like(truth)
    sleeve[0, 40:52, 85:125] = True
    image[sleeve] = scene[sleeve] + 4.0
    masks = CollinearityForeground.learn(clips, SHAPE, SIZES).segment(expose(image, rng, noise=2.0))
    assert np.mean(masks[sleeve] > 0) > 0.8
    assert iou(masks[0], truth[0] | sleeve[0]) > 0.9


def test_an_empty_scene_has_empty_masks(learned):
    scene, _, foreground = learned
    for seed in range(3):
        assert not foreground.segment(expose(scene, np.random.default_rng(seed))).any()


@pytest.mark.parametrize("gain", [(0.9, 0.9, 0.9), (1.08, 1.0, 0.93)], ids=["exposure", "white balance"])
def test_follows_gain_and_white_balance(learned, gain):
    scene, _, foreground = learned
    image, truth = with_person(scene, (40, 40, 200))
    masks = foreground.segment(expose(image, np.random.default_rng(3), gain=gain))
    assert min(iou(masks[c], truth[c]) for c in range(2)) > 0.9


@pytest.mark.parametrize("noise", [1.0, 5.0])
def test_a_single_plate_is_enough(noise):
    rng = np.random.default_rng(4)
    scene, clips = background(rng, frames=1, noise=noise)
    image, truth = with_person(scene, (40, 40, 200))
    masks = CollinearityForeground.learn(clips, SHAPE, SIZES).segment(expose(image, rng, noise=noise))
    assert min(iou(masks[c], truth[c]) for c in range(2)) > 0.9


def test_frames_do_not_depend_on_the_frames_before(learned):
    scene, clips, foreground = learned
    rng = np.random.default_rng(6)
    images = [expose(with_person(scene, color)[0], rng) for color in ((40, 40, 200), (200, 40, 40), (90, 160, 90))]
    first = [foreground.segment(image) for image in images]
    fresh = CollinearityForeground.learn(clips, SHAPE, SIZES)
    for image, mask in reversed(list(zip(images, first, strict=True))):
        np.testing.assert_array_equal(fresh.segment(image), mask)


def test_nothing_outside_a_smaller_picture(learned):
    scene, _, foreground = learned
    image, _ = with_person(scene, (40, 40, 200))
    masks = foreground.segment(expose(image, np.random.default_rng(7)))
    assert not masks[1, 100:].any() and not masks[1, :, 140:].any()


def test_specks_go_and_small_holes_close(learned, monkeypatch):
    scene, clips, _ = learned
    image, truth = with_person(scene, (40, 40, 200))
    image[0, 10, 10] = 0  # the window makes nine pixels of it
    image[0, 50:52, 70:72] = scene[0, 50:52, 70:72]
    monkeypatch.setattr("tk.model.masks.foreground.SPECK_AREA", 12 / 19200)
    monkeypatch.setattr("tk.model.masks.foreground.HOLE_AREA", 12 / 19200)
    masks = CollinearityForeground.learn(clips, SHAPE, SIZES).segment(expose(image, np.random.default_rng(8)))
    assert not masks[0, :20, :20].any()
    assert masks[0, 48:54, 68:74].all()
    assert iou(masks[0], truth[0]) > 0.93


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 10_000), density=st.floats(0.2, 0.8), smooth=st.floats(0.3, 2.0))
def test_areas_are_counted_in_pixels(seed, density, smooth):
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(24, 30)), (0, 0), smooth)
    mask = noise > np.quantile(noise, 1 - density)
    expected = mask.copy()
    count, regions = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    for k in range(1, count):
        if np.sum(filled(regions == k)) < 10:
            expected[filled(regions == k)] = False
    # holes inside what stays, and those at the border of the picture are none
    count, regions = cv2.connectedComponents((~mask).astype(np.uint8), connectivity=4)
    for k in range(1, count):
        hole = regions == k
        edge = hole[0].any() or hole[-1].any() or hole[:, 0].any() or hole[:, -1].any()
        around = cv2.dilate(hole.astype(np.uint8), np.ones((3, 3))) > 0
        if not edge and np.sum(filled(hole)) < 6 and (expected & around).any():
            expected[filled(hole)] = True
    np.testing.assert_array_equal(clean_by_area(mask, 10, 6) > 0, expected)


def filled(region):
    """A region and all that it encloses."""
    outside = np.pad(~region, 1, constant_values=True).astype(np.uint8)
    _, parts = cv2.connectedComponents(outside, connectivity=4)
    return (parts != parts[0, 0])[1:-1, 1:-1]


def test_mog2_finds_the_person_and_not_the_shadow():
    rng = np.random.default_rng(9)
    scene, clips = background(rng, frames=20)
    image, truth = with_person(scene, (40, 40, 200))
    foreground = Mog2Foreground.learn(clips, SHAPE, SIZES)
    picture = expose(image, rng)
    masks = foreground.segment(picture)
    assert min(iou(masks[c], truth[c]) for c in range(2)) > 0.9
    np.testing.assert_array_equal(foreground.segment(picture), masks)  # frozen: it learns nothing from it


def test_median_plate_forgets_a_moving_person():
    rng = np.random.default_rng(10)
    scene = plates(rng)
    frames = []
    for k in range(9):
        image = scene.copy()
        image[:, 30:80, 15 * k : 15 * k + 14] = (40, 40, 200)
        frames.append(expose(image, rng, noise=1.0))
    clips = median_plate(frames, SIZES)
    assert [clip.shape for clip in clips] == [(1, 120, 160, 3), (1, 100, 140, 3)]
    for c, (width, height) in enumerate(SIZES):
        assert np.abs(clips[c][0] - scene[c, :height, :width]).max() < 6


def test_wrong_clips_are_refused(learned):
    _, clips, _ = learned
    with pytest.raises(CaptureError, match="1 clips for 2 cameras"):
        CollinearityForeground.learn(clips[:1], SHAPE, SIZES)
    with pytest.raises(CaptureError, match="camera 2 has shape"):
        CollinearityForeground.learn([clips[0], clips[1][:, 1:]], SHAPE, SIZES)
    with pytest.raises(CaptureError, match="camera 1 has shape"):
        Mog2Foreground.learn([clips[0][:0], clips[1]], SHAPE, SIZES)
    with pytest.raises(CaptureError, match="empty"):
        median_plate([], SIZES)


@pytest.mark.parametrize("name", ["walk", "dance"])
def test_exact_masks_of_the_shared_captures(name):
    folder = CAPTURES / name
    if not folder.is_dir():
        pytest.skip(f"the shared capture {name} is not here")
    clips, images, truth, frame = [], [], [], 12
    for camera in ("cam1", "cam5"):
        clip = cv2.VideoCapture(str(folder / "background" / f"{camera}.mp4"))
        clips.append(np.stack([clip.read()[1] for _ in range(10)]))
        video = cv2.VideoCapture(str(folder / "videos" / f"{camera}.mp4"))
        images.append([video.read()[1] for _ in range(frame + 1)][-1])
        truth.append(cv2.imread(str(folder / "masks" / camera / f"{frame:06d}.png"), cv2.IMREAD_GRAYSCALE) > 0)
    height, width = truth[0].shape
    foreground = CollinearityForeground.learn(clips, (height, width), [(width, height)] * 2)
    masks = foreground.segment(np.stack(images))
    for mask, exact in zip(masks, truth, strict=True):
        assert iou(mask, exact) > 0.85
        assert np.mean(mask[exact] > 0) > 0.97
