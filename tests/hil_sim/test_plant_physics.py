"""The simulated bench obeys the laws that its equations were written from, checked another way."""

from __future__ import annotations

import numpy as np
import pytest

from hil_sim.plant import kernel
from hil_sim.plant.interface import Law
from hil_sim.plant.kernel_data import ATMOSPHERE, record
from hil_sim.plant.plant import Plant, compression
from hil_sim.plant.tables import build
from hil_sim.scenario.file import Scenario
from hil_sim.scenario.truth import TrueMachine, load_machine, machine_text
from rig.model.parameters import parameter_names
from rig.model.parse import InputError
from rig.model.rig import Rig
from tests.hil_sim.plant_trace import CLOSED, Array, Trace, bench, sine, story

PERIODS = {"period_1": 600.0, "phase_1": 0.1, "period_2": 150.0, "phase_2": 0.6}


def both_moving(seconds: float = 2.0, rate: float = 2000.0) -> Trace:
    rig = bench(rate)
    centred = {"position_gain": 20.0}
    return story([sine(rig, 1.2, 1.0, **centred), sine(rig, 1.2, 2.0, **centred)], seconds)


def chain(joints: int) -> tuple[Rig, TrueMachine]:
    """Return a bench of equal joints and bodies drawn at random."""
    shipped = bench()
    rig = shipped.model_copy(
        update={"name": f"chain-{joints}", "joints": (shipped.joints[1],) * joints}
    )
    rng = np.random.default_rng(joints)
    root = rng.normal(size=(joints, joints))
    R = root @ root.T + joints * np.eye(joints)
    true = dict.fromkeys(parameter_names(joints), 1e-7) | {"b": 2e8}
    true |= {f"Fv{i + 1}": 0.0 for i in range(joints)}
    true |= {f"W{i + 1}": float(rng.uniform(1, 9)) for i in range(joints)}
    if joints == 1:
        true["M1"] = R[0, 0]
    elif joints == 2:
        true |= {"M1": R[0, 0] + R[1, 1], "M2": R[1, 1], "R12": R[0, 1]}
    else:
        true |= {f"R{i + 1}{k + 1}": R[i, k] for i in range(joints) for k in range(i, joints)}
    return rig, TrueMachine(parameters=true)


def lagrangian(q: Array, v: Array, true: dict[str, float], gravity: float) -> float:
    """Return T - V of the chain, from NOTES' sums over absolute angles."""
    n, theta, turn = len(q), np.cumsum(q), np.cumsum(v)
    R = np.zeros((n, n))
    for i in range(n):
        for k in range(i, n):
            R[i, k] = R[k, i] = true.get(f"R{i + 1}{k + 1}", 0.0)
    if n == 1:
        R[0, 0] = true["M1"]
    if n == 2:
        R[0, 0], R[1, 1] = true["M1"] - true["M2"], true["M2"]
    kinetic = sum(
        0.5 * R[i, k] * np.cos(theta[i] - theta[k]) * turn[i] * turn[k]
        for i in range(n)
        for k in range(n)
    )
    return float(kinetic + sum(true[f"W{i + 1}"] * gravity * np.cos(theta[i]) for i in range(n)))


@pytest.mark.parametrize("joints", [1, 2, 3, 5])
def test_a_chain_of_any_length_accelerates_as_its_lagrangian_says(joints: int) -> None:
    rig, machine = chain(joints)
    tables = build(rig, machine, Scenario(), PERIODS)
    rng = np.random.default_rng(7)
    tables.joints["torque_offset"] = torque = rng.normal(size=joints) * 20
    q = np.array([float(j.linkage.angle(rng.uniform(-0.03, 0.03))) for j in rig.joints])
    v = rng.normal(size=joints)
    state, rate = np.zeros(5 * joints + 3), np.zeros(5 * joints + 3)
    b = record(tables.bench)
    state[:joints], state[joints : 2 * joints] = q, v
    # Chambers at p and p A_cap / A_rod push nowhere.
    area = rig.joints[0].cylinder.cap_area / rig.joints[0].cylinder.rod_area
    state[2 * joints : 3 * joints] = compression(1e6, 2e8, b.trapped)
    state[3 * joints : 4 * joints] = compression(1e6 * area, 2e8, b.trapped)
    work = np.zeros((joints + 4, joints))
    kernel.rates(state, np.zeros(joints), 1.0, tables.joints, b, tables.inertia, work, rate)
    a = rate[joints : 2 * joints]

    def free(q: Array, v: Array) -> float:
        return lagrangian(q, v, machine.parameters, rig.gravity)

    def momentum(q: Array, v: Array, i: int) -> float:
        e = 1e-3 * np.eye(joints)[i]  # T is quadratic: the central difference is exact
        return (free(q, v + e) - free(q, v - e)) / 2e-3

    d = 1e-4
    for i in range(joints):
        e = d * np.eye(joints)[i]
        along = momentum(q + d * v, v + d * a, i) - momentum(q - d * v, v - d * a, i)
        force = along / (2 * d) - (free(q + e, v) - free(q - e, v)) / (2 * d)
        assert force == pytest.approx(torque[i], abs=2e-5 * np.max(np.abs(torque)) + 2e-4)


def test_work_done_on_the_pistons_is_stored_or_turned_to_heat() -> None:
    t = both_moving()
    q, v, true = t["angle"], t["rate"], t.truth
    energy = np.array(
        [
            lagrangian(x, w, true, t.rig.gravity) - 2 * lagrangian(x, 0 * w, true, t.rig.gravity)
            for x, w in zip(q, v, strict=True)
        ]
    )
    heat = sum(true[f"Fv{i + 1}"] * v[:, i] ** 2 for i in range(2))
    power = np.sum(t.force() * t["speed"], axis=1) - heat
    done = np.concatenate([[0.0], np.cumsum((power[1:] + power[:-1]) / 2) * t.period])
    assert np.ptp(energy) > 20.0
    assert np.max(np.abs(energy - energy[0] - done)) < 2e-3 * np.ptp(energy)


def test_newton_and_the_mass_balance_hold_with_the_true_parameters() -> None:
    t = both_moving()
    missing = t.missing_torque()[50:]
    assert np.all(np.std(missing, axis=0) < 0.02)  # of some 100 N m
    for joint in range(2):
        for found in t.missing_flow(joint):
            # What is left is the laminar foot of the edges, of up to 1e-4 m^3/s.
            assert np.max(np.abs(found[50:])) < 3e-7


def test_what_leaves_the_pump_arrives_in_the_cylinders_or_passes_the_relief_valve() -> None:
    t = both_moving()
    demand = sum(np.maximum(f, 0.0) for joint in range(2) for f in t.flow(joint))[2:-2]
    volume, pump = 0.5e-3, t.rig.supply.flow
    b = t.truth["b"] * (1.0 - 0.004 * (t["oil_temperature"][2:-2] - 40.0))
    relief = pump - demand - volume / b * t.slope(t["supply_pressure"])
    assert np.min(relief) > -3e-7
    # It closes as the supply falls through its override of 0.15 MPa, and not before.
    low, high = t["supply_pressure"][2:-2] < 6.8e6, t["supply_pressure"][2:-2] > 6.99e6
    assert low.any()
    assert high.any()
    assert np.max(relief[low]) < 0.02 * pump
    assert np.min(relief[high]) > 0.9 * pump


def test_the_bench_rests_at_mid_stroke_until_told_to_move() -> None:
    t = story([CLOSED, CLOSED], 2.0)
    assert np.max(np.abs(t["piston"])) < 1e-9
    assert np.max(np.abs(t.missing_torque())) < 1e-6
    assert np.max(np.abs(t["supply_pressure"] - 7e6)) < 10.0
    assert np.all(t["cap_pressure"] + t["rod_pressure"] == pytest.approx(7e6))


def test_a_closed_valve_holds_its_joint_but_gives() -> None:
    rig = bench(1000.0)
    t = story([CLOSED, sine(rig, 1.0, 1.0, position_gain=20.0)], 4.0, rate=1000.0)
    give = np.ptp(t["piston"][500:, 0])
    assert 2e-5 < give < 5e-4
    assert abs(np.mean(t["piston"][-1000:, 0]) - np.mean(t["piston"][500:1500, 0])) < 1e-5
    # The locked cylinder's oil is a spring: its pressures answer the other joint's motion.
    assert np.ptp(t["cap_pressure"][500:, 0]) > 0.1e6


@pytest.mark.parametrize("push", [-1.0, 1.0])
def test_an_end_stop_holds_against_full_pressure(push: float) -> None:
    t = story([CLOSED, Law(bias=push, limit=4.0)], 2.5, rate=1000.0)
    end = np.sign(push) * 0.0375
    over = (t["piston"][:, 1] - end) * np.sign(push)
    assert 0.0 < np.max(over) < 0.5e-3
    assert np.ptp(t["piston"][-500:, 1]) < 1e-6
    rest = over[-1]
    # Hunt and Crossley at rest: k x^1.5 carries the pressures' force and the arm's weight.
    left = t.missing_force()[-1, 1]
    assert 5e9 * rest**1.5 == pytest.approx(abs(left), rel=0.02)
    assert abs(left) > 3e3


def test_pressure_never_falls_below_vapour_and_oil_is_not_lost() -> None:
    rig = bench()
    slam = Law(wave=np.repeat([4.0, -4.0], 150), gain=1.0, limit=4.0)
    t = story([slam, Law(wave=np.repeat([-4.0, 4.0], 210), gain=1.0, limit=4.0)], 3.0, rate=1000.0)
    for name in ("cap_pressure", "rod_pressure", "supply_pressure"):
        assert np.min(t[name]) >= -ATMOSPHERE
        assert np.all(np.isfinite(t[name]))
    assert min(np.min(t["cap_pressure"]), np.min(t["rod_pressure"])) < -0.09e6
    assert np.max(np.abs(t["piston"])) < 0.0375 + 1e-3
    assert rig.supply.pressure / 2 > np.min(t["supply_pressure"])


def test_a_closed_chamber_drawn_apart_and_pressed_again_comes_back() -> None:
    machine = load_machine(bench())
    b = record(build(bench(), machine, Scenario(), PERIODS).bench)
    z = np.linspace(-0.05, 0.03, 2001)
    p = np.array([kernel.pressure(x, b) for x in z])
    assert np.all(np.diff(p) >= 0)
    assert np.min(p) > -ATMOSPHERE
    back = [compression(x, machine.parameters["b"], b.trapped) for x in p[p > -0.05e6]]
    assert np.max(np.abs(back - z[p > -0.05e6])) < 1e-12
    assert (p[-1] - p[-2]) / (z[-1] - z[-2]) == pytest.approx(machine.parameters["b"], rel=1e-4)


def test_two_hard_driven_joints_want_more_than_the_pump_gives() -> None:
    rig = bench()
    gentle = story([CLOSED, sine(rig, 0.3, 1.0, position_gain=20.0)], 1.0, rate=1000.0)
    hard = story(
        [sine(rig, 2.0, 1.5, position_gain=30.0), sine(rig, 2.0, 1.5, position_gain=30.0)],
        2.0,
        rate=1000.0,
    )
    assert np.min(gentle["supply_pressure"]) > 0.98 * 7e6
    assert np.min(hard["supply_pressure"]) < 0.8 * 7e6
    # In no 0.2 s do the valves take more than the pump gave and the supply's oil let go of.
    demand = sum(np.maximum(f, 0.0) for joint in range(2) for f in hard.flow(joint))
    taken = np.convolve(demand, np.full(200, 1e-3), mode="valid")
    assert 0.9 * rig.supply.flow < np.max(taken) / 0.2
    assert np.max(taken) < rig.supply.flow * 0.2 + 0.5e-3 * 7e6 / hard.truth["b"]


def test_an_orifice_is_odd_smooth_and_turbulent_at_large_drops() -> None:
    drop = np.linspace(-5e6, 5e6, 20001)
    q = np.array([kernel.orifice(d, 50e3) for d in drop])
    assert np.all(q == -q[::-1])
    assert np.all(np.diff(q) > 0)
    assert np.max(np.abs(np.diff(q))) < 1.01 * (drop[1] - drop[0]) / np.sqrt(50e3)
    assert q[-1] == pytest.approx(np.sqrt(5e6), rel=1e-4)
    assert kernel.orifice(10.0, 50e3) == pytest.approx(10.0 / np.sqrt(50e3), rel=1e-6)


def test_the_plants_linkage_is_the_rigs() -> None:
    rig = bench(5000.0)
    t = story([sine(rig, 0.5, 2.0), CLOSED], 0.4, rate=5000.0)
    again = rig.joints[0].linkage.angle(t["piston"][:, 0])
    assert np.max(np.abs(again - t["angle"][:, 0])) < 1e-12
    speed = t.slope(t["piston"][:, 0])
    assert np.max(np.abs(speed - t["speed"][2:-2, 0])) < 1e-6


def test_a_bench_without_a_machine_file_needs_every_nominal_value() -> None:
    rig = bench()
    nominal = {k: v for k, v in rig.nominal.items() if k not in ("b", "W2")}
    other = rig.model_copy(update={"name": "home-made"})
    assert Plant(other, Scenario(), 1).truth() == rig.nominal
    bare = other.model_copy(update={"nominal": nominal})
    with pytest.raises(InputError, match=r"home-made.*missing: W2 b$"):
        Plant(bare, Scenario(), 1)
    level = bare.model_copy(update={"gravity": 0.0})  # a weight has no effect
    with pytest.raises(InputError, match=r"home-made.*missing: b$"):
        Plant(level, Scenario(), 1)


def test_the_shipped_machine_is_table_iii() -> None:
    truth = Plant(bench(), Scenario(), 1).truth()
    assert tuple(truth) == parameter_names(2)
    assert (truth["M1"], truth["Fv1"], truth["W2"]) == (4.47, 50.77, 3.30)
    assert (truth["b"], truth["C_pm_2"]) == pytest.approx((233e6, 5.36e-7))
    assert machine_text("shinshu-2dof") is not None
