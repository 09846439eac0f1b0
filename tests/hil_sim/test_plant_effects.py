"""Somebody spoils the bench; each effect changes what it should, by what it should."""

from __future__ import annotations

import numpy as np
import pytest

from hil_sim.effects import CLASSES
from hil_sim.plant.interface import Law
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from tests.hil_sim.plant_trace import CLOSED, Array, Trace, bench, scenario, sine, story

RIG = bench(2000.0)
MOVE_2 = [CLOSED, sine(RIG, 0.8, 1.0, position_gain=20.0)]
MOVE_1 = [sine(RIG, 0.8, 1.0, position_gain=20.0), CLOSED]


def sliding(t: Trace, joint: int = 1) -> tuple[Array, Array]:
    """Return (speed, the force friction takes) where the joint slides well, once settled."""
    v, f = t["speed"][2:-2, joint], -t.missing_force()[:, joint]
    fast = np.abs(v) > 0.03
    fast[:1000] = False
    return v[fast], f[fast]


def slope(x: Array, y: Array) -> float:
    return float(np.polyfit(x, y, 1)[0])


def test_the_catalogue_is_the_contracts_and_laminar_edges() -> None:
    names = {kind.effect_name() for kind in CLASSES}
    contract = """coulomb_friction stribeck_friction asymmetric_friction asymmetric_viscous_friction
        pressure_dependent_friction base_inclination payload joint_spring torque_offset
        valve_deadband spool_offset underlap_leakage spool_lag spool_hysteresis internal_leakage
        external_leakage supply_sag tank_pressure return_line entrained_air dead_volume
        channel_delay sensor_lag sensor_gain sensor_offset sensor_crosstalk periodic_disturbance"""
    assert names == {*contract.split(), "laminar_orifice"}


def test_an_empty_scenario_leaves_nothing_to_explain() -> None:
    v, f = sliding(story(MOVE_2, 2.0))
    assert len(v) > 1000
    assert np.max(np.abs(f)) < 0.5


def test_coulomb_friction_opposes_sliding_and_gives_before_it_slips() -> None:
    t = story(MOVE_2, 2.0, "{name: coulomb_friction, where: joint 2, force: 80 N}")
    v, f = sliding(t)
    assert np.mean(f * np.sign(v)) == pytest.approx(80.0, rel=0.01)
    # LuGre, not sign(v): where the motion turns, the force needs about the bristles' 40 um.
    s, force = t["piston"][2:-2, 1], t.missing_force()[:, 1]
    turn = 1000 + int(np.argmax(s[1000:3000]))
    after = np.abs(s - s[turn]) * (np.arange(len(s)) > turn)
    part = force[turn + int(np.argmax(after[turn:] > 20e-6))]
    assert -75.0 < part < 75.0


def test_stribeck_friction_fades_with_speed() -> None:
    t = story(
        [CLOSED, sine(RIG, 0.5, 0.5, position_gain=10.0)],
        5.0,
        "{name: coulomb_friction, where: joint 2, force: 50 N},"
        "{name: stribeck_friction, where: joint 2, force: 60 N, speed: 20 mm/s}",
    )
    v, f = t["speed"][2:-2, 1], -t.missing_force()[:, 1] * np.sign(t["speed"][2:-2, 1])
    late, creep = np.arange(len(v)) > 4000, (np.abs(v) > 4e-3) & (np.abs(v) < 6e-3)
    assert np.median(f[late & creep]) == pytest.approx(50 + 60 * np.exp(-1 / 16), rel=0.05)
    assert np.median(f[late & (np.abs(v) > 0.06)]) == pytest.approx(50.0, rel=0.02)


def test_asymmetric_friction_differs_with_direction() -> None:
    where = "where: joint 2, extending: 90 N, retracting: 30 N"
    v, f = sliding(story(MOVE_2, 2.0, f"{{name: asymmetric_friction, {where}}}"))
    assert np.mean(f[v > 0]) == pytest.approx(90.0, rel=0.02)
    assert np.mean(f[v < 0]) == pytest.approx(-30.0, rel=0.02)


def test_pressure_dependent_friction_follows_the_chambers() -> None:
    where = "where: joint 1, coefficient: 15 N/MPa"
    t = story(MOVE_1, 2.0, f"{{name: pressure_dependent_friction, {where}}}")
    v, f = sliding(t, 0)
    held = (t["cap_pressure"] + t["rod_pressure"])[2:-2, 0][-500:]
    fast = np.abs(t["speed"][2:-2, 0][-500:]) > 0.03
    assert np.abs(t.missing_force()[-500:, 0])[fast] == pytest.approx(15e-6 * held[fast], rel=0.02)
    assert np.mean(f * np.sign(v)) > 50


def test_a_payload_weighs_and_resists_at_the_tip() -> None:
    t = story(MOVE_1, 2.0, "{name: payload, mass: 6.5 kg}")
    torque = t.missing_torque()[2:-2]
    theta = np.cumsum(t["angle"], axis=1)
    x = 0.5 * np.sin(theta).sum(axis=1)
    y = -0.5 * np.cos(theta).sum(axis=1)
    acceleration = t.slope(np.stack([t.slope(x), t.slope(y)], axis=1))
    # Newton for the tip's mass about the first joint.
    moment = x[4:-4] * (acceleration[:, 1] + 9.8) - y[4:-4] * acceleration[:, 0]
    assert -torque[1000:, 0] == pytest.approx(6.5 * moment[1000:], abs=0.5)
    assert np.ptp(moment[1000:]) > 1.0
    assert story(MOVE_1, 0.1, "{name: payload, mass: 6.5 kg}").truth["M1"] == 4.47


def test_an_inclined_base_turns_gravity() -> None:
    t = story([CLOSED, CLOSED], 0.5, "{name: base_inclination, angle: 5 deg}")
    q = t["angle"][-1]
    tilt = np.deg2rad(5.0)
    g2 = 3.30 * 9.8 * (np.sin(q.sum() + tilt) - np.sin(q.sum()))
    g1 = g2 + 8.55 * 9.8 * (np.sin(q[0] + tilt) - np.sin(q[0]))
    assert t.missing_torque()[-1] == pytest.approx([-g1, -g2], rel=1e-3)


def test_a_hose_pulls_back_and_hardens() -> None:
    t = story(MOVE_2, 2.0, "{name: joint_spring, where: joint 2, stiffness: 80 N*m/rad}")
    twist = t["angle"][2:-2, 1] - t["angle"][0, 1]
    torque = t.missing_torque()[:, 1]
    assert slope(twist[1000:], -torque[1000:]) == pytest.approx(80.0, rel=0.03)
    assert -torque[1000:] == pytest.approx(80 * (twist + 0.25 * twist**3)[1000:], abs=0.1)


def test_a_torque_offset_is_there_all_the_time() -> None:
    t = story(MOVE_2, 1.0, "{name: torque_offset, where: joint 2, torque: -7 N*m}")
    assert t.missing_torque()[500:, 1] == pytest.approx(-7.0, abs=0.1)


def test_a_dead_band_swallows_small_openings_with_rounded_edges() -> None:
    t = story(MOVE_2, 2.0, "{name: valve_deadband, where: joint 2, width: 10 mV}")
    u, missing, ideal = t["spool"][2:-2, 1], t.missing_flow(1)[0], t.flow(1)[0][2:-2]
    wide = np.abs(u) > 0.03
    wide[:1000] = False
    assert -missing[wide] / ideal[wide] * np.abs(u[wide]) == pytest.approx(0.010, rel=0.05)
    edge = np.abs(np.abs(u) - 0.010) < 5e-4
    passed = ((missing + ideal) / ideal * np.abs(u))[edge]
    assert np.all(passed > 2e-4)  # a sharp edge would pass nothing below it
    still = story(
        [CLOSED, Law(bias=0.05, limit=1.0)],
        1.0,
        "{name: valve_deadband, where: joint 2, width: 10 mV}",
    )
    moved = story([CLOSED, Law(bias=0.05, limit=1.0)], 1.0)
    assert moved["piston"][-1, 1] > 3e-3
    assert abs(still["piston"][-1, 1]) < 0.1 * moved["piston"][-1, 1]


def test_a_spool_offset_makes_a_closed_valve_creep() -> None:
    where = "where: joint 2, voltage: "
    down = story([CLOSED, CLOSED], 1.0, f"{{name: spool_offset, {where}5 mV}}")
    up = story([CLOSED, CLOSED], 1.0, f"{{name: spool_offset, {where}-5 mV}}")
    assert down["piston"][-1, 1] < -2e-3
    assert up["piston"][-1, 1] > 2e-3
    assert up["spool"][-1, 1] == 0.0


def test_underlap_lets_oil_through_at_null() -> None:
    t = story([CLOSED, CLOSED], 1.0, "{name: underlap_leakage, where: joint 2, width: 8 mV}")
    assert t["supply_pressure"][-1] < t["supply_pressure"][0] - 5e3
    low, high = t["cap_pressure"][-1, 1], t["rod_pressure"][-1, 1]
    assert 1e6 < low < 6e6
    assert 1e6 < high < 6e6


def test_a_spool_lag_delays_the_opening_behind_the_lvdt() -> None:
    t = story(MOVE_2, 1.0, "{name: spool_lag, where: joint 2, time: 4 ms}")
    u, x = t["spool"][:, 1], t["opening"][:, 1]
    assert np.max(np.abs(u - x)) > 1e-3
    assert (u - x)[2:-2] == pytest.approx(4e-3 * t.slope(x), abs=1e-5)


def test_internal_leakage_equalises_the_chambers() -> None:
    t = story(
        MOVE_2, 2.0, "{name: internal_leakage, where: joint 2, conductance: 2e-12 m^3/(s*Pa)}"
    )
    cap, rod = t.missing_flow(1)
    drop = (t["rod_pressure"] - t["cap_pressure"])[2:-2, 1]
    foot = np.max(np.abs(story(MOVE_2, 2.0).missing_flow(1)[0][1000:]))
    assert cap[1000:] == pytest.approx(2e-12 * drop[1000:], abs=0.05 * 2e-12 * 3e6 + foot)
    assert np.median(cap[1000:] + rod[1000:]) == pytest.approx(0.0, abs=2e-8)


@pytest.mark.parametrize(("where", "leaks"), [("joint 2", (1, 1)), ("joint 2 rod", (0, 1))])
def test_external_leakage_empties_its_chamber(where: str, leaks: tuple[int, int]) -> None:
    t = story(
        MOVE_2, 2.0, f"{{name: external_leakage, where: {where}, conductance: 3e-12 m^3/(s*Pa)}}"
    )
    for leak, found, name in zip(
        leaks, t.missing_flow(1), ("cap_pressure", "rod_pressure"), strict=True
    ):
        expected = -3e-12 * leak * np.median(t[name][1000:, 1])
        assert np.median(found[1000:]) == pytest.approx(expected, abs=1e-6)


def test_a_worn_pump_and_a_thin_line_sag_further() -> None:
    laws = [sine(RIG, 1.0, 1.0, position_gain=20.0), sine(RIG, 1.0, 1.0, position_gain=20.0)]

    def lowest(effects: str, name: str = "supply_pressure") -> float:
        return float(np.min(story(laws, 2.0, effects)[name]))

    sound = lowest("")
    assert lowest("{name: supply_sag, flow: 8 L/min}") < sound - 0.5e6
    assert lowest("{name: supply_sag, override: 1 MPa}") < sound - 0.3e6
    thin = story(laws, 2.0, "{name: supply_sag, line_drop: 0.8 MPa}")
    drop = thin["supply_pressure"] - thin["port_pressure"]
    assert np.min(thin["port_pressure"]) < sound - 0.3e6
    assert 0.3e6 < np.max(drop) < 1.2e6
    assert np.median(drop[:100]) < 0.05e6


def test_the_tank_is_not_always_empty() -> None:
    t = story(
        [CLOSED, Law(bias=1.0, limit=1.0)],
        1.2,
        "{name: tank_pressure, pressure: 0.3 MPa, back_pressure: 0.5 MPa}",
    )
    plain = story([CLOSED, Law(bias=1.0, limit=1.0)], 1.2)
    assert np.max(t["tank_pressure"]) > 0.32e6
    # At the end stop the rod side stands at the tank's pressure.
    assert t["rod_pressure"][-1, 1] == pytest.approx(0.3e6, rel=0.02)
    assert plain["rod_pressure"][-1, 1] == pytest.approx(0.0, abs=5e3)


def test_entrained_air_softens_the_oil_at_low_pressure_most() -> None:
    laws = [sine(RIG, 0.6, 5.0), CLOSED]
    for fraction, dissolution in ((0.01, 10e6), (0.03, 5e6)):
        t = story(
            laws,
            1.0,
            f"{{name: entrained_air, fraction: {fraction}, dissolution: {dissolution:g} Pa}}",
        )
        p = t["cap_pressure"][2:-2, 0]
        volume, _ = t.rig.chamber_volumes(0, t["piston"][2:-2, 0])
        # The extra flow is what compresses the gas: V_g = a V p0 / p exp(-p / p_d), p absolute.
        pa = p + 101_325.0
        gas = fraction * 101_325.0 / pa * np.exp(-pa / dissolution) * (1 / pa + 1 / dissolution)
        slopes = t.slope(t["cap_pressure"][:, 0])
        assert -t.missing_flow(0)[0] == pytest.approx(gas * volume * slopes, abs=4e-8)
        assert np.max(gas * volume * np.abs(slopes)) > 5e-7


def test_dead_volume_needs_more_oil_to_press() -> None:
    laws = [sine(RIG, 0.6, 5.0), CLOSED]
    t = story(laws, 1.0, "{name: dead_volume, where: joint 1 rod, volume: 40 cm^3}")
    cap, rod = t.missing_flow(0)
    rate = t.slope(t["rod_pressure"][:, 0]) / t.truth["b"]
    assert slope(rate, -rod) == pytest.approx(40e-6, rel=0.02)
    assert np.max(np.abs(cap)) < 0.1 * np.max(np.abs(rod))


def test_effects_do_not_reach_the_other_joint() -> None:
    t = story(
        [sine(RIG, 0.8, 1.0, position_gain=20.0)] * 2,
        2.0,
        "{name: coulomb_friction, where: joint 2, force: 80 N},"
        "{name: internal_leakage, where: joint 2, conductance: 2e-12 m^3/(s*Pa)}",
    )
    assert np.max(np.abs(t.missing_force()[1000:, 0])) < 2.0
    assert np.max(np.abs(t.missing_flow(0)[0][1000:])) < 3e-7


def test_every_effect_at_once_still_gives_finite_numbers() -> None:
    text = ", ".join(
        f"{{name: {name}, {rest}}}"
        for name, rest in {
            "coulomb_friction": "where: joint 1, force: 80 N, presliding: 5 um",
            "asymmetric_friction": "where: joint 2, extending: 100 N, retracting: 0 N",
            "valve_deadband": "where: joint 1, width: 20 mV",
            "underlap_leakage": "where: joint 2, width: 10 mV",
            "spool_lag": "where: joint 1, time: 0.2 ms",
            "supply_sag": "line_drop: 0.2 MPa, flow: 5 L/min",
            "tank_pressure": "pressure: 0.2 MPa, back_pressure: 1 MPa, lag: 0.5 ms",
            "entrained_air": "fraction: 0.05",
            "payload": "mass: 10 kg",
            "external_leakage": "where: joint 1 cap, conductance: 1e-11 m^3/(s*Pa)",
            "dead_volume": "where: joint 2 cap, volume: 20 cm^3",
        }.items()
    )
    rig = bench()
    slam = Law(wave=np.repeat([4.0, -4.0], 150), gain=1.0, limit=4.0)
    t = story([slam, slam], 2.0, text, rate=1000.0)
    assert all(np.all(np.isfinite(x)) for x in t.signals.values())
    assert np.max(t["cap_pressure"]) < 40e6
    assert Plant(rig, Scenario(), 1).truth() == Plant(rig, scenario(text), 1).truth()
