"""Sets of effects: which are impossible, and which are tried in place of others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.terms import make
from analysis.terms.base import Used
from analysis.trace.search.exact_fit import ExactFit, fit_coefficients
from analysis.trace.search.exchanges import exchanged
from analysis.trace.search.extensions import extensions
from analysis.trace.search.hypothesis import (
    Hypothesis,
    energy_above_noise,
    is_preferred,
    may_grow,
    negative_body,
)
from analysis.workers.forked import Forked
from analysis.workers.pool import Serial
from rig.model.rig import Rig
from tests.analysis.trace.gate_cases import LEAK, searched
from tests.analysis.trace.hidden import pair_of_runs
from tests.variants import kept


def fit_of(error: float = 1.0, **values: float) -> ExactFit:
    """Return a fit with these coefficients, each with the same standard error."""
    information = np.eye(len(values)) / error**2
    return ExactFit((), values, np.zeros(0), information)


def test_a_joint_that_weighs_less_than_nothing_is_impossible(rig: Rig) -> None:
    """A spring can pull as hard as a joint's weight, which then seems to push."""
    unstated = rig.model_copy(update={"nominal": {}})
    baseline = fit_of(M1=50.0, W1=-5.0)
    wrong = fit_of(M1=50.0, W1=-243.0)
    assert negative_body(unstated, wrong, baseline) == "W1 would be -243, below zero"
    assert negative_body(unstated, fit_of(error=100.0, M1=50.0, W1=-243.0), baseline) == ""
    assert negative_body(unstated, fit_of(M1=50.0, W1=12.0, R12=-3.0), baseline) == ""
    # A counterweight: the baseline shows it, or the rig file states it.
    assert negative_body(unstated, wrong, fit_of(M1=50.0, W1=-150.0)) == ""
    stated = rig.model_copy(update={"nominal": {"W1": -200.0}})
    assert negative_body(stated, wrong, baseline) == ""


@pytest.mark.parametrize("inclination", kept([-0.3, 0.3], (0,)))
def test_an_inclination_of_either_sign_is_tried_for_a_spring(rig: Rig, inclination: float) -> None:
    """The one is of the bench and the other of a joint; from the wrong sign none is found."""
    names = ("joint_spring", "base_inclination", "internal_leakage")
    s = searched(rig, *pair_of_runs(rig, c_internal=LEAK, inclination=inclination), *names)
    again = exchanged(s.hypotheses, s.set_of("joint_spring", "internal_leakage"))
    found = {u.term.name: u.shape for u in again.effects}
    assert set(found) == {"base_inclination", "internal_leakage"}
    assert found["base_inclination"][0] == pytest.approx(inclination, rel=0.02)


def test_a_search_by_two_processes_gives_the_same(rig: Rig) -> None:
    """Sets that one process fits must not be known to some of the others only."""
    names = ("internal_leakage", "spool_offset", "torque_offset", "sensor_gain", "dead_volume")
    runs = pair_of_runs(rig, c_internal=LEAK, u_null=3e-3)
    alone, shared = (searched(rig, *runs, *names, pool=pool) for pool in (Serial(), Forked(2)))
    assert shared.winner.keys == alone.winner.keys
    assert {u.term.name for u in alone.winner.effects} == {"internal_leakage", "spool_offset"}
    expected, fitted = (s.hypotheses.fitted for s in (alone, shared))
    assert fitted.keys() == expected.keys()
    assert {k: o.total for k, o in fitted.items()} == {k: o.total for k, o in expected.items()}
    # Sets are compared by identity: a result of another process is kept only once.
    assert shared.hypotheses.refined(shared.winner.effects) is shared.winner


def test_an_effect_is_exchanged_for_one_that_does_not_resemble_it(rig: Rig) -> None:
    names = ("torque_offset", "spool_offset", "internal_leakage")
    s = searched(rig, *pair_of_runs(rig, c_internal=LEAK, u_null=1e-3), *names)
    again = exchanged(s.hypotheses, s.set_of("torque_offset", "internal_leakage"))
    assert {name for name, _ in again.keys} == {"spool_offset", "internal_leakage"}


@pytest.mark.slow
def test_an_offset_of_a_pressure_is_tried_for_a_spring(rig: Rig) -> None:
    """A spring that rests far away is nearly the torque of a rod pressure that is 60 kPa off."""
    names = ("joint_spring", "sensor_offset", "internal_leakage")
    s = searched(rig, *pair_of_runs(rig, c_internal=LEAK, offset_rod_pressure=6e4), *names)
    again = exchanged(s.hypotheses, s.set_of("joint_spring", "internal_leakage"))
    found = {u.term.key: u.shape for u in again.effects}
    assert set(found) == {("sensor_offset", "joint 2 rod"), ("internal_leakage", "joint 2")}
    assert found["sensor_offset", "joint 2 rod"][0] == pytest.approx(6e4, rel=0.05)


@pytest.mark.slow
def test_an_extension_that_ended_in_a_local_minimum_is_fitted_again(rig: Rig) -> None:
    """Another start had led the dead band's edges astray; a spring beside it cannot do that."""
    names = ("valve_deadband", "joint_spring")
    s = searched(rig, *pair_of_runs(rig, w_ahead=6e-3, w_astern=6e-3, k_spring=30.0), *names)
    alone, both = s.set_of("valve_deadband"), s.set_of(*names)
    data, base = s.hypotheses.train_data, s.hypotheses.base
    astray = [
        replace(u, shape=tuple(5.0 * x for x in u.shape)) if u.term.name == names[0] else u
        for u in both.effects
    ]
    fit = fit_coefficients(data, (*base, *astray))
    excess = energy_above_noise(data, fit.residual)
    s.hypotheses.fitted[both.keys] = replace(both, fit=fit, excess_energy=excess)
    again = next(o for o in extensions(s.hypotheses, alone) if o.keys == both.keys)
    assert again.total == pytest.approx(both.total, abs=0.01 * sum(excess.values()))


def test_of_two_equally_simple_sets_the_one_that_spoils_no_equation_is_preferred(rig: Rig) -> None:
    """In all it leaves 1 % more, which another effect makes; a torque it leaves a hundredth."""
    s = searched(rig, *pair_of_runs(rig, c_internal=LEAK), "internal_leakage", "torque_offset")
    band = s.hypotheses.noise_band

    def leaving(name: str, torque: float, flow: float) -> Hypothesis:
        times = {"torque_2": torque, "flow_cap_2": flow, "flow_rod_2": flow}
        return replace(s.set_of(name), excess_energy={e: band[e] * v for e, v in times.items()})

    kept = leaving("internal_leakage", torque=1.0, flow=1.00e5)
    spoiled = leaving("torque_offset", torque=100.0, flow=0.99e5)
    assert spoiled.total < kept.total
    assert is_preferred(kept, spoiled, s.hypotheses.noise_band)
    assert not is_preferred(spoiled, kept, s.hypotheses.noise_band)
    assert s.hypotheses.best([spoiled, kept]) is kept
    far = leaving("torque_offset", torque=100.0, flow=0.5e5)
    assert s.hypotheses.best([far, kept]) is far


def test_an_effect_at_both_joints_counts_once_in_a_set() -> None:
    lags = [Used(make("spool_lag", joint), (3e-3,)) for joint in ("joint 1", "joint 2")]
    friction = Used(make("coulomb_friction", "joint 2"))
    leak = Used(make("internal_leakage", "joint 1"))
    assert may_grow([*lags, friction])
    assert not may_grow([*lags, friction, leak])
    assert not may_grow([*lags, friction], by=2)
