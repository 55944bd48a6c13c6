"""What every importer hands on: the cameras and videos of a project, in metres and matched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from tk.errors import CalibrationError, VideoError
from tk.io.captures.calibration import scale_world
from tk.io.captures.units import LEAST_APART_M, MOST_APART_M, FoundUnit, apart, infer_unit
from tk.io.importers.videos import Places, Wanted, find_clips
from tk.model.cameras.camera import Camera, Rig


@dataclass(frozen=True)
class Project:
    """A project of another tool, read.

    Attributes:
        tool: whose it is, for messages.
        source: the calibration file (or folder) that was read.
        rig: the cameras that have a video, metres. A width and height of 0 are unknown: the video's are taken.
        clips: the video file or folder of pictures of each of them.
        masks, backgrounds: the same for masks and pictures of the empty scene; empty where there are none.
        up: the world's upward direction where the format fixes it ("-y"), else None.
        notes: what was inferred or left out, a line each, for the user to read.
    """

    tool: str
    source: Path
    rig: Rig
    clips: tuple[Path, ...]
    masks: tuple[Path, ...] = ()
    backgrounds: tuple[Path, ...] = ()
    up: str | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Request:
    """What the user asked for.

    Attributes:
        folder: the folder to import; videos are looked for in it.
        unit: of the calibration's lengths, None to infer it.
        trial: a part of the path of the videos that are meant, None where there is no choice.
    """

    folder: Path
    unit: str | None = None
    trial: str | None = None


class Importer(Protocol):
    """One format; a module of this package is one.

    Attributes:
        TOOL: the tool's name.
        LOOKS_FOR: what :func:`detect` looks for, for the message when nothing matches.
        NESTS: a recording's folder lies below the one with the calibration.
    """

    TOOL: str
    LOOKS_FOR: str
    NESTS: bool

    def detect(self, root: Path) -> bool:
        """Whether this folder holds the format's calibration. Opens as little as possible."""
        ...

    def read(self, root: Path, request: Request) -> Project:
        """Read the calibration in ``root`` and find the videos in ``request.folder``.

        Raises:
            CalibrationError: the calibration cannot be used.
            VideoError: the videos cannot be found, or not be told apart.
        """
        ...


@dataclass(frozen=True)
class Cameras:
    """A calibration file's cameras, lengths in the file's unit.

    Attributes:
        source: the file.
        rig: its cameras.
        keys: a second name of each, by which its video may be called.
        notes: as in :class:`Project`.
    """

    source: Path
    rig: Rig
    keys: tuple[str, ...]
    notes: tuple[str, ...] = ()


def in_metres(
    cameras: Cameras, request: Request, default: str, said: str | None = None, always: bool = False
) -> Cameras:
    """The cameras with lengths in metres, and a note that says how the unit was found.

    Args:
        cameras: as read.
        request: its ``unit`` comes before everything else.
        default: the unit that the tool writes as a rule.
        said: the unit that the file itself gives.
        always: the format has no other unit than ``default``.
    """
    if request.unit:
        found, how = FoundUnit(request.unit), "as --units says"
    elif said:
        found, how = FoundUnit(said), "as the file says"
    elif always:
        found, how = FoundUnit(default), "as always in this format"
    else:
        found = infer_unit(cameras.rig.centers, default)
        how = f"as {default} is usual there"
    rig = scale_world(cameras.rig, found.metres)
    if found.note:
        note = f"{found.note}; --units m, cm or mm overrides it"
    else:
        note = f"lengths are in {found.name}, {how}"
        if not LEAST_APART_M <= apart(rig.centers) <= MOST_APART_M:
            note += f": the cameras are then up to {apart(rig.centers):.3g} m apart, which is unusual"
    return replace(cameras, rig=rig, notes=(*cameras.notes, f"{cameras.source}: {note}"))


def check_camera(camera: Camera, where: str) -> Camera:
    """The camera, made sure of: finite, positive focal lengths, the rotation made orthonormal.

    Raises:
        CalibrationError: with ``where`` at the beginning.
    """
    numbers = (camera.matrix, camera.distortions, camera.rotation, camera.translation)
    if not all(np.isfinite(values).all() for values in numbers):
        raise CalibrationError(f"{where}: holds a number that is not finite")
    if not (camera.matrix[0, 0] > 0 and camera.matrix[1, 1] > 0):
        raise CalibrationError(
            f"{where}: focal lengths {camera.matrix[0, 0]:g}, {camera.matrix[1, 1]:g} must be positive"
        )
    off = float(np.abs(camera.rotation @ camera.rotation.T - np.eye(3)).max())
    if off > 1e-3 or np.linalg.det(camera.rotation) < 0:
        raise CalibrationError(f"{where}: the rotation is no rotation matrix (R Rᵀ is off the identity by {off:.2g})")
    nearest = cv2.Rodrigues(cv2.Rodrigues(camera.rotation)[0])[0]
    return replace(camera, rotation=np.asarray(nearest, dtype=np.float64))


def assemble(
    tool: str,
    cameras: Cameras,
    request: Request,
    places: Places,
    *,
    up: str | None = None,
    in_order: bool = False,
    all_expected: bool = True,
) -> Project:
    """The project of these cameras (metres) and the videos that are found for them.

    Args:
        tool: its name.
        cameras: in metres.
        request: where to look, and for which trial.
        places: the folders, relative to the request's, that the tool keeps videos in.
        up: the world's upward direction, None to leave it open.
        in_order: the tool itself matches cameras and videos in the order of their names.
        all_expected: a camera without a video is worth a note.

    Raises:
        VideoError: see :func:`tk.io.importers.videos.find_clips`.
    """
    names = [Wanted(camera.name, key) for camera, key in zip(cameras.rig, cameras.keys, strict=True)]
    found = find_clips(request.folder, places, names, request.trial, in_order)
    chosen = [index for index, clip in enumerate(found.clips) if clip is not None]
    notes = [*cameras.notes, *found.notes]
    without = [names[index].name for index, clip in enumerate(found.clips) if clip is None]
    if without and all_expected:
        notes.append(f"{found.folder}: no video of {', '.join(without)}: left out")
    elif without:
        notes.append(f"{cameras.source}: {len(without)} of its {len(names)} cameras have no video here: left out")
    wanted = [names[index] for index in chosen]
    masks = _beside(request.folder, found.folder, ("masks", "mask"), wanted, notes)
    backgrounds = _beside(request.folder, found.folder, ("background", "backgrounds"), wanted, notes)
    return Project(
        tool=tool,
        source=cameras.source,
        rig=Rig(tuple(cameras.rig[index] for index in chosen)),
        clips=tuple(clip for clip in found.clips if clip is not None),
        masks=masks,
        backgrounds=backgrounds,
        up=up,
        notes=tuple(notes),
    )


def _beside(
    root: Path, videos: Path, folders: Sequence[str], wanted: Sequence[Wanted], notes: list[str]
) -> tuple[Path, ...]:
    """Masks or backgrounds of these cameras, from the first of these folders there is; () and a note if not of all."""
    for parent in dict.fromkeys((videos.parent, root)):
        for name in folders:
            if not (parent / name).is_dir():
                continue
            try:
                found = find_clips(parent, Places((name,), pictures=True), wanted, None, False)
            except VideoError as reason:
                notes.append(f"{reason}: {name}/ is left out")
                return ()
            missing = [camera.name for camera, clip in zip(wanted, found.clips, strict=True) if clip is None]
            if missing:
                notes.append(f"{found.folder}: has nothing of {', '.join(missing)}: all of it is left out")
                return ()
            return tuple(clip for clip in found.clips if clip is not None)
    return ()
