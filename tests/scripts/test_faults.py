from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scripts.faults import Outcome, make_faulty
from tk.errors import ClockError
from tk.io.captures.capture import open_capture
from tk.io.results.status import Status


def test_joint_is_silent_only_without_any_warning() -> None:
    error, sigma = np.full((4, 15), 0.2), np.full((4, 15), 0.02)
    sigma[1], sigma[2] = np.nan, 0.06
    status = np.array([Status.TRACKED, Status.TRACKED, Status.TRACKED, Status.SUSPECT], np.uint8)
    outcome = Outcome(0, [], error, status, sigma)
    assert outcome.silent.all(axis=1).tolist() == [True, False, False, False]
    assert not outcome.alarm.any()
    assert Outcome(0, [], error / 10, status, sigma).alarm.tolist() == [False, True, False, True]


@pytest.mark.parametrize("fault", ["wrong fps", "other rate"])
def test_rates_that_contradict_each_other_are_refused(tiny: Path, tmp_path: Path, fault: str) -> None:
    faulty = make_faulty(fault, tiny, tmp_path / "faulty", None, 4)
    with pytest.raises(ClockError):
        open_capture(faulty.folder)
