"""The catalogue as a whole: all names, rows against kernels, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lsim

from analysis.effects.base import SUPPLY, Effect, Evidence, ordered
from analysis.effects.contact import (
    contact_levels,
    contact_state,
    contact_under_load,
    stiffened_path,
)
from analysis.effects.measurement import Sensor
from analysis.effects.mechanics import growth
from analysis.effects.valve import second_order
from analysis.identify.identify import identify
from analysis.regression.rows import right_sides
from analysis.signals.conditioning import Signals
from analysis.terms import base, baseline, known, make
from analysis.terms.base import Used, family_of
from rig.model.parameters import gain_names
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis.small_bench import TRUTH
from tests.analysis.test_terms import signals_of
from tests.studies.effects.catalogue_text import FAMILIES, pages

CONTRACT = {
    "coulomb_friction", "stribeck_friction", "asymmetric_friction", "pressure_dependent_friction",
    "base_inclination", "payload", "joint_spring", "torque_offset",
    "valve_deadband", "spool_offset", "underlap_leakage", "spool_lag",
    "internal_leakage", "external_leakage", "supply_sag", "tank_pressure", "entrained_air",
    "dead_volume", "channel_delay", "sensor_gain", "sensor_offset",
    "asymmetric_viscous_friction", "periodic_disturbance", "friction_curve", "position_force",
    "metering_curve", "leakage_curve", "bulk_modulus_curve", "supply_curve",
    "sensor_lag", "sensor_crosstalk", "spool_hysteresis", "return_line",
}  # fmt: skip


# Forms of edge, line and seal, no sizes.
COMPARED = range(40, 400, 45)  # samples of `state` at which kernels and rows are compared
DETAILS = (
    "return_laminar", "rounding", "corner", "w_tank", "V_supply", "stiffening", "transition",
    "tail", "exponent", "spread", "steepness", "sharpness",
)  # fmt: skip


def effects(rig: Rig) -> list[Effect]:
    kinds = [kind for kind in known().values() if issubclass(kind, Effect)]
    return [kind(where) for kind in kinds for where in kind.places(rig)]


def effect(name: str, where: str) -> Effect:
    found = make(name, where)
    assert isinstance(found, Effect)
    return found


def test_every_name_of_the_contract_is_an_effect_with_its_rivals_and_its_experiment() -> None:
    kinds = {name: kind for name, kind in known().items() if issubclass(kind, Effect)}
    assert set(kinds) >= CONTRACT
    for name, kind in kinds.items():
        said = (kind.family, kind.variable, kind.separated_by, kind.__doc__)
        assert all(said), name
        assert set(kind.confounders) <= set(kinds) - {name}, name


def test_places_are_those_of_the_contract_and_every_candidate_has_its_own_parameters(
    rig: Rig,
) -> None:
    allowed = {"bench", "joint 1", "joint 2"}
    allowed |= {f"{joint} {side}" for joint in ("joint 1", "joint 2") for side in ("cap", "rod")}
    every = effects(rig)
    assert {e.place for e in every} <= allowed
    shared = {name for i in (1, 2) for name in gain_names(i)}
    owners: dict[str, tuple[str, str]] = {}
    for e in every:
        own = [c.parameter for c in e.coefficients(rig) if c.parameter not in shared]
        own += [n for n in e.shape_names() if not n.startswith(("presliding", *DETAILS))]
        placed = [s.parameter for s in e.shapes(rig) if s.fixed]
        searched = [n for n in e.shape_names() if not n.startswith(DETAILS) and n not in placed]
        assert len(searched) <= 2
        for name in own:
            assert owners.setdefault(name, (e.name, e.where)) == (e.name, e.where)


def test_an_effect_with_columns_of_the_gains_says_so(rig: Rig) -> None:
    gains = {name for i in (1, 2) for name in gain_names(i)}
    for e in effects(rig):
        assert e.adds_to_gains is any(c.parameter in gains for c in e.coefficients(rig)), e.name


def test_shapes_are_looked_at_within_their_bounds(rig: Rig) -> None:
    for e in effects(rig):
        shapes = e.shapes(rig)
        assert tuple(s.parameter for s in shapes) == e.shape_names()
        for s in shapes:
            assert all(s.low <= point <= s.high for point in s.grid), s.parameter
            assert s.neutral is None or s.low <= s.neutral <= s.high


@pytest.fixture
def state(rig: Rig) -> Signals:
    """A smooth motion with everything else at random, pressures between tank and supply."""
    rng = np.random.default_rng(3)
    t = np.arange(400) / 1000
    phase = rng.uniform(0, 6, (2, 2))
    middle = np.array([[1.13, -1.44]])
    q = middle + 0.2 * np.sin(2 * np.pi * 3 * t[:, None] + phase[:1])
    qd = 0.2 * 2 * np.pi * 3 * np.cos(2 * np.pi * 3 * t[:, None] + phase[:1])
    qdd = -((2 * np.pi * 3) ** 2) * (q - middle)
    return replace(signals_of(rig, q, qd, qdd, rng), t=t)


def test_knots_are_placed_where_the_joint_is_excited(rig: Rig, state: Signals) -> None:
    """A locked joint that yields a little moves too, but its equations have no rows."""
    yielding = replace(
        state,
        excited=np.array([True, False]),
        bands=np.array([np.inf, np.inf]),
        s=state.s + 0.03,
        sd=1e-3 * state.sd,
    )
    for e in effects(rig):
        if e.by_data and e.where.startswith("joint 2"):
            alone = e.points(rig, Evidence([replace(state, bands=yielding.bands)], []))
            both = e.points(rig, Evidence([state, yielding], []))
            assert np.array(both) == pytest.approx(np.array(alone)), e


def test_preparing_alters_the_rows_of_no_family_but_those_that_an_effect_names(
    rig: Rig, state: Signals
) -> None:
    terms = baseline()

    def seen(signals: Signals) -> dict[str, list[np.ndarray]]:
        found = {name: [side] for name, side in right_sides(rig, signals).items()}
        for term in terms:
            for name, columns in term.columns(rig, signals, ()).items():
                found[name] += columns.values()
        return found

    before = seen(state)
    for e in effects(rig):
        shape = tuple(s.grid[-1] for s in e.shapes(rig))
        after = seen(e.prepare(rig, state, shape))
        changed = {
            family_of(name)
            for name, columns in before.items()
            if not all(map(np.array_equal, columns, after[name]))
        }
        assert changed <= set(e.alters), e.name


def packed(e: Effect, rig: Rig, shape: tuple[float, ...]) -> tuple[dict[str, float], np.ndarray]:
    values = {**TRUTH, **{c.parameter: TRUTH.get(c.parameter, 0.7) for c in e.coefficients(rig)}}
    return values, e.pack(rig, values, shape)


def observed(signals: Signals, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The simulation's view of one sample: `x` and `bench`."""
    fields = ("q", "qd", "theta", "G", "s", "sd", "u", "p_cap", "p_rod", "V_cap", "V_rod")
    x = np.array([getattr(signals, field)[k] for field in fields])
    return x, np.array([signals.t[k], signals.p_s[k], signals.p_tank[k], 40.0])


def hidden_state(e: Effect, rig: Rig, signals: Signals, shape: tuple[float, ...]) -> np.ndarray:
    """What the hidden state is at every sample, from the definition."""
    s = signals.s[:, e.joint] if e.where.startswith("joint") else np.zeros(len(signals.t))
    if e.name == "asymmetric_friction":  # both levels are equal here
        ahead, back = contact_levels(s, *shape)
        return np.asarray(0.5 * (ahead - back) * shape[0])
    if e.name == "pressure_dependent_friction" and not sum(shape[4:5]):
        rod_weight, share = sum(shape[3:4]) or 1.0, sum(shape[5:6]) or 0.5
        cap, rod = signals.p_cap[:, e.joint], signals.p_rod[:, e.joint]
        load = np.abs(2.0 * (1.0 - share) * cap + 2.0 * share * rod_weight * rod)
        stiffness = rig.supply.pressure / shape[0]
        path = stiffened_path(s, signals.sd[:, e.joint], sum(shape[1:2]))
        return np.asarray(contact_under_load(path, load, stiffness) / stiffness)
    if e.name == "stribeck_friction":
        exponent = sum(shape[3:4]) or 2.0
        level = np.exp(-(np.abs(signals.sd[:, e.joint] / shape[0]) ** exponent))
        return np.asarray(contact_under_load(s, level, 1.0 / shape[1]) * shape[1])
    if e.family == "friction":
        distance, *stiffening = shape[4:5] if e.name == "friction_curve" else shape
        path = stiffened_path(s, signals.sd[:, e.joint], sum(stiffening[:1]))
        return np.asarray(distance * contact_state(path, distance))
    return np.zeros(len(signals.t))


def test_kernels_and_rows_are_the_same_equations(rig: Rig, state: Signals) -> None:
    """What the simulation would integrate is, at any state and in any form, what the rows say."""
    forms = []
    for e in effects(rig):
        if isinstance(e, Sensor):
            continue
        for start in e.detailed_shapes(rig, e.shape_of(rig, ())):
            # The simulation's supply follows at once.
            shape = (*start[:2], 0.0) if e.name == "supply_sag" else start
            others = e.other_form_starts(rig, shape)
            others += tuple(form for other in others for form in e.other_form_starts(rig, other))
            if e.name == "supply_sag":
                others = tuple(one for one in others if one[2] == 0.0)
            forms += [(e, one) for one in dict.fromkeys((shape, *others))]
    for e, shape in forms:
        signals = consistent(rig, state, e, shape) if e.stage == SUPPLY else state
        values, par = packed(e, rig, shape)
        seen = e.prepare(rig, signals, shape)
        columns = e.columns(rig, seen, shape)
        memory = np.zeros(len(signals.t))
        if e.remembers(shape):
            memory = hidden_state(e, rig, signals, shape)
        states = np.tile(memory, (e.hidden(rig), 1)).T
        if e.name in ("spool_lag", "spool_hysteresis"):
            states = e.hidden_path(rig, signals, {}, shape)
        for k in COMPARED:
            x, bench = observed(signals, k)
            z, dz = states[k].copy(), np.zeros(e.hidden(rig))
            out, M = np.zeros((base.OUT_ROWS, 2)), np.zeros((2, 2))
            phases = (base.PREPARE, base.CONTRIBUTE) if e.prepares else (base.CONTRIBUTE,)
            for phase in phases:
                e.kernel.function(phase, bench, x, z, par, out, M, dz)
            wanted, wanted_bench = observed(seen, k)
            assert x == pytest.approx(wanted, rel=1e-9, abs=1e-12), e
            assert bench == pytest.approx(wanted_bench, rel=1e-6), e
            for i in range(2):
                rows = {
                    "torque": M[i] @ signals.qdd[k] - out[base.TORQUE, i],
                    "flow_cap": out[base.FLOW_CAP, i] - out[base.COMP_CAP, i] * seen.pd_cap[k, i],
                    "flow_rod": out[base.FLOW_ROD, i] - out[base.COMP_ROD, i] * seen.pd_rod[k, i],
                }
                for kind, value in rows.items():
                    here = columns.get(f"{kind}_{i + 1}", {})
                    total = sum(values[name] * column[k] for name, column in here.items())
                    assert value == pytest.approx(total, rel=1e-9, abs=1e-14), (e, kind)


def consistent(rig: Rig, signals: Signals, e: Effect, shape: tuple[float, ...]) -> Signals:
    """Pressure rates such that continuity holds where equations are compared.

    The kernels solve orifices, the rows measure.
    """
    drawn = e.name in ("supply_sag", "supply_curve")
    rig_flow, pd_cap, pd_rod = rig.supply.flow, signals.pd_cap.copy(), signals.pd_rod.copy()
    for k in COMPARED:
        low, high = 0.0, 1.0
        for _ in range(80):  # bisection on the flow through the common line
            Q = 0.5 * (low + high)
            flows = edge_flows(rig, signals, k, e, shape, Q / rig_flow)
            low, high = (Q, high) if sum(flows) > Q else (low, Q)
        for i, flow in enumerate(flows):
            c = rig.joints[i].cylinder
            cap = (signals.u[k, i] > 0) == drawn
            into = flow if drawn else -flow
            b = rig.nominal["b"]
            if cap:
                pd_cap[k, i] = (into - c.cap_area * signals.sd[k, i]) * b / signals.V_cap[k, i]
            else:
                pd_rod[k, i] = (into + c.rod_area * signals.sd[k, i]) * b / signals.V_rod[k, i]
    return replace(signals, pd_cap=pd_cap, pd_rod=pd_rod)


def joined(ratio: float, drop: float, turning: float) -> float:
    """Laminar and turbulent asymptote, joined; `drop` is that at the whole flow."""
    if turning == 0.0:  # laminar throughout
        return float(drop * ratio)
    whole = (1.0 + turning**3) ** (1 / 3)
    return float(drop / whole * ratio * np.cbrt(ratio**3 + turning**3))


def edge_flows(
    rig: Rig, signals: Signals, k: int, e: Effect, shape: tuple[float, ...], ratio: float
) -> list[float]:
    out = []
    for i in range(2):
        u, cap, rod = signals.u[k, i], signals.p_cap[k, i], signals.p_rod[k, i]
        pp, pm, mp, mm = (TRUTH[name] for name in gain_names(i + 1))
        if e.name == "supply_curve":
            # A parabola through the three values, and its tangent beyond the last.
            bent = np.polyfit(shape[:3], (0.0, *shape[3:]), 2)
            Q, last = ratio * rig.supply.flow, shape[2]
            beyond = np.polyval(np.polyder(bent), last) * max(Q - last, 0.0)
            port = signals.p_s[k] - np.polyval(bent, min(Q, last)) - beyond
            drop, gain = (port - cap, pp) if u > 0 else (port - rod, mm)
        elif e.name == "supply_sag":
            port = signals.p_s[k] - joined(ratio, *shape[:2])
            drop, gain = (port - cap, pp) if u > 0 else (port - rod, mm)
        else:
            port = shape[0] + shape[1] * ratio**2
            if e.name == "return_line":
                port = joined(ratio, *shape)
            drop, gain = (rod - port, mp) if u > 0 else (cap - port, pm)
        out.append(gain * abs(u) * np.sqrt(max(drop, 0.0)))
    return out


def test_hidden_states_move_as_the_rows_say(rig: Rig) -> None:
    """Along a fine path the kernel's rate is the slope of what the rows compute."""
    rate = 20_000.0
    t = np.arange(6000) / rate
    rng = np.random.default_rng(1)
    q = np.array([1.13, -1.44]) + 0.02 * np.sin(2 * np.pi * 2 * t[:, None] + np.array([0.3, 1.0]))
    qd = np.gradient(q, 1 / rate, axis=0)
    signals = replace(signals_of(rig, q, qd, np.zeros_like(q), rng), t=t, rate=rate)
    signals.u[:] = 0.1 * np.sin(2 * np.pi * 5 * t)[:, None]
    signals.p_cap[:] = 3e6 + 5e5 * np.sin(2 * np.pi * 3 * t)[:, None]
    signals.p_rod[:] = 4e6
    for name, shape in (
        ("coulomb_friction", (1e-4, 40.0)), ("pressure_dependent_friction", (1e-4, 40.0)),
        ("spool_lag", (3e-3,)), ("spool_lag", (3e-3, 0.6)), ("spool_lag", (3e-3, 1.4)),
    ):  # fmt: skip
        e = effect(name, "joint 2")
        if e.prepares:
            memory = e.hidden_path(rig, signals, {}, shape)[:, : len(shape)]
        else:
            memory = hidden_state(e, rig, signals, shape)[:, None]
        slope = np.gradient(memory, 1 / rate, axis=0)
        par = packed(e, rig, shape)[1]
        scale = np.abs(slope[500:]).max(axis=0)
        for k in range(500, 5500, 97):
            x, bench = observed(signals, k)
            z, dz = np.zeros(e.hidden(rig)), np.zeros(e.hidden(rig))
            z[: memory.shape[1]] = memory[k]
            out, M = np.zeros((base.OUT_ROWS, 2)), np.zeros((2, 2))
            phase = base.PREPARE if e.prepares else base.CONTRIBUTE
            e.kernel.function(phase, bench, x, z, par, out, M, dz)
            for i in range(memory.shape[1]):
                assert dz[i] == pytest.approx(slope[k, i], abs=0.03 * scale[i]), (name, shape, k)


@pytest.mark.parametrize("zeta", [0.3, 0.8, 1.0, 1.5])
def test_a_lag_of_second_order_is_that_of_another_library(zeta: float) -> None:
    """Linear between samples, at rest before the first, its delay in slow motion as stated."""
    u = np.random.default_rng(2).standard_normal(400)
    time = 1e-3 * np.arange(len(u))
    tau = 4e-3
    w = 2.0 * zeta / tau
    _, x, states = lsim(([w * w], [1.0, 2.0 * zeta * w, w * w]), u - u[0], time)
    path = second_order(u, tau * 1e3, zeta)
    assert path[:, 0] == pytest.approx(x + u[0], abs=1e-9)
    assert 1e3 * path[:, 1] == pytest.approx(w * w * states[:, 0], abs=1e-6)
    ramp = second_order(time, tau * 1e3, zeta)[:, 0]
    assert time[-1] - ramp[-1] == pytest.approx(tau, rel=1e-6)


@pytest.mark.parametrize("shape", [(12e-3, 0.0, 1.0), (12e-3, 0.7, 1.0)])
def test_a_command_held_between_samples_delays_the_opening_by_half_of_one(
    rig: Rig, state: Signals, shape: tuple[float, float, float]
) -> None:
    """The lag's equation, stepped by another library at a fiftieth of a sample."""
    lag = effect("spool_lag", "joint 1")
    tau, zeta, _ = shape
    w = 2.0 * zeta / tau
    fine, time = 50, np.arange(50 * len(state.t)) / (50 * rig.sample_rate)
    held = np.repeat(state.u[:, 0], fine)
    law = ([w * w], [1.0, 2.0 * zeta * w, w * w]) if zeta else ([1.0], [tau, 1.0])
    _, x, _ = lsim(law, held - held[0], time, interp=False)
    path = x[::fine] + held[0]
    opening, linear = (lag.prepare(rig, state, s).u[:, 0] for s in (shape, shape[:2]))
    error, late = (float(np.std(a[50:] - path[50:])) for a in (opening, linear))
    assert error < 0.15 * late


REFUSED = [
    ("coulomb_friction", "joint 1", {"Fc1": -20.0}, (4e-5,)),
    ("coulomb_friction", "joint 1", {"Fc1": 5000.0}, (4e-5,)),
    ("stribeck_friction", "joint 2", {"Fs2": -20.0}, (0.03, 4e-5)),
    ("stribeck_friction", "joint 2", {"Fs2": 50.0}, (0.24, 4e-5)),
    ("asymmetric_friction", "joint 1", {"F_ext_1": 80.0, "F_ret_1": -30.0}, (4e-5,)),
    ("asymmetric_friction", "joint 1", {"F_ext_1": 80.0, "F_ret_1": 79.0}, (4e-5,)),
    ("pressure_dependent_friction", "joint 1", {"k_friction_1": -1e-5}, (4e-5,)),
    ("asymmetric_viscous_friction", "joint 2", {"c_ext_2": 40.0, "c_ret_2": -3000.0}, ()),
    ("asymmetric_viscous_friction", "joint 2", {"c_ext_2": 40.0, "c_ret_2": 39.0}, ()),
    ("asymmetric_viscous_friction", "joint 2", {"c_ext_2": 40.0, "c_ret_2": 9.0, "Fc2": 9.0}, ()),
    # Beside the joint's own 630 N s/m: the piston takes most of it back, in both directions alike.
    ("asymmetric_viscous_friction", "joint 2", {"c_ext_2": -520, "c_ret_2": -480, "Fc2": 9.0}, ()),
    ("periodic_disturbance", "joint 2", {"T_sin_2": 1e4, "T_cos_2": 0.0}, (7.0,)),
    ("periodic_disturbance", "joint 2", {"T_sin_2": 1.0, "T_cos_2": 0.0}, (60.0,)),
    (
        "friction_curve",
        "joint 2",
        {f"friction_2_{part}_{k}": -30.0 for part in ("shared", "extending") for k in range(1, 5)},
        (0.0, 0.05, 0.1, 0.2, 4e-5),
    ),
    (
        "position_force",
        "joint 2",
        {f"F_position_2_{k}": 1e5 for k in range(1, 9)},
        (*np.linspace(-0.04, 0.04, 9), *np.eye(9)[0]),
    ),
    (
        "metering_curve",
        "joint 2",
        {f"C_{e}_2_at_{k}": (4 - k) * 1e-7 for e in ("pp", "pm", "mp", "mm") for k in range(2, 8)},
        (0.0, 0.02, 0.04, 0.06, 0.09, 0.12, 0.16, 0.2),
    ),
    (
        "leakage_curve",
        "joint 2",
        {f"Q_leak_2_{k}": -1e-6 for k in range(2, 10)},
        tuple(np.linspace(0.0, 4e6, 9)),
    ),
    (
        "bulk_modulus_curve",
        "bench",
        {f"softness_{k}": -1e-8 for k in (1, 2, 3)},
        (0.0, 2e6, 4e6, 6e6),
    ),
    ("supply_curve", "bench", {}, (0.0, 1e-4, 2e-4, 6e5, 3e5)),
    ("asymmetric_friction", "joint 1", {"F_ext_1": 200.0, "F_ret_1": 3.0}, (40e-6, 40e-6)),
    ("coulomb_friction", "joint 1", {"Fc1": 200.0, "Fv1": -50.0}, (40e-6,)),
    ("sensor_lag", "joint 1 cap", {}, (0.1,)),
    ("sensor_crosstalk", "joint 1 cap", {}, (0.3,)),
    ("spool_hysteresis", "joint 1", {}, (0.35,)),
    ("return_line", "bench", {}, (2.52e9, 0.2)),
    ("tank_pressure", "bench", {}, (0.0, 5e5)),
    ("base_inclination", "bench", {}, (0.785,)),
    ("payload", "bench", {"m_payload": -1.0}, ()),
    ("payload", "bench", {"m_payload": 1000.0}, ()),
    ("joint_spring", "joint 2", {"k_spring_2": -30.0}, (-1.44,)),
    ("joint_spring", "joint 2", {"k_spring_2": 30.0}, (9.0,)),
    ("torque_offset", "joint 2", {"T_offset_2": 1e4}, ()),
    ("valve_deadband", "joint 1", {}, (0.56, 0.56, 1e-3)),
    ("spool_offset", "joint 1", {}, (0.14,)),
    ("underlap_leakage", "joint 1", {}, (0.7, 1e-3)),
    ("spool_lag", "joint 1", {}, (0.1,)),
    ("internal_leakage", "joint 1", {"c_internal_1": -2e-12}, ()),
    ("external_leakage", "joint 1 rod", {"c_external_1_rod": 1e-9}, ()),
    ("supply_sag", "bench", {}, (2.52e9, 0.2, 0.0)),
    ("tank_pressure", "bench", {}, (0.0, 0.0)),
    ("tank_pressure", "bench", {}, (3.5e6, 0.0)),
    ("entrained_air", "bench", {"alpha_air": -0.01}, ()),
    ("entrained_air", "bench", {"alpha_air": 0.5}, ()),
    ("dead_volume", "joint 1 cap", {}, (1.3e-3,)),
    ("channel_delay", "joint 1 piston", {}, (0.1,)),
    ("sensor_gain", "joint 1 cap", {}, (1.5,)),
    ("sensor_offset", "joint 1 cap", {}, (2.6e6,)),
]


@pytest.mark.parametrize(("name", "where", "values", "shape"), REFUSED)
def test_the_unphysical_is_refused_in_words(
    rig: Rig, name: str, where: str, values: dict[str, float], shape: tuple[float, ...]
) -> None:
    said = effect(name, where).problem(rig, TRUTH | values, shape)
    assert said
    assert "nan" not in said


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("asymmetric_friction", {"F_ext_1": 200.0, "F_ret_1": 100.0}),
        ("pressure_dependent_friction", {"k_friction_1": 4e-5}),
    ],
)
def test_a_level_that_falls_with_speed_is_refused_whatever_it_depends_on(
    rig: Rig, name: str, values: dict[str, float]
) -> None:
    """Viscous friction of -5 N m s/rad takes half of 250 N up to the limit of the speed."""
    tried = effect(name, "joint 1")
    falls = tried.problem(rig, TRUTH | values | {"Fv1": -5.0}, (40e-6, 40e-6))
    assert falls == "viscous friction would be negative: this level falls with speed"
    assert tried.problem(rig, TRUTH | values | {"Fv1": -0.5}, (40e-6, 40e-6)) == ""


def test_a_seal_may_hold_a_twelfth_in_the_other_direction(rig: Rig) -> None:
    levels = {"F_ext_1": 120.0, "F_ret_1": 10.0}
    assert effect("asymmetric_friction", "joint 1").problem(rig, TRUTH | levels, (4e-5,)) == ""


def test_a_spring_is_too_stiff_only_where_the_joint_could_not_move_against_it(rig: Rig) -> None:
    """Over a tenth of its reach the cylinder must turn the joint; over all of it, need not."""
    spring, (low, high) = effect("joint_spring", "joint 2"), rig.joints[1].position_range
    reach = abs(rig.joints[1].geometry(high)[0] - rig.joints[1].geometry(low)[0])
    force, lever = rig.supply.pressure * rig.joints[1].cylinder.cap_area, 0.1
    said = [
        spring.problem(rig, TRUTH | {"k_spring_2": force * lever / (share * reach)}, (-1.44,))
        for share in (1.0, 0.02)
    ]
    assert said[0] == ""
    assert "k_spring_2" in said[1]


def test_a_large_cylinders_seal_may_give_way_by_more(rig: Rig) -> None:
    """The bench's bore of 25 mm gives half a millimetre, one of 100 mm four times as much."""
    joint = rig.joints[1]
    cylinder = joint.cylinder.model_copy(update={"cap_area": 16 * joint.cylinder.cap_area})
    large = joint.model_copy(update={"cylinder": cylinder})
    grown = rig.model_copy(update={"joints": (rig.joints[0], large)})
    said = [effect("coulomb_friction", "joint 2").outside(r, (1.5e-3,)) for r in (rig, grown)]
    assert "presliding_2" in said[0]
    assert said[1] == ""


def test_bounds_grow_with_the_machine_and_not_with_its_pipes(rig: Rig) -> None:
    """An accumulator beside a short hose, a zero set at the stroke's end, a slow machine's lag."""
    part = rig.joints[0].cylinder.model_copy(update={"cap_pipe_volume": 1e-6})
    joint = rig.joints[0].model_copy(update={"cylinder": part})
    hosed = rig.model_copy(update={"joints": (joint, *rig.joints[1:])})
    volume = effect("dead_volume", "joint 1 cap").shapes(hosed)[0]
    assert volume.high > 2.0 * part.cap_area * part.stroke
    (offset,) = effect("sensor_offset", "joint 1 piston").shapes(rig)
    low, high = rig.sensors.piston.range
    assert offset.high == pytest.approx(0.25 * (high - low))
    slow = rig.model_copy(update={"sample_rate": 200.0})
    for name, where in (
        ("sensor_lag", "joint 1 rod"), ("channel_delay", "joint 1 rod"), ("spool_lag", "joint 1"),
    ):  # fmt: skip
        bounds = [effect(name, where).shapes(r)[0].high for r in (rig, slow)]
        assert bounds == pytest.approx([0.1, 0.5])


def test_a_hose_that_stiffens_gives_as_its_volume_grows(rig: Rig, state: Signals) -> None:
    """Dv/dp of a hose that widens with the logarithm of its pressure, by finite differences."""
    hose, V, k, step = effect("dead_volume", "joint 1 rod"), 5e-5, 2e-7, 100.0
    p, level = state.p_rod[:, 0], 0.5 * rig.supply.pressure
    assert p.min() > 0.0
    seen = hose.prepare(rig, state, (V, k)).V_rod[:, 0] - state.V_rod[:, 0]

    def widened(at: np.ndarray) -> np.ndarray:
        return np.asarray(V * (1.0 + k * level) / k * np.log1p(k * at))

    assert seen == pytest.approx((widened(p + step) - widened(p - step)) / (2 * step), rel=1e-6)
    assert np.interp(level, np.sort(p), np.sort(seen)[::-1]) == pytest.approx(V, rel=0.02)


@pytest.mark.parametrize("exponent", [1.0, 1.2, 1.4])
def test_free_air_is_as_soft_as_its_volume_shrinks(
    rig: Rig, state: Signals, exponent: float
) -> None:
    """dV/dp of a gas with p V^n constant, by finite differences."""
    air, alpha, step = effect("entrained_air", "bench"), 0.02, 10.0
    column = air.columns(rig, state, (exponent,))["flow_cap_1"]["alpha_air"]

    def volume(p: np.ndarray) -> np.ndarray:
        return np.asarray(alpha * (101_325.0 / (p + 101_325.0)) ** (1.0 / exponent))

    p = state.p_cap[:, 0]
    softness = -(volume(p + step) - volume(p - step)) / (2 * step)
    taken = -state.V_cap[:, 0] * softness * state.pd_cap[:, 0]
    assert alpha * column == pytest.approx(taken, rel=1e-6)


def test_every_effect_is_refused_somewhere(rig: Rig) -> None:
    assert {case[0] for case in REFUSED} == CONTRACT


def test_a_payload_is_absorbed_and_says_so(rig: Rig, multisine_run: Run) -> None:
    """The rows cannot show it: its columns are a sum of the baseline's, and the solver sees it."""
    payload = effect("payload", "bench")
    assert "compare" in payload.absorbed(rig)
    terms = (*(Used(t) for t in baseline()), Used(payload))
    solution = identify([multisine_run], terms=terms).solutions["mechanical"]
    assert "m_payload" in solution.unidentifiable


def test_a_payload_adds_to_the_inertia_what_a_point_mass_does(rig: Rig) -> None:
    """6.5 kg at the tip; M2 grows by about 1.6, M1 by twice that."""
    grown = growth(rig)
    assert grown["M2"] * 6.5 == pytest.approx(1.6, rel=0.02)
    assert grown["M1"] == pytest.approx(2 * grown["M2"])


def test_effects_that_no_data_can_tell_apart_name_each_other(rig: Rig) -> None:
    null = effect("spool_offset", "joint 2")
    assert null.inseparable() == (("sensor_offset", "joint 2 spool"),)
    assert "joint 2 spool" not in type(effect("sensor_offset", "bench")).places(rig)
    assert effect("sensor_gain", "joint 1 spool").absorbed(rig)
    assert not effect("sensor_gain", "joint 1 cap").absorbed(rig)


def test_sensors_are_put_right_before_the_valve_and_the_valve_in_its_own_order() -> None:
    names = [("valve_deadband", "joint 1"), ("spool_lag", "joint 1"), ("spool_offset", "joint 1"),
             ("channel_delay", "joint 1 spool"), ("supply_sag", "bench")]  # fmt: skip
    terms = [Used(make(*which)) for which in names] + [Used(t) for t in baseline()]
    order = [u.term.name for u in ordered(terms)]
    assert order[:5] == [
        "channel_delay", "spool_offset", "spool_lag", "valve_deadband", "supply_sag",
    ]  # fmt: skip
    assert order[5:] == [t.name for t in baseline()]


def test_a_place_that_is_none_is_named() -> None:
    with pytest.raises(InputError, match=r"coulomb_friction.*'bench'"):
        _ = effect("coulomb_friction", "bench").joint


def test_the_pages_are_those_of_the_classes(rig: Rig) -> None:
    """The pages were written after the last change of the catalogue."""
    docs = Path(__file__).parents[3] / "docs"
    for name, text in pages(rig).items():
        written = (docs / name).read_text(encoding="utf-8")
        assert written.startswith(text), f'run `make study NAME="effects --docs docs"`: {name}'
    for family in FAMILIES:
        assert (docs / "images" / f"effects-{family}.svg").stat().st_size < 200_000
