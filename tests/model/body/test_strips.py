"""Strips: their places on the pieces, and the choice of some."""

import numpy as np
import pytest

from tests.model.figures import skin_of
from tk.errors import ConfigError
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.skeleton import SEGMENTS
from tk.model.body.strips import LIMBS, build_strips

BODY = skin_of(BodyDimensions.from_stature(1.75))
STRIPS = build_strips(BODY, circles=12, meridians=8, samples=16)
PER_PIECE = 20


def test_every_piece_has_its_circles_and_meridians():
    assert STRIPS.angles.shape == (PER_PIECE * len(BODY.pieces), 17, 2)
    for index, piece in enumerate(BODY.pieces):
        mine = STRIPS.piece == index
        assert mine.sum() == PER_PIECE and (STRIPS.paired & mine).sum() == 12
        assert {SEGMENTS[s] for s in STRIPS.segment[mine]} == {piece.segment}
        eta, omega = np.moveaxis(STRIPS.angles[mine], -1, 0)
        circles, meridians = slice(None, 12), slice(12, None)
        assert np.ptp(eta[circles], axis=1).max() == 0 and np.ptp(omega[meridians], axis=1).max() == 0
        np.testing.assert_allclose(np.ptp(omega[circles], axis=1), 2 * np.pi)
        z = piece.point(eta, omega)[..., 2]
        assert z.min() >= piece.z_lower - 1e-9 and z.max() <= piece.z_upper + 1e-9
        np.testing.assert_allclose(z[meridians][:, [0, -1]], [[piece.z_lower, piece.z_upper]] * 8, atol=1e-9)


def test_product_of_normal_and_point_is_one():
    for index, piece in enumerate(BODY.pieces):
        mine = STRIPS.piece == index
        eta, omega = np.moveaxis(STRIPS.angles[mine], -1, 0)
        n = STRIPS.normals[mine]
        np.testing.assert_allclose(np.sum(n * piece.point(eta, omega), axis=-1), 1, atol=1e-12)
        unit = n / np.linalg.norm(n, axis=-1, keepdims=True)
        np.testing.assert_allclose(unit, piece.normal(eta, omega), atol=1e-12)


def test_circles_are_equal_lengths_apart():
    for index in STRIPS.limb_piece:
        piece = BODY.pieces[index]
        eta = STRIPS.angles[(STRIPS.piece == index) & STRIPS.paired][:, 0, 0]
        p = piece.point(eta, np.zeros_like(eta))
        gaps = np.linalg.norm(np.diff(p, axis=0), axis=1)
        np.testing.assert_allclose(gaps, gaps.mean(), rtol=1e-3)


def test_limbs_are_their_tapered_pieces():
    assert [BODY.pieces[i].segment for i in STRIPS.limb_piece] == list(LIMBS)
    for index in STRIPS.limb_piece:
        piece = BODY.pieces[index]
        assert piece.z_lower >= 0 and piece.z_upper < piece.radii[2], "tapered, cut at both ends"
        assert piece.z_upper - piece.z_lower > 0.2


@pytest.mark.parametrize(("pairs", "singles"), [(5, 0), (3, 2), (0, 4), (12, 8), (0, 0)])
def test_even_choice_is_spread_over_each_limb(pairs, singles):
    chosen = STRIPS.even(pairs, singles)
    assert chosen.dtype == np.int32 and len(chosen) == len(LIMBS) * (pairs + singles) == len(set(chosen))
    assert np.array_equal(chosen, STRIPS.even(pairs, singles))
    for s, name in enumerate(SEGMENTS):
        mine = chosen[STRIPS.segment[chosen] == s]
        assert len(mine) == (pairs + singles if name in LIMBS else 0)
        assert STRIPS.paired[mine].sum() == (pairs if name in LIMBS else 0)
        steps = np.diff(mine[STRIPS.paired[mine]])
        assert steps.size == 0 or np.ptp(steps) <= 1
    assert set(STRIPS.piece[chosen]) <= set(STRIPS.limb_piece)


def test_random_choice_follows_the_seed_and_repeats_no_strip():
    chosen = STRIPS.draw(np.random.default_rng(5), batch=40, pairs=5, singles=2)
    assert chosen.shape == (40, len(LIMBS) * 7)
    assert np.array_equal(chosen, STRIPS.draw(np.random.default_rng(5), batch=40, pairs=5, singles=2))
    assert not np.array_equal(chosen[0], chosen[1])
    for row in chosen:
        assert len(set(row)) == len(row)
        limbs = STRIPS.segment[row].reshape(len(LIMBS), 7)
        assert (limbs == np.array([SEGMENTS.index(name) for name in LIMBS])[:, None]).all()
        assert (STRIPS.paired[row].reshape(len(LIMBS), 7).sum(axis=1) == 5).all()
    assert len(np.unique(chosen)) == len(LIMBS) * PER_PIECE, "every strip is drawn"


def test_more_strips_than_exist_are_refused():
    with pytest.raises(ConfigError, match="13 contour pairs a limb: choose 0 to 12"):
        STRIPS.even(13)
    with pytest.raises(ConfigError, match="contour single points"):
        STRIPS.draw(np.random.default_rng(0), pairs=5, singles=9)
    with pytest.raises(ConfigError, match="strips"):
        build_strips(BODY, circles=0)
