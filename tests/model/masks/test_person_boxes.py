"""Boxes around the person, with noise elsewhere in the image."""

import numpy as np
import pytest

from tk.model.masks.person_boxes import PersonBoxes

SHAPE = (240, 320)
PERSON = (slice(60, 200), slice(120, 170))
MARGIN = 20  # of the 240 rows


def look(change, shape=SHAPE):
    """Return the box in an image of an even scene after ``change``."""
    plate = np.full((1, *shape, 3), 120, np.uint8)
    picture = plate.copy()
    change(picture[0])
    gains, noise = np.ones((1, 3), np.float32), np.array([2.0], np.float32)
    return PersonBoxes(plate, 0.7, SHAPE[0]).boxes(picture, gains, noise)[0].tolist()


def person(picture):
    picture[PERSON] = (30, 30, 200)


AROUND_THE_PERSON = [120 - MARGIN, 60 - MARGIN, 50 + 2 * MARGIN, 140 + 2 * MARGIN]


def test_the_box_is_around_the_person():
    assert look(person) == AROUND_THE_PERSON


def test_an_empty_scene_and_a_shadow_have_no_box():
    def shadow(picture):
        picture[150:180, 40:120] = 96

    assert look(lambda picture: None) == [0, 0, 0, 0] == look(shadow)


def test_small_regions_far_away_are_ignored():
    def flicker(picture):
        person(picture)
        picture[20:26, 20:26] = 180
        picture[220:226, 300:306] = 180

    assert look(flicker) == AROUND_THE_PERSON


@pytest.mark.parametrize("at, size", [((100, 260), 16), ((100, 180), 6)], ids=["a hand far away", "a finger close by"])
def test_the_box_holds_a_hand_beyond_an_invisible_sleeve(at, size):
    def hand(picture):
        person(picture)
        picture[at[0] : at[0] + size, at[1] : at[1] + size] = (120, 150, 220)

    left, _, width, _ = look(hand)
    assert left == AROUND_THE_PERSON[0] and left + width == at[1] + size + MARGIN


def test_image_sizes_that_are_no_multiple_of_a_cell():
    assert look(person, (243, 322)) == AROUND_THE_PERSON


@pytest.mark.parametrize("shape", [(240, 320), (243, 322), (241, 323)])
def test_the_box_of_a_person_whom_the_border_cuts_ends_at_the_border(shape):
    def cut(picture):
        picture[150:, 290:] = (30, 30, 200)

    left, top, width, height = look(cut, shape)
    assert (left + width, top + height) == shape[::-1]
