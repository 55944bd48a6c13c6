"""Compute the fit of a result to the images: the two measures of the silhouette paper (its section 5), for each view.

- E_S (eq. 12): share of wrongly classified pixels. The body of the result is rendered into every view and compared
  with the capture's masks, with the cameras and time offsets of the run; lost frames are omitted.
- Distance of chosen joints from ground truth in pixels: "averaged across both feet and all marked frames, and averaged
  across all the views used for tracking". The paper says "mean squared" and gives pixels; here it is the mean distance.

Views that were not used for tracking are judged and marked.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ConfigError
from tk.evaluation.joints import plain_values
from tk.io.captures.capture import Capture, open_capture
from tk.io.captures.session import inherited
from tk.io.results.data import Result
from tk.io.results.reader import as_damage_error, read_result, read_truth
from tk.kernels.mask_values import PERSON
from tk.model.body.joints import ANKLE_JOINTS, JOINTS
from tk.model.cameras.camera import Rig
from tk.model.cues.ray_costs import RayGrid, residual_of
from tk.trackers.bodies import as_tracked, body_and_poses

Float = NDArray[np.float64]


@dataclass(frozen=True)
class ViewScore:
    """Measures of one camera."""

    camera: str  # name of the camera
    tracked: bool | None  # True if the camera was used for tracking; None if unknown
    joint_px: float  # mean distance of the chosen joints, pixels
    joint_share: float  # joint_px as a share of the subject's height in this view
    silhouette_error: float | None  # E_S, mean over the frames; None without masks or body


@dataclass(frozen=True)
class ViewEvaluation:
    """Measures of all views of a capture."""

    joints: tuple[str, ...]  # the chosen joints
    frames: int  # number of frames in both the result and the ground truth
    views: tuple[ViewScore, ...]  # one score per camera
    note: str = ""  # reason for a missing E_S; empty if there is none

    @property
    def joint_px(self) -> float:
        """Return the mean over the views that were used for tracking (section 5.1)."""
        return float(np.mean([view.joint_px for view in self._used]))

    @property
    def joint_share(self) -> float:
        return float(np.mean([view.joint_share for view in self._used]))

    @property
    def silhouette_error(self) -> float | None:
        """Return the mean over all views, tracked or not (section 5.2)."""
        values = [view.silhouette_error for view in self.views if view.silhouette_error is not None]
        return float(np.mean(values)) if values else None

    @property
    def _used(self) -> list[ViewScore]:
        return [view for view in self.views if view.tracked is not False]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; infinity and NaN become None."""
        means = {"joint_px": self.joint_px, "joint_share": self.joint_share, "silhouette_error": self.silhouette_error}
        return dict(plain_values(asdict(self) | means))

    def format_table(self) -> str:
        """Return the table that ``tk evaluate`` prints."""
        lines = [f"{'view':14}{'tracked':>8}{'joints px':>11}{'% height':>10}{'E_S %':>8}"]
        for view in self.views:
            used = {True: "yes", False: "no", None: "?"}[view.tracked]
            lines.append(
                f"{view.camera:14}{used:>8}{view.joint_px:11.2f}{100 * view.joint_share:10.2f}"
                f"{_percent(view.silhouette_error):>8}"
            )
        lines.append(
            f"{'mean':14}{'':>8}{self.joint_px:11.2f}{100 * self.joint_share:10.2f}{_percent(self.silhouette_error):>8}"
        )
        lines.append(f"joints: {', '.join(self.joints)}, over the tracked views; E_S over all views")
        return "\n".join([*lines, self.note] if self.note else lines)


def evaluate_views(
    result: str | os.PathLike[str],
    truth: str | os.PathLike[str],
    capture: str | Path,
    joints: Sequence[str] = ANKLE_JOINTS,
    masks: str = "auto",
) -> ViewEvaluation:
    """Measure the fit of a result in all views of its capture.

    Args:
        result: the result file.
        truth: the ground truth file.
        capture: the capture's folder.
        joints: joints whose distance is measured.
        masks: as for :func:`~tk.io.captures.capture.open_capture`.

    Raises:
        ConfigError: an unknown joint.
        CaptureError: the capture cannot be read, or shows another recording.
    """
    if not joints:
        raise ConfigError(f"joints: name at least one of {', '.join(JOINTS)}")
    for name in joints:
        if name not in JOINTS:
            raise ConfigError(f"joint {name!r} is unknown: choose from {', '.join(JOINTS)}")
    found, true = read_result(result), read_truth(truth)[0]
    opened = open_capture(capture, None, masks, found.resampled)
    common, rows, true_rows = np.intersect1d(found.frames, true.frames, return_indices=True)
    if len(common) == 0 or common[-1] >= opened.frame_count:
        raise CaptureError(f"{capture}: {found.path} is of frames that this capture and {truth} do not share")
    estimate, position = found.joints[rows], true.positions[true_rows]
    used = found.state.get("run/cameras")
    names = {name.strip() for name in str(used).split(",")}
    known = bool(names & set(opened.rig.names))  # not in a damaged state, or without one
    with as_damage_error(found.path, "the body or a pose"):
        error, note = _silhouette_errors(found, as_tracked(opened, found))
    views = []
    for v, camera in enumerate(opened.rig):
        px, share = _pixel_error(Rig((camera,)), estimate, position, joints)
        views.append(
            ViewScore(camera.name, camera.name in names if known else None, px, share, error[v] if error else None)
        )
    return ViewEvaluation(tuple(joints), len(common), tuple(views), note)


def _pixel_error(view: Rig, estimate: Float, truth: Float, joints: Sequence[str]) -> tuple[float, float]:
    """Return the mean distance in one view, pixels and as a share of the true height from ankles to crown."""
    camera = view[0]
    chosen = [JOINTS.index(name) for name in joints]
    a, b = (camera.project(p[:, chosen].reshape(-1, 3))[0] for p in (estimate, truth))
    ankles = truth[:, [JOINTS.index(name) for name in ANKLE_JOINTS]].mean(axis=1)
    crown, foot = (camera.project(p)[0] for p in (truth[:, JOINTS.index("head_top")], ankles))
    distance, height = _mean_length(a - b), _mean_length(crown - foot)
    return distance, distance / height


def _mean_length(vectors: Float) -> float:
    """Return the mean length of those vectors (N, 2) that are known; NaN if none is."""
    length = np.linalg.norm(vectors, axis=1)
    known = length[np.isfinite(length)]
    return float(known.mean()) if known.size else float("nan")


def _silhouette_errors(result: Result, capture: Capture) -> tuple[list[float] | None, str]:
    """Return the mean E_S of each view over the frames of the result with a pose, or None and the reason."""
    found = body_and_poses(result)
    if found is None:
        return None, f"no E_S: {result.path} does not contain the tracked body"
    if not capture.has_masks:
        return None, f"no E_S: {capture.path} has no masks/"
    body, poses = found
    row_of = {int(frame): row for row, frame in enumerate(result.frames)}
    is_shown = result.has_pose & np.isfinite(result.pose).all(axis=1)
    first, last = int(result.frames.min()), int(result.frames.max())
    errors, grid = [], RayGrid(capture.rig, capture.rig.frame_shape[0])
    with capture.frames(first, last + 1) as frames:
        for frame in frames:
            row = row_of.get(frame.index)
            if row is not None and frame.masks is not None and is_shown[row]:
                label = grid.render(body, poses[row][None]).label[0]
                errors.append(residual_of(label > 0, grid.sample(frame.masks) >= PERSON).sum(axis=1))
    values = np.array(errors).reshape(-1, len(capture.rig))
    seen = np.isfinite(values)  # NaN for an empty mask
    if not seen.any(axis=0).all():
        return None, f"no E_S: {capture.path} has a view without a mask in the frames with a pose"
    return [float(values[seen[:, v], v].mean()) for v in range(len(capture.rig))], ""


def capture_of(truth: str | os.PathLike[str]) -> Path | None:
    """Return the capture folder that contains the ground truth file; None if there is none."""
    folder = Path(truth).parent
    return folder if inherited(folder, "calibration.toml").is_file() else None


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"
