"""Boxes side by side in one image: contents are preserved and boxes do not touch."""

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.model.masks.mosaic import Mosaic, doubled

HEIGHT, WIDTH = 20, 30


@st.composite
def boxes(draw):
    result = []
    for _ in range(draw(st.integers(1, 4))):
        left, top = draw(st.integers(0, WIDTH - 1)), draw(st.integers(0, HEIGHT - 1))
        result.append((left, top, draw(st.integers(1, WIDTH - left)), draw(st.integers(1, HEIGHT - top))))
    if draw(st.booleans()):
        result[draw(st.integers(0, len(result) - 1))] = (0, 0, 0, 0)
    return np.array(result, np.int32)


@settings(max_examples=50)
@given(boxes=boxes(), gap=st.integers(1, 5), factor=st.integers(1, 3))
def test_boxes_in_a_mosaic_have_their_size_and_do_not_touch(boxes, gap, factor):
    mosaic = Mosaic.of(boxes, gap).enlarged(factor)
    picture = np.arange(factor * HEIGHT * factor * WIDTH).reshape(factor * HEIGHT, factor * WIDTH) + 1
    whole = np.zeros(mosaic.shape, int)
    for c in range(len(boxes)):
        mosaic.part(whole, c)[...] = mosaic.crop(picture, c)
    assert np.count_nonzero(whole) == factor**2 * int(np.sum(boxes[:, 2] * boxes[:, 3]))
    full = sum(1 for box in boxes if box[2] > 0)
    grown = cv2.dilate((whole > 0).astype(np.uint8), np.ones((gap, gap), np.uint8))
    assert cv2.connectedComponents(grown)[0] - 1 == full
    for c in range(len(boxes)):
        np.testing.assert_array_equal(mosaic.part(whole, c), mosaic.crop(picture, c))


def test_tightened_boxes_hold_the_set_pixels_and_a_margin():
    mosaic = Mosaic.of(np.array([[4, 2, 20, 15], [0, 0, 0, 0], [0, 0, 30, 20]], np.int32), 2)
    marks = np.zeros(mosaic.shape, np.uint8)
    mosaic.part(marks, 0)[1, 6:9] = 1
    tight = mosaic.tightened(marks, 3, 2)
    np.testing.assert_array_equal(tight.boxes, [[7, 2, 9, 5], [0, 0, 0, 0], [0, 0, 0, 0]])
    part = mosaic.part_of(marks, 0, tight.boxes[0])
    assert part.shape == (5, 9) and part.sum() == 3 and part[1, 3:6].all()


def test_doubled_repeats_each_pixel_four_times():
    picture = np.arange(35, dtype=np.uint8).reshape(5, 7) * 7
    np.testing.assert_array_equal(doubled(picture), picture.repeat(2, axis=0).repeat(2, axis=1))
