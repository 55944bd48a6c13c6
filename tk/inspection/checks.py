"""Check a capture before tracking: `tk inspect`.

The masks of ten frames are compared through the calibration (:mod:`tk.model.masks.mask_agreement`, the test that
`tk track` makes at its start): do they have a visual hull in common, which camera is inconsistent, by how many pixels,
and would its video be consistent some frames earlier or later? Further checks: each camera's masks, the working volume,
the floor, and the up direction. If there are several people and the pixels of person 0 are consistent, the checks are
of these pixels.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.inspection.delays import REACH, find_delays, in_frames
from tk.inspection.leveling import find_up
from tk.inspection.people import PeopleWatch, many_people
from tk.inspection.results import CameraReport, Inspection, Sample
from tk.io.captures.capture import Capture
from tk.io.captures.video import odd_turn
from tk.kernels.mask_values import PERSON
from tk.model.body.plausibility import fits_height
from tk.model.cameras.common_view import sample_box, views_of
from tk.model.cameras.landmark_agreement import consensus, trunk
from tk.model.cameras.mounting import SNAP_DEG
from tk.model.cameras.up import shown, up_vector
from tk.model.cameras.volume import Volume
from tk.model.hull.coarse import Hull
from tk.model.masks.image_health import MOST_SHIFT, ImageHealth, Sampled, mask_contradiction, sampled
from tk.model.masks.image_shift import shift_between
from tk.model.masks.mask_agreement import INCONSISTENT, Agreement, MaskAgreement
from tk.model.masks.regions import clean_by_area
from tk.model.masks.silhouettes import HOLE_SHARE, SPECK_SHARE
from tk.run.segmentation import make_labeller, people_in_scene
from tk.run.task import Task
from tk.settings import Settings
from tk.threads import one_thread
from tk.trackers.camera_monitor import confirmed
from tk.trackers.judgement import FAULTS

Masks = NDArray[np.uint8]
_LOG = logging.getLogger(__name__)

#: frames that are compared; frames whose neighbours, REACH before and after, are also compared. These values decide
#: which findings are printed, and no tracking result depends on them.
_FRAMES, _DELAY_FRAMES = 10, 5
#: frames that are read, from the first one that all cameras have: videos are decoded in order, so later frames take
#: longer
_SPAN = 600
#: finding: a larger share of a mask's area is holes
_HOLES = 0.01
#: finding: a larger share of the hull at the border of the working volume
_AT_BORDER = 0.03


@one_thread()
def inspect(
    capture: Capture, config: Settings, pictures: int = 3, within: Callable[[float], None] = lambda share: None
) -> tuple[Inspection, list[Sample]]:
    """Check a capture.

    Args:
        capture: the capture.
        config: settings of the segmentation.
        pictures: number of frames to return for the sheet.
        within: receives the share of the frames that are read.

    Raises:
        CaptureError: the capture cannot be read.
    """
    first = capture.first_frame  # before it, a camera that begins later shows its first image
    span = range(first, min(capture.frame_count, first + _SPAN))
    frames = np.unique(np.linspace(first, span[-1], _FRAMES).round().astype(int))
    quarter = first + len(span) // 4
    last = max(span[-1] - REACH, quarter)
    centers = np.unique(np.linspace(quarter, last, _DELAY_FRAMES).round().astype(int)).tolist()
    near = {i + s for i in centers for s in range(-REACH, REACH + 1)} & set(span)
    kept = frames[np.linspace(0, len(frames) - 1, min(pictures, len(frames))).round().astype(int)]
    read = _read(capture, config, span, near | set(frames.tolist()), set(kept.tolist()), within)
    _LOG.info("comparing the masks of %d cameras", len(capture.rig))
    notes, small, masks = read.notes, read.small, read.masks
    pairs = [(i + s, i + s + REACH) for i in centers for s in (-REACH, 0)]
    given = [(small[i], small[k]) for i, k in pairs if capture.has_masks and i in small and k in small]
    unrelated = mask_contradiction(given)
    compare = MaskAgreement(capture.rig, capture.volume)
    people, entered = read.watch.people(), read.watch.entered or 0
    if (later := frames >= entered).any():  # before it the masks show nobody, or people outside the volume
        kept, frames = kept[kept >= entered], frames[later]
        centers = [i for i in centers if i - REACH >= entered] or centers
    agreement = compare.compare([masks[i] for i in frames.tolist()])
    if len(people) > 1:
        own = {index: read.watch.of_first(index, m, read.landmarks[index]) for index, m in masks.items()}
        alone = compare.compare([own[i] for i in frames.tolist()])
        if not (alone.refusal or alone.wrong or alone.disagreement > INCONSISTENT):
            # the others are people, not what a turned camera shows of one person
            masks, agreement = own, alone
    bad = np.array([[i in images for images in read.bad_images] for i in frames.tolist()], np.bool_)
    by_masks, marked = agreement, [read.landmarks[i] for i in frames.tolist()]
    agreement = confirmed(by_masks, capture.rig, marked, bad)
    late, sure = find_delays(compare, masks, centers, agreement)
    for c in () if sure else np.flatnonzero(late).tolist():
        notes.append(
            f"camera {capture.rig[c].name} may start {in_frames(late[c])}, but without some of the compared frames its "
            "masks say otherwise: it cannot be decided"
        )
        late[c] = 0
    chosen = [masks[i] for i in frames.tolist()]
    hulls = compare.hulls([compare.possible(m) for m in chosen])
    good = agreement.right
    points = [hull.points(good) for hull in hulls if hull is not None]
    views = views_of(capture.rig, sample_box(capture.volume))
    inspection = Inspection(
        capture=capture.name,
        frames=tuple(frames.tolist()),
        cameras=tuple(
            _camera(capture, chosen, c, agreement, int(late[c]), bad) for c, bad in enumerate(read.bad_images)
        ),
        with_hull=float(agreement.closes.mean()),
        extent_m=agreement.extent_m,
        seen_by_all=float((views == len(capture.rig)).mean()),
        seen_by_two=float((views >= 2).mean()),
        at_border=_at_border(capture.volume, points),
        leveling=find_up(capture.calibration.mounting, capture.up, points, len(people) < 2),
        people=people,
        findings=(),
        notes=tuple(notes),
    )
    seen = [
        Sample(i, read.images[i], masks[i], _silhouettes(hulls[frames.tolist().index(i)], good), compare.step)
        for i in kept.tolist()
    ]
    empty = capture.background() or ()
    moved = [line for i in kept[:1] for line in _moved_since_empty(capture, empty, read.images[int(i)], masks[int(i)])]
    denied = bool(by_masks.refusal or by_masks.wrong) and not (agreement.refusal or agreement.wrong)
    somebody = [] if capture.has_masks else _somebody_in_empty(Task.of(capture, config), empty)
    findings = [*somebody, *moved, *_findings(inspection, capture, agreement, denied)]
    if not agreement.wrong:  # a wrong camera makes one person look like several
        findings += many_people(people, entered)
    return replace(inspection, findings=tuple([unrelated, *findings] if unrelated else findings)), seen


@dataclass(frozen=True)
class _Read:
    """What was read of a capture.

    Attributes:
        masks: (C, H, W) by frame index. landmarks: (N, C, L, 4) of N people in these frames, if known. images:
            (C, H, W, 3) likewise, of fewer frames. small: masks and images at a small size, of the frames of ``masks``.
        bad_images: of each camera, what is wrong with an image, by frame index.
        watch: has seen the people.
        notes: what the capture and the segmentation report.
    """

    masks: dict[int, Masks]
    landmarks: dict[int, NDArray[np.float64] | None]
    images: dict[int, NDArray[np.uint8]]
    small: dict[int, Sampled]
    bad_images: tuple[dict[int, str], ...]
    watch: PeopleWatch
    notes: list[str]


def _read(
    capture: Capture, config: Settings, span: range, compared: set[int], kept: set[int], within: Callable[[float], None]
) -> _Read:
    """Decode and segment the frames of ``span``; return the masks of the frames that are ``compared``, and the
    images of those that are ``kept``."""
    notes = list(capture.warnings)
    _LOG.info("making masks of the first frame")
    label = make_labeller(Task.of(capture, config), notes.append)
    read = _Read({}, {}, {}, {}, tuple({} for _ in capture.rig), PeopleWatch(capture, span), notes)
    health = ImageHealth(capture.rig.sizes)
    watched = {i for i in span if read.watch.wants(i)}
    due = watched | compared
    with capture.frames(span.start, span.stop) as reader:
        for done, frame in enumerate(frame for frame in reader if frame.index in due):
            i, labels = frame.index, label(frame)
            if done:
                within(done / (len(due) - 1))
            else:  # it takes longer than the others: a network is loaded
                _LOG.info("making masks of %d further frames", len(due) - 1)
            if i in watched:
                read.watch.look(i, labels)
            if i in compared:
                read.masks[i], read.landmarks[i] = labels.masks.copy(), labels.landmarks
                read.small[i] = sampled(frame.images, labels.masks, capture.rig.sizes)
                for bad, reason in zip(read.bad_images, health.look(frame.images, read.masks[i]), strict=True):
                    if reason is not None:
                        bad[i] = FAULTS[reason]
            if i in kept:
                read.images[i] = frame.images.copy()
    return read


def _at_border(volume: Volume, points: Sequence[NDArray[np.float64]]) -> float:
    """Return the share of the points (N, 3) of all hulls at the border of the working volume; NaN without any."""
    if not points:
        return float("nan")
    p, edge = np.concatenate(points), max(volume.size) / 50
    at_border = ((p < volume.lower + edge) | (p > volume.upper - edge)).any(axis=1)
    return float(at_border.mean()) if len(p) else float("nan")


def _silhouettes(hull: Hull | None, good: Sequence[int]) -> NDArray[np.bool_] | None:
    if hull is None:
        return None
    pictures = []
    for c in range(len(hull.inside)):
        others = [k for k in good if k != c]
        pictures.append(hull.silhouette(hull.common(others or [c]), c))
    return np.array(pictures)


def _camera(
    capture: Capture, masks: Sequence[Masks], c: int, agreement: Agreement, late: int, bad_images: Mapping[int, str]
) -> CameraReport:
    camera = capture.rig[c]
    own = [m[c, : camera.height, : camera.width] >= PERSON for m in masks]
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
    if bad_images:
        first, reason = next(iter(bad_images.items()))
        verdict = f"it {reason} (frame {first} is the first of {len(bad_images)})"
    elif late:
        verdict = (
            f"its video seems to start {in_frames(late)}: its frame {max(-late, 0)} shows what frame "
            f"{max(late, 0)} of the others shows"
        )
    elif c in agreement.wrong:
        turn = odd_turn(capture.clips[c], capture.clips)
        verdict = agreement.reason(c) + (f"; {turn}" if turn else "")
    return CameraReport(
        name=camera.name,
        area=float(np.mean([m.mean() for m in own])),
        specks=float(np.mean(specks)) if specks else 0.0,
        holes=float(np.mean(holes)) if holes else 0.0,
        empty=1.0 - len(shown) / len(own),
        cut=cut / len(own),
        outside=float(agreement.outside[c]),
        shift_px=float(np.hypot(*agreement.shift_px[c])),
        pairs_px=float(agreement.pairs_px[c]),
        late_frames=late,
        bad_images=len(bad_images),
        verdict=verdict,
    )


def _moved_since_empty(
    capture: Capture, scene: Sequence[NDArray[np.uint8]], images: NDArray[np.uint8], masks: Masks
) -> list[str]:
    """Return a line for each camera whose image differs from that of its empty scene by a shift."""
    lines = []
    for camera, empty, image, mask in zip(capture.rig, scene, images, masks, strict=False):
        h, w = empty.shape[1:3]
        moved = shift_between(empty[0], image[:h, :w], mask[:h, :w])
        if moved > MOST_SHIFT:
            lines.append(
                f"camera {camera.name} was moved or zoomed, by {moved * max(h, w):.0f} px, between its empty scene and "
                "the recording: record the empty scene again, and calibrate again if that was done before the move"
            )
    return lines


def _somebody_in_empty(task: Task, scene: Sequence[NDArray[np.uint8]]) -> list[str]:
    """Return a line if a network finds a person in two or more images of the empty scene, inside the working volume:
    what the person hides there is no background."""
    if not scene:
        return []
    images = np.zeros((len(scene), *task.setup.rig.frame_shape, 3), np.uint8)
    for image, clip in zip(images, scene, strict=True):
        image[: clip.shape[1], : clip.shape[2]] = clip[0]
    for seen in () if (people := people_in_scene(task, images)) is None else people:
        shown = consensus(task.setup.rig, seen)
        place, volume = trunk(shown.points), task.setup.volume
        if ((place > volume.lower) & (place < volume.upper)).all():
            names = ", ".join(np.array(task.setup.rig.names)[shown.agree])
            return [f"the empty scene shows a person ({names}): record it again when nobody is there"]
    return []


def _findings(found: Inspection, capture: Capture, agreement: Agreement, denied: bool) -> list[str]:
    """Return what is to be mended. ``denied``: the masks contradict each other, but the landmarks do not."""
    lines = [f"camera {c.name} is inconsistent with the others: {c.verdict}" for c in found.cameras if c.verdict]
    if agreement.refusal:
        lines.insert(0, agreement.refusal)
    elif denied:
        lines.append(
            "the masks contradict each other, but the landmarks of the cameras agree: the masks show other people or "
            "things, or miss parts of the person: look at them (-o DIR)"
        )
    elif not lines and agreement.disagreement > INCONSISTENT:
        lines.append(
            f"the cameras are inconsistent, none more than the others: {agreement.disagreement:.0%} of the masks lie "
            "outside the hulls of the others; check the calibration, and whether masks miss parts of the person"
        )
    if found.with_hull < 0.5:
        lines.insert(
            0,
            f"the masks of {1 - found.with_hull:.0%} of the frames have no visual hull in common: check the unit, "
            "[volume], the calibration, and whether masks are empty",
        )
    for c in found.cameras:
        if c.empty > 0.2:
            lines.append(f"camera {c.name} shows nobody in {c.empty:.0%} of the frames")
        if c.cut > 0.2:
            lines.append(
                f"camera {c.name} shows the person cut off at the edge of the image in {c.cut:.0%} of the frames"
            )
        if c.specks > SPECK_SHARE and len(found.people) < 2:
            lines.append(f"camera {c.name}: {c.specks:.0%} of its masks is not connected to the largest part")
        if c.holes > _HOLES:
            lines.append(f"camera {c.name}: its masks have holes, {c.holes:.0%} of their area")
    if found.seen_by_two < 0.5:
        lines.append(f"only {found.seen_by_two:.0%} of the working volume is seen by two cameras: check [volume]")
    if found.at_border > _AT_BORDER:
        lines.append(f"{found.at_border:.0%} of the person lies at the border of the working volume: make it larger")
    height = capture.subject_height_m
    if height and not fits_height(found.extent_m, height):
        lines.append(f"the person measures {found.extent_m:.2f} m, but [subject] height is {height:.2f} m")
    if found.leveling.person and not found.leveling.decided:
        lines.append(f"up = {shown(capture.up)}: {found.leveling.how}")
    tilt = np.degrees(np.arccos(np.clip(capture.up_axis @ up_vector(found.leveling.up), -1.0, 1.0)))
    if tilt > SNAP_DEG:
        lines.append(
            f"up = {shown(capture.up)} differs by {tilt:.0f}° from the estimate from cameras and person, "
            f"{shown(found.leveling.up)}: tk calibrate --level writes the estimate to capture.toml"
        )
    return lines
