"""The data of a report as plain values for JSON. Arrays are base64 of little-endian float32."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.evaluation.joints import Evaluation, evaluate, plain_values
from tk.evaluation.people import evaluate_people
from tk.io.results.data import Result
from tk.io.results.reader import joint_tracks, positions_at, read_truth
from tk.io.results.status import STATUS_MEANING, Status
from tk.model.body.expected_error import in_cm, mean_range
from tk.model.body.joints import BONE_ENDS, HINGES, JOINTS, LIMB_JOINTS, SEGMENTS
from tk.model.cameras.camera import Rig
from tk.render.figure import AROUND, Figure
from tk.render.palette import (
    BONE,
    LOST,
    LOST_BODY,
    SEGMENT_COLORS,
    SIDE_COLORS,
    SIGMA_MOST_M,
    hexadecimal,
    person_color,
    sigma_colors,
)
from tk.render.people import People, Stage
from tk.render.scene import camera_pyramid

Float = NDArray[np.float64]

# Most rows of all people in a page: a row takes 1.7 kB, so a page has at most 8 MB with its images. Of longer
# recordings every second, third, … frame is shown.
_MOST_ROWS = 4000
#: stops of the colour scale of σ; the page interpolates between them
_SIGMA_STOPS = 9


def describe(result: Result, rig: Rig | None = None, truth: Path | None = None) -> dict[str, Any]:
    """Return all data of the report except the images.

    Args:
        result: the result, with at least one frame.
        rig: the cameras, if the result does not have them.
        truth: the ground truth; the file need not exist.
    """
    meta = result.meta
    whole = result.people
    step = -(-len(whole) * len(whole[0]) // _MOST_ROWS)
    people = People(tuple(person.at_rows(np.arange(0, len(person), step)) for person in whole))
    first = people.first
    errors = _errors(result, people.results, truth)
    return {
        "capture": meta.capture,
        "method": meta.method,
        "fps": meta.fps,
        "software": result.software,
        "created": result.created,
        "seed": meta.seed,
        "settings": meta.config_toml,
        "notes": list(result.notes),
        "frames": first.frames.tolist(),
        "frameCount": len(whole[0]),
        "step": step,
        "time": first.time.round(4).tolist(),
        "statusWords": list(STATUS_MEANING),
        "withoutPose": [int(Status.LOST), int(Status.ABSENT)],
        "scene": _scene(people.stage, result.cameras.rig if result.cameras else rig),
        "joints": list(JOINTS),
        "cameras": list(meta.residual_cameras),
        "leftOut": [int(count) for count in People(whole).left_out.sum(axis=0)],
        "objectiveKind": meta.objective_kind,
        "people": [
            _person(person, figure, people.stage, error) | _figures(all_rows)
            for person, all_rows, figure, error in zip(people.results, whole, people.figures, errors, strict=True)
        ],
        "colors": {
            "segments": {name: hexadecimal(color) for name, color in SEGMENT_COLORS.items()},
            "sides": {name: [hexadecimal(color) for color in colors] for name, colors in SIDE_COLORS.items()},
            "people": [hexadecimal(person_color(person.person)) for person in people.results],
            "lost": hexadecimal(LOST),
            "lostBody": hexadecimal(LOST_BODY),
            "bone": hexadecimal(BONE),
            "sigma": sigma_colors(np.linspace(0, SIGMA_MOST_M, _SIGMA_STOPS))[:, ::-1].tolist(),
            "sigmaMost": SIGMA_MOST_M,
        },
    }


def packed(values: ArrayLike) -> dict[str, Any]:
    """Return an array as its shape and base64 of float32; infinities become NaN."""
    array = np.asarray(values, dtype="<f4")
    array = np.where(np.isfinite(array), array, np.float32(np.nan))
    return {"shape": list(array.shape), "data": base64.b64encode(array.tobytes()).decode("ascii")}


def _person(result: Result, figure: Figure, stage: Stage, truth: dict[str, Any] | None) -> dict[str, Any]:
    """Return the data of one person; joints and body in the frame of :func:`_on_floor`."""
    T = _on_floor(stage)
    carrying = sorted({solid.segment for solid in figure.solids})
    return {
        "number": result.person,
        "status": result.status.tolist(),
        "positions": packed(figure.joints @ T[:3, :3].T + T[:3, 3]),
        "segments": [SEGMENTS[k] for k in carrying],
        "transforms": packed((T @ figure.transforms[:, carrying])[:, :, :3]),
        "solids": [
            {"segment": carrying.index(solid.segment), "rings": packed(solid.divided.rings)} for solid in figure.solids
        ],
        "sigma": None if figure.sigma is None else packed(figure.sigma),
        "silhouetteError": None if (error := result.silhouette_error) is None else packed(error),
        "truth": truth,
        "objective": packed(result.objective),
        "angles": _angles(result, figure),
        "unmeasured": [f"{joint.joint} {joint.unmeasured}" for joint in result.meta.angles if joint.unmeasured],
        "timing": _timing(result),
    }


def _figures(person: Result) -> dict[str, Any]:
    """Return in how many frames a person is present, lost and suspect, and the expected errors."""
    present = np.isfinite(person.joints).any(axis=(1, 2))
    lost, suspect = present & ~person.has_pose, person.status == Status.SUSPECT
    counts = {"present": int(present.sum()), "lostCount": int(lost.sum()), "suspectCount": int(suspect.sum())}
    mean = "" if (found := person.mean_error_range) is None else in_cm(found)
    return counts | {"expectedMean": mean, "expected": _expected(person.in_joint_order())}


def _expected(result: Result) -> list[str] | None:
    """Return the range of the mean error of each joint (J,) over the frames with a pose; "" if unknown."""
    if (expected := result.expected_error) is None:
        return None
    ranges = [mean_range(of_joint) for of_joint in expected[result.has_pose].T]
    return ["" if found is None else in_cm(found) for found in ranges]


def _on_floor(stage: Stage) -> Float:
    """Return the transform (4, 4) from the world to a frame on the floor: z up, the middle of the motion above the
    origin."""
    T = np.eye(4)
    T[:3, :3] = stage.axes.T
    T[:3, 3] = -stage.axes.T @ stage.origin
    return T


def _scene(stage: Stage, rig: Rig | None) -> dict[str, Any]:
    """Return what does not move."""
    T = _on_floor(stage)
    return {
        "bones": BONE_ENDS.tolist(),
        "around": AROUND,
        "cameras": [
            {"name": camera.name, "points": packed(camera_pyramid(camera) @ T[:3, :3].T + T[:3, 3])}
            for camera in rig or ()
        ],
        "radius": stage.radius,
        "height": float((stage.middle - stage.origin) @ stage.axes[:, 2]),
    }


def _angles(result: Result, figure: Figure) -> list[dict[str, Any]]:
    """Return a panel per angle, with both sides in one. Flexion of elbows and knees has a standard deviation.

    An angle that is NaN in every frame has no panel; the page gives `JointAngles.unmeasured` instead.
    """
    panels: dict[str, dict[str, Any]] = {}
    for joint in result.meta.angles:
        side = joint.joint[-2:] if joint.joint.endswith(("_l", "_r")) else ""
        base = joint.joint.removesuffix(side)
        for column, name in enumerate(joint.names):
            values = result.angles[joint.joint][:, column]
            if np.isnan(values).all():
                continue
            title = f"{base} {name}".replace("_", " ")
            panel = panels.setdefault(
                title, {"title": title[0].upper() + title[1:], "convention": joint.convention, "lines": []}
            )
            line: dict[str, Any] = {"side": {"_l": "left", "_r": "right", "": "middle"}[side]}
            line |= {"values": packed(values)}
            if name == "flexion" and joint.joint in HINGES and figure.sigma is not None:
                line |= {
                    "sigma": packed(
                        hinge_sigma_deg(figure, (HINGES[joint.joint][0], joint.joint, HINGES[joint.joint][1]))
                    )
                }
            panel["lines"].append(line)
    return list(panels.values())


def hinge_sigma_deg(figure: Figure, joints: Sequence[str]) -> Float:
    """Return the standard deviation (F,) of the angle at the middle one of three joints, degrees.

    First-order propagation of independent, isotropic errors of the three positions.
    """
    index = [JOINTS.index(name) for name in joints]
    A, B, C = np.moveaxis(figure.joints[:, index], 1, 0)
    assert figure.sigma is not None
    a, b, c = np.moveaxis(figure.sigma[:, index], 1, 0)
    u, v = A - B, C - B
    p, q = np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (u * v).sum(axis=1) / (p * q)
        # sensitivity to the middle joint: it moves relative to both ends at the same time
        middle = 1 / p**2 + 1 / q**2 - 2 * cosine / (p * q)
        return np.asarray(np.degrees(np.sqrt((a / p) ** 2 + (c / q) ** 2 + b**2 * middle)))


def _errors(result: Result, people: Sequence[Result], truth: Path | None) -> list[dict[str, Any] | None]:
    """Return the errors of each person against the ground truth, cm: by joint over all frames of the result, and the
    mean of each frame of ``people``; None without a truth."""
    errors: list[dict[str, Any] | None] = [None] * len(people)
    if truth is None or not truth.exists():
        return errors
    found, true = joint_tracks(result), read_truth(truth)
    positions = positions_at(people[0].frames, true)
    if not np.isfinite(positions).any():
        return errors
    if len(people) == len(true) == 1:
        return [_error_data(evaluate(found[0], true[0]), people[0], positions[0])]
    for score in evaluate_people(found, true).people:
        for k, person in enumerate(people):
            if score.errors is not None and score.matched_with[0] == person.person:
                errors[k] = _error_data(score.errors, person, positions[score.person])
    return errors


def _error_data(found: Evaluation, person: Result, positions: Float) -> dict[str, Any]:
    groups = {f"all {len(JOINTS)}": (found.raw.all, found.corrected.all)}
    groups |= {f"{len(LIMB_JOINTS)} limb joints": (found.raw.limbs, found.corrected.limbs)}
    groups |= {name: (found.raw.joints[name], found.corrected.joints[name]) for name in JOINTS}
    rows = [[name, *plain_values([raw.mean_cm, corrected.mean_cm])] for name, (raw, corrected) in groups.items()]
    distances = np.linalg.norm(person.in_joint_order().joints - positions, axis=-1)
    known = np.isfinite(distances)
    means = np.where(known, distances, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return {"rows": rows, "frames": packed(np.where(known.any(axis=1), 100 * means, np.nan))}


def _timing(result: Result) -> list[dict[str, Any]]:
    """Return the mean time of every stage, milliseconds per frame."""
    means = {stage: 1e3 * float(np.nanmean(values)) if len(values) else 0.0 for stage, values in result.timing.items()}
    return [{"stage": stage, "ms": ms} for stage, ms in means.items() if np.isfinite(ms)]
