"""Pixels of reduced images, found by the cameras' pixels."""

import numpy as np
import pytest

from tk.model.reduced_images import crop, every

RNG = np.random.default_rng(0)


def image_of(height: int, width: int) -> np.ndarray:
    return RNG.integers(0, 256, (1, height, width, 3), np.uint8)


def shown_at(image: np.ndarray, rows: np.ndarray, columns: np.ndarray, factor: int) -> np.ndarray:
    y, x = np.minimum(rows // factor, len(image) - 1), np.minimum(columns // factor, image.shape[1] - 1)
    return image[y[:, None], x]


@pytest.mark.parametrize("factor", [1, 2, 3])
@pytest.mark.parametrize("step", [1, 3, 4, 5, 11])
@pytest.mark.parametrize("size", [(48, 72), (49, 73), (51, 77)])
def test_every_some_pixels_of_a_reduced_image_are_those_of_the_camera(
    factor: int, step: int, size: tuple[int, int]
) -> None:
    images = image_of(size[0] // factor, size[1] // factor)
    places = (np.arange(step // 2, side, step) for side in size)
    np.testing.assert_array_equal(every(images, size, step)[0], shown_at(images[0], *places, factor))


def test_no_images_have_no_pixels() -> None:
    assert every(np.zeros((2, 0, 0, 3), np.uint8), (48, 72), 3).shape == (2, 0, 0, 3)


@pytest.mark.parametrize("size", [(48, 72), (49, 73)])
@pytest.mark.parametrize("rows", [slice(0, 48), slice(7, 20), slice(40, 60)])
@pytest.mark.parametrize("step", [1, 2])
def test_a_crop_has_each_pixel_of_the_camera(size: tuple[int, int], rows: slice, step: int) -> None:
    columns = slice(5, 80)
    places = [np.arange(side)[part][::step] for side, part in zip(size, (rows, columns), strict=True)]
    for factor in (1, 2):
        image = image_of(size[0] // factor, size[1] // factor)[0]
        np.testing.assert_array_equal(crop(image, size, rows, columns, step), shown_at(image, *places, factor))
