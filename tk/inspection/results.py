"""The results of `tk inspect`, as text, values and pictures."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.evaluation.joints import plain_values
from tk.inspection.leveling import Leveling
from tk.inspection.people import PersonReport
from tk.model.cameras.up import shown


@dataclass(frozen=True)
class CameraReport:
    """One camera.

    Attributes:
        area: share of the image that its masks cover.
        specks, holes: shares of the mask: parts that are not connected to the largest one; holes.
        empty, cut: shares of the frames without a person, and with a person at the edge of the image.
        outside: share of its masks outside the hull of the other cameras.
        shift_px: smallest shift that moves its masks into that hull, pixels; NaN if none does.
        pairs_px: error of its outlines in pairs with the others that are not wrong, median, pixels; NaN if no pair can
            be tested.
        late_frames: frames by which its video starts late: its frame k shows what frame k + late of the others shows.
        bad_images: number of frames whose image is blank, frozen or moved.
        verdict: what is wrong, in words; empty if nothing is.
    """

    name: str
    area: float
    specks: float
    holes: float
    empty: float
    cut: float
    outside: float
    shift_px: float
    pairs_px: float
    late_frames: int
    bad_images: int
    verdict: str


@dataclass(frozen=True)
class Inspection:
    """The results of all checks.

    Attributes:
        capture: name of the capture. frames: frames that were checked.
        cameras: one report per camera.
        with_hull: share of the frames in which the masks have a visual hull in common.
        extent_m: length of the person, metres.
        seen_by_all, seen_by_two: shares of the working volume that all cameras, or at least two, see.
        at_border: share of the hull at the border of the working volume.
        leveling: up direction and floor.
        people: those who were found, by number.
        findings: problems, one line each, the worst first.
        notes: what the capture and the segmentation report, one line each.
    """

    capture: str
    frames: tuple[int, ...]
    cameras: tuple[CameraReport, ...]
    with_hull: float
    extent_m: float
    seen_by_all: float
    seen_by_two: float
    at_border: float
    leveling: Leveling
    people: tuple[PersonReport, ...]
    findings: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON, NaN as None."""
        return dict(plain_values(asdict(self)))

    def format_table(self) -> str:
        """Return the text for the terminal."""
        lines = [
            f"{self.capture}: {len(self.frames)} frames from {self.frames[0]} to {self.frames[-1]}; "
            f"{self.with_hull:.0%} of them have a visual hull; length of the person {self.extent_m:.2f} m",
            "",
            f"{'camera':12} {'mask':>6} {'specks':>7} {'holes':>6} {'empty':>6} {'cut':>5} {'outside':>8} "
            f"{'shift':>7} {'pairs':>7} {'late':>5}",
        ]
        for c in self.cameras:
            shift, pairs = (f"{px:.0f} px" if np.isfinite(px) else "?" for px in (c.shift_px, c.pairs_px))
            outside = f"{c.outside:.1%}" if np.isfinite(c.outside) else "-"
            lines.append(
                f"{c.name:12} {c.area:6.1%} {c.specks:7.1%} {c.holes:6.1%} {c.empty:6.0%} {c.cut:5.0%} {outside:>8} "
                f"{shift:>7} {pairs:>7} {c.late_frames:5d}"
            )
        lines += [
            "",
            f"volume: all cameras see {self.seen_by_all:.0%} of it, at least two see {self.seen_by_two:.0%}; "
            f"{self.at_border:.1%} of the person is at its border",
            f"up: {shown(self.leveling.up)}, {self.leveling.how}",
            f"floor: {self.leveling.floor_m:+.2f} m along up"
            if np.isfinite(self.leveling.floor_m)
            else "floor: not found",
            *(person.line(len(self.cameras)) for person in self.people),
            "",
            *(self.findings or ("No problems found.",)),
            *(f"note: {note}" for note in self.notes),
        ]
        return "\n".join(lines)


@dataclass(frozen=True)
class Sample:
    """What the sheet of `tk inspect` shows of a frame.

    Attributes:
        index: frame index. images: (C, H, W, 3) uint8. masks: (C, H, W) uint8.
        hulls: (C, h, w) bool, silhouettes of the hull of the other cameras, every ``step``-th pixel; None without one.
    """

    index: int
    images: NDArray[np.uint8]
    masks: NDArray[np.uint8]
    hulls: NDArray[np.bool_] | None
    step: int
