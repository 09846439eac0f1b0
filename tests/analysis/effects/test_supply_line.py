"""A line between supply sensor and valves: what it drops, and how late, by another route."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from analysis.effects.base import Evidence, ordered
from analysis.effects.compliance import DeadVolume
from analysis.effects.supply import PortEffect, ReturnLine, SupplySag, TankPressure, port_flow
from analysis.signals.conditioning import Signals
from analysis.terms.base import Used
from rig.model.rig import Rig
from tests.analysis.test_terms import signals_of

DROP, SHARE, VOLUME = 0.8e6, 0.3, 0.4e-3  # Pa at the pump's flow, of that flow, m^3


@pytest.fixture
def lifting(rig: Rig) -> Signals:
    """Joint 1 lifts at a speed that swings, fast enough for the line to lag; nothing else moves."""
    t = np.arange(800) / 1000.0
    still = np.zeros((len(t), 2))
    signals = signals_of(rig, still + np.array([1.1, -1.4]), still, still, np.random.default_rng(0))
    flow = rig.supply.flow * (0.35 - 0.25 * np.cos(2 * np.pi * 12 * t))
    speed = np.column_stack((flow / rig.joints[0].cylinder.cap_area, np.zeros(len(t))))
    opening = still + np.array([0.05, 0.0])
    return replace(signals, t=t, rate=1000.0, sd=speed, u=opening, pd_cap=still, pd_rod=still)


def dropped(rig: Rig, signals: Signals, volume: float) -> np.ndarray:
    seen = SupplySag("bench").prepare(rig, signals, (DROP, SHARE, volume))
    return np.asarray(signals.p_s - seen.p_s)


def through(drop: float, flow: float) -> float:
    """The line's flow at a drop, from its law by a root finder."""
    whole = DROP / np.cbrt(1.0 + SHARE**3)
    law = lambda Q: whole * (Q / flow) * np.cbrt((Q / flow) ** 3 + SHARE**3) - drop  # noqa: E731
    return float(brentq(law, 0.0, 10 * flow)) if drop > 0 else 0.0


def test_without_oil_between_the_drop_is_that_of_the_flow_at_each_instant(
    rig: Rig, lifting: Signals
) -> None:
    flow = lifting.sd[:, 0] * rig.joints[0].cylinder.cap_area
    drop = dropped(rig, lifting, 0.0)
    back = [through(d, rig.supply.flow) for d in drop[::50]]
    assert back == pytest.approx(flow[::50], rel=1e-6)
    small = replace(lifting, sd=0.01 * lifting.sd)
    tenfold = replace(lifting, sd=0.1 * lifting.sd)
    assert dropped(rig, tenfold, 0.0).max() == pytest.approx(
        10 * dropped(rig, small, 0.0).max(), rel=0.01
    )  # laminar: as the flow
    huge, more = (replace(lifting, sd=k * lifting.sd) for k in (10.0, 20.0))
    assert dropped(rig, more, 0.0).max() == pytest.approx(
        4 * dropped(rig, huge, 0.0).max(), rel=0.01
    )  # turbulent: as its square


def test_the_flow_drawn_fills_the_dead_volume_too(rig: Rig, lifting: Signals) -> None:
    """By continuity the volume takes V / b times the pressure rate, which the line must carry."""
    volume, rate = 60e-6, 40e6 * np.sin(2 * np.pi * 12 * lifting.t) ** 2
    rising = replace(lifting, pd_cap=np.column_stack((rate, np.zeros(len(rate)))))
    terms = [
        Used(SupplySag("bench"), (DROP, SHARE, 0.0)), Used(DeadVolume("joint 1 cap"), (volume,)),
    ]  # fmt: skip
    seen = rising
    for used in ordered(terms):
        seen = used.term.prepare(rig, seen, used.shape)
    through_line = np.array([through(d, rig.supply.flow) for d in (rising.p_s - seen.p_s)[::50]])
    softness = 1.0 / rig.nominal["b"]
    moved = rising.sd[:, 0] * rig.joints[0].cylinder.cap_area
    filled = softness * (rising.V_cap[:, 0] + volume) * rate
    assert through_line == pytest.approx((moved + filled)[::50], rel=1e-6)
    assert filled.max() > 0.05 * moved.max()


@pytest.mark.parametrize("effect", [SupplySag("bench"), ReturnLine("bench")])
def test_a_pump_rated_for_far_more_than_the_arm_draws_changes_no_first_look(
    rig: Rig, lifting: Signals, effect: PortEffect
) -> None:
    """The drops that a search begins with are those at the flow that is there."""

    def looked_at(rig: Rig) -> np.ndarray:
        seen = [
            effect.prepare(rig, lifting, p) for p in effect.points(rig, Evidence([lifting], []))
        ]
        return np.array([np.abs(s.p_s - s.p_tank - lifting.p_s + lifting.p_tank) for s in seen])

    some, other = (
        looked_at(rig.model_copy(update={"supply": rig.supply.model_copy(update={"flow": flow})}))
        for flow in (0.6 * rig.supply.flow, 9.0 * rig.supply.flow)
    )
    assert some.max() > 0.1 * rig.supply.pressure
    assert other.max(axis=1) == pytest.approx(some.max(axis=1), rel=0.4)


def test_the_oil_between_sensor_and_valves_is_continuity_in_its_volume(
    rig: Rig, lifting: Signals
) -> None:
    """V / b d(drop)/dt = Q drawn - Q of the line, by an integrator of its own."""
    flow = lifting.sd[:, 0] * rig.joints[0].cylinder.cap_area
    stiffness = rig.nominal["b"] / VOLUME

    def rate(t: float, drop: np.ndarray) -> list[float]:
        drawn = float(np.interp(t, lifting.t, flow))
        return [stiffness * (drawn - through(float(drop[0]), rig.supply.flow))]

    ours = dropped(rig, lifting, VOLUME)
    theirs = solve_ivp(
        rate, (0.0, lifting.t[-1]), ours[:1], t_eval=lifting.t, method="LSODA",
        rtol=1e-6, atol=1.0, max_step=2e-3,
    ).y[0]  # fmt: skip
    settled = slice(200, None)
    swing = np.ptp(theirs[settled])
    assert np.abs(ours - theirs)[settled].max() < 0.02 * swing
    assert np.abs(dropped(rig, lifting, 0.0) - theirs)[settled].max() > 0.1 * swing


def test_a_drop_at_a_flow_that_no_record_reaches_is_given_at_the_flow_that_is_reached(
    rig: Rig, lifting: Signals
) -> None:
    """The swing draws 0.6 of a matched pump, and a fifteenth of one fifteen times as large."""
    rated = rig.model_copy(
        update={"supply": rig.supply.model_copy(update={"flow": 9.0 * rig.supply.flow})}
    )
    shape = (81.0 * DROP, 3.0, 0.0)  # nearly laminar
    assert SupplySag("bench").remark(rig, [lifting], shape) == ""
    said = SupplySag("bench").remark(rated, [lifting], shape)
    litres = 6e4 * 0.6 * rig.supply.flow
    assert f"{litres:.2g} l/min" in said
    assert f"{81.0 * DROP / 15.0 / 1e6:.2g} MPa" in said


def test_a_drop_that_no_record_reaches_may_be_that_of_any_line_beyond(
    rig: Rig, lifting: Signals
) -> None:
    """From a fifteenth of the pump's flow, a laminar line grows 15 times, a turbulent one 225."""
    rated = rig.model_copy(
        update={"supply": rig.supply.model_copy(update={"flow": 9.0 * rig.supply.flow})}
    )
    for shape in ((81.0 * DROP, 3.0, 0.0), (81.0 * DROP, 0.0, 0.0)):
        seen = lifting.p_s - SupplySag("bench").prepare(rated, lifting, shape).p_s
        low, high = SupplySag("bench").extrapolated(rated, [lifting], shape)["dp_supply"]
        assert low == pytest.approx(15.0 * seen.max(), rel=1e-3)
        assert high == pytest.approx(225.0 * seen.max(), rel=1e-3)
        assert low <= (1.0 + 1e-3) * shape[0]
        assert high >= (1.0 - 1e-3) * shape[0]
    (line,) = ReturnLine("bench").extrapolated(rated, [lifting], (DROP,)).values()
    assert line[0] < DROP == pytest.approx(line[1])


def test_a_drop_of_the_return_line_that_no_record_reaches_may_be_large(
    rig: Rig, lifting: Signals
) -> None:
    """A tenth of the supply pressure at 0.38 of the pump's flow is 0.7 of it at the whole."""
    p, flow = rig.supply.pressure, float(port_flow(rig, lifting, drawn=False).max())
    rated = rig.model_copy(update={"supply": rig.supply.model_copy(update={"flow": 7**0.5 * flow})})
    shape = (0.1 * p, 0.7 * p)
    raised = TankPressure("bench").prepare(rated, lifting, shape).p_tank - lifting.p_tank
    assert raised.max() == pytest.approx(0.2 * p, rel=1e-3)
    assert TankPressure("bench").problem(rated, {}, shape) == ""


def test_an_accumulator_may_be_as_slow_at_a_small_pump_of_low_pressure(
    rig: Rig, lifting: Signals
) -> None:
    """A laminar line and a capacity C = V / b are a lag of R C: 0.3 s at 1.5 MPa and 0.3 l/min."""
    supply = rig.supply.model_copy(update={"pressure": 1.5e6, "flow": 5e-6})
    small = rig.model_copy(update={"supply": supply})
    resistance, lag = 0.3 * supply.pressure / supply.flow, 0.3
    shape = (0.3 * supply.pressure, 3.0, lag / resistance * rig.nominal["b"])
    assert SupplySag("bench").outside(small, shape) == ""
    flow = np.where(lifting.t < 0.1, 0.0, 0.5 * supply.flow)
    speed = np.column_stack((flow / rig.joints[0].cylinder.cap_area, np.zeros(len(flow))))
    begun = replace(lifting, sd=speed, p_s=np.full(len(flow), supply.pressure))
    drop = supply.pressure - SupplySag("bench").prepare(small, begun, shape).p_s
    after = lifting.t - 0.1
    slow = np.where(after < 0.0, 0.0, 0.5 * shape[0] * -np.expm1(-after / lag))
    assert drop == pytest.approx(slow, abs=0.02 * slow.max())


def test_lines_at_both_ports_of_one_valve_have_the_flow_of_an_edge_that_opens_less(
    rig: Rig,
) -> None:
    """The flow through edge and line in series, by a root finder, over the root of the drop."""
    lone = rig.model_copy(update={"joints": rig.joints[:1]})
    sag, back = SupplySag("bench"), ReturnLine("bench")
    turbulent = (DROP, 0.01)
    with_sag, with_back = [Used(sag, turbulent)], [Used(back, turbulent)]
    assert sag.inseparable_beside(lone, turbulent, with_back) == (("metering_curve", "joint 1"),)
    assert back.inseparable_beside(lone, turbulent, with_sag) == (("metering_curve", "joint 1"),)
    assert not sag.inseparable_beside(rig, turbulent, with_back)
    assert not sag.inseparable_beside(lone, (DROP, 0.0), with_back)  # laminar throughout
    assert not sag.inseparable_beside(lone, turbulent, [])
    gain, k = 6e-7, DROP / rig.supply.flow**2

    def over_root(u: float, drop: float) -> float:
        series = lambda Q: Q - gain * u * np.sqrt(max(drop - k * Q * Q, 0.0))  # noqa: E731
        return float(brentq(series, 0.0, np.sqrt(drop / k))) / np.sqrt(drop)

    for u in (0.01, 0.1, 0.5):
        at = [over_root(u, drop) for drop in (0.5e6, 2e6, 6e6)]
        assert at == pytest.approx([at[0]] * 3, rel=1e-6)
    assert over_root(0.5, 2e6) < 0.9 * 50 * over_root(0.01, 2e6)


def test_a_regulator_follows_with_one_time_constant_at_any_flow(rig: Rig, lifting: Signals) -> None:
    """The drop of an orifice through a first-order lag, integrated by another route."""
    volume, share, flow = 1e-3, 1e-3, rig.supply.flow
    lag = volume / rig.nominal["b"] * 2.0 * DROP / flow  # of dp/dQ at the pump's whole flow

    def rate(t: float, drop: np.ndarray) -> np.ndarray:
        drawn = 0.35 - 0.25 * np.cos(2 * np.pi * 12 * t)
        return np.asarray((DROP * drawn**2 - drop) / lag)

    begun = DROP * (0.35 - 0.25) ** 2
    wanted = solve_ivp(rate, (0.0, lifting.t[-1]), [begun], t_eval=lifting.t, rtol=1e-9, atol=1.0)
    seen = SupplySag("bench").prepare(rig, lifting, (DROP, share, volume, 1.0))
    assert lag > 3e-3
    assert lifting.p_s - seen.p_s == pytest.approx(wanted.y[0], abs=1e-3 * wanted.y[0].max())
