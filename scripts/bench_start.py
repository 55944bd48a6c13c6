"""What the first pose takes, piece by piece, processor time of the tracker's process. `scripts.bench CAPTURE --start`.

Each line is measured once in a new process: repeat the command, and take the least.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from unittest import mock

import numpy as np

_SELF = "from scripts.bench_start import pieces; pieces({path!r}, {masks!r})"


def measure(capture: Path, masks: str) -> str:
    """Return a line for each piece, milliseconds."""
    code = _SELF.format(path=str(capture), masks=masks)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def pieces(path: str, masks: str) -> None:
    """Print the pieces of the start. Call it in a new process that has imported nothing."""
    begun = time.process_time()

    def done(what: str) -> None:
        nonlocal begun
        now = time.process_time()
        print(f"{what:48s} {1e3 * (now - begun):6.0f} ms")
        begun = time.process_time()

    import tk.cli
    import tk.io.importers
    import tk.run.session
    import tk.trackers.region

    done("imports")
    from tk.kernels.runtime import ensure_runtime, ti
    from tk.people.find import PeopleFinder
    from tk.people.people import People
    from tk.run.plan import open_plan, recording_task
    from tk.run.segmentation import sources_of_masks
    from tk.run.task import RecordingOptions
    from tk.threads import one_thread
    from tk.trackers import contour_finder

    recording = tk.io.importers.open_recording(Path(path), None, masks)
    task = recording_task(recording, RecordingOptions())
    setup = task.setup
    done("opening the recording")
    ensure_runtime()
    done("starting Taichi")
    spent = {"transformation of kernels": 0.0, "body fit": 0.0, "search for the pose": 0.0}

    def timed(name: str, function: Callable[..., object]) -> Callable[..., object]:
        def run(*args: object, **options: object) -> object:
            start = time.process_time()
            try:
                return function(*args, **options)
            finally:
                spent[name] += time.process_time() - start

        return run

    kernel = ti.lang.kernel_impl.Kernel
    with open_plan(task, lambda _: None) as plan:
        done("tracker, without its kernels")
        frames = plan.observations.frames(plan.first, plan.stop)
        with mock.patch.object(kernel, "materialize", timed("transformation of kernels", kernel.materialize)):
            plan.tracker.prepare(with_landmarks=bool(sources_of_masks(task.source)))
        transformed = spent["transformation of kernels"]
        begun += transformed
        done("kernels from the cache")
        print(f"{'transformation of kernels':48s} {1e3 * transformed:6.0f} ms")
        opening = [observation for observation, _ in islice(frames, plan.tracker.opening_frames)]
        done("receiving the first frames")
        with one_thread():
            PeopleFinder(setup.rig, setup.volume, setup.up).find(opening[0].masks, opening[0].uncertain)
            done("finding people")
            people = People(setup, task.settings, task.options.people, plan.tracker, lambda _: None)
            find, fit = contour_finder.find_person, contour_finder.fit_body
            with (
                mock.patch.object(contour_finder, "find_person", timed("search for the pose", find)),
                mock.patch.object(contour_finder, "fit_body", timed("body fit", fit)),
            ):
                people.start(opening)
        for name in ("search for the pose", "body fit"):
            begun += spent[name]
            print(f"{name:48s} {1e3 * spent[name]:6.0f} ms")
        done("people again, agreement of cameras, scales")
        assert np.isfinite(opening[0].time)
