"""What can be told of a capture before it is tracked: `tk inspect`.

Masks of a dozen frames are compared through the calibration (:mod:`tk.model.masks.mask_agreement`): whether they
close to one
person, which camera disagrees, by how much, and whether it would agree some frames earlier or later. Beside it: each
camera's masks, the working volume, the floor, and what points up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.inspection.leveling import Leveling, find_up
from tk.io.captures.capture import Capture
from tk.model.body.plausibility import fits_height
from tk.model.cameras.common_view import sample_box, views_of
from tk.model.cameras.up import up_vector
from tk.model.masks.image_health import ImageHealth
from tk.model.masks.mask_agreement import DISAGREE, Agreement, MaskAgreement, Place
from tk.model.masks.regions import clean_by_area
from tk.model.masks.silhouettes import HOLE_SHARE
from tk.run.segmentation import make_labeller
from tk.settings import Settings
from tk.threads import one_thread

Masks = NDArray[np.uint8]

#: frames that are compared; of some of them the neighbours, too, as far as a camera may be late
_FRAMES, _MOMENTS, _LATEST = 10, 5, 5
#: frames from the capture's first that are looked at: pictures are decoded in their order
_SPAN = 600
#: a camera is late or early if its masks then leave out so much less of what they leave out now
_LATE_SHARE, _LATE_LEAST = 0.5, 0.01
#: shares of a mask's area: parts beside the largest one; and holes that are no gaps between limbs
_SPECKS, _HOLES = 0.05, 0.01
#: more of the hull than this at the sides of the working volume
_AT_THE_SIDE = 0.03
#: up as the capture has it and as it looks from cameras and person differ by more than this, degrees
_TILTED_DEG = 10.0


@dataclass(frozen=True)
class CameraReport:
    """One camera.

    Attributes:
        area: its masks' share of the picture. specks, holes: shares of the mask, see :data:`_SPECKS`.
        empty, cut: shares of the frames in which it shows nobody, or the person reaches the picture's edge.
        outside: share of its masks that lies outside the hull of the others.
        shift_px: the least movement that brings its masks into that hull, pixels; NaN where none does.
        late_frames: by how many frames its video starts late: its frame k shows what frame k + late of the others does.
        sick: in how many of the frames the picture shows nothing or stands still.
        verdict: in words; empty where all is well.
    """

    name: str
    area: float
    specks: float
    holes: float
    empty: float
    cut: float
    outside: float
    shift_px: float
    late_frames: int
    sick: int
    verdict: str


@dataclass(frozen=True)
class Inspection:
    """What was found.

    Attributes:
        capture: its name. frames: those looked at.
        cameras: a report each.
        closes: share of the frames with a visual hull.
        extent_m: of the person.
        seen_by_all: share of the working volume that all cameras see; seen_by_two: at least two.
        at_the_side: share of the hull that lies at the volume's sides.
        leveling: what points up, and the floor.
        findings: what is the matter, a line each, the worst first; empty where nothing is.
    """

    capture: str
    frames: tuple[int, ...]
    cameras: tuple[CameraReport, ...]
    closes: float
    extent_m: float
    seen_by_all: float
    seen_by_two: float
    at_the_side: float
    leveling: Leveling
    findings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON: what is no number is null."""
        return _finite(asdict(self))

    def format_table(self) -> str:
        """For people to read."""
        lines = [
            f"{self.capture}: {len(self.frames)} frames from {self.frames[0]} to {self.frames[-1]}; a hull in "
            f"{self.closes:.0%} of them, {self.extent_m:.2f} m long",
            "",
            f"{'camera':12} {'mask':>6} {'specks':>7} {'holes':>6} {'empty':>6} {'cut':>5} {'outside':>8} "
            f"{'off by':>9} {'late':>5}",
        ]
        for c in self.cameras:
            off = f"{c.shift_px:.0f} px" if np.isfinite(c.shift_px) else "?"
            outside = f"{c.outside:.1%}" if np.isfinite(c.outside) else "-"
            lines.append(
                f"{c.name:12} {c.area:6.1%} {c.specks:7.1%} {c.holes:6.1%} {c.empty:6.0%} {c.cut:5.0%} {outside:>8} "
                f"{off:>9} {c.late_frames:5d}"
            )
        lines += [
            "",
            f"volume: all cameras see {self.seen_by_all:.0%} of it, two see {self.seen_by_two:.0%}; "
            f"{self.at_the_side:.1%} of the person is at its sides",
            f"up: {self.leveling.up}, {self.leveling.how}",
            f"floor: {self.leveling.floor_m:+.2f} m along up"
            if np.isfinite(self.leveling.floor_m)
            else "floor: not found",
            "",
            *(self.findings or ("Nothing is the matter.",)),
        ]
        return "\n".join(lines)


@dataclass(frozen=True)
class Seen:
    """What the sheet of pictures is made of: a frame's pictures, masks and the others' hull in each camera.

    Attributes:
        index: of the frame. images: (C, H, W, 3). masks: (C, H, W).
        hulls: (C, h, w) bool silhouettes of the hull of the other cameras, every ``step``-th pixel; None without one.
    """

    index: int
    images: NDArray[np.uint8]
    masks: Masks
    hulls: NDArray[np.bool_] | None
    step: int


@one_thread()
def inspect(capture: Capture, config: Settings, pictures: int = 3) -> tuple[Inspection, list[Seen]]:
    """Look at a capture.

    Args:
        capture: what to look at.
        config: how it is segmented.
        pictures: frames to keep for the sheet.

    Raises:
        CaptureError: it cannot be read.
    """
    span = min(capture.frame_count, _SPAN)
    frames = np.unique(np.linspace(0, span - 1, _FRAMES).round().astype(int))
    moments = np.unique(np.linspace(span // 4, max(span - 1 - _LATEST, span // 4), _MOMENTS).round().astype(int))
    near = {int(m) + s for m in moments for s in range(-_LATEST, _LATEST + 1)} & set(range(span))
    kept = frames[np.linspace(0, len(frames) - 1, min(pictures, len(frames))).round().astype(int)]
    notes: list[str] = list(capture.warnings)
    label = make_labeller(capture.setup(), capture, config, notes.append)
    health, sick = ImageHealth(), np.zeros(len(capture.rig), int)
    masks: dict[int, Masks] = {}
    images: dict[int, NDArray[np.uint8]] = {}
    with capture.frames(0, span) as reader:
        for frame in reader:
            if frame.index not in near and frame.index not in frames:
                continue
            masks[frame.index] = label(frame)[0].copy()
            sick += [reason is not None for reason in health.look(frame.images, masks[frame.index])]
            if frame.index in kept:
                images[frame.index] = frame.images.copy()
    compare = MaskAgreement(capture.rig, capture.volume)
    chosen = [masks[int(i)] for i in frames]
    agreement = compare.compare(chosen)
    late = _late(compare, masks, moments, agreement)
    places = compare.places([compare.small(m) for m in chosen])
    good = [c for c in range(len(capture.rig)) if c not in agreement.apart]
    hulls = [place.hull(good) for place in places if place is not None]
    leveling = find_up(capture.rig, capture.up, hulls)
    p = np.concatenate(hulls) if hulls else np.zeros((0, 3))
    edge = max(capture.volume.size) / 50
    sides = ((p < capture.volume.lower + edge) | (p > capture.volume.upper - edge)).any(axis=1)
    views = views_of(capture.rig, sample_box(capture.volume))
    cameras = tuple(_camera(capture, chosen, c, agreement, int(late[c]), int(sick[c])) for c in range(len(capture.rig)))
    inspection = Inspection(
        capture=capture.name,
        frames=tuple(int(i) for i in frames),
        cameras=cameras,
        closes=float(agreement.closes.mean()),
        extent_m=agreement.extent_m,
        seen_by_all=float((views == len(capture.rig)).mean()),
        seen_by_two=float((views >= 2).mean()),
        at_the_side=float(sides.mean()) if len(p) else float("nan"),
        leveling=leveling,
        findings=(),
    )
    seen = [
        Seen(int(i), images[int(i)], masks[int(i)], _silhouettes(places[list(frames).index(i)], good), compare.step)
        for i in kept
    ]
    return replace(inspection, findings=(*_findings(inspection, capture, agreement), *notes)), seen


def _late(
    compare: MaskAgreement, masks: dict[int, Masks], moments: Sequence[int] | NDArray[np.int64], agreement: Agreement
) -> NDArray[np.int64]:
    """(C,) by how many frames each camera starts late: its masks of which frame lie in the hull of the others."""
    C = len(compare.rig)
    moments = [int(m) for m in moments]
    small = {index: compare.small(m) for index, m in masks.items()}
    places = compare.places([small[m] for m in moments])
    shifts = np.arange(-_LATEST, _LATEST + 1)
    late = np.zeros(C, np.int64)
    out = np.zeros((C, len(shifts)))
    for c in range(C):
        others = [k for k in range(C) if k != c and (k != agreement.odd)]
        out[c] = _outside_by_shift(small, moments, places, others, c, shifts)
    best = shifts[np.nanargmin(np.where(np.isfinite(out), out, np.inf), axis=1)]
    now = out[:, _LATEST]
    least = np.nanmin(np.where(np.isfinite(out), out, np.inf), axis=1)
    candidates = np.flatnonzero((best != 0) & (now > _LATE_LEAST) & (least < _LATE_SHARE * now))
    # the hulls of a good camera lack what a late one cuts off: the late one is whose shift helps most
    if len(candidates):
        c = int(candidates[np.argmax((now - least)[candidates])])
        late[c] = -best[c]
    return late


def _outside_by_shift(
    small: dict[int, NDArray[np.bool_]],
    moments: Sequence[int],
    places: Sequence[Place | None],
    others: Sequence[int],
    camera: int,
    shifts: NDArray[np.int64],
) -> NDArray[np.float64]:
    """(S,) share of a camera's masks outside the hull of the others, when they are taken so many frames later."""
    area, out = np.zeros(len(shifts)), np.zeros(len(shifts))
    for moment, place in zip(moments, places, strict=True):
        # all shifts or none, so that they are compared over the same moments
        if place is None or any(moment + int(s) not in small for s in shifts):
            continue
        silhouette = place.silhouette(place.carve(others), camera)
        for i, s in enumerate(shifts):
            mask = small[moment + int(s)][camera]
            area[i] += mask.sum()
            out[i] += np.count_nonzero(mask & ~silhouette)
    return np.where(area > 0, out / np.maximum(area, 1), np.nan)


def _silhouettes(place: Place | None, good: Sequence[int]) -> NDArray[np.bool_] | None:
    if place is None:
        return None
    pictures = []
    for c in range(len(place.sees)):
        others = [k for k in good if k != c]
        pictures.append(place.silhouette(place.common(others or [c]), c))
    return np.array(pictures)


def _camera(
    capture: Capture, masks: Sequence[Masks], c: int, agreement: Agreement, late: int, sick: int
) -> CameraReport:
    camera = capture.rig[c]
    own = [m[c, : camera.height, : camera.width] >= 128 for m in masks]
    shown = [m for m in own if m.any()]
    specks, holes, cut = [], [], 0
    for mask in shown:
        count, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        areas = np.sort(stats[1:count, cv2.CC_STAT_AREA])
        specks.append(1.0 - areas[-1] / areas.sum())
        mended = clean_by_area(mask, 0.0, HOLE_SHARE * areas[-1])
        holes.append(float(np.count_nonzero(mended)) / mask.sum() - 1.0)
        cut += bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())
    verdict = ""
    if sick:
        verdict = "its picture shows nothing, or stands still while the others move"
    elif late:
        verdict = (
            f"its video seems to start {abs(late)} frame(s) {'late' if late > 0 else 'early'}: its frame k shows what "
            f"frame k {late:+d} of the others does"
        )
    elif c in agreement.apart:
        verdict = agreement.why(c)
    return CameraReport(
        name=camera.name,
        area=float(np.mean([m.mean() for m in own])),
        specks=float(np.mean(specks)) if specks else 0.0,
        holes=float(np.mean(holes)) if holes else 0.0,
        empty=1.0 - len(shown) / len(own),
        cut=cut / len(own),
        outside=float(agreement.own[c]),
        shift_px=float(np.hypot(*agreement.shift_px[c])),
        late_frames=late,
        sick=sick,
        verdict=verdict,
    )


def _findings(found: Inspection, capture: Capture, agreement: Agreement) -> list[str]:
    lines = [f"camera {c.name} disagrees with the others: {c.verdict}" for c in found.cameras if c.verdict]
    if not lines and agreement.disagreement > DISAGREE:
        lines.append(
            f"the cameras disagree, none more than the others: {agreement.disagreement:.0%} of the masks lie outside "
            "the hulls of the others; the calibration is off, or masks miss parts of the person"
        )
    if found.closes < 0.5:
        lines.insert(
            0,
            f"the masks of {1 - found.closes:.0%} of the frames have no hull in common: wrong unit or volume, a "
            "calibration that is off, or empty masks",
        )
    for c in found.cameras:
        if c.empty > 0.2:
            lines.append(f"camera {c.name} shows nobody in {c.empty:.0%} of the frames")
        if c.cut > 0.2:
            lines.append(f"camera {c.name} cuts the person off at the picture's edge in {c.cut:.0%} of the frames")
        if c.specks > _SPECKS:
            lines.append(f"camera {c.name}: {c.specks:.0%} of its masks lies in parts beside the largest one")
        if c.holes > _HOLES:
            lines.append(f"camera {c.name}: its masks have holes, {c.holes:.0%} of their area")
    if found.seen_by_two < 0.5:
        lines.append(f"only {found.seen_by_two:.0%} of the working volume is seen by two cameras: is [volume] right?")
    if found.at_the_side > _AT_THE_SIDE:
        lines.append(f"{found.at_the_side:.0%} of the person lies at the sides of the working volume: make it larger")
    height = capture.subject_height_m
    if height and not fits_height(found.extent_m, height):
        lines.append(f"the person measures {found.extent_m:.2f} m, but [subject] height is {height:.2f} m")
    tilt = np.degrees(np.arccos(np.clip(capture.up_axis @ up_vector(found.leveling.up), -1.0, 1.0)))
    if tilt > _TILTED_DEG:
        lines.append(
            f"up = {capture.up} is {tilt:.0f}° from what cameras and person say, {found.leveling.up}: tk level writes "
            "it down"
        )
    return lines


def _finite(value: Any) -> Any:
    """The value with None for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
