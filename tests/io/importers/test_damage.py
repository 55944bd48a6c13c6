"""Randomly damaged calibrations are read, or refused with one line."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.io.conftest import write_toml
from tests.io.importers.conftest import make_rig, projection_matrix, renamed, tables
from tests.io.importers.test_other_formats import write_easymocap, write_panoptic
from tests.io.importers.test_xml_formats import write_qca, write_xcp
from tk.errors import CaptureError
from tk.io.importers import read_project
from tk.model.cameras.mounting import infer_up

NAMES = ["26578", "26579", "26580", "26581"]
RIG = renamed(make_rig(), *NAMES)
DAMAGES = 40


def write_projections(folder: Path) -> None:
    for camera in RIG:
        np.savetxt(folder / f"{camera.name}.txt", projection_matrix(camera))


FORMATS: dict[str, Callable[[Path], object]] = {
    "toml": lambda folder: write_toml(folder / "camera_array.toml", {"cameras": tables(RIG)}),
    "easymocap": lambda folder: write_easymocap(folder, RIG),
    "panoptic": lambda folder: write_panoptic(folder, RIG, NAMES),
    "qualisys": lambda folder: write_qca(folder / "x.qca.txt", RIG),
    "vicon": lambda folder: write_xcp(folder / "x.xcp", RIG, (1e-8, 0.0)),
    "projections": write_projections,
}


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return the data truncated, with a part removed or repeated, or with some bytes changed."""
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    b = min(b, a + rng.choice([1, 8, 200]))
    kind = rng.randrange(5)
    if kind == 0:
        return data[:a]
    if kind == 1:
        return data[:a] + data[b:]
    if kind == 2:
        return data[:b] + data[a:]
    if kind == 3:
        return data[:a] + bytes(rng.choices(b"0123456789.-e[]{}<>\"'=,: \n\x00\xff", k=b - a)) + data[b:]
    return data[:a] + rng.choice([b"nan", b"9" * 400, b"-", b"null", b"true", b"[", b'"', b"1e999"]) + data[b:]


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_calibration_is_read_or_refused_in_one_line(
    name: str, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (folder / "videos").mkdir()
    for camera in NAMES:
        (folder / "videos" / f"{camera}.mp4").write_bytes(b"")
    FORMATS[name](folder)
    files = sorted(path for path in folder.iterdir() if path.is_file())
    intact = {path: path.read_bytes() for path in files}
    rng = random.Random(3)
    refused = 0
    capfd.readouterr()
    for _ in range(DAMAGES):
        path = rng.choice(files)
        path.write_bytes(damaged(intact[path], rng))
        try:
            project = read_project(folder)
            infer_up(project.rig)
            if len(project.rig) < len(NAMES):  # a damaged matrix is no matrix; missing cameras are noted
                assert any("left out" in note for note in project.notes)
                refused += 1
        except CaptureError as reason:
            refused += 1
            assert "\n" not in str(reason) and str(folder) in str(reason)
        path.write_bytes(intact[path])
    assert refused > 0
    assert capfd.readouterr() == ("", "")
