"""Whether a camera was zoomed or focused during a recording: its focal length in a part of its views."""

from __future__ import annotations

import numpy as np

from tk.calibration.bundle import Part, focal_changes
from tk.calibration.rig import Calibrated

#: places of a recording at which a change is tried
_CUTS = 6
#: a change counts above so many standard deviations of independent errors of the points. A board that is bent by 0.3
#: to 1 px shows 7; a zoom by 1 % in points with a noise of 0.3 px shows 12.
_SIGMAS = 10.0


def largest_change(done: Calibrated) -> tuple[int, float, str] | None:
    """Return the camera whose focal length changes most clearly, the change as a share, and when; None if none does.

    The bundle adjustment assumes one focal length for each camera; wrong poses can hide a zoom in its residuals.
    """
    parts: list[Part] = []
    when: list[str] = []
    for c, fitted in enumerate(done.fitted):
        own = sorted(view.instant for view in done.views if view.camera == c)
        others = {view.instant for view in done.views if view.camera != c}
        cuts = sorted({own[len(own) * k // _CUTS] for k in range(1, _CUTS)} - set(own[:1])) if own else []
        tried = [(frozenset(i for i in own if i >= cut), f"from instant {cut} on") for cut in cuts]
        tried.append((frozenset(own) - others, "where no other camera sees the board"))
        if fitted.how == "given":
            tried.append((frozenset(own), "since the calibration that --intrinsics names"))
        parts += [Part(c, instants) for instants, _ in tried]
        when += [text for _, text in tried]
    changes = focal_changes(done.solved, done.views, parts)
    clear = np.where(np.isfinite(changes[:, 0]), np.abs(changes[:, 0]) / changes[:, 1], 0.0)
    k = int(np.argmax(clear))
    return (parts[k].camera, float(changes[k, 0]), when[k]) if clear[k] > _SIGMAS else None
