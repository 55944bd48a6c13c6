"""Write an imported project as a capture."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import tomli_w

from tk.errors import CaptureError, ClockError, unwritable
from tk.io.captures.calibration import camera_table
from tk.io.captures.capture import open_capture
from tk.io.captures.video import PICTURE_SUFFIXES, probe
from tk.io.importers.project import Project
from tk.io.importers.sizes import fit_size
from tk.io.importers.world import find_volume
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.mounting import FoundUp, infer_up
from tk.model.cameras.up import up_text
from tk.model.cameras.volume import Volume


@dataclass(frozen=True)
class Imported:
    """A capture that was written.

    Attributes:
        path: its folder.
        cameras: number of cameras.
        notes: lines for the user about what was inferred, changed or left out.
    """

    path: Path
    cameras: int
    notes: tuple[str, ...]


def write_capture(project: Project, output: Path) -> Imported:
    """Write the capture completely or not at all.

    Videos and images become hard links, which take no space and stay when the originals are deleted; on another file
    system they are copied.

    Raises:
        CaptureError: the output exists already or cannot be written, a video cannot be read or does not fit.
    """
    if len(project.rig) < 2:
        raise CaptureError(f"{project.source}: {len(project.rig)} camera with a video; a capture needs at least 2")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise CaptureError(f"{output}: exists already; remove it, or choose another name")
    notes = list(project.notes)
    rig = _fitted(_renamed(project.rig, notes), project.clips, notes)
    found = FoundUp(project.up, f"as {project.tool} defines it") if project.up else infer_up(rig)
    volume, where = find_volume(rig)
    notes.append(f"up = {_up_toml(found.up)}: {found.how}")
    if volume is None:
        notes.append(where)
    else:
        center, size = list(volume.center), list(volume.size)
        notes.append(f"[volume] center = {center}, size = {size} (metres): {where}")

    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{output.name}-", dir=output.parent))
    except OSError as reason:
        raise unwritable(output, reason, CaptureError) from None
    try:
        document = calibration_toml(rig, project)
        (draft / "calibration.toml").write_text(document, encoding="utf-8")
        (draft / "capture.toml").write_text(
            capture_toml(output.resolve().name, project, found, volume, where), encoding="utf-8"
        )
        copied = _place(project.clips, rig.names, draft, "videos")
        if project.masks:
            copied |= _place(project.masks, rig.names, draft, "masks")
        if project.backgrounds:
            copied |= _place(project.backgrounds, rig.names, draft, "background")
        warnings = _warnings(draft) if volume else ()  # without a volume it cannot be opened yet
        draft.chmod(0o755)
        if output.exists():
            output.rmdir()
        draft.rename(output)
    except OSError as reason:
        raise unwritable(output, reason, CaptureError) from None
    except CaptureError as reason:  # name the output, not the draft
        raise type(reason)(str(reason).replace(str(draft), str(output))) from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    notes.append("the videos were copied" if copied else "the videos are hard links to the originals: no copies")
    notes += [line.replace(str(draft), str(output)) for line in warnings]
    return Imported(output, len(rig), tuple(notes))


def _warnings(capture: Path) -> tuple[str, ...]:
    """Return what is to be said about a new capture; videos of different rates are no reason to refuse it."""
    try:
        return open_capture(capture).warnings
    except ClockError as error:
        return (error.line,)


def calibration_toml(rig: Rig, project: Project) -> str:
    """Return the text of `calibration.toml`, metres."""
    metadata = {"units": "m", "imported_from": f"{project.tool}, {project.source.name}"}
    return tomli_w.dumps({camera.name: camera_table(camera) for camera in rig} | {"metadata": metadata})


def capture_toml(name: str, project: Project, up: FoundUp, volume: Volume | None, where: str) -> str:
    """Return the text of `capture.toml`: each inferred value with a comment on how it was inferred."""
    lines = [
        f"# imported from {project.tool}, {project.source.name}",
        tomli_w.dumps({"name": name}).strip(),
        f"# up: {up.how}",
        f"up = {_up_toml(up.up)}",
        "",
    ]
    if volume is None:
        lines += [f"# {where}", "# [volume]", "# center = [0.0, 0.0, 1.0]", "# size = [2.0, 2.0, 2.2]"]
    else:
        lines += [
            f"# {where}; metres",
            "# make it as small as the motion allows: then the voxels are smaller",
            "[volume]",
            f"center = {list(volume.center)}",
            f"size = {list(volume.size)}",
        ]
    lines += [
        "",
        "# [subject]",
        "# height = 1.75    # metres, without shoes",
        "",
        "# [init]",
        '# pose = "any"     # if the person does not start with arms and legs spread',
    ]
    return "\n".join(lines) + "\n"


def _up_toml(up: str) -> str:
    """Return an axis as a TOML string, a vector as an array of five decimals."""
    if not up.startswith("["):
        return f'"{up}"'
    return json.dumps([round(value, 5) for value in json.loads(up_text(up))])


def _renamed(rig: Rig, notes: list[str]) -> Rig:
    """Return the cameras with names that are valid file names and distinct."""
    cameras: list[Camera] = []
    for camera in rig:
        name = re.sub(r"[^\w.+-]+", "_", camera.name).strip(".") or "camera"
        while name == "metadata" or name in [other.name for other in cameras]:
            name += "_"
        if name != camera.name:
            notes.append(f"camera {camera.name!r} is called {name} in the capture")
        cameras.append(replace(camera, name=name))
    return Rig(tuple(cameras))


def _fitted(rig: Rig, clips: Sequence[Path], notes: list[str]) -> Rig:
    cameras = []
    for camera, clip in zip(rig, clips, strict=True):
        found = probe(clip)
        fitted, note = fit_size(camera, found.width, found.height, clip)
        if note:
            notes.append(note)
        cameras.append(fitted)
    return Rig(tuple(cameras))


def _place(clips: Sequence[Path], names: Sequence[str], draft: Path, folder: str) -> bool:
    """Link or copy the clips into a folder, named by their cameras; return whether one was copied."""
    images = folder == "videos" and any(clip.is_dir() for clip in clips)
    copied = False
    for clip, name in zip(clips, names, strict=True):
        target = draft / ("images" if images else folder)
        target.mkdir(exist_ok=True)
        if not clip.is_dir():
            copied |= _link(clip, target / f"{name}{clip.suffix.lower()}")
            continue
        (target / name).mkdir()
        for file in sorted(clip.iterdir()):
            if file.is_file() and file.suffix.lower() in PICTURE_SUFFIXES and not file.name.startswith("."):
                copied |= _link(file, target / name / file.name)
    return copied


def _link(original: Path, target: Path) -> bool:
    """Make a hard link, or a copy if the file system refuses; return whether it is a copy."""
    original = original.resolve()
    try:
        os.link(original, target)
        return False
    except OSError:
        shutil.copy2(original, target)
        return True
