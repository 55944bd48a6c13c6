"""`tk calibrate --refine`: a calibration refined by a tracked recording of a person."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from tk.errors import CalibrationError, CaptureError, ConfigError, ResultError
from tk.io.captures.calibration import CALIBRATION, write_calibration
from tk.io.captures.capture import Capture
from tk.io.captures.mask_store import MaskStore
from tk.io.paths import check_output
from tk.io.results.reader import read_result
from tk.model.body.body_fit import INFORMATIVE_FRAMES
from tk.model.cameras.bundle import TrackedPerson
from tk.model.cameras.refinement import Refined, RefinementSettings
from tk.model.cameras.tracker_frame import TrackerFrame
from tk.run.plan import reduce_images
from tk.run.prefetch import open_observations
from tk.run.refinement import refine_rig
from tk.run.task import Task
from tk.settings import Settings
from tk.threads import one_thread
from tk.trackers.bodies import body_and_poses


@one_thread()
def refine_capture(
    capture: Capture,
    result: Path,
    output: Path,
    config: Settings,
    note: Callable[[str], None],
    how: RefinementSettings | None = None,
    force: bool = False,
) -> Refined:
    """Refine a capture's cameras by a result of tracking it, and write a new calibration file; ``force`` replaces one.
    Return the refinement, its cameras in the tracker's frame.

    Raises:
        ConfigError: the result has no cone body.
        CaptureError, ResultError: capture and result do not match, or too few frames are tracked.
        CalibrationError: the new file cannot be written.
    """
    check_output(output, CALIBRATION, force, [result], capture.path, CalibrationError)
    found = read_result(result)
    tracked = [(person, known) for person in found.people if (known := body_and_poses(person)) is not None]
    if not tracked:
        raise ConfigError(f"{result}: has no body with contours; track with the method region")
    if not len(found.frames) or found.frames.max() >= capture.frame_count or found.meta.up != capture.up:
        raise ResultError(f"{result}: is not a result of {capture.path}")
    if found.cameras is not None and found.cameras.rig.names != capture.rig.names:
        raise ResultError(
            f"{result}: was tracked with the cameras {', '.join(found.cameras.rig.names)}; open the same",
            hint="name them with --cameras",
        )
    source = reduce_images(capture, config.person_pixels)
    world, store = TrackerFrame.of(source.rig, source.up), MaskStore()
    with open_observations(Task.of(source, config), note, image_step=0) as observations:
        for observation, _ in observations.frames(int(found.frames.min()), int(found.frames.max()) + 1):
            store.put(observation.index, observation.masks)
    masks, people = lru_cache(16)(store.get), list[TrackedPerson]()
    for person, (body, poses) in tracked:
        inside = world.poses_in(poses)
        people.append(TrackedPerson(body.standing("z"), masks, person.frames, inside, person.has_pose))
    done = refine_rig(people, world.rig, how)
    if done is None:
        raise CaptureError(
            f"{result}: has too few consecutive tracked frames to refine {capture.path}; "
            f"{INFORMATIVE_FRAMES} are needed"
        )
    read = np.array(capture.late_frames) / capture.fps
    # what is new is added to the file's delays: those of the capture may include distances from its clock's frames
    new = read + done.offset_frames / capture.fps - capture.time_offset_s
    late = new + (capture.calibration.time_offset_s or 0.0)
    write_calibration(output, capture.calibration, world.rig_out(done.rig.recorded()), late.tolist())
    return done
