"""Pictures that show nothing, or stand still while others move."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest

from tk.model.masks.image_health import MOVED, ImageHealth, described, mask_contradiction, sampled

C, H, W = 4, 96, 128


def frame(t: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Images (C, H, W, 3) with noise and a bright bar that moves; masks of the bar."""
    images = rng.integers(90, 110, (C, H, W, 3)).astype(np.uint8)
    masks = np.zeros((C, H, W), np.uint8)
    images[:, 20:80, 10 + 3 * t : 30 + 3 * t] += 80
    masks[:, 20:80, 10 + 3 * t : 30 + 3 * t] = 255
    return images, masks


def test_healthy_images_have_no_reason() -> None:
    rng, health = np.random.default_rng(0), ImageHealth()
    assert all(health.look(*frame(t, rng)) == [None] * C for t in range(12))


def complaint(images: Sequence[np.ndarray], masks: Sequence[np.ndarray]) -> str:
    return mask_contradiction(pairwise(map(sampled, images, masks))) or ""


def test_masks_that_never_change_are_contradicted_only_if_somebody_moves() -> None:
    rng = np.random.default_rng(0)
    images, masks = zip(*(frame(t, rng) for t in range(6)), strict=True)
    still = [frame(0, rng)[0] for _ in range(6)]
    same = [masks[0]] * 6
    assert "never change" in complaint(images, same)
    assert not complaint(images, masks)  # the person moves
    assert not complaint(still, same)  # nobody does
    assert not complaint([np.zeros((C, 0, 0, 3), np.uint8)] * 6, same)


@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_images_change_where_masks_of_the_same_time_change(gain: float) -> None:
    rng = np.random.default_rng(0)
    images, masks = zip(*(frame(2 * t, rng) for t in range(10)), strict=True)
    images = tuple((p * gain ** (t % 2)).astype(np.uint8) for t, p in enumerate(images))  # the exposure changes
    assert not complaint(images, masks)
    assert not complaint(images, [np.roll(m, 1, axis=2) for m in masks])  # a mask one pixel off
    for late in (-5, 5):
        assert "other frames" in complaint(images, np.roll(masks, late, axis=0))


def test_frozen_camera_is_found_once_the_others_have_moved_until_it_moves_again() -> None:
    rng, health = np.random.default_rng(0), ImageHealth()
    held = None
    told = []
    for t in range(14):
        images, masks = frame(t, rng)
        if 4 <= t < 10:
            assert held is not None
            images[1], masks[1] = held
        held = images[1].copy(), masks[1].copy()
        told.append(health.look(images, masks))
    assert all(reasons[c] is None for reasons in told for c in (0, 2, 3))
    frozen = [t for t in range(14) if told[t][1] == "frozen"]
    # a frame's movement is a sixth of the bar: more than the threshold from the first or second frame on
    assert frozen in (list(range(4, 10)), list(range(5, 10)))


def test_camera_that_is_moved_is_found_until_it_is_back() -> None:
    rng, health = np.random.default_rng(0), ImageHealth()
    scene = np.kron(rng.integers(0, 200, (C, 12, 16, 3)), np.ones((1, 8, 8, 1))).astype(np.uint8)
    told = []
    for t in range(36):
        images, masks = frame(t, rng)
        images = np.where(masks[..., None] > 0, images, scene)
        if 8 <= t < 20:
            images[2], masks[2] = np.roll(images[2], 3, axis=1), np.roll(masks[2], 3, axis=1)
        told.append(health.look(images, masks))
    assert all(reasons[c] is None for reasons in told for c in (0, 1, 3))
    moved = [t for t in range(36) if told[t][2] == MOVED]
    # a camera is looked at in its turn: after eight frames at most
    assert moved == list(range(moved[0], moved[-1] + 1)) and 8 <= moved[0] < 16 and 19 <= moved[-1] < 28


def test_unchanged_images_are_healthy_while_nobody_moves() -> None:
    images, masks = frame(0, np.random.default_rng(0))
    health = ImageHealth()
    assert all(health.look(images, masks) == [None] * C for _ in range(5))


@pytest.mark.parametrize(("frozen", "told"), [((0, 1), ["frozen", "frozen", None, None]), ((0, 1, 3), [None] * C)])
def test_several_frozen_cameras_are_found_if_half_of_the_others_move(frozen: tuple[int, ...], told: list) -> None:
    rng, health = np.random.default_rng(0), ImageHealth()
    first = frame(0, rng)
    for t in range(8):
        images, masks = frame(t, rng)
        for c in frozen:
            images[c], masks[c] = first[0][c], first[1][c]
        found = health.look(images, masks)
    assert found == told


@pytest.mark.parametrize("level", [0, 128])
def test_uniform_image_is_blank(level: int) -> None:
    images, masks = frame(0, np.random.default_rng(0))
    images[2] = level
    assert ImageHealth().look(images, masks) == [None, None, "blank", None]


def test_masks_are_compared_if_there_are_no_images() -> None:
    rng, health = np.random.default_rng(0), ImageHealth()
    first = frame(0, rng)[1]
    told = []
    for t in range(8):
        masks = frame(t, rng)[1]
        masks[3] = first[3]
        told.append(health.look(np.empty((C, 0, 0, 3), np.uint8), masks))
    assert told[0] == [None] * C and told[-1] == [None, None, None, "frozen"]


def test_state_is_restored() -> None:
    rng, health = np.random.default_rng(0), ImageHealth()
    frames = [frame(t, rng) for t in range(10)]
    for images, masks in frames:
        images[0], masks[0] = frames[0][0][0], frames[0][1][0]
    for f in frames[:3]:
        health.look(*f)
    again = ImageHealth()
    again.state = health.state
    told = [again.look(*f) for f in frames[3:]]
    assert told == [health.look(*f) for f in frames[3:]] and told[-1][0] == "frozen"
    again.state = ImageHealth().state
    assert again.look(*frames[-1]) == [None] * C


def test_frame_ranges_are_described_in_words() -> None:
    assert described(12, 12, 1) == "frame 12"
    assert described(30, 74, 45) == "frames 30 to 74"
    assert described(30, 74, 12) == "12 of the frames 30 to 74"


def test_faults_of_a_camera_do_not_depend_on_the_size_of_the_others() -> None:
    """The images of smaller cameras lie in the upper left of larger ones."""
    rng, sizes = np.random.default_rng(0), np.array([[W, H], [W, H], [2 * W, 2 * H], [W, H]])
    alone, padded = ImageHealth(), ImageHealth(sizes)
    scene = np.kron(rng.integers(0, 200, (C, 12, 16, 3)), np.ones((1, 8, 8, 1))).astype(np.uint8)
    found, last = [], np.zeros((H, W, 3), np.uint8)
    for t in range(36):
        images, masks = frame(t, rng)
        images = np.where(masks[..., None] > 0, images, scene)
        if 8 <= t < 20:
            images[0], masks[0] = np.roll(images[0], 3, axis=1), np.roll(masks[0], 3, axis=1)
        if t == 30:
            images[1] = 128
        images[3] = last if 8 <= t < 20 else images[3]
        last = images[3].copy()
        layers = (np.zeros((C, 2 * H, 2 * W, 3), np.uint8), np.zeros((C, 2 * H, 2 * W), np.uint8))
        for whole, part in zip(layers, (images, masks), strict=True):
            whole[:, :H, :W] = part
            whole[2] = np.repeat(np.repeat(part[2], 2, axis=0), 2, axis=1)
        reasons = padded.look(*layers)
        assert reasons == alone.look(images, masks)
        found += reasons
    assert {MOVED, "blank", "frozen"} <= set(found)
