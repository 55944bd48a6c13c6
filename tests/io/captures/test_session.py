"""Captures in a session inherit cameras, the empty scene and settings, and say so."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import refused
from tests.io.conftest import MakeCapture, calibration_tables, picture, write_picture, write_toml
from tk.batch.jobs import make_jobs
from tk.errors import CalibrationError, CaptureError, ConfigError
from tk.io.captures.capture import open_capture
from tk.io.importers import open_recording, read_project
from tk.run.task import RecordingOptions


@pytest.fixture
def session(make_capture: MakeCapture, tmp_path: Path) -> Path:
    """Return a session of two trials without calibration; its subject is 1.63 m tall, and up is y."""
    folder = tmp_path / "session"
    folder.mkdir()
    for name in ("trial1", "trial2"):
        capture = make_capture(settings={"fps": 15.0}, name=name)
        (capture / "calibration.toml").unlink()
        shutil.rmtree(capture / "background", ignore_errors=True)
        capture.rename(folder / name)
    write_toml(folder / "calibration.toml", calibration_tables())
    volume = {"center": [0.0, 0.0, 1.0], "size": [1.0, 1.0, 1.0]}
    write_toml(folder / "session.toml", {"up": "y", "volume": volume, "subject": {"height": 1.63, "body": "body.toml"}})
    for camera in range(3):
        write_picture(folder / "background" / f"cam{camera + 1}.png", picture(camera, 0))
    return folder


def test_trial_inherits_and_says_from_where(session: Path) -> None:
    capture = open_capture(session / "trial1")
    assert capture.calibration.path == session / "calibration.toml"
    assert (capture.up, capture.subject_height_m, capture.volume.size) == ("y", 1.63, (1.0, 1.0, 1.0))
    assert capture.subjects[0].body == "../body.toml"
    scene = capture.background()
    assert scene is not None and len(scene) == 3 and capture.masks_from == "none"
    (note,) = (line for line in capture.warnings if "inherited from the session" in line)
    assert str(session) in note and all(part in note for part in ("calibration.toml", "background", "up = 'y'", "1.63"))


def test_trial_wins(session: Path) -> None:
    trial = session / "trial1"
    write_toml(trial / "calibration.toml", calibration_tables(radius_m=4.0))
    write_toml(trial / "capture.toml", {"fps": 15.0, "up": "z", "subject": {"height": 1.9}})
    for camera in range(3):
        write_picture(trial / "background" / f"cam{camera + 1}.png", picture(camera, 7))
    capture = open_capture(trial)
    assert capture.calibration.path == trial / "calibration.toml"
    assert (capture.up, capture.subject_height_m, capture.subjects[0].body) == ("z", 1.9, "../body.toml")
    scene = capture.background()
    assert scene is not None and np.array_equal(scene[1][0], picture(1, 7))
    (note,) = (line for line in capture.warnings if "inherited from the session" in line)
    assert "calibration.toml" not in note and "background" not in note and "up" not in note


def test_without_the_mark_nothing_is_inherited(session: Path) -> None:
    (session / "session.toml").unlink()
    with refused(CalibrationError, "there is no such file", session / "trial1" / "calibration.toml"):
        open_capture(session / "trial1")


def test_empty_mark_is_enough_and_grandparents_do_not_count(session: Path) -> None:
    (session / "session.toml").write_text("")
    assert open_capture(session / "trial1").subject_height_m is None
    (session / "deeper").mkdir()
    (session / "trial1").rename(session / "deeper" / "trial1")
    with refused(CalibrationError, "there is no such file"):
        open_capture(session / "deeper" / "trial1")


@pytest.mark.parametrize(("content", "complaint"), [
    ('name = "x"', "name belongs to one trial"),
    ("up = 'sideways'", "up"),
    ("[subject]\nheight = 17", "height = 17 must be between 0.3 and 3 metres"),
    ("up = ", "invalid TOML"),
])  # fmt: skip
def test_error_in_the_sessions_file_names_it(session: Path, content: str, complaint: str) -> None:
    (session / "session.toml").write_text(content)
    with refused(CaptureError, complaint, session / "session.toml"):
        open_capture(session / "trial1")


def test_unknown_key_of_the_session_is_reported_with_its_file(session: Path) -> None:
    (session / "session.toml").write_text("hight = 1.8\n")
    warnings = open_capture(session / "trial1").warnings
    assert f"{session / 'session.toml'}: unknown keys are ignored: hight" in warnings
    assert not any("capture.toml: unknown" in line for line in warnings)


def test_batch_tracks_all_trials_of_a_session(session: Path, tmp_path: Path) -> None:
    (session / "notes").mkdir()
    jobs = make_jobs([session], tmp_path / "out", RecordingOptions())
    assert [(job.name, job.capture) for job in jobs] == [
        ("trial1", session / "trial1"), ("trial2", session / "trial2")
    ]  # fmt: skip
    with pytest.raises(ConfigError, match="is given twice"):
        make_jobs([session, session / "trial2"], tmp_path / "out", RecordingOptions())


def test_session_without_trials_is_refused(session: Path, tmp_path: Path) -> None:
    for name in ("trial1", "trial2"):
        shutil.rmtree(session / name / "videos")
    with refused(CaptureError, "is a session (session.toml) without trials", session):
        make_jobs([session], tmp_path / "out", RecordingOptions())


def test_session_is_no_capture_and_no_project(session: Path) -> None:
    with refused(CaptureError, "is a session of 2 captures", session):
        open_recording(session)
    with refused(CaptureError, "nothing to import: tk batch", session):
        read_project(session)
    with refused(CaptureError, "is a capture already", session / "trial1"):
        read_project(session / "trial1")
