"""Detections of one person are joined; those of people who stand close together are not."""

import numpy as np

from tk.segmenters.blazepose import suppressed

SIDE = 84.0  # of the box around a head, pixels


def people_at(*heads):
    """Rows of each person's detections for boxes of one size at these middles."""
    middle = np.array(heads, np.float64)
    return [rows.tolist() for rows in suppressed(middle, np.full(middle.shape, SIDE))]


def test_detections_of_one_head_are_one_person():
    assert people_at((255, 106), (258, 105), (250, 112)) == [[0, 1, 2]]


def test_people_whose_heads_are_apart_are_two():
    # two dancers: their hips are 55 pixels apart, a third of the radius of a body in this image
    assert people_at((255, 106), (164, 112), (257, 105), (166, 107)) == [[0, 2], [1, 3]]


def test_boxes_that_overlap_by_less_than_three_tenths_are_two_people():
    apart = SIDE * 7 / 13  # intersection over union 0.3
    assert people_at((0, 0), (apart - 1, 0)) == [[0, 1]]
    assert people_at((0, 0), (apart + 1, 0)) == [[0], [1]]


def test_without_detections_there_is_nobody():
    assert suppressed(np.zeros((0, 2)), np.zeros((0, 2))) == []


def test_empty_boxes_are_each_a_person():
    assert [rows.tolist() for rows in suppressed(np.zeros((2, 2)), np.zeros((2, 2)))] == [[0], [1]]
