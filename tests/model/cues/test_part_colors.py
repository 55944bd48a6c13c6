"""What colours the parts have: learned, told apart, kept."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.model.figures import BODY
from tk.kernels.line_search import COLOR_BINS
from tk.model.body.cone_body import COLOR_GROUPS
from tk.model.cues.part_colors import PartColors, color_bins

NAMES = [part.name for part in BODY.parts]
SHIRT, SKIN, TROUSERS = (200, 40, 30), (120, 150, 220), (30, 30, 35)


def bin_of(color):
    return int(color_bins(np.array(color, np.uint8)))


def clothed(colors, pixels=400, seed=0):
    """Teach the colours of a shirt, of skin and of trousers, with noise of a few levels."""
    rng = np.random.default_rng(seed)
    worn = {"torso": SHIRT, "upper_arm_l": SHIRT, "forearm_l": SKIN, "head": SKIN, "pelvis": TROUSERS}
    worn |= {"thigh_l": TROUSERS, "hand_l": SKIN, "foot_l": TROUSERS, "calf_l": TROUSERS}
    for component, color in worn.items():
        part = next(i for i, p in enumerate(BODY.parts) if p.component == component)
        noisy = np.clip(rng.normal(color, 3, (pixels, 3)), 0, 255).astype(np.uint8)
        colors.learn(color_bins(noisy), np.full(pixels, part + 1, np.uint8))


def test_every_part_has_a_group_and_either_side_the_same():
    assert set(BODY.color_group) == set(range(len(COLOR_GROUPS)))
    of = dict(zip(NAMES, BODY.color_group, strict=True))
    for name, value in of.items():
        if name.endswith("_l"):
            assert of[name[:-2] + "_r"] == value


@given(b=st.integers(0, 255), g=st.integers(0, 255), r=st.integers(0, 255))
@settings(max_examples=50)
def test_bins_have_sixteen_levels_of_each_channel(b, g, r):
    found = bin_of((b, g, r))
    assert found == (b // 16) * 256 + (g // 16) * 16 + r // 16
    assert 0 <= found < COLOR_BINS


def test_likelihoods_are_uniform_before_learning():
    colors = PartColors(BODY)
    assert not colors.known and colors.state.counts is None
    assert colors.regions(np.zeros((2, 4, 4, 3), np.uint8), (8, 8)) is None
    assert colors.mismatch.shape == (COLOR_BINS, len(COLOR_GROUPS)) and not colors.mismatch.any()


def test_colors_distinguish_parts():
    colors = PartColors(BODY)
    clothed(colors)
    mismatch = colors.mismatch
    assert colors.known and mismatch.dtype == np.float32 and mismatch.min() >= 0 and mismatch.max() <= 1
    torso, forearm, thigh = (COLOR_GROUPS.index(name) for name in ("torso", "forearm", "thigh"))
    for color, suits in ((SHIRT, torso), (SKIN, forearm), (TROUSERS, thigh)):
        row = mismatch[bin_of(color)]
        assert row[suits] < 0.15
        assert all(row[other] > 0.5 for other in {torso, forearm, thigh} - {suits})
    # a colour that nobody wears suits all alike
    assert np.ptp(mismatch[bin_of((250, 250, 10))]) < 0.05


def test_likelihoods_are_shares_and_nothing_is_impossible():
    colors = PartColors(BODY)
    clothed(colors)
    share = np.exp(colors.log_likelihood)
    learned = [COLOR_GROUPS.index(name) for name in ("torso", "forearm", "thigh", "head", "calf")]
    np.testing.assert_allclose(share[learned].sum(axis=1), 1, rtol=1e-3)
    assert (share > 0).all()
    regions = colors.regions(np.zeros((2, 4, 4, 3), np.uint8), (8, 8))
    assert regions is not None and 0 < regions.weight <= 1 and regions.step == 2
    np.testing.assert_array_equal(regions.log_likelihood, colors.log_likelihood)


def test_new_colors_are_learned_slowly():
    colors = PartColors(BODY)
    torso = NAMES.index("chest") + 1
    red, green = bin_of((0, 0, 250)), bin_of((0, 250, 0))
    group = COLOR_GROUPS.index("torso")
    colors.learn(np.full(500, red), np.full(500, torso, np.uint8))
    suits = [colors.mismatch[green, group]]
    for _ in range(60):
        colors.learn(np.full(500, green), np.full(500, torso, np.uint8))
        suits.append(float(np.exp(colors.log_likelihood[group, green] - colors.log_likelihood[group, red])))
    assert suits[1] < 0.2 and suits[-1] > 2
    assert (np.diff(suits[1:]) > 0).all()


def test_a_pixel_is_learned_by_its_weight():
    colors, expected = PartColors(BODY), PartColors(BODY)
    torso = NAMES.index("chest") + 1
    red, green = bin_of((0, 0, 250)), bin_of((0, 250, 0))
    bins, label = np.repeat([red, green, green, red], 100), np.repeat([torso, torso, torso, 0], 100).astype(np.uint8)
    colors.learn(bins, label, np.repeat(np.float32([1, 0.5, 0, 0.25]), 100))
    kept = np.r_[:150, 300:325]
    expected.learn(bins[kept], label[kept])
    np.testing.assert_allclose(colors.state.counts, expected.state.counts)
    np.testing.assert_allclose(colors.state.outside, expected.state.outside)


def test_state_round_trip():
    first, second = PartColors(BODY), PartColors(BODY)
    clothed(first)
    second.state = first.state
    np.testing.assert_array_equal(second.log_likelihood, first.log_likelihood)
    for colors in (first, second):
        clothed(colors, seed=1)
    np.testing.assert_array_equal(second.mismatch, first.mismatch)
    untouched = PartColors(BODY)
    clothed(untouched)
    untouched.state = PartColors(BODY).state
    assert not untouched.known
