"""The clips of a folder, and those of the cameras: videos, folders of numbered images, single images."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np

from tk.errors import CaptureError, VideoError
from tk.io.captures.calibration import Calibration, match_camera
from tk.io.captures.clip import Clip, Image
from tk.io.captures.frames import Images
from tk.io.captures.pictures import PICTURE_SUFFIXES, PictureClip, picture_number, probe_pictures
from tk.io.captures.video import VIDEO_SUFFIXES, as_calibrated, probe_video
from tk.model.cameras.camera import Camera

#: file in a folder of masks from `tk masks` that says how they were made
MASKS_RECORD = "masks.toml"


def probe(path: Path, is_mask: bool = False) -> Clip:
    """Return the clip at ``path``, of either kind. Its first image has been decoded as a check."""
    if path.is_dir() or path.suffix.lower() in PICTURE_SUFFIXES:
        return probe_pictures(path, is_mask)
    return probe_video(path, is_mask)


def names_in(folder: Path, most: int = 12) -> str:
    """Return the names of what a folder holds, for a message."""
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "") or "nothing"


def list_clips(folder: Path, pictures: bool = False) -> dict[str, Path]:
    """Return the video files, folders of images and, with ``pictures``, single images in a folder, by stem.

    Raises:
        VideoError: the same stem twice.
    """
    suffixes = VIDEO_SUFFIXES + (PICTURE_SUFFIXES if pictures else ())
    clips: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or not (path.is_dir() or path.suffix.lower() in suffixes):
            continue
        if path.is_dir() and path.suffix.lower() in VIDEO_SUFFIXES:
            raise VideoError(f"{path}: is a folder with the name of a video; rename it, or put the video in its place")
        stem = path.name if path.is_dir() else path.stem
        if stem in clips:
            raise VideoError(f"{folder}: holds both {clips[stem].name} and {path.name}; keep the one that is meant")
        clips[stem] = path
    return clips


def open_clips(calibration: Calibration, path: Path) -> tuple[Clip, ...]:
    """Return each camera's video, or folder of pictures, in the capture folder ``path``."""
    for folder in (path / "videos", path / "images"):
        if folder.is_dir():
            return clips_of(calibration, folder, "video" if folder.name == "videos" else "folder of pictures", "mp4")
    if loose := [file.name for file in sorted(path.iterdir()) if file.suffix.lower() in VIDEO_SUFFIXES]:
        raise VideoError(
            f"{path}: has no videos/; {loose[0]} is in the folder itself: if all videos start at the same instant, "
            "move them to videos/",
            hint=f"otherwise type tk sync {path} -o CAPTURE",
        )
    raise VideoError(f"{path}: has neither videos/ nor images/, and its capture.toml no [videos]")


def open_masks(calibration: Calibration, path: Path, masks: str) -> tuple[Clip, ...] | None:
    """Return each camera's given masks, None without any; ``masks``: see `open_capture`."""
    if masks in ("none", "median"):
        return None
    folder = path / "masks" if masks == "auto" else Path(masks)
    if not folder.is_dir():
        if masks == "auto":
            return None
        raise CaptureError(f"masks {masks}: is not a folder; give auto, none, median or a folder of masks")
    clips = clips_of(calibration, folder, "masks", "mp4", is_mask=True)
    if (folder / MASKS_RECORD).is_file():
        for clip in clips:
            if isinstance(clip, PictureClip) and picture_number(clip.files[0]) != 0:
                raise CaptureError(
                    f"{clip.path}: starts with {clip.files[0].name}, so frame 0 has no mask; "
                    f"make the missing ones: tk masks {path} -o {folder}"
                )
    return clips


def clips_of(
    calibration: Calibration, folder: Path, what: str, suffix: str, *, pictures: bool = False, is_mask: bool = False
) -> tuple[Clip, ...]:
    """Return each camera's clip in ``folder``, checked to be of the camera's size."""
    found = list_clips(folder, pictures)
    taken: dict[str, Camera] = {}
    for camera, key in zip(calibration.rig, calibration.keys, strict=True):
        try:
            stem = match_camera(camera.name, key, found)
        except CaptureError as ambiguous:
            raise VideoError(f"{folder}: {ambiguous}") from None
        if stem is None:
            expected = folder / (camera.name if folder.name == "images" else f"{camera.name}.{suffix}")
            raise VideoError(
                f"{expected}: camera {camera.name!r} has no {what}; {folder.name}/ holds {names_in(folder)}"
            )
        if stem in taken:
            raise VideoError(
                f"{found[stem]}: fits both cameras {taken[stem].name!r} and {camera.name!r}; rename it to its camera"
            )
        taken[stem] = camera
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        clips = list(threads.map(lambda stem: probe(found[stem], is_mask), taken))
    for k, (clip, camera) in enumerate(zip(clips, taken.values(), strict=True)):
        clips[k] = as_calibrated(clip, (camera.width, camera.height))
        check_calibrated(clips[k], camera, calibration.path.name)
    return tuple(clips)


def check_calibrated(clip: Clip, camera: Camera, calibration: str) -> None:
    """Raise VideoError for images of another size than those of the calibration."""
    if (clip.width, clip.height) != (camera.width, camera.height):
        raise VideoError(
            f"{clip.path}: is {clip.width}×{clip.height}, but {calibration} gives camera {camera.name!r} "
            f"{camera.width}×{camera.height}; calibrate for this size or scale the pictures"
        )


def read_some(clip: Clip, most: int) -> Image:
    """Return the first frames of a clip, at most ``most``: (T, h, w, 3)."""
    result = np.empty((min(clip.frame_count, most), clip.height, clip.width, 3), np.uint8)
    with closing(Images(clip, np.arange(len(result)))) as images:
        for k, out in enumerate(result):
            images.read(k, out)
    return result
