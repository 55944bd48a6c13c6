"""The most probable explanation of errors of pairs and of shares outside hulls: arrays without images."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from tk.model.masks.camera_hypotheses import ERROR, PairNats, Verdict, most_probable

TOLERANCE = 1.3 * ERROR


def errors(C: int, untested: Sequence[tuple[int, int]] = (), **tolerances: float | tuple[float, float]) -> np.ndarray:
    """Return (C, C, 2) errors of a tenth of a tolerance; of pairs such as c01 others, a number for those of a turned
    camera, which have both signs, or both."""
    error = np.full((C, C, 2), np.nan)
    for a in range(C):
        for b in range(a):
            sides = tolerances.get(f"c{b}{a}", 0.1)
            both = np.array((sides, -sides) if isinstance(sides, float) else sides)
            error[b, a], error[a, b] = TOLERANCE * both, -TOLERANCE * both
    for a, b in untested:
        error[a, b] = error[b, a] = np.nan
    return error


def nats(error: np.ndarray) -> PairNats:
    return PairNats.of(error, np.full(error.shape[:2], TOLERANCE))


def verdict(
    error: np.ndarray,
    outside: Callable[[Sequence[int]], np.ndarray] | None = None,
    exchange: Callable[[int, int], PairNats | None] = lambda *_: None,
    landmarks: np.ndarray | None = None,
) -> Verdict:
    C = len(error)
    return most_probable(
        nats(error),
        np.ones(C, np.bool_),
        np.full(C, np.nan) if landmarks is None else landmarks,
        outside or (lambda _: np.zeros(C)),
        exchange,
    )


def turned(C: int, *cameras: int, by: float = 4.0) -> np.ndarray:
    """Return errors of which all pairs of some cameras are far off."""
    return errors(C, **{f"c{a}{b}": by for b in range(C) for a in range(b) if a in cameras or b in cameras})


USED = Verdict((), None, False)
REFUSED = Verdict((), None, True)


def test_ratio_falls_with_the_error_and_is_bounded() -> None:
    found = [float(nats(errors(2, c01=away)).good[0, 1]) for away in (0.0, 0.5, 1.0, 2.0, 5.0, 40.0)]
    assert found == sorted(found, reverse=True)
    assert found[1] > 0 > found[3] and abs(found[4] - found[5]) < 0.01


def test_missing_pieces_and_surplus_ones_have_one_sign() -> None:
    short, long, turn = (nats(errors(2, c01=sides)) for sides in ((-3.0, 0.1), (3.0, 0.1), (3.0, -3.0)))
    assert short.missing[0, 1] > 0 > short.surplus[0, 1] and short.surplus[1, 0] > 0
    assert long.surplus[0, 1] > 0 > long.missing[0, 1]
    assert turn.missing[0, 1] < 0 and turn.surplus[0, 1] < 0


def test_right_cameras_are_used() -> None:
    for C in (2, 3, 5, 16):
        assert verdict(errors(C)) == USED


@pytest.mark.parametrize("C", [3, 4, 5, 16])
def test_turned_camera_is_wrong(C: int) -> None:
    assert verdict(turned(C, 1)) == Verdict((1,), None, False)


def test_turned_cameras_are_wrong_if_they_are_a_minority() -> None:
    assert verdict(turned(5, 0, 3)) == Verdict((0, 3), None, False)
    assert verdict(turned(16, 1, 2, 5)) == Verdict((1, 2, 5), None, False)
    for cameras, C in (((0, 1, 2), 5), ((0, 1), 4), ((0,), 2)):
        assert verdict(turned(C, *cameras)) == REFUSED


def test_one_pair_that_errs_accuses_nobody() -> None:
    assert verdict(errors(5, c01=2.0)) == USED


@pytest.mark.parametrize("other_side", [0.1, -2.5])
def test_two_cameras_do_not_show_whether_a_mask_is_poor(other_side: float) -> None:
    """A camera that is turned may err on one side of its only pair."""
    assert verdict(errors(2, c01=(2.5, other_side))) == REFUSED


def test_mask_that_misses_a_piece_in_all_pairs_is_used() -> None:
    assert verdict(errors(4, c01=(-3.0, 0.1), c02=(-3.0, 0.1), c03=(-3.0, 0.1))) == USED


def test_set_with_an_untested_rival_blames_nobody() -> None:
    """0 and 2 face each other; of 0 and 1, which contradict each other, either may be wrong."""
    assert verdict(errors(3, [(0, 2)], c01=2.0)) == REFUSED
    assert verdict(errors(3, c01=2.0, c02=3.0)) == Verdict((0,), None, False)


def test_hull_accuses_a_camera_that_no_pair_accuses() -> None:
    def beside(right: Sequence[int]) -> np.ndarray:
        return np.where(np.arange(5) == 2, 0.5, 0.0)  # another person in one image

    untested = errors(5, [(2, c) for c in range(5)])
    assert verdict(untested, beside) == Verdict((2,), None, False)

    def half(right: Sequence[int]) -> np.ndarray:
        return np.where((np.arange(5) != 2) & (2 in right), 0.4, 0.0)  # half of the person in one mask

    assert verdict(errors(5), half) == Verdict((2,), None, False)
    assert verdict(errors(5), lambda right: half(right) / 10) == USED


def test_hulls_are_asked_only_where_they_can_change_the_verdict() -> None:
    asked: list[list[int]] = []

    def outside(right: Sequence[int]) -> np.ndarray:
        asked.append(list(right))
        return np.zeros(9)

    assert verdict(errors(9), outside) == USED
    assert asked == [list(range(9))]


def test_masks_without_pairs_and_hulls_contradict_nothing() -> None:
    assert verdict(np.full((4, 4, 2), np.nan), lambda _: np.full(4, np.nan)) == USED
    seen = np.zeros(3, np.bool_)
    for _ in range(3):  # nobody, or one camera, sees the person
        found = most_probable(
            nats(np.full((3, 3, 2), np.nan)), seen, np.full(3, np.nan), lambda _: np.zeros(3), lambda *_: None
        )
        assert found == USED
        seen[0] = True


def test_exchanged_videos_are_the_explanation_if_all_pairs_agree_then() -> None:
    def exchange(a: int, b: int) -> PairNats | None:
        return nats(errors(5)) if (a, b) == (1, 3) else nats(turned(5, 1, 3, a, b))

    assert verdict(turned(5, 1, 3), exchange=exchange) == Verdict((), (1, 3), True)
    poor = nats(errors(5, c01=(-3.0, 0.1), c02=(-3.0, 0.1), c03=(-3.0, 0.1)))
    found = verdict(turned(5, 1, 3), exchange=lambda a, b: poor if (a, b) == (1, 3) else None)
    assert found.exchanged == (1, 3), "one of the masks is poor besides"
    assert verdict(errors(5), exchange=exchange) == USED


@pytest.mark.parametrize(("untested", "expected"), [((), (0, 1)), (((0, 2),), None)])
def test_swap_needs_two_tested_partners_of_each_camera(
    untested: Sequence[tuple[int, int]], expected: tuple[int, int] | None
) -> None:
    """Of three cameras, two of which face each other, exchanged videos agree by chance."""
    found = verdict(turned(3, 0, 1), exchange=lambda a, b: nats(errors(3, untested)) if (a, b) == (0, 1) else None)
    assert found.exchanged == expected


def test_landmarks_are_evidence_for_and_against_a_camera() -> None:
    error = turned(5, 2)
    assert verdict(error, landmarks=np.full(5, 5.0)) == USED
    assert verdict(error, landmarks=np.array([5.0, 5.0, -5.0, 5.0, 5.0])) == Verdict((2,), None, False)
    assert verdict(errors(5), landmarks=np.array([5.0, 5.0, -50.0, 5.0, 5.0])) == USED  # the network errs, too
    assert verdict(turned(5, 0, 1, 2), landmarks=np.full(5, 8.0)) == USED
    assert verdict(turned(5, 0, 1, 2), landmarks=np.full(5, -8.0)) == REFUSED
