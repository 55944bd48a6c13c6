"""Strips: their places on the pieces."""

import numpy as np

from tests.model.figures import DIMENSIONS, skin_of
from tk.model.body.strips import CIRCLES, STEPS, build_strips, limb_pieces

BODY = skin_of(DIMENSIONS)
STRIPS = build_strips(BODY, range(len(BODY.pieces)))


def test_every_piece_has_its_circles():
    assert STRIPS.angles.shape == (CIRCLES * len(BODY.pieces), STEPS + 1, 2)
    for index, piece in enumerate(BODY.pieces):
        eta, omega = np.moveaxis(STRIPS.angles[STRIPS.piece == index], -1, 0)
        assert len(eta) == CIRCLES and np.ptp(eta, axis=1).max() == 0
        np.testing.assert_allclose(np.ptp(omega, axis=1), 2 * np.pi)
        z = piece.point(eta, omega)[..., 2]
        assert z.min() >= piece.z_lower - 1e-9 and z.max() <= piece.z_upper + 1e-9


def test_circles_are_equal_lengths_apart():
    for index in limb_pieces(BODY):
        eta = STRIPS.angles[STRIPS.piece == index][:, 0, 0]
        gaps = np.linalg.norm(np.diff(BODY.pieces[index].point(eta, np.zeros_like(eta)), axis=0), axis=1)
        np.testing.assert_allclose(gaps, gaps.mean(), rtol=1e-3)
