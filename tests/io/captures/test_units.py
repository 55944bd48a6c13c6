from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tk.io.captures.units import UNITS, apart, infer_unit

RING = np.array([[np.cos(a), np.sin(a), 0.3] for a in np.linspace(0, 2 * np.pi, 5)[:-1]])  # 2 across


@given(across_m=st.floats(2.0, 14.0), unit=st.sampled_from(list(UNITS)))
def test_the_unit_of_an_ordinary_rig_is_recognised(across_m: float, unit: str) -> None:
    found = infer_unit(RING * across_m / 2 / UNITS[unit])
    assert (found.name, found.metres) == (unit, UNITS[unit])
    assert (found.note is None) == (unit == "m")


@given(across_m=st.floats(0.5, 30.0))
def test_a_rig_plausible_in_metres_is_not_scaled(across_m: float) -> None:
    assert infer_unit(RING * across_m / 2).note is None
    assert infer_unit(RING * across_m / 2 * 1000, default="mm").name == "mm"


def test_the_other_possible_unit_is_named() -> None:
    found = infer_unit(RING * 1200 / 2)
    assert found.name == "cm" and found.note is not None
    assert "12 m apart" in found.note and "in mm it would be 1.2 m" in found.note
    assert infer_unit(RING * 2000 / 2).name == "mm"


@pytest.mark.parametrize("across", [0.01, 40.0, 1e6])
def test_a_rig_implausible_in_every_unit_is_refused(across: float) -> None:
    found = infer_unit(RING * across / 2)
    assert found.name == "m" and found.note is not None and "no unit makes it 0.5 to 30 m" in found.note


def test_too_few_cameras_to_infer_a_unit() -> None:
    assert infer_unit(np.zeros((0, 3))) == infer_unit([[1000.0, 0.0, 0.0]]) == infer_unit(np.zeros((2, 3)))
    assert apart(np.zeros((0, 3))) == 0.0 and apart([[0, 0, 0], [3, 4, 0]]) == 5.0
