"""The clips of a folder: videos, folders of numbered images, single images."""

from __future__ import annotations

from pathlib import Path

from tk.errors import VideoError
from tk.io.captures.clip import Clip
from tk.io.captures.pictures import PICTURE_SUFFIXES, probe_pictures
from tk.io.captures.video import VIDEO_SUFFIXES, probe_video


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
