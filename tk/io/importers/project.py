"""What all formats share: a format's description, and a project in metres with a video for every camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tk.errors import CalibrationError, VideoError, VolumeError
from tk.io.captures.calibration import calibration_of, scale_world
from tk.io.captures.units import LEAST_APART_M, MOST_APART_M, UNITS, FoundUnit, apart, infer_unit
from tk.io.importers.files import matching
from tk.io.importers.videos import CameraNames, Found, find_clips
from tk.model.cameras.camera import Rig
from tk.model.cameras.common_view import view_height
from tk.model.cameras.mounting import FoundUp

#: metres, least height of the views in which a person fits: a child of one metre, and a margin
PERSON_VIEW_M = 1.2


@dataclass(frozen=True)
class Project:
    """A project of another tool."""

    tool: str  # name of the tool
    source: Path  # calibration file or folder
    rig: Rig  # cameras with a video, metres. A width and height of 0 are unknown: the video's size is used.
    clips: tuple[Path, ...]  # video file or folder of images of each camera
    up: FoundUp  # the world's up direction
    # masks, backgrounds: the same for masks and images of the empty scene; empty without any
    masks: tuple[Path, ...] = ()
    backgrounds: tuple[Path, ...] = ()
    turns: tuple[int, ...] = ()  # clockwise quarter turns after which each camera's image is upright; empty: none
    time_offset_s: tuple[float, ...] = ()  # delay of each camera, seconds; empty: none
    # width and height of each camera as the file has them, if they are no whole numbers, else None; empty: all None
    fractional: tuple[tuple[float, float] | None, ...] = ()
    notes: tuple[str, ...] = ()  # lines for the user about what was inferred or left out


class Tables:
    """The cameras of a calibration file, as tables of `calibration.toml`.

    Attributes:
        source: calibration file or folder.
        cameras: table of each camera, lengths in the file's unit, by a second name of the camera, which its video may
            have.
        markers: cameras that may record no videos. unusable: number of such cameras that are not calibrated.
        notes: as in :class:`Project`.
        unit: unit of lengths, None if unknown; unit_from: what specifies it.
        scaled: whether the unit is one of length; otherwise it is arbitrary, and the user must give it.
    """

    def __init__(self, source: Path, unit: str | None = None, unit_from: str = "the file") -> None:
        self.source, self.unit, self.unit_from = source, unit, unit_from
        self.cameras: dict[str, Mapping[str, Any]] = {}
        self.markers: set[str] = set()
        self.unusable = 0
        self.scaled = True
        self.notes: list[str] = []

    def add(
        self,
        name: str,
        size: ArrayLike,
        matrix: ArrayLike,
        distortions: ArrayLike,
        rotation: ArrayLike,
        translation: ArrayLike,
        key: str = "",
        turns: int = 0,
        fisheye: bool = False,
    ) -> None:
        """Add a camera.

        Args:
            name: its name.
            size: width and height, pixels; 0 and 0 are unknown: the video's size is used.
            matrix: (3, 3) intrinsic matrix, pixels.
            distortions: (4,), (5,) or (8,) in OpenCV's order.
            rotation: (3,) Rodrigues vector or (3, 3), world to camera.
            translation: (3,) world to camera.
            key: its second name.
            turns: clockwise quarter turns after which its image is upright.
            fisheye: whether the distortions are those of OpenCV's fisheye model.
        """
        arrays = {"size": size, "matrix": matrix, "distortions": distortions}
        arrays |= {"rotation": rotation, "translation": translation}
        values = {name: np.asarray(array).tolist() for name, array in arrays.items()}
        table = {"name": name, "rotation_count": turns, "fisheye": fisheye, **values}
        key = key if key and key not in self.cameras else name
        if key in self.cameras:
            raise CalibrationError(f"{self.source}: two cameras have the name {name!r}; give each its own")
        self.cameras[key] = table

    @contextmanager
    def optional(self, name: str, marker: bool) -> Iterator[None]:
        """Read a camera in the block. If it is a marker camera, a fault of its calibration leaves it out in silence."""
        before, notes = set(self.cameras), len(self.notes)
        try:
            yield
            added = {key: table for key, table in self.cameras.items() if key not in before}
            if marker:
                calibration_of(self.source, added, "m", sizes_known=False)
                self.markers.add(name)
                del self.notes[notes:]
        except CalibrationError:
            if not marker:
                raise
            for key in set(self.cameras) - before:
                del self.cameras[key]
            del self.notes[notes:]
            self.unusable += 1

    def leave_out(self, name: str, why: str) -> None:
        """Note that a camera is left out."""
        self.notes.append(f"{self.source}: camera {name!r} {why}: left out")


@dataclass(frozen=True)
class Format:
    """A calibration format: the constant ``FORMAT`` of a module of this package."""

    tool: str  # name of the tool
    patterns: tuple[str, ...]  # glob patterns of calibration files in a folder; the first one that matches is used
    read: Callable[[Sequence[Path]], Tables]  # reads the cameras from these files; raises CalibrationError
    # folders that hold videos, as patterns relative to the project; the first that matches is used
    videos: tuple[str, ...]
    # unit of lengths in this format, if the file does not say and the distances of the cameras allow it
    unit: str = "m"
    nests: bool = False  # recordings lie in folders below the calibration
    up: str | None = None  # the world's up direction if the format fixes it
    in_order: bool = False  # the tool matches cameras and videos in the order of their names
    videos_of_all: bool = True  # a camera without a video is worth a note by name
    # returns the calibration files in a folder, where patterns are not enough
    search: Callable[[Path], list[Path]] | None = None

    def find(self, root: Path) -> list[Path]:
        """Return the calibration files in a folder; [] without any."""
        if self.search is not None:
            return self.search(root)
        found = (matching(root, pattern) for pattern in self.patterns)
        return next((files for files in found if files), [])


@dataclass(frozen=True)
class Wanted:
    """What the user asks of an import.

    Attributes:
        unit: "m", "cm" or "mm", unit of the calibration's lengths; None to infer it.
        trial: a part of the path of the videos, if there are several recordings.
        scale: length of the calibration's unit, "0.83" (metres), or a measured distance, "cam1,cam2=3.42" (metres).
    """

    unit: str | None = None
    trial: str | None = None
    scale: str | None = None


def read_format(form: Format, files: Sequence[Path], folder: Path, wanted: Wanted) -> Project:
    """Read the calibration ``files``, and find a video in ``folder`` for every camera."""
    tables = form.read(files)
    if len(tables.cameras) < 2:
        why = "".join(f"; {note.removeprefix(f'{tables.source}: ')}" for note in tables.notes)
        raise CalibrationError(
            f"{tables.source}: {len(tables.cameras)} calibrated camera, and a capture needs at least 2{why}"
        )
    calibration = calibration_of(tables.source, tables.cameras, "m", sizes_known=False)
    rig, unit_note = _in_metres(calibration.rig, tables, wanted, form.unit)
    names = [CameraNames(camera.name, key) for camera, key in zip(rig, calibration.keys, strict=True)]
    marker = [camera.name in tables.markers for camera in rig]
    found = _find_clips(form, folder, names, marker, wanted.trial)
    chosen = [index for index, clip in enumerate(found.clips) if clip is not None]
    notes = [*tables.notes, f"{tables.source}: {unit_note}", *found.notes]
    without = [index for index, clip in enumerate(found.clips) if clip is None]
    if markers := tables.unusable + sum(marker[index] for index in without):
        total = len(names) + tables.unusable
        notes.append(f"{tables.source}: {markers} of its {total} cameras record no videos: left out")
    missing = [names[index].name for index in without if not marker[index]]
    if missing and form.videos_of_all:
        notes.append(f"{found.folder}: no video of {', '.join(missing)}: left out")
    elif missing:
        notes.append(f"{tables.source}: {len(missing)} of its {len(names)} cameras have no video here: left out")
    chosen_names = [names[index] for index in chosen]
    return Project(
        tool=form.tool,
        source=tables.source,
        rig=Rig(tuple(rig[index] for index in chosen)),
        clips=tuple(clip for clip in found.clips if clip is not None),
        masks=_beside(folder, found.folder, ("masks", "mask"), chosen_names, notes),
        backgrounds=_beside(folder, found.folder, ("background", "backgrounds"), chosen_names, notes),
        up=FoundUp(form.up, f"as {form.tool} defines it") if form.up else calibration.mounting,
        turns=tuple(calibration.turns[index] for index in chosen),
        time_offset_s=tuple(calibration.time_offset_s[index] for index in chosen),
        fractional=tuple(_fractional(tables.cameras[calibration.keys[index]].get("size")) for index in chosen),
        notes=tuple(notes),
    )


def _find_clips(
    form: Format, folder: Path, names: Sequence[CameraNames], marker: Sequence[bool], trial: str | None
) -> Found:
    """Return the video of each camera: those of all cameras, or of the video cameras alone if these are as many."""
    if not any(marker):
        return find_clips(folder, form.videos, names, trial, form.in_order)
    own = [index for index, other in enumerate(marker) if not other]
    try:
        some = find_clips(folder, form.videos, [names[index] for index in own], trial, form.in_order)
    except VideoError:
        return find_clips(folder, form.videos, names, trial, False)
    clips: list[Path | None] = [None] * len(names)
    for index, clip in zip(own, some.clips, strict=True):
        clips[index] = clip
    found = replace(some, clips=tuple(clips))
    try:
        every = find_clips(folder, form.videos, names, trial, False)
    except VideoError:
        return found
    return max(found, every, key=lambda clips: sum(clip is not None for clip in clips.clips))


def _fractional(size: Any) -> tuple[float, float] | None:
    if size is None or all(float(value).is_integer() for value in np.ravel(size)):
        return None
    width, height = np.ravel(size).tolist()
    return width, height


def _in_metres(rig: Rig, tables: Tables, wanted: Wanted, default: str) -> tuple[Rig, str]:
    """Return the cameras with lengths in metres, and a note about the unit: requested, specified, or inferred."""
    if wanted.scale:
        return _scaled(rig, tables.source, wanted.scale)
    if wanted.unit:
        found, reason = FoundUnit(wanted.unit), "as requested"
    elif not tables.scaled:
        a, b = rig.names[:2]
        raise CalibrationError(
            f"{tables.source}: the length of its unit is arbitrary; measure the distance of two cameras, from lens to "
            "lens, and give it",
            hint=f"--scale {a},{b}=METRES, or --units m if the model was scaled to metres",
        )
    elif tables.unit:
        found, reason = FoundUnit(tables.unit), f"as {tables.unit_from} says"
    else:
        found, reason = infer_unit(rig.centers, default), "the default of this format"
        if found.name == "cm" and apart(rig.centers) * UNITS["mm"] >= LEAST_APART_M:
            found = _by_person(rig, tables.source)
    rig = scale_world(rig, found.metres)
    if found.note:
        return rig, f"{found.note}; the option units (m, cm or mm) overrides it"
    note = f"lengths are in {found.name}, {reason}"
    if not LEAST_APART_M <= apart(rig.centers) <= MOST_APART_M:
        note += f": the cameras are then up to {apart(rig.centers):.3g} m apart, which is unlikely"
    return rig, note


def _scaled(rig: Rig, source: Path, scale: str) -> tuple[Rig, str]:
    """Return the cameras with lengths in metres by a scale that the user gives, and a note about it."""
    names, _, length = scale.rpartition("=")
    try:
        metres = float(length)
    except ValueError:
        metres = 0.0
    if not 0 < metres < float("inf"):
        raise CalibrationError(
            f"scale {scale!r}: must be metres in one unit of the calibration, or cam1,cam2=METRES, a measured distance"
        )
    if names:
        pair = [name.strip() for name in names.split(",")]
        if len(pair) != 2 or pair[0] == pair[1] or any(name not in rig.names for name in pair):
            raise CalibrationError(f"scale {scale!r}: must name two cameras of {source}: {', '.join(rig.names)}")
        a, b = (rig[rig.names.index(name)].center for name in pair)
        if not (between := float(np.linalg.norm(a - b))) > 0:
            raise CalibrationError(f"scale {scale!r}: both cameras stand in the same place in {source}")
        metres /= between
    rig = scale_world(rig, metres)
    return rig, f"one unit is {metres:.6g} m, as requested: the cameras are up to {apart(rig.centers):.3g} m apart"


def _by_person(rig: Rig, source: Path) -> FoundUnit:
    """Return millimetres if a person fits into the views then; the same numbers are a larger room in centimetres.

    If a person fits in centimetres alone, the numbers are either those or a table top, and an error.
    """
    try:
        view = view_height(rig)
    except VolumeError:
        view = 0.0
    if view * UNITS["mm"] >= PERSON_VIEW_M:
        return FoundUnit("mm", "lengths are taken for mm: a person fits into the views")
    wide = apart(rig.centers)
    sizes = [
        f"{unit} ({wide * UNITS[unit]:.2g} m apart, views {view * UNITS[unit]:.2g} m high)" for unit in ("cm", "mm")
    ]
    raise CalibrationError(
        f"{source}: the cameras may be in {' or '.join(sizes)}: give the unit", hint="--units cm or --units mm"
    )


def _beside(
    root: Path, videos: Path, folders: Sequence[str], cameras: Sequence[CameraNames], notes: list[str]
) -> tuple[Path, ...]:
    """Return masks or backgrounds from the first existing folder; () and a note if they are not complete."""
    for parent in dict.fromkeys((videos.parent, root)):
        for name in folders:
            if not (parent / name).is_dir():
                continue
            try:
                found = find_clips(parent, (name,), cameras, None, False, images=True)
            except VideoError as reason:
                notes.append(f"{reason}: {name}/ is left out")
                return ()
            missing = [camera.name for camera, clip in zip(cameras, found.clips, strict=True) if clip is None]
            if missing:
                notes.append(f"{found.folder}: has nothing of {', '.join(missing)}: all of it is left out")
                return ()
            return tuple(clip for clip in found.clips if clip is not None)
    return ()
