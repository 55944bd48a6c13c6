"""What a capture says about its scene: up and the working volume, inferred where `capture.toml` leaves them open."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from tk.errors import CalibrationError, VolumeError
from tk.io.captures.calibration import Calibration
from tk.io.captures.capture_toml import CaptureSettings
from tk.model.cameras.camera import Rig
from tk.model.cameras.common_view import all_look_away, infer_volume, sample_box, views_of
from tk.model.cameras.mounting import DEFAULT_UP, FoundUp
from tk.model.cameras.up import shown, up_vector
from tk.model.cameras.volume import Volume

#: two up directions contradict each other if they differ by more, degrees
UP_AGREE_DEG = 25.0

#: metres; a note asks for the unit if cameras are farther apart, because their positions may be in millimetres
_FAR_APART_M = 100.0


def up_of(settings: CaptureSettings, found: FoundUp, path: Path, warn: Callable[[str], None]) -> str:
    """Return the axis of `capture.toml`; if it gives none, z, unless most cameras are mounted along another one. A note
    says if most cameras contradict the given one."""
    file, given = path / "capture.toml", settings.up
    if given is None and not found.sure:
        warn(f'{file}: gives no up, and {found.how}; write up = "{found.up}" if it is right')
        return found.up
    up = DEFAULT_UP if given is None else given
    if not found.sure or up_vector(found.up) @ up_vector(up) > np.cos(np.radians(UP_AGREE_DEG)):
        return up
    if given is not None:
        warn(
            f"{file}: up = {shown(given)}, but the cameras are mounted upright along {shown(found.up)}, {found.how}; "
            "if they are, correct it (tk calibrate --level)"
        )
        return given
    warn(f"{file}: gives no up; {shown(found.up)} is taken, {found.how}; tk calibrate --level looks closer")
    return found.up


def volume_of(settings: CaptureSettings, rig: Rig, path: Path, warn: Callable[[str], None]) -> Volume:
    """Return the volume from `capture.toml`, or the inferred one; at least two cameras must see a part of it."""
    file = path / "capture.toml"
    if settings.volume is None:
        try:
            volume = infer_volume(rig)
        except VolumeError as reason:
            if away := all_look_away(rig):
                raise CalibrationError(f"{path / 'calibration.toml'}: {away}") from None
            raise VolumeError(f"{file}: gives no [volume], and none can be inferred: {reason}; add one") from None
        center, size = ([round(x, 2) for x in values] for values in (volume.center, volume.size))
        warn(f"{file}: gives no [volume]; inferred from the cameras: center = {center}, size = {size} (metres)")
        return volume
    if not (views_of(rig, sample_box(settings.volume)) >= 2).any():
        if away := all_look_away(rig):
            raise CalibrationError(f"{path / 'calibration.toml'}: {away}")
        raise VolumeError(
            f"{file}: [volume]: no two cameras see center = {list(settings.volume.center)}, "
            f"size = {list(settings.volume.size)}; move it (metres), or check the units in calibration.toml"
        )
    return settings.volume


def warn_of_units(calibration: Calibration, warn: Callable[[str], None]) -> None:
    """Add a note if the positions of the cameras look like millimetres."""
    centers = calibration.rig.centers
    if np.linalg.norm(np.ptp(centers, axis=0)) > _FAR_APART_M:
        warn(f'{calibration.path}: the cameras are over {_FAR_APART_M:g} m apart; is [metadata] units = "mm" missing?')
