"""Write an imported project as a capture."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tomli_w

from tk.errors import CalibrationError, CaptureError, ClockError, VolumeError
from tk.io.captures.calibration import camera_table
from tk.io.captures.capture import open_capture
from tk.io.captures.clip_folder import probe
from tk.io.captures.pictures import PICTURE_SUFFIXES
from tk.io.captures.video import as_calibrated
from tk.io.importers.project import Project
from tk.io.paths import replacing, text_of
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.common_view import all_look_away, closest_to_axes, common_boxes
from tk.model.cameras.up import shown, up_text
from tk.model.cameras.volume import Volume
from tk.system.files import link_or_copy
from tk.system.names import file_name

#: least side of a working volume, metres: a person with arms spread needs more
_ROOM_M = 1.5
#: a size with fractions was computed from something else (Pose2Sim: from the principal point); it is off by less than
#: this share of the image
_ROUGH = 0.15
#: codecs pad images to blocks of 16 pixels: a smaller difference in size is padding, removed or kept
_BLOCK = 16


@dataclass(frozen=True)
class Imported:
    """A capture that was written."""

    path: Path  # its folder
    cameras: int  # number of cameras
    notes: tuple[str, ...]  # lines for the user about what was inferred, changed or left out


def write_capture(project: Project, output: Path) -> Imported:
    """Write the capture completely or not at all.

    Videos and images become hard links, which take no space and stay when the originals are deleted; on another file
    system they are copied.
    """
    if len(project.rig) < 2:
        raise CaptureError(f"{project.source}: {len(project.rig)} camera with a video; a capture needs at least 2")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise CaptureError(f"{output}: exists already; remove it, or choose another name")
    notes = list(project.notes)
    rig = _fitted(_renamed(project.rig, notes), project, notes)
    volume, where = find_volume(rig)
    if volume is None and (away := all_look_away(rig)):
        raise CalibrationError(f"{project.source}: {away}")
    notes.append(f"up = {shown(project.up.up)}: {project.up.how}")
    if volume is None:
        notes.append(where)
    else:
        center, size = list(volume.center), list(volume.size)
        notes.append(f"[volume] center = {center}, size = {size} (metres): {where}")

    metadata = {"units": "m", "imported_from": f"{project.tool}, {text_of(project.source.name)}"}
    turns, late = project.turns or (0,) * len(rig), project.time_offset_s or (0.0,) * len(rig)
    tables = {camera.name: camera_table(camera, turn, own) for camera, turn, own in zip(rig, turns, late, strict=True)}
    settings = capture_toml(text_of(output.resolve().name), project, volume, where)
    with replacing(output, CaptureError) as draft:
        shutil.rmtree(draft, ignore_errors=True)  # of an import that was killed
        draft.mkdir(parents=True)
        (draft / "calibration.toml").write_text(tomli_w.dumps({**tables, "metadata": metadata}), encoding="utf-8")
        (draft / "capture.toml").write_text(settings, encoding="utf-8")
        parts = {"videos": project.clips, "masks": project.masks, "background": project.backgrounds}
        copied = sum(_place(clips, rig.names, draft, folder) for folder, clips in parts.items() if clips)
        try:
            warnings = _warnings(draft) if volume else ()  # without a volume it cannot be opened yet
        except CaptureError as reason:  # name the output, not the draft
            raise type(reason)(str(reason).replace(str(draft), str(output))) from None
    notes.append("the videos were copied" if copied else "the videos are hard links to the originals: no copies")
    notes += [line.replace(str(draft), str(output)) for line in warnings]
    return Imported(output, len(rig), tuple(notes))


def _warnings(capture: Path) -> tuple[str, ...]:
    """Return the warnings about a new capture; videos of different rates are one of them, not an error."""
    try:
        return open_capture(capture).warnings
    except ClockError as error:
        return (error.line,)


def find_volume(rig: Rig) -> tuple[Volume | None, str]:
    """Return the working volume, around the point nearest to all optical axes, and how it was found.

    It is the box that all cameras see, if a person fits into it; else the box that all but one see, and so on.
    """
    try:
        middle = closest_to_axes(rig)
        boxes = list(common_boxes(rig))
    except VolumeError as reason:
        return None, f"no [volume] could be inferred: {reason}; give one"
    behind = [camera.name for camera in rig if camera.to_camera(middle)[0, 2] <= 0]
    looks = f"; {', '.join(behind)} look away from it: check the calibration" if behind else ""
    if not boxes:
        return None, f"no [volume] could be inferred: no two cameras see the point nearest to all axes{looks}; give one"
    roomy = [(views, box) for views, box in boxes if min(box.size) >= _ROOM_M]
    views, box = roomy[0] if roomy else boxes[0]
    who = "all cameras see" if views == len(rig) else f"{views} of the {len(rig)} cameras see"
    return _rounded(box), f"the box that {who} around the point nearest to their axes{looks}"


def _rounded(volume: Volume) -> Volume:
    """Round to centimetres, for people to read and edit."""
    center = [round(x, 2) for x in volume.center]
    size = [max(round(x, 2), 0.01) for x in volume.size]
    return Volume((center[0], center[1], center[2]), (size[0], size[1], size[2]))


def capture_toml(name: str, project: Project, volume: Volume | None, where: str) -> str:
    """Return the text of `capture.toml`: each inferred value with a comment on how it was inferred."""
    lines = [
        f"# imported from {project.tool}, {text_of(project.source.name)}",
        tomli_w.dumps({"name": name}).strip(),
        f"# up: {project.up.how}",
        f"up = {_up_toml(project.up.up)}",
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
    """Return the cameras with names that files can have on every system, and distinct."""
    cameras: list[Camera] = []
    for camera in rig:
        name = file_name(camera.name, "camera", ["metadata", *(other.name for other in cameras)])
        if name != camera.name:
            notes.append(f"camera {camera.name!r} is called {name} in the capture")
        cameras.append(replace(camera, name=name))
    return Rig(tuple(cameras))


def _fitted(rig: Rig, project: Project, notes: list[str]) -> Rig:
    """Return the cameras with the sizes of their videos."""
    cameras = []
    written = project.fractional or (None,) * len(rig)
    for camera, clip, size in zip(rig, project.clips, written, strict=True):
        found = as_calibrated(probe(clip), (camera.width, camera.height))
        shape = found.width, found.height
        if size and all(abs(a - b) < _ROUGH * b for a, b in zip(size, shape, strict=True)):
            fitted = replace(camera, width=found.width, height=found.height)
            note: str | None = (
                f"camera {camera.name!r}: its size in the calibration, {size[0]:.1f}×{size[1]:.1f}, is not an image's; "
                f"the video's is used, {found.width}×{found.height}"
            )
        else:
            fitted, note = fit_size(camera, *shape, clip)
        if note:
            notes.append(note)
        cameras.append(fitted)
    return Rig(tuple(cameras))


def fit_size(camera: Camera, width: int, height: int, clip: Path) -> tuple[Camera, str | None]:
    """Return the camera of a video of ``width`` × ``height`` pixels, and a note about the change.

    - A calibration without a size (0 × 0) takes the video's size.
    - A difference of a few pixels (1088 rows against 1080) is a codec's padding at the right and the bottom: the matrix
      stays the same.
    - One exact ratio in both directions is a scaled image: the matrix is scaled. Pixel centres are integers, so a pixel
      x maps to s (x + ½) - ½.

    Any other difference is an error.
    """
    calibrated = (camera.width, camera.height)
    if calibrated in ((width, height), (0, 0)):
        return replace(camera, width=width, height=height), None
    sizes = f"camera {camera.name!r}: calibrated at {camera.width}×{camera.height}, video {width}×{height}"
    if abs(width - camera.width) < _BLOCK and abs(height - camera.height) < _BLOCK:
        return (
            replace(camera, width=width, height=height),
            f"{sizes}: a codec's padding at the right and the bottom; the matrix stays as it is",
        )
    if width * camera.height == height * camera.width:
        scale = width / camera.width
        matrix = np.diag([scale, scale, 1.0]) @ camera.matrix
        matrix[:2, 2] = scale * (camera.matrix[:2, 2] + 0.5) - 0.5
        return (
            replace(camera, matrix=matrix, width=width, height=height),
            f"{sizes}: the video is scaled by {scale:g}, and so is the matrix",
        )
    turned = (
        "; is the video turned by 90°?"
        if abs(width - camera.height) < _BLOCK and abs(height - camera.width) < _BLOCK
        else ""
    )
    ratios = f"{width / camera.width:.4g} and {height / camera.height:.4g}"
    raise CalibrationError(
        f"{clip}: {sizes}: neither a few pixels of padding nor one scale in both directions ({ratios}){turned}; "
        "calibrate at the video's size, or export the video at the calibration's"
    )


def _place(clips: Sequence[Path], names: Sequence[str], draft: Path, folder: str) -> bool:
    """Link or copy the clips into a folder, named by their cameras; return whether one was copied."""
    images = folder == "videos" and any(clip.is_dir() for clip in clips)
    copied = False
    for clip, name in zip(clips, names, strict=True):
        target = draft / ("images" if images else folder)
        target.mkdir(exist_ok=True)
        if not clip.is_dir():
            copied |= link_or_copy(clip.resolve(), target / f"{name}{clip.suffix.lower()}")
            continue
        (target / name).mkdir()
        for file in sorted(clip.iterdir()):
            if file.is_file() and file.suffix.lower() in PICTURE_SUFFIXES and not file.name.startswith("."):
                copied |= link_or_copy(file.resolve(), target / name / file.name)
    return copied
