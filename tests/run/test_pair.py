"""Two people who pass each other, in a rendered capture with the truth of both."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import development_capture
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_people
from tk.run.session import estimates
from tk.run.task import Task, TrackOptions

FRAMES = 40  # they pass in frame 35, 0.7 m apart


@pytest.mark.slow
def test_two_people_who_pass_each_other_keep_their_numbers() -> None:
    capture = open_capture(development_capture("pair"))
    truth = read_people(capture.truth_file)
    found = list(estimates(Task(capture.setup(), capture, TrackOptions(frames=(0, FRAMES), people="all"))))
    assert [(e.frame, e.person) for e in found] == [(frame, person) for frame in range(FRAMES) for person in (0, 1)]
    assert "lost" not in {e.status for e in found}
    for person in (0, 1):
        joints = np.array([e.joints for e in found if e.person == person])
        error = np.linalg.norm(joints - truth[person].positions[:FRAMES], axis=2).mean(axis=1)
        assert error.mean() < 0.03 and error.max() < 0.06  # metres
