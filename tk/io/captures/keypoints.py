"""Reads 2D keypoints in the layout of OpenPose and Pose2Sim: a folder for each camera with a JSON file for each image.

    FOLDER/cam1/…_000000000012_keypoints.json      or FOLDER/cam1_json/cam1_000012.json

The number at the end of the file's name is the number of the image in its video. The number of keypoints of a person
determines their layout: 25 for OpenPose's BODY_25, 26 for HALPE_26 (the default of Pose2Sim), 17 for COCO.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.captures.calibration import match_camera
from tk.io.captures.capture import Capture
from tk.io.captures.init_pose import LEAST_JOINTS, LEAST_SPREAD_M, read_init_pose, spread_m
from tk.io.toml import LARGE, read_text, shown
from tk.model.body.joints import JOINTS, LIMB_KINDS
from tk.model.cameras.triangulation import same_person, triangulate_joints
from tk.model.setup import InitPose

Float = NDArray[np.float64]

_COCO_17 = ("nose", "eye_l", "eye_r", "ear_l", "ear_r", *(f"{joint}_{side}" for joint in LIMB_KINDS for side in "lr"))
_BODY_25 = (
    *("nose", "neck", "shoulder_r", "elbow_r", "wrist_r", "shoulder_l", "elbow_l", "wrist_l"),
    *("pelvis", "hip_r", "knee_r", "ankle_r", "hip_l", "knee_l", "ankle_l", "eye_r", "eye_l", "ear_r", "ear_l"),
    *("toe_l", "small_toe_l", "heel_l", "toe_r", "small_toe_r", "heel_r"),
)
_HALPE_26 = (
    *(*_COCO_17, "head_top", "neck", "pelvis"),
    *("toe_l", "toe_r", "small_toe_l", "small_toe_r", "heel_l", "heel_r"),
)
#: index of each joint's keypoint, by the number of keypoints. Necks are left out: theirs lie lower, between the
#: shoulders.
LAYOUTS: Mapping[int, Mapping[str, int]] = {
    len(names): {name: k for k, name in enumerate(names) if name in JOINTS and name != "neck"}
    for names in (_COCO_17, _BODY_25, _HALPE_26)
}

#: most people in an image, and most files in a folder; more are a mistake in the input
_MOST_PEOPLE, _MOST_FILES = 30, 1_000_000
_NUMBER = re.compile(r"(\d+)(?:_keypoints)?$")


def read_keypoints(folder: Path, capture: Capture, frame: int) -> list[Float]:
    """Return all people that were detected in the images of a frame.

    Args:
        folder: folder with a folder for each camera.
        capture: gives the cameras, by their names or by their tables' keys, and the time offsets.
        frame: frame of the capture.

    Returns:
        For each camera (P, 15, 3), x, y in pixels and confidence, in the order of JOINTS; NaN for joints without a
        keypoint.

    Raises:
        CaptureError: a camera has no folder, or no file of this frame, or a file is damaged.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder}: is no folder; keypoints are a folder a camera with a JSON file a picture")
    found = {path.name.removesuffix("_json"): path for path in sorted(folder.iterdir()) if path.is_dir()}
    people = []
    cameras = zip(capture.rig, capture.calibration.keys, capture.clips, capture.late_frames, strict=True)
    for camera, key, clip, late in cameras:
        try:
            name = match_camera(camera.name, key, found)
        except CaptureError as ambiguous:
            raise CaptureError(f"{folder}: {ambiguous}") from None
        if name is None:
            there = ", ".join(path.name for path in found.values()) or "no folders"
            raise CaptureError(f"{folder}: camera {camera.name!r} has no folder of keypoints; there are {there}")
        picture = int(clip.shown(np.array([frame - late]))[0])
        if picture < 0:
            raise CaptureError(f"{clip.path}: has no image near frame {frame}; choose another [init] frame")
        people.append(read_people(_file_of(found[name], picture)))
    return people


def _file_of(folder: Path, picture: int) -> Path:
    """Return the file of an image."""
    numbers: dict[int, Path] = {}
    for count, path in enumerate(sorted(folder.glob("[!.]*.json"))):
        number = _NUMBER.search(path.stem)
        if count >= _MOST_FILES:
            raise CaptureError(f"{folder}: holds over {_MOST_FILES} files")
        if number is None or len(number[1]) > 18:
            raise CaptureError(f"{path}: its name does not end with the picture's number, as cam1_000012.json does")
        if (other := numbers.setdefault(int(number[1]), path)) is not path:
            raise CaptureError(f"{path}: has the number of {other.name}, too; a picture has one file")
    if not numbers:
        raise CaptureError(f"{folder}: holds no JSON files")
    if picture not in numbers:
        raise CaptureError(
            f"{folder}: has no keypoints of picture {picture}, but of {min(numbers)} to {max(numbers)}; choose "
            "another [init] frame"
        )
    return numbers[picture]


def read_people(path: Path) -> Float:
    """Return the people in an image (P, 15, 3): x, y, confidence in the order of JOINTS, NaN without keypoint.

    Raises:
        CaptureError: the file cannot be read, or is not one of OpenPose's.
    """
    text = read_text(path)
    try:
        document = json.loads(text)
    except ValueError as reason:  # JSONDecodeError, or Python's own for a number of thousands of digits
        raise CaptureError(f"{path}: is not JSON: {' '.join(str(reason).split())}") from None
    except RecursionError:
        raise CaptureError(f"{path}: is not JSON of keypoints: lists lie too deep within each other") from None
    people = document.get("people") if isinstance(document, dict) else None
    if not isinstance(people, list):
        raise CaptureError(f'{path}: has no list "people", as OpenPose writes it')
    if len(people) > _MOST_PEOPLE:
        raise CaptureError(f"{path}: holds {len(people)} people; {_MOST_PEOPLE} are the most")
    joints = [_joints(person, f"{path}: person {k}") for k, person in enumerate(people)]
    return np.array([person for person in joints if np.isfinite(person).any()]).reshape(-1, len(JOINTS), 3)


def _joints(person: object, where: str) -> Float:
    """Return (15, 3) of one person; all NaN for a person without keypoints."""
    numbers = person.get("pose_keypoints_2d") if isinstance(person, dict) else None
    if not isinstance(numbers, list):
        raise CaptureError(f'{where} has no list "pose_keypoints_2d"')
    result = np.full((len(JOINTS), 3), np.nan)
    if not numbers:
        return result
    count, rest = divmod(len(numbers), 3)
    if rest or count not in LAYOUTS:
        raise CaptureError(
            f"{where} has {len(numbers)} numbers; x, y and confidence of 17 (COCO), 25 (BODY_25) or 26 (HALPE_26) "
            "keypoints are read"
        )
    for number in numbers:
        if isinstance(number, bool) or not isinstance(number, int | float):
            raise CaptureError(f"{where}: {shown(number)} is no number")
        if abs(number) > LARGE or (isinstance(number, float) and math.isinf(number)):
            raise CaptureError(f"{where}: {shown(number)} is too large for pixels")
    values = np.array(numbers, np.float64).reshape(-1, 3)
    if (values[:, 2] < 0).any():
        raise CaptureError(f"{where}: {values[:, 2].min():g} is no confidence; it must not be negative")
    for name, k in LAYOUTS[count].items():
        # not found: zeros in OpenPose's files, NaN in others'
        if values[k, 2] > 0 and np.isfinite(values[k]).all():
            result[JOINTS.index(name)] = values[k]
    return result


def first_pose(capture: Capture, pose_names: tuple[str, ...], given: Path | None, first_frame: int) -> InitPose | None:
    """Return the rough initial pose from a file or a folder of keypoints; None if there is neither.

    Args:
        capture: gives `[init] keypoints` if nothing is ``given``.
        pose_names: (D,) names of the entries of the pose vector.
        given: a TOML file with a pose, or a folder of keypoints.
        first_frame: first frame that is asked for; keypoints are read in this frame or, if that is later, in the
            capture's `[init] frame`.

    Raises:
        CaptureError: file or folder cannot be used.
    """
    if given is not None and not given.is_dir():
        return read_init_pose(given, pose_names)
    folder = given or capture.init_keypoints
    if folder is None:
        return None
    return keypoint_pose(folder, capture, max(first_frame, capture.init_frame, capture.first_frame))


def keypoint_pose(folder: Path, capture: Capture, frame: int) -> InitPose:
    """Return a rough initial pose: the subject's joints in a frame, triangulated from keypoints.

    The subject is the person in the working volume that most cameras see.

    Raises:
        CaptureError: two cameras agree on too few joints; and as :func:`read_keypoints` does.
    """
    people = read_keypoints(folder, capture, frame)
    seeing = [camera.name for camera, found in zip(capture.rig, people, strict=True) if len(found)]
    box = np.asarray(capture.volume.lower), np.asarray(capture.volume.upper)
    points, _ = triangulate_joints(capture.rig, same_person(capture.rig, people, box))
    joints = {name: p for name, p in zip(JOINTS, points, strict=True) if np.isfinite(p).all()}
    if len(joints) < LEAST_JOINTS or spread_m(joints) < LEAST_SPREAD_M:
        raise CaptureError(
            f"{folder}: in frame {frame} cameras agree on {len(joints)} joints of one person in the working volume "
            f"({len(seeing)} of {len(people)} see anybody); {LEAST_JOINTS} are needed, not in a line: choose another "
            "[init] frame, or check that keypoints and calibration are of the same pictures"
        )
    return InitPose(joints, {}, frame)
