"""Masks of a whole recording in a folder: `tk masks`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray

from tk.errors import CaptureError, ConfigError, unwritable
from tk.io.captures.capture import Capture
from tk.io.captures.clip_folder import MASKS_RECORD
from tk.io.paths import check_not_input, replacing, resolved
from tk.io.toml import load_toml
from tk.run.plan import choose_frames
from tk.run.reporter import Reporter
from tk.run.segmentation import NO_SEGMENTER
from tk.segmenters import load, names
from tk.segmenters.people_masks import PeopleMasks
from tk.threads import one_thread


@dataclass(frozen=True)
class Written:
    """What :func:`write_masks` has done.

    Attributes:
        frames: number of the requested frames that have masks in the folder.
        now: number of frames whose masks this run has made.
    """

    frames: int
    now: int


@one_thread()
def write_masks(
    capture: Capture,
    folder: Path,
    reporter: Reporter,
    segmenter: str | None = None,
    frames: tuple[int, int | None] = (0, None),
) -> Written:
    """Write ``folder/<camera>/000000.png`` …: 8 bits, 255 where the segmenter sees people, else 0.

    Existing masks do not change, so the same command continues an interrupted run.

    Args:
        capture: the recording; its own masks and its empty scene are not used.
        folder: output folder, created if necessary.
        reporter: receives notes and progress.
        segmenter: name of the segmenter; None: the first of :func:`tk.segmenters.names`.
        frames: range of frames, end exclusive (None: to the end of the recording).

    Raises:
        ConfigError: the segmenter does not exist, or the folder holds other files.
        CaptureError: no segmenter is installed, or a frame cannot be read or written; finished masks remain.
    """
    for warning in capture.warnings:
        reporter.note(warning)
    capture = capture.as_recorded()  # a time offset shifts masks and images alike, when they are read
    start, stop = choose_frames(capture, frames, reporter.note)
    if segmenter is None:
        installed = names()
        if not installed:
            raise CaptureError(f"{capture.path}: {NO_SEGMENTER}")
        segmenter = installed[0]
    _check_folder(capture, folder)
    made = PeopleMasks(load(segmenter), segmenter, capture.rig, capture.volume)
    origin: dict[str, str | list[str]] = {
        "capture": capture.name,
        "segmenter": segmenter,
        "cameras": list(capture.rig.names),
    }
    if capture.clock is not None:
        origin["clock"] = capture.clock.text
    _claim(folder, origin)
    missing = [k for k in range(start, stop) if not all(_file(folder, n, k).exists() for n in capture.rig.names)]
    reporter.begin(stop - start, stop - start - len(missing))
    empty = dict.fromkeys(capture.rig.names, 0)
    if missing:
        wanted = set(missing)
        with capture.frames(missing[0], missing[-1] + 1) as reader:
            for frame in reader:
                if frame.index not in wanted:
                    continue
                for camera, mask in zip(capture.rig, made.segment(frame.images), strict=True):
                    _write(_file(folder, camera.name, frame.index), mask[: camera.height, : camera.width])
                    empty[camera.name] += not mask.any()
                reporter.advance(frame.index, None)
    for name, count in empty.items():
        if count:
            reporter.note(f"{folder / name}: nobody in {count} of {len(missing)} frames")
    if start > 0 and not all(_file(folder, name, 0).exists() for name in capture.rig.names):
        reporter.note(f"{folder}: masks of the frames before {start} are missing; tk track needs them from frame 0 on")
    return Written(stop - start, len(missing))


def _check_folder(capture: Capture, folder: Path) -> None:
    """Raise ConfigError for a folder in which the capture has files, except masks that `tk masks` has made."""
    if resolved(folder) != resolved(capture.path / "masks"):
        check_not_input(folder, capture=capture.path)


def _file(folder: Path, camera: str, index: int) -> Path:
    return folder / camera / f"{index:06d}.png"


def _claim(folder: Path, origin: dict[str, str | list[str]]) -> None:
    """Record in the folder how its masks are made; refuse a folder of masks that were made differently."""
    record = folder / MASKS_RECORD
    if record.is_file():
        found = load_toml(record, ConfigError)
        for name, value in origin.items():
            if found.get(name) != value:
                raise ConfigError(
                    f"{record}: these masks were made differently: {name}: {found.get(name)}, not {value}; "
                    "delete the folder, or choose another one"
                )
        return
    try:
        if folder.exists() and any(folder.iterdir()):
            raise ConfigError(f"{folder}: holds files that tk masks has not made; choose another folder")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error, CaptureError) from None
    with replacing(record, CaptureError) as part:
        part.write_text(tomli_w.dumps(origin), encoding="utf-8")


def _write(path: Path, mask: NDArray[np.uint8]) -> None:
    """Write a complete image file, or none."""
    _, coded = cv2.imencode(".png", mask)
    with replacing(path, CaptureError) as part:
        path.parent.mkdir(exist_ok=True)
        part.write_bytes(coded.tobytes())
