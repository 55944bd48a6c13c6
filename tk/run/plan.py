"""What a run is, before its first frame: the capture opened, the tracker made, the frames chosen."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tk.errors import CaptureError, ConfigError
from tk.io.captures.capture import Capture
from tk.io.captures.init_pose import InitPose
from tk.io.captures.keypoints import first_pose
from tk.io.results.writer import JointAngles, ResultMeta
from tk.io.settings_file import to_toml
from tk.model.body.angles import ANGLES
from tk.model.body.cone_body import ConeBody
from tk.model.body.skeleton import SEGMENTS
from tk.run.prefetch import TIMING_STAGES, Source, open_source
from tk.run.segmentation import mask_source
from tk.settings import Settings
from tk.trackers.bodies import read_body
from tk.trackers.contour_tracker import ContourTracker
from tk.trackers.protocol import Tracker
from tk.trackers.region import RegionTracker
from tk.trackers.silhouette import SilhouetteTracker
from tk.trackers.volumetric import VolumetricTracker

_LOG = logging.getLogger(__name__)

METHODS = ("region", "silhouette", "volumetric")


def make_tracker(method: str, capture: Capture, config: Settings) -> Tracker:
    """The tracker of this name for a capture.

    Raises:
        ConfigError: there is none of this name.
    """
    rig, up = capture.rig, capture.up
    if method == RegionTracker.method:
        return RegionTracker(rig, up, config.silhouette, config.region)
    if method == SilhouetteTracker.method:
        return SilhouetteTracker(rig, up, config.silhouette)
    if method == VolumetricTracker.method:
        return VolumetricTracker(rig, capture.volume, up, config)
    raise ConfigError(f"--method {method}: choose one of {', '.join(METHODS)}")


def choose_frames(capture: Capture, frames: tuple[int, int | None], note: Callable[[str], None]) -> tuple[int, int]:
    """The first frame of ``--frames`` and the one to stop before, within the capture.

    Raises:
        ConfigError: the capture ends before the first.
    """
    start, stop = frames
    if start >= capture.frame_count:
        asked = f"{start}:" if stop is None else f"{start}:{stop}"
        raise ConfigError(f"--frames {asked}: {capture.path} has only frames 0 to {capture.frame_count - 1}")
    if stop is not None and stop > capture.frame_count:
        note(f"--frames {start}:{stop}: {capture.path} ends with frame {capture.frame_count - 1}")
    return max(start, capture.first_frame), capture.frame_count if stop is None else min(stop, capture.frame_count)


@dataclass(frozen=True)
class Plan:
    """What is to be tracked, and by whom.

    Attributes:
        capture, config: what, and by which settings.
        source: of the observations; the tracker is not started yet.
        first: the frame in which the subject is found; begin: the first that is told; stop: the one to stop before.
        init: the rough pose, if one was given; body: the body, if one was given.
    """

    capture: Capture
    config: Settings
    source: Source
    tracker: Tracker
    first: int
    begin: int
    stop: int
    init: InitPose | None
    body: ConeBody | None

    def meta(self) -> ResultMeta:
        """What the result says of itself."""
        tracker, capture = self.tracker, self.capture
        contours = isinstance(tracker, ContourTracker)
        return ResultMeta(
            pose_names=tracker.pose_names,
            pose_units=tracker.pose_units,
            stages=tracker.stages,
            timing_stages=(*TIMING_STAGES, *tracker.timing_stages, "total"),
            fps=capture.fps,
            up=capture.up,
            capture=capture.name,
            method=tracker.method,
            seed=self.config.seed,
            config_toml=to_toml(self.config),
            waist_names=tracker.waist_names,
            ankle_names=tracker.ankle_names,
            sigma=tracker.method == RegionTracker.method,
            residual_cameras=capture.rig.names if tracker.method == RegionTracker.method else (),
            segment_names=SEGMENTS if contours else (),
            feet=contours,
            angles=tuple(JointAngles(a.joint, a.names, a.convention) for a in ANGLES) if contours else (),
            objective_kind="E_S" if contours else "robust distance of surface points",
        )

    def origin(self, store_hull: bool) -> dict[str, str]:
        """What else but :class:`ResultMeta` must agree when a run is taken up again, by the name that a user knows."""
        capture, masks, init = self.capture, self.capture.mask_clips, self.init
        given = "none" if self.body is None else hashlib.sha256(repr(self.body).encode()).hexdigest()[:12]
        return {
            "first frame": str(self.begin),
            "frame of the initial pose": str(self.first),
            "given body (its hash)": given,
            "cameras": ", ".join(capture.rig.names),
            "masks": mask_source(capture) if masks is None else os.path.relpath(masks[0].path.parent, capture.path),
            "initial pose (its hash)": "none" if init is None else hashlib.sha256(repr(init).encode()).hexdigest()[:12],
            "stored hull": "yes" if store_hull else "no",
        }


@contextmanager
def open_plan(
    capture: Capture,
    config: Settings,
    note: Callable[[str], None],
    method: str,
    frames: tuple[int, int | None],
    init_pose: Path | None,
    body_file: Path | None,
) -> Iterator[Plan]:
    """Open a capture for tracking, with its source of observations; arguments as of :func:`tk.run.session.track`.

    Raises:
        TkError: the arguments do not go together, or with the capture.
    """
    # its process starts while this one makes tables and compiles
    with open_source(capture, config, note, keep_images=method != SilhouetteTracker.method) as source:
        _LOG.info("preparing the %s tracker", method)
        tracker = make_tracker(method, capture, config)
        body = read_body(body_file, capture.up) if body_file else None
        init = first_pose(capture, tracker.pose_names, init_pose, frames[0])
        if init_pose is None and init is not None:
            init_pose = capture.init_keypoints
        if init and not ((capture.volume.lower <= init.center) & (init.center <= capture.volume.upper)).all():
            raise CaptureError(
                f"{init_pose}: the body is at {init.center.round(2).tolist()}, outside the working volume "
                f"{capture.volume.lower.round(2).tolist()} to {capture.volume.upper.round(2).tolist()}; give metres"
            )
        first = init.frame if init and init.frame is not None else frames[0] if init else capture.init_frame
        if init is None and capture.init_pose == "any":
            first = max(first, frames[0])  # no frame is better than another
        start, stop = choose_frames(capture, frames, note)
        if not first < capture.frame_count:
            raise CaptureError(f"{init_pose}: frame = {first} is past the capture's last, {capture.frame_count - 1}")
        if first >= stop:
            raise ConfigError(
                f"--frames {start}:{stop}: the subject is found in frame {first} and followed forwards; "
                f"end after frame {first}, or start elsewhere with --init-pose FILE"
            )
        if start < first:
            note(f"frames before {first} are left out: the subject is found in frame {first} and followed forwards")
        yield Plan(capture, config, source, tracker, first, max(start, first), stop, init, body)
