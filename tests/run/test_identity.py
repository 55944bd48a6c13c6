"""People who meet: who is who afterwards, and frames of people who were mixed up."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.report.conftest import complete_result, with_partner
from tk.io.captures.mask_store import MaskStore
from tk.io.results.data import Result
from tk.io.results.reader import read_result
from tk.io.results.status import Status
from tk.kernels.line_search import COLOR_BINS
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import build_cone_body
from tk.model.cues.part_colors import LearnedColors, PartColors
from tk.people.identity import (
    EXCHANGED,
    KEPT,
    UNCLEAR,
    Contact,
    Contacts,
    doubtful,
    judge_contacts,
    last_outcome,
    outcome_of,
    report,
    unmixed,
    unmixed_masks,
)

AT = np.zeros((2, 3))
LEARNED = LearnedColors(np.ones((2, 3)), np.ones(3))


@pytest.fixture(scope="module")
def people(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, ...]:
    """Two people of a result; the second enters in frame 4."""
    return with_partner(read_result(complete_result(tmp_path_factory.mktemp("two") / "two.h5", tiny))).people


def meet(contacts: Contacts, distances: list[float]) -> list[Contact]:
    """Return the contacts that end while two people have these distances in frames 10, 11, …"""
    found = []
    for frame, distance in enumerate(distances, 10):
        pelvis = {0: np.zeros(3), 1: np.array([distance, 0, 0])}
        found += contacts.update(frame, pelvis, {0: LEARNED, 1: LEARNED})
    return found


def test_contact_lasts_from_the_approach_to_the_departure() -> None:
    contacts = Contacts()
    assert meet(contacts, [2.0, 0.9, 0.4, 0.6]) == []
    (ended,) = contacts.update(14, {0: np.zeros(3), 1: np.ones(3)}, {0: LEARNED, 1: LEARNED})
    assert (ended.people, ended.first, ended.moment, ended.last) == ((0, 1), 11, 12, 14)
    np.testing.assert_array_equal(ended.learned[1].counts, LEARNED.counts)


def test_exchange_is_likeliest_where_it_makes_the_steps_shortest() -> None:
    contacts = Contacts()
    for frame, (a, b) in enumerate([(0.0, 0.5), (0.1, 0.6), (0.7, 0.2), (0.8, 0.3), (2.0, 0.3)]):
        pelvis = {0: np.array([a, 0, 0]), 1: np.array([b, 0, 0])}
        ended = contacts.update(frame, pelvis, {0: LEARNED, 1: LEARNED})
    assert [contact.moment for contact in ended] == [2]


def test_people_of_unknown_colours_have_no_contact() -> None:
    contacts = Contacts()
    assert contacts.update(0, {0: np.zeros(3), 1: np.zeros(3)}, {0: None, 1: LEARNED}) == [] and not contacts.all


@pytest.mark.parametrize(
    ("likeness", "shorter_m", "outcome"),
    [
        ([[-0.2, -3.0], [-1.9, -0.3]], -0.5, KEPT),
        ([[-3.0, -0.2], [-0.3, -1.9]], -0.5, EXCHANGED),
        ([[-0.2, -0.3], [-0.3, -0.3]], -0.5, UNCLEAR),
        ([[-0.2, -0.3], [-0.3, -0.3]], -1.5, KEPT),  # they were never so close
    ],
)
def test_assignment_with_the_larger_likelihood_wins(
    likeness: list[list[float]], shorter_m: float, outcome: int
) -> None:
    assert outcome_of(np.array(likeness), shorter_m) == outcome


def test_likeness_is_zero_for_the_colours_that_were_learned() -> None:
    body = build_cone_body(BodyDimensions.from_stature(1.7))
    rng = np.random.default_rng(0)
    bins = rng.choice([5, 600, 3000], 4000, p=[0.5, 0.3, 0.2]).astype(np.int32)
    colors = PartColors(body)
    assert colors.likeness(bins) == 0
    colors.learn(bins, np.ones(len(bins), np.uint8))
    assert colors.likeness(bins) == pytest.approx(0, abs=1e-6)
    assert colors.likeness(np.full(100, COLOR_BINS - 1, np.int32)) < -3


def test_frames_of_people_who_were_mixed_up_are_unmixed(people: tuple[Result, ...]) -> None:
    contact = Contact((0, 1), 3, 9, 7, AT, outcome=EXCHANGED)
    first, second = unmixed(people, [contact])
    inside = (people[0].frames >= 7) & (people[0].frames <= 9)
    np.testing.assert_array_equal(first.joints[~inside], people[0].joints[~inside])
    np.testing.assert_array_equal(first.joints[inside], people[1].joints[inside])
    np.testing.assert_array_equal(second.status[inside], people[0].status[inside])
    assert unmixed(people, [Contact((0, 1), 3, 9, 7, AT, outcome=KEPT)]) == people
    assert report([contact]) == ["people 0 and 1 were mixed up in frame 7; this is undone"]


def test_frames_in_which_it_is_unclear_who_is_who_are_doubtful(people: tuple[Result, ...]) -> None:
    contact = Contact((0, 1), 3, 9, 7, AT, outcome=UNCLEAR)
    found = doubtful(people[1], [contact])
    assert people[1].frames[found].tolist() == [3, 4, 5, 6, 7, 8, 9]
    assert "suspect, frames 3 to 9" in report([contact])[0]
    assert (people[1].status[~found] != Status.SUSPECT).all()


def test_masks_are_exchanged_in_the_same_frames(people: tuple[Result, ...], tmp_path: Path) -> None:
    stores = [MaskStore(tmp_path / str(n)) for n in (0, 1)]
    for frame in people[0].frames.tolist():
        for n, store in enumerate(stores):
            store.put(frame, np.full((2, 3, 4), 255 * n, np.uint8))
    contact = Contact((0, 1), 2, 6, 3, AT, outcome=EXCHANGED)  # the second person is absent in frame 3
    for _ in range(2):  # an interrupted run is finished again: the stores stay as they are
        mine, others = (unmixed_masks(n, [contact], dict(enumerate(stores)), people) for n in (0, 1))
        assert [int(mine.get(frame).max()) for frame in range(2, 8)] == [0, 0, 255, 255, 255, 0]
        assert [int(others.get(frame).max()) for frame in range(2, 8)] == [255, 255, 0, 0, 0, 255]
    assert unmixed_masks(0, [], dict(enumerate(stores)), people) is stores[0]


def test_contact_with_somebody_who_leaves_is_over_and_no_other_person_continues_it() -> None:
    contacts = Contacts()
    meet(contacts, [2.0, 0.4, 0.3])
    contacts.leave(1)
    (left,) = contacts.all
    assert (left.first, left.last, left.outcome, left.learned) == (11, 12, UNCLEAR, ())
    assert contacts.update(900, {0: np.zeros(3), 1: np.ones(3) * 3}, {0: LEARNED, 1: LEARNED}) == []
    assert left.last == 12


def test_nobody_tracked_is_in_no_contact() -> None:
    contacts = Contacts()
    judge_contacts(contacts, [], {})
    assert not contacts.all


@pytest.mark.parametrize(
    ("own", "lost", "outcome"), [(-0.1, False, KEPT), (-3.0, False, EXCHANGED), (-0.1, True, UNCLEAR)]
)
def test_contact_at_the_end_of_a_run_is_judged_in_the_last_frame(own: float, lost: bool, outcome: int) -> None:
    """By the colours of both, if both are found there; the pelvises have been close."""

    def person(number: int) -> Any:
        def likeness(share: int, learned: object, pose: object) -> float:
            return own if share == number else -1.0

        sharing = SimpleNamespace(likeness=likeness, last_poses=lambda: (np.zeros(3), np.zeros(3)))
        return SimpleNamespace(number=number, lost=lost and number == 1, sharing=sharing)

    answers: Any = {n: SimpleNamespace(used=n) for n in (0, 1)}
    contact = Contact((0, 1), 3, 9, 7, AT, shorter_m=-0.5, learned=(LEARNED, LEARNED))
    assert last_outcome(contact, [person(0), person(1)], answers) == outcome
    assert last_outcome(Contact((0, 1), 3, 9, 7, AT, outcome=KEPT), [], {}) == KEPT
