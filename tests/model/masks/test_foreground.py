"""Segmentation of synthetic scenes with known masks, and of development captures."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.conftest import development_capture
from tk.errors import CaptureError
from tk.model.masks.background import median_plate, reduced
from tk.model.masks.foreground import CollinearityForeground, Prior
from tk.model.masks.learned_scene import LearnedScene
from tk.model.masks.regions import clean_by_area

SHAPE = (120, 160)
SIZES = np.array([[160, 120], [140, 100]])
PERSON = (slice(25, 85), slice(60, 85))
SHADOW = (slice(78, 95), slice(20, 66))  # reaches under the person's feet


def plates(rng):
    """Return (2, H, W, 3) float: smooth walls with some texture; the second image is smaller."""
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
    """Return the scene with a soft-edged cast shadow and a person of one colour, and the person's masks."""
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
def test_the_mask_holds_the_person_and_not_the_shadow(noise, color):
    rng = np.random.default_rng(1)
    scene, clips = background(rng, noise=noise)
    image, truth = with_person(scene, color)
    masks = CollinearityForeground.learn(clips, SHAPE, SIZES).label(expose(image, rng, noise=noise))[0]
    assert masks.shape == (2, *SHAPE) and masks.dtype == np.uint8 and set(np.unique(masks)) == {0, 255}
    for c in range(2):
        assert iou(masks[c], truth[c]) > 0.93


@pytest.mark.parametrize("size", [(160, 120), (162, 122), (163, 121), (165, 123)])
def test_a_person_whom_the_border_cuts_is_seen_up_to_the_border(size):
    width, height = size
    scene = np.full((1, height, width, 3), (150.0, 140.0, 120.0))
    image, rng = scene.copy(), np.random.default_rng(1)
    image[0, 60:, width - 40 :] = (40, 40, 200)
    clip = np.stack([expose(scene[0], rng) for _ in range(12)])
    masks = CollinearityForeground.learn([clip], (height, width), np.array([size])).label(expose(image, rng))[0]
    assert (masks[0, 64:, width - 36 :] == 255).all()


@pytest.mark.filterwarnings("error")
def test_a_bright_window_is_measured_in_the_camera_and_not_in_the_padding():
    rng = np.random.default_rng(2)
    scene = np.full((1, 120, 160, 3), (150.0, 140.0, 120.0))
    clip = np.stack([expose(scene[0], rng) for _ in range(12)])
    lamp = expose(scene * 1.03, rng)  # the light has changed a little
    lamp[0, 40:80, 50:70] = (40, 40, 200)
    alone = CollinearityForeground.learn([clip], SHAPE, SIZES[:1]).label(lamp)[0]
    wide = np.zeros((1, 240, 400, 3), np.uint8)
    wide[:, :120, :160] = lamp
    padded = CollinearityForeground.learn([clip], (240, 400), SIZES[:1]).label(wide)[0]
    np.testing.assert_array_equal(padded[:, :120, :160], alone)


def test_images_that_are_reduced_already_give_the_same_masks(learned):
    scene, _, foreground = learned
    images = expose(with_person(scene, (40, 40, 200))[0], np.random.default_rng(3))
    for ours, theirs in zip(foreground.label(images), foreground.label(images, reduced(images, 2)), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_clothes_of_the_walls_colour_leave_no_hole(learned):
    scene, _, foreground = learned
    # 0.8 of the wall's colour: by colour alone, a shadow
    image, truth = with_person(scene, (120, 112, 96))
    masks = foreground.label(expose(image, np.random.default_rng(2)))[0]
    inner = cv2.erode(truth[0].astype(np.uint8), np.ones((5, 5))) > 0
    assert np.mean(masks[0][inner] > 0) > 0.97
    assert iou(masks[0], truth[0]) > 0.85


def test_shadows_are_uncertain_and_scene_and_person_are_not():
    rng = np.random.default_rng(4)
    scene, clips = background(rng)
    image, truth = with_person(scene, (40, 40, 200), shadow=0.75)
    image = expose(image, rng)
    foreground = CollinearityForeground.learn(clips, SHAPE, SIZES)
    masks, uncertain = foreground.label(image)
    assert uncertain.shape == masks.shape and uncertain.dtype == bool
    assert not (uncertain & (masks > 0)).any()
    assert not uncertain[1, :, SIZES[1][0] :].any() and not uncertain[1, SIZES[1][1] :].any()
    shade, elsewhere = np.zeros(SHAPE, bool), np.ones(SHAPE, bool)
    shade[82:91, 52:56] = True  # beside the person, without the soft edge
    elsewhere[65:105, :95] = False
    assert uncertain[0][shade].mean() > 0.9
    assert uncertain[0][elsewhere & ~truth[0]].mean() < 0.02


@pytest.mark.parametrize(("difference", "noise"), [((4.0, 4.0, 4.0), 2.0), ((-20.0, 20.0, 20.0), 25.0)])
def test_a_sleeve_of_nearly_the_walls_colour_is_found(difference, noise):
    """Slightly brighter than the wall; of another colour, in noise that would hide it."""
    rng = np.random.default_rng(11)
    scene, clips = background(rng, noise=2.0)
    image, truth = with_person(scene, (40, 40, 200))
    sleeve = np.zeros_like(truth)
    sleeve[0, 40:54, 85:125] = True
    image[sleeve] = scene[sleeve] + np.array(difference)
    masks = CollinearityForeground.learn(clips, SHAPE, SIZES).label(expose(image, rng, noise=noise))[0]
    assert np.mean(masks[sleeve] > 0) > 0.8
    assert iou(masks[0], truth[0] | sleeve[0]) > 0.85


def test_masks_of_the_empty_scene_are_empty(learned):
    scene, _, foreground = learned
    for seed in range(3):
        assert not foreground.label(expose(scene, np.random.default_rng(seed)))[0].any()


@pytest.mark.parametrize("gain", [(0.9, 0.9, 0.9), (1.08, 1.0, 0.93)], ids=["exposure", "white balance"])
def test_masks_do_not_depend_on_exposure_and_white_balance(learned, gain):
    scene, _, foreground = learned
    image, truth = with_person(scene, (40, 40, 200))
    masks = foreground.label(expose(image, np.random.default_rng(3), gain=gain))[0]
    assert min(iou(masks[c], truth[c]) for c in range(2)) > 0.9


@pytest.mark.parametrize("noise", [1.0, 5.0])
def test_a_single_image_of_the_empty_scene_is_enough(noise):
    rng = np.random.default_rng(4)
    scene, clips = background(rng, frames=1, noise=noise)
    image, truth = with_person(scene, (40, 40, 200))
    masks = CollinearityForeground.learn(clips, SHAPE, SIZES).label(expose(image, rng, noise=noise))[0]
    assert min(iou(masks[c], truth[c]) for c in range(2)) > 0.9


def test_masks_do_not_depend_on_earlier_frames(learned):
    scene, clips, foreground = learned
    rng = np.random.default_rng(6)
    images = [expose(with_person(scene, color)[0], rng) for color in ((40, 40, 200), (200, 40, 40), (90, 160, 90))]
    first = [foreground.label(image)[0] for image in images]
    fresh = CollinearityForeground.learn(clips, SHAPE, SIZES)
    for image, mask in reversed(list(zip(images, first, strict=True))):
        np.testing.assert_array_equal(fresh.label(image)[0], mask)


def test_specks_are_removed_and_small_holes_filled(learned):
    """In images twice as large."""
    scene, clips, _ = learned

    def larger(layers):
        return layers.repeat(2, axis=1).repeat(2, axis=2)

    image, truth = (larger(layers) for layers in with_person(scene, (40, 40, 200)))
    image[0, 20, 20] = 0  # nine pixels after the 3×3 window
    image[0, 100:102, 140:142] = larger(scene)[0, 100:102, 140:142]
    shape = (2 * SHAPE[0], 2 * SHAPE[1])
    foreground = CollinearityForeground.learn([larger(clip) for clip in clips], shape, 2 * SIZES)
    masks = foreground.label(expose(image, np.random.default_rng(8)))[0]
    assert not masks[0, :40, :40].any()
    assert masks[0, 96:106, 136:146].all()
    assert iou(masks[0], truth[0]) > 0.93


@settings(max_examples=50)
@given(seed=st.integers(0, 10_000), density=st.floats(0.2, 0.8), smooth=st.floats(0.3, 2.0))
def test_clean_by_area_equals_a_count_of_region_pixels(seed, density, smooth):
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(24, 30)), (0, 0), smooth)
    mask = noise > np.quantile(noise, 1 - density)
    expected = mask.copy()
    count, regions = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    for k in range(1, count):
        if np.sum(filled(regions == k)) < 10:
            expected[filled(regions == k)] = False
    # holes in the kept parts; background regions at the border of the image are no holes
    count, regions = cv2.connectedComponents((~mask).astype(np.uint8), connectivity=4)
    for k in range(1, count):
        hole = regions == k
        edge = hole[0].any() or hole[-1].any() or hole[:, 0].any() or hole[:, -1].any()
        around = cv2.dilate(hole.astype(np.uint8), np.ones((3, 3))) > 0
        if not edge and np.sum(filled(hole)) < 6 and (expected & around).any():
            expected[filled(hole)] = True
    np.testing.assert_array_equal(clean_by_area(mask, 10, 6) > 0, expected)


def filled(region):
    """The region and everything enclosed by it."""
    outside = np.pad(~region, 1, constant_values=True).astype(np.uint8)
    _, parts = cv2.connectedComponents(outside, connectivity=4)
    return (parts != parts[0, 0])[1:-1, 1:-1]


def test_median_plate_shows_no_moving_person():
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


def test_clips_of_wrong_number_or_size_are_refused(learned):
    _, clips, _ = learned
    with pytest.raises(CaptureError, match="1 clips for 2 cameras"):
        CollinearityForeground.learn(clips[:1], SHAPE, SIZES)
    with pytest.raises(CaptureError, match="camera 2 has shape"):
        CollinearityForeground.learn([clips[0], clips[1][:, 1:]], SHAPE, SIZES)
    with pytest.raises(CaptureError, match="camera 1 has shape"):
        CollinearityForeground.learn([clips[0][:0], clips[1]], SHAPE, SIZES)
    with pytest.raises(CaptureError, match="empty"):
        median_plate([], SIZES)


@pytest.mark.parametrize("name", ["walk", "dance"])
def test_masks_of_development_captures_agree_with_exact_ones(name):
    folder = development_capture(name)
    clips, images, truth, frame = [], [], [], 12
    for camera in ("cam1", "cam5"):
        clip = cv2.VideoCapture(str(folder / "background" / f"{camera}.mp4"))
        clips.append(np.stack([clip.read()[1] for _ in range(10)]))
        video = cv2.VideoCapture(str(folder / "videos" / f"{camera}.mp4"))
        images.append([video.read()[1] for _ in range(frame + 1)][-1])
        truth.append(cv2.imread(str(folder / "masks" / camera / f"{frame:06d}.png"), cv2.IMREAD_GRAYSCALE) > 0)
    height, width = truth[0].shape
    foreground = CollinearityForeground.learn(clips, (height, width), [(width, height)] * 2)
    masks = foreground.label(np.stack(images))[0]
    for mask, exact in zip(masks, truth, strict=True):
        assert iou(mask, exact) > 0.85
        assert np.mean(mask[exact] > 0) > 0.97


def test_a_shadow_that_people_enclose_is_no_person():
    rng = np.random.default_rng(11)
    scene = np.clip(rng.normal(110, 14, (2, *SHAPE, 1)) * np.array([0.8, 0.95, 1.1]), 0, 255).astype(np.uint8)
    clips = [np.stack([expose(scene, rng, noise=1.0)[c, :h, :w] for _ in range(5)]) for c, (w, h) in enumerate(SIZES)]
    foreground = CollinearityForeground.learn(clips, SHAPE, SIZES)
    ring, hole = np.zeros(SHAPE, np.uint8), np.zeros(SHAPE, np.uint8)
    cv2.circle(ring, (70, 50), 34, 1, 14)
    cv2.circle(hole, (70, 50), 26, 1, cv2.FILLED)
    hole = (hole > 0) & (ring == 0)
    shown = np.where(hole[..., None], 0.8 * scene, scene)
    shown[:, ring > 0] = (40, 40, 200)
    masks, uncertain = foreground.label(expose(shown.astype(np.uint8), rng, noise=1.0))
    for mask, unsure in zip(masks, uncertain, strict=True):
        assert np.mean(mask[ring > 0] > 0) > 0.95
        assert np.mean(mask[hole] > 0) < 0.15 and np.mean(unsure[hole]) > 0.7
    shown[:, hole] = np.array([85, 101, 117])  # grey cloth: darker than the scene, and without its structure
    for mask in foreground.label(expose(shown.astype(np.uint8), rng, noise=1.0))[0]:
        assert np.mean(mask[hole] > 0) > 0.9


def test_where_a_learned_scene_is_unknown_the_prior_decides():
    """The image stands for the scene there, which is no sign of a shadow."""
    rng = np.random.default_rng(12)
    scene = np.clip(rng.normal(110, 14, (1, *SHAPE, 1)) * np.array([0.8, 0.95, 1.1]), 0, 255).astype(np.uint8)
    unknown, ring, hole = (np.zeros(SHAPE, np.uint8) for _ in range(3))
    cv2.rectangle(unknown, (40, 20), (100, 84), 1, cv2.FILLED)
    cv2.circle(ring, (70, 50), 24, 1, 10)
    cv2.circle(hole, (70, 50), 20, 1, cv2.FILLED)
    learned = LearnedScene(scene, unknown[None] > 0)
    foreground = CollinearityForeground.of_learned(learned, SIZES[:1])
    image = expose(scene, rng, noise=1.0)
    image[:, ring > 0] = image[:, 70:112, 62:78] = (40, 40, 200)  # reaches out of the unknown part
    prior = Prior.of(255 * ring[None], (hole & (1 - ring))[None] > 0)
    (mask,), _ = foreground.label(image, prior=prior)
    assert np.mean(mask[(ring | hole) > 0] > 0) > 0.9
