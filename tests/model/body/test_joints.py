"""The joint table: what must hold for any rows."""

from __future__ import annotations

import numpy as np
import pytest

from tk.model.body.joints import FOOT_POINTS, FOOT_SEGMENT, JOINTS, SEGMENTS, TABLE, in_joint_order


def test_names_are_unique() -> None:
    """Points of the feet stand beside joints in tables and exports."""
    assert len({*JOINTS, *FOOT_POINTS}) == len(JOINTS) + len(FOOT_POINTS)
    dofs = [name for row in TABLE for name in row.dof_names]
    assert len({*dofs}) == len(dofs)
    assert {*FOOT_SEGMENT.values()} <= {*SEGMENTS} and {row.carrier for row in TABLE if row.carrier} <= {*SEGMENTS}


def test_joints_are_ordered_and_an_absent_one_is_named() -> None:
    values = np.random.default_rng(0).normal(size=(4, len(JOINTS) + 1, 3))
    np.testing.assert_array_equal(in_joint_order(values[:, ::-1], ("toes_l", *JOINTS[::-1])), values[:, :-1])
    with pytest.raises(KeyError, match=JOINTS[0]):
        in_joint_order(values[:, 1:], JOINTS[1:])
