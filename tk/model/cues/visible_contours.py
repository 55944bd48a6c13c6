"""How much of each bone's outline a view shows against the background."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.cone_body import ConeBody
from tk.model.body.joints import HIPS, ROWS, SHOULDERS, TABLE
from tk.model.body.skeleton import JOINTS
from tk.model.cues.ray_costs import RayGrid

Float = NDArray[np.float64]

# The joints at the ends of a segment's bone; the pelvis belongs to the trunk.
_BONES = {
    row.carrier: (row.bone_from, row.name)
    for row in TABLE
    if row.bone_from and (row.carrier == "torso" or ROWS[row.bone_from].chain == row.chain)
}
_SEGMENTS = list(_BONES)
_ENDS = np.array([[JOINTS.index(name) for name in ends] for ends in _BONES.values()])
# (J, S) weights of the segments that a joint belongs to: its bones, and the trunk for shoulders and hips.
_OF_JOINT = np.zeros((len(JOINTS), len(_BONES)))
for _s, _ends in enumerate(_BONES.values()):
    _OF_JOINT[[JOINTS.index(name) for name in _ends], _s] = 1.0
_OF_JOINT[[JOINTS.index(name) for name in (*SHOULDERS, *HIPS)], _SEGMENTS.index("torso")] = 1.0
_OF_JOINT /= _OF_JOINT.sum(axis=1, keepdims=True)


def contour_shares(body: ConeBody, grid: RayGrid, label: NDArray[np.uint8], joints: Float) -> Float:
    """Return (..., V, J) how much of the outline of each joint's bones a view shows against the background, 0 to 1: 1
    if one side is visible over the bone's whole length, 0 if the bones lie before or behind other parts of the body.

    Args:
        body: the body.
        grid: rays of the V views.
        label: (..., V, h, w) 1 + the part that a ray meets, 0 where it meets nothing.
        joints: (..., J, 3) m, in the world of the grid's cameras.
    """
    h, w = label.shape[-2:]
    images = label.reshape(-1, h, w)
    empty = np.zeros((len(images), h + 2, w + 2), np.bool_)  # beyond the image is no background
    np.equal(images, 0, out=empty[:, 1:-1, 1:-1])
    beside = empty[:, :-2, 1:-1] | empty[:, 2:, 1:-1] | empty[:, 1:-1, :-2] | empty[:, 1:-1, 2:]
    outline = np.flatnonzero(beside & (images > 0))
    S = len(_SEGMENTS)
    bins = outline // (h * w) * (S + 1) + _segments(body)[images.reshape(-1)[outline]]
    found = np.bincount(bins, minlength=len(images) * (S + 1)).reshape(*label.shape[:-2], S + 1)[..., :S]
    pixels = grid.rig.project(joints)
    bones = pixels[..., _ENDS[:, 0], :] - pixels[..., _ENDS[:, 1], :]
    length = np.sqrt((bones**2).sum(axis=-1)) / grid.step
    # two rays: a bone along the view is a disc of about this width; a view does not show what is behind the camera
    shown = np.where(np.isfinite(length), np.minimum(found / np.maximum(length, 2.0), 1.0), 0.0)
    return np.asarray(shown @ _OF_JOINT.T)


def _segments(body: ConeBody) -> NDArray[np.int64]:
    """Return (1 + P,) the segment, by :data:`_SEGMENTS`, of each label of a body; their number for other labels."""
    names = ["torso" if part.segment == "pelvis" else part.segment for part in body.parts]
    return np.array([len(_BONES), *(_SEGMENTS.index(name) if name in _BONES else len(_BONES) for name in names)])
