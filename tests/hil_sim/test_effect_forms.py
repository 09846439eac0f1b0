"""One cause, several physics: what each form of an effect keeps, and where it differs."""

from __future__ import annotations

import numpy as np
import pytest

from hil_sim.effects import CLASSES
from hil_sim.plant import kernel
from hil_sim.plant.kernel_data import ATMOSPHERE, record
from hil_sim.plant.plant import Plant
from hil_sim.plant.tables import build
from hil_sim.scenario.file import parse_scenario
from hil_sim.scenario.truth import load_machine
from tests.hil_sim.plant_trace import CLOSED, bench, scenario, sine, story
from tests.hil_sim.test_plant_effects import sliding
from tests.variants import every_second

RIG = bench(1000.0)
MOVE_2 = [CLOSED, sine(RIG, 0.8, 1.0, position_gain=20.0)]
PERIODS = {"period_1": 600.0, "phase_1": 0.1, "period_2": 200.0, "phase_2": 0.6}


def tables(effect: str):
    return build(RIG, load_machine(RIG), scenario(effect), PERIODS)


@pytest.mark.parametrize("form", every_second(["bristle", "dahl", "tanh", "root"]))
def test_friction_of_any_form_takes_its_level_from_fast_sliding(form: str) -> None:
    more = f"force: 80 N, form: {form}, width: 1 mm/s"
    v, force = sliding(story(MOVE_2, 2.0, f"{{name: coulomb_friction, where: joint 2, {more}}}"))
    assert len(v) > 500
    assert np.mean(force * np.sign(v)) == pytest.approx(80.0, rel=0.02)


def test_friction_without_memory_is_a_curve_over_speed() -> None:
    for form, curve in (("tanh", np.tanh), ("root", lambda x: x / np.hypot(1.0, x))):
        more = f"force: 60 N, form: {form}, width: 2 mm/s"
        joint = tables(f"{{name: coulomb_friction, where: joint 1, {more}}}").joints[0]
        v = np.linspace(-0.02, 0.02, 41)
        force = [kernel.sliding(0.0, x, 3e6, 3e6, joint) for x in v]
        assert force == pytest.approx(60.0 * curve(v / 2e-3), abs=1e-9)


def test_edges_open_alike_far_from_the_null_and_each_in_its_way_near_it() -> None:
    shapes = {}
    for form in ("round", "sharp", "notch"):
        text = f"{{name: valve_deadband, where: joint 1, width: 10 mV, form: {form}}}"
        joint = tables(text).joints[0]
        x = np.linspace(-0.02, 0.2, 2201)
        opened = np.array(
            [kernel.opening(v, joint["lap_ahead"], joint["rounding"], joint["notch"]) for v in x]
        )
        slope = np.diff(opened) / np.diff(x)
        assert np.all(slope > -1e-12)
        assert np.max(slope) < 1.0 + 1e-9
        assert slope[-1] == pytest.approx(1.0)
        assert np.all(opened[x < 0.0079] == 0.0)
        shapes[form] = opened
    # A notch is the slowest to open, a sharp edge follows the travel at once.
    assert shapes["sharp"][400] == pytest.approx(0.01)
    assert shapes["notch"][400] == pytest.approx(0.01**2 / (2 * 0.02))


@pytest.mark.parametrize(("form", "n"), [("isothermal", 1.0), ("polytropic", 1.4)])
def test_the_stiffness_of_oil_with_air_is_the_slope_of_its_volume(form: str, n: float) -> None:
    b = record(tables(f"{{name: entrained_air, fraction: 2 %, form: {form}}}").bench)
    pure = record(tables("{name: entrained_air, fraction: 0.0001 %}").bench)

    def volume(z: float) -> float:
        # Oil of compression z, and what is left of the gas at that pressure.
        p = kernel.pressure(z, b) + ATMOSPHERE
        return -z + 0.02 * (ATMOSPHERE / p) ** (1 / n) * np.exp(-p / b.air_dissolution)

    for z in (0.002, 0.01, 0.02):
        h = 1e-7
        slope = (kernel.pressure(z + h, b) - kernel.pressure(z - h, b)) / (
            volume(z - h) - volume(z + h)
        )
        stiff = (kernel.pressure(z + h, pure) - kernel.pressure(z - h, pure)) / (2 * h)
        assert kernel.softening(z, 1.0, b) == pytest.approx(slope / stiff, rel=1e-4)


def test_a_laminar_supply_line_drops_in_proportion_to_the_flow() -> None:
    # Closed valves take nothing; an open one takes the line's flow, from the pump at rest.
    t = tables("{name: supply_sag, line_drop: 0.7 MPa, form: laminar}")
    rated, b = RIG.supply.flow, record(t.bench)
    for share in (0.25, 0.5, 1.0):
        assert share * rated / b.line_laminar == pytest.approx(0.7e6 * share)
    soft = tables("{name: supply_sag, line_drop: 0.7 MPa, form: accumulator}")
    assert record(soft.bench).manifold_volume > 10 * b.manifold_volume


def shown(effect: str) -> np.ndarray:
    """What cap_pressure_2 reads [Pa] without noise while joint 2 moves."""
    clean = parse_scenario(f"effects: [{effect}]\nnoise: 0", "today.yaml")
    plant = Plant(RIG, clean, 3)
    codes, _ = plant.advance(600, MOVE_2)
    k = RIG.channels.index("cap_pressure_2")
    sensor = RIG.sensors.of("cap_pressure")
    low, high = sensor.range
    return low + codes[:, k] * (high - low) / ((1 << sensor.bits) - 1)


def test_a_lagging_sensor_follows_its_world_behind_one_pole_or_two() -> None:
    true = shown("")
    text = "{name: sensor_lag, channel: cap_pressure_2, time: 4 ms, form: %s}"
    one, two = (shown(text % form) for form in ("pole", "poles"))
    rate = RIG.sample_rate
    # One pole by its own equation, two by theirs: tau/2 twice.
    inner = slice(5, -5)
    back = one + 4e-3 * np.gradient(one) * rate
    assert np.abs(back - true)[inner].max() < 0.02 * np.ptp(true)
    twice = two + 4e-3 * np.gradient(two) * rate
    twice += 4e-6 * np.gradient(np.gradient(two)) * rate**2
    assert np.abs(twice - true)[inner].max() < 0.02 * np.ptp(true)
    assert np.abs(one - two).max() > 50.0


def test_cross_talk_shows_the_other_chamber_or_its_quick_part() -> None:
    text = "{name: sensor_crosstalk, channel: cap_pressure_2, share: 0.05, form: %s}"
    wire, coupling = (shown(text % form) - shown("") for form in ("wire", "coupling"))
    rod = 0.05 * story(MOVE_2, 0.6, "", rate=1000.0)["rod_pressure"][:, 1]
    n = min(len(rod), len(wire))
    assert np.abs(wire[:n] - rod[:n]).max() < 0.02 * np.abs(rod).max()
    # What a coupling shows falls off within a second: x' = wire' - x / 1 s.
    faded = np.cumsum(coupling) / RIG.sample_rate
    change = coupling - coupling[0] + faded - (wire - wire[0])
    assert np.abs(change).max() < 0.02 * np.abs(wire).max()
    assert np.abs(coupling - wire).max() > 50.0


MOVERS = [c for c in CLASSES if c.forms and c.drawn_at != "pressure"]


@pytest.mark.parametrize("kind", every_second(MOVERS), ids=lambda c: c.effect_name())
def test_every_form_runs_and_moves_the_bench_otherwise(kind) -> None:
    key, (_, most) = next(iter(kind.sizes.items()))
    more = ", speed: 20 mm/s" if kind.effect_name() == "stribeck_friction" else ""
    more = ", retracting: 10 N" if kind.effect_name() == "asymmetric_friction" else more
    unit = {"force": "N", "extending": "N", "coefficient": "N/Pa", "width": "V",
            "line_drop": "Pa", "fraction": "", "torque": "N*m",
            "drop": "Pa", "time": "s", "share": "", "transition": "Pa"}[key]  # fmt: skip
    if kind.effect_name() == "asymmetric_viscous_friction":
        unit, more = "N*s/m", ", retracting: 10 N*s/m"
    more = ", frequency: 7 Hz" if kind.effect_name() == "periodic_disturbance" else more
    where = "" if kind.drawn_at == "bench" else "where: joint 2, "
    runs = []
    for form in kind.forms:
        text = f"{{name: {kind.effect_name()}, {where}{key}: {most:g} {unit}{more}, form: {form}}}"
        t = story(MOVE_2, 0.6, text, rate=1000.0)
        assert np.isfinite(t["cap_pressure"]).all()
        runs.append(t["cap_pressure"][:, 1])
    for a in range(len(runs)):
        for b in range(a):
            assert np.max(np.abs(runs[a] - runs[b])) > 50.0
