"""The people of a run: what each shows in the opening."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import QUICK
from tests.people import RIG, person_mask, write_people
from tk.errors import CaptureError
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.kernels.mask_values import PERSON
from tk.model.body.anthropometry import AVERAGE_BODY
from tk.model.body.cone_body import build_cone_body
from tk.model.setup import Subject
from tk.people.people import People
from tk.run.task import Task, TrackOptions
from tk.trackers.protocol import Frame
from tk.trackers.region import RegionTracker


@pytest.mark.parametrize("meet", [False, True])
def test_an_opening_ends_where_two_people_are_mixed_up(tmp_path: Path, meet: bool) -> None:
    capture = open_capture(write_people(tmp_path / "two", [lambda _: (-0.6, 0.0), lambda _: (0.6, 0.1)], 1))
    task = Task(capture.setup(), capture, TrackOptions(people="all"))
    people = People(task.setup, task.settings, "all", RegionTracker.of(task.setup, task.settings), lambda _: None)
    opening = []
    for k in range(16):
        at = min(0.08 * k, 0.55) - 0.6 if meet else -0.6
        masks = np.stack([person_mask(camera, (at, 0.0)) | person_mask(camera, (-at, 0.1)) for camera in RIG])
        opening.append(Frame(k, np.zeros((*masks.shape, 3), np.uint8), masks))
    shares = people._shares(people._finder.find(opening[0].masks), opening)
    assert all([frame.index for frame in share] == list(range(len(share))) for share in shares)
    ends = sorted(len(share) for share in shares)
    assert len(ends) == 2 and (7 <= ends[0] < 16 if meet else ends == [16, 16])


@pytest.mark.parametrize("failing", [{0}, {1}, {0, 1}])
def test_somebody_who_cannot_be_tracked_does_not_end_the_run_of_others(tmp_path: Path, failing: set[int]) -> None:
    calls: list[int] = []

    class Finds(RegionTracker):
        """A tracker that does not find some of those for whom it is started."""

        def start(self, frames: Sequence[Frame], subject: Subject) -> None:
            calls.append(len(calls))
            if calls[-1] in failing:
                raise CaptureError("no pose explains the masks")
            self.take_body(build_cone_body(AVERAGE_BODY))

    capture = open_capture(write_people(tmp_path / "two", [lambda _: (-0.6, 0.0), lambda _: (0.6, 0.1)], 1))
    told: list[str] = []
    task = Task(capture.setup(), capture, TrackOptions(people="all"))
    people = People(task.setup, task.settings, "all", Finds.of(task.setup, task.settings), told.append)
    masks = np.stack([person_mask(camera, (-0.6, 0.0)) | person_mask(camera, (0.6, 0.1)) for camera in RIG])
    opening = [Frame(k, np.zeros((*masks.shape, 3), np.uint8), masks) for k in range(2)]
    if len(failing) == 2:
        with pytest.raises(CaptureError, match="no pose explains"):
            people.start(opening)
        return
    assert people.start(opening)
    assert [person.number for person in people.written] == [0]
    assert sum("cannot be tracked: no pose explains the masks" in line for line in told) == 1


def test_somebody_beside_the_volume_is_no_evidence_in_the_first_frame(tmp_path: Path) -> None:
    """Nobody tracks the other person, who stands outside."""
    capture = open_capture(write_people(tmp_path / "two", [lambda _: (-0.6, 0.0)], 1))
    task = Task(capture.setup(), capture, TrackOptions(settings_file.from_toml(QUICK)))
    people = People(task.setup, task.settings, "auto", RegionTracker.of(task.setup, task.settings), lambda _: None)
    alone = np.stack([person_mask(camera, (-0.6, 0.0)) for camera in RIG])
    masks = alone | np.stack([person_mask(camera, (1.5, 0.2)) for camera in RIG])
    images = np.random.default_rng(1).integers(0, 255, (*masks.shape, 3), np.uint8)
    opening = [Frame(0, images, masks)]
    assert people.start(opening)
    answer = people.step(opening[0])[0]
    assert np.mean((answer.share.masks >= PERSON) != (alone >= PERSON)) < 0.1 * np.mean(alone >= PERSON)
