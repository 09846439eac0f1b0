"""Geometry against the law of cosines and finite differences; converter codes there and back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.model import channels, linkage
from rig.model.parameters import mechanical_names, parameter_names, parameter_unit
from rig.model.quantity import parse_quantity
from rig.model.wire import codes

JOINTS = [(0.11, 0.33, 0.30, 0.0), (0.27, 0.10, 0.30, -math.pi)]


@pytest.mark.parametrize("geometry", JOINTS)
@given(s=st.floats(-0.0375, 0.0375))
def test_the_triangle_closes_where_the_pins_say(
    geometry: tuple[float, float, float, float], s: float
) -> None:
    a, c, mid, offset = geometry
    q = float(linkage.angle_from_piston(s, *geometry))
    # Independent route: place the pins in the plane and measure their distance.
    beta = q + offset
    distance = math.hypot(c * math.cos(beta) - a, c * math.sin(beta))
    assert distance == pytest.approx(mid + s, abs=1e-12)
    assert float(linkage.piston_from_angle(q, *geometry)) == pytest.approx(s, abs=1e-12)


@pytest.mark.parametrize("geometry", JOINTS)
def test_the_jacobian_is_the_slope_of_the_piston(
    geometry: tuple[float, float, float, float],
) -> None:
    q = linkage.angle_from_piston(np.linspace(-0.036, 0.036, 41), *geometry)
    h = 1e-5
    ahead = linkage.piston_from_angle(q + h, *geometry)
    behind = linkage.piston_from_angle(q - h, *geometry)
    here = linkage.piston_from_angle(q, *geometry)
    np.testing.assert_allclose(
        linkage.jacobian(q, *geometry), (ahead - behind) / (2 * h), rtol=1e-8
    )
    np.testing.assert_allclose(
        linkage.jacobian_rate(q, *geometry), (ahead - 2 * here + behind) / h**2, atol=2e-5
    )
    assert (linkage.jacobian(q, *geometry) > 0).all()


def test_the_second_joint_bends_the_arm_down() -> None:
    q = np.degrees(linkage.angle_from_piston(np.array([-0.0375, 0.0, 0.0375]), *JOINTS[1]))
    np.testing.assert_allclose(q, [-105.0, -82.4, -55.0], atol=0.06)


@given(st.floats(-40.0, 40.0), st.integers(8, 16))
def test_an_input_code_is_within_half_a_step_or_saturated(value: float, bits: int) -> None:
    low, high = -20.0, 20.0
    code = codes.encode_input(value, low, high, bits)
    back = float(codes.decode_input(code, low, high, bits))
    assert 0 <= int(code) < 1 << bits
    assert abs(back - min(max(value, low), high)) <= 0.5001 * (high - low) / ((1 << bits) - 1)


@given(st.floats(-20.0, 20.0), st.integers(8, 16))
def test_an_output_code_is_symmetric_and_zero_is_exactly_zero(volts: float, bits: int) -> None:
    code = int(codes.encode_output(volts, 10.0, bits))
    assert int(codes.encode_output(-volts, 10.0, bits)) == -code
    assert float(codes.decode_output(0, 10.0, bits)) == 0.0
    clipped = min(max(volts, -10.0), 10.0)
    step = 10.0 / ((1 << (bits - 1)) - 1)
    assert abs(float(codes.decode_output(code, 10.0, bits)) - clipped) <= 0.5001 * step


def test_names_are_those_of_the_contract() -> None:
    assert mechanical_names(1) == ("M1", "Fv1", "W1")
    assert mechanical_names(2) == ("M1", "M2", "R12", "Fv1", "Fv2", "W1", "W2")
    assert mechanical_names(3)[:6] == ("R11", "R12", "R13", "R22", "R23", "R33")
    assert parameter_names(2)[7:12] == ("b", "C_pp_1", "C_pm_1", "C_mp_1", "C_mm_1")
    for name in parameter_names(3):
        assert parse_quantity(f"1 {parameter_unit(name)}", parameter_unit(name)) == 1.0


@given(st.sampled_from(channels.JOINT_KINDS), st.integers(1, 99))
def test_a_channel_name_is_read_back(kind: str, joint: int) -> None:
    assert channels.kind_of(channels.channel(kind, joint)) == (kind, joint)


@pytest.mark.parametrize("bad", ["spool", "spool_0", "spool_01", "Spool_1", "", "cap_1"])
def test_an_unknown_channel_is_refused(bad: str) -> None:
    with pytest.raises(ValueError, match="unknown channel"):
        channels.unit_of(bad)
