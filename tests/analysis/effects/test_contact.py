"""The contact of a seal along a path, against a solver of its differential equation in time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from analysis.effects.contact import contact_state, contact_under_load, worked
from analysis.effects.friction import CoulombFriction, StribeckFriction
from analysis.effects.friction_levels import PressureDependentFriction
from analysis.signals.conditioning import condition
from rig.model.records import Run
from rig.model.rig import Rig

AMPLITUDE, FREQUENCY = 5e-4, 2.0
DISTANCE = 60e-6


def place(t: np.ndarray | float) -> np.ndarray:
    return np.asarray(AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * np.asarray(t)))


def speed(t: np.ndarray | float) -> np.ndarray:
    omega = 2 * np.pi * FREQUENCY
    return np.asarray(AMPLITUDE * omega * np.cos(omega * np.asarray(t)))


@pytest.mark.parametrize("stiffening", [0.0, 250.0])
def test_a_contact_along_the_worked_path_is_that_of_its_equation_in_time(stiffening: float) -> None:
    t = np.arange(4000) / 4000

    def rate(now: float, z: np.ndarray) -> np.ndarray:
        v = float(speed(now))
        return (1 + stiffening * abs(v)) * (v - abs(v) * z) / DISTANCE

    wanted = solve_ivp(rate, (0.0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-9, max_step=1e-3)
    found = contact_state(worked(place(t), speed(t), stiffening), DISTANCE)
    assert found == pytest.approx(wanted.y[0], abs=3e-3)


def test_a_contact_that_stiffens_turns_over_sooner_the_faster_it_is_reversed() -> None:
    """Half of the force is back after 0.69 d of travel at rest, after less of it at speed."""
    needed = []
    for pace in (1.0, 4.0):
        t = np.arange(20_000) / 20_000 / pace
        s, v = place(pace * t), pace * speed(pace * t)
        z = contact_state(worked(s, v, 250.0), DISTANCE)
        turn = int(np.argmax(s))
        there = turn + int(np.argmax(z[turn:] < 0.0))
        needed.append(s[turn] - s[there])
    assert needed[1] < 0.8 * needed[0] < 0.8 * np.log(2) * DISTANCE


def test_a_level_that_does_not_change_is_the_plain_contact() -> None:
    s = place(np.arange(2000) / 2000)
    force = contact_under_load(s, np.full(len(s), 3.0), 3.0 / DISTANCE)
    assert force == pytest.approx(3.0 * contact_state(s, DISTANCE))


def test_a_shape_without_the_detail_is_a_contact_that_does_not_stiffen(
    rig: Rig, multisine_run: Run
) -> None:
    signals = condition(rig, multisine_run.records[0])
    for kind, equation in ((CoulombFriction, "torque_1"), (PressureDependentFriction, "torque_1")):
        effect = kind("joint 1")
        old, new = (effect.columns(rig, signals, s)[equation] for s in ((4e-5,), (4e-5, 0.0)))
        assert {n: c.tolist() for n, c in old.items()} == {n: c.tolist() for n, c in new.items()}
        values = dict.fromkeys(old, 50.0)
        packed = [effect.pack(rig, values, s).tolist() for s in ((4e-5,), (4e-5, 0.0))]
        assert packed[0] == packed[1]
    assert "stiffening_1" not in StribeckFriction("joint 1").shape_names()
