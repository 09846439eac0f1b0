"""The model in motion: against the other program's bench, its own energy, and a new term."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from analysis.identify.identify import identify
from analysis.regression.rows import right_sides
from analysis.signals.conditioning import Signals, condition
from analysis.simulation.integrator import integrate
from analysis.simulation.model import Model, nominal_model
from analysis.simulation.simulate import compiled, drive_of, simulate, state_at
from analysis.terms import base, baseline
from analysis.terms.base import Coefficient, Columns, Kernel, Term, Used, kernel
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis import small_bench as bench
from tests.analysis.right_hand_side import rates_of
from tests.analysis.small_bench import TRUTH

BASELINE = tuple(Used(term) for term in baseline())


@pytest.fixture(scope="module")
def truth_model(rig: Rig) -> Model:
    return nominal_model(rig.model_copy(update={"nominal": TRUTH}), BASELINE)


@pytest.fixture(scope="module")
def clean(rig: Rig) -> Signals:
    """Noise-free signals of both joints at once."""
    rng = np.random.default_rng(5)
    waves = {i: bench.Excitation.multisine(0.018, rng) for i in (0, 1)}
    step = bench.Step("both", (), (0.0, 0.0))
    run = bench.experiment(
        rig, {"both": waves}, repeats=1, seed=0, steps=(step,), scale=0.0, seconds=4.0
    )
    return condition(rig, run.records[0])


def test_with_the_true_parameters_the_other_programs_bench_is_reproduced(
    truth_model: Model, clean: Signals
) -> None:
    first, n = 200, 3600
    result = simulate(truth_model, drive_of(clean), state_at(clean, first), first, n)
    assert result.failure == ""
    assert result.outside == 0
    inner = slice(first, first + n)
    assert np.abs(result.piston - clean.s[inner]).max() < 2e-4 * np.ptp(clean.s)
    assert np.abs(result.p_cap - clean.p_cap[inner]).max() < 2e-3 * np.ptp(clean.p_cap)
    assert np.abs(result.p_rod - clean.p_rod[inner]).max() < 2e-3 * np.ptp(clean.p_rod)


def test_own_integrator_agrees_with_scipys(truth_model: Model, clean: Signals) -> None:
    ready, drive = compiled(truth_model), drive_of(clean)
    start = state_at(clean, 0)
    own = simulate(ready, drive, start, 0, 800)
    y0 = np.concatenate((start.q, start.qd, start.p_cap, start.p_rod))
    t = np.arange(800) / 1000
    found = solve_ivp(
        rates_of(ready, drive), (0, t[-1]), y0, "DOP853", t, rtol=1e-9, atol=1e-9, max_step=1e-3
    )
    assert np.abs(found.y[:2].T - own.q).max() < 2e-5  # rad, of strokes of 0.3
    assert np.abs(found.y[4:6].T - own.p_cap).max() < 2e3  # of 7 MPa


def test_work_of_the_cylinders_is_kinetic_potential_and_friction(
    truth_model: Model, clean: Signals, rig: Rig
) -> None:
    """Energy by NOTES' closed two-joint forms, not by the chain's."""
    result = simulate(truth_model, drive_of(clean), state_at(clean, 200), 200, 3000)
    q, qd = result.q, result.qd
    c2 = np.cos(q[:, 1])
    M11, M12, M22 = (
        TRUTH["M1"] + 2 * TRUTH["R12"] * c2, TRUTH["M2"] + TRUTH["R12"] * c2, TRUTH["M2"],
    )  # fmt: skip
    kinetic = 0.5 * (M11 * qd[:, 0] ** 2 + 2 * M12 * qd[:, 0] * qd[:, 1] + M22 * qd[:, 1] ** 2)
    potential = -9.8 * (TRUTH["W1"] * np.cos(q[:, 0]) + TRUTH["W2"] * np.cos(q[:, 0] + q[:, 1]))
    power = np.zeros(3000)
    for i, joint in enumerate(rig.joints):
        area = joint.cylinder
        force = area.cap_area * result.p_cap[:, i] - area.rod_area * result.p_rod[:, i]
        power += force * result.speed[:, i] - TRUTH[f"Fv{i + 1}"] * qd[:, i] ** 2
    work = np.concatenate(([0.0], np.cumsum(0.5 * (power[1:] + power[:-1])) / 1000))
    energy = kinetic + potential
    assert np.ptp(energy) > 1.0  # J: something happened
    assert np.abs(energy - energy[0] - work).max() < 1e-3 * np.ptp(energy)


def test_a_locked_joint_follows_its_measured_motion(truth_model: Model, clean: Signals) -> None:
    held = replace(clean, excited=np.array([False, True]))
    result = simulate(truth_model, drive_of(held), state_at(held, 200), 200, 2000)
    inner = slice(200, 2200)
    assert result.q[:, 0] == pytest.approx(held.q[inner, 0])
    # Joint 2 feels joint 1's acceleration, so it still moves as it did with both free.
    assert np.abs(result.piston[:, 1] - clean.s[inner, 1]).max() < 5e-4 * np.ptp(clean.s[:, 1])


def test_a_state_that_ceases_to_exist_is_reported_not_hidden(
    truth_model: Model, clean: Signals
) -> None:
    drive = replace(drive_of(clean), u=np.full_like(clean.u, 0.5))
    result = simulate(truth_model, drive, state_at(clean, 200))
    assert "past its end" in result.failure
    assert result.filled < 2000
    assert np.isfinite(result.q).all()
    assert (result.piston[result.filled :] == result.piston[-1]).all()


def test_pressures_without_a_real_root_are_counted(truth_model: Model, clean: Signals) -> None:
    start = state_at(clean, 200)
    start = replace(start, p_cap=np.array([-2e5, 3.5e6]))
    result = simulate(truth_model, drive_of(clean), start, 200, 500)
    assert 0 < result.outside < 500
    assert np.isfinite(result.p_cap).all()


def test_an_inertia_that_cannot_be_is_said(truth_model: Model, clean: Signals) -> None:
    bad = dict(truth_model.parameters)
    bad["M2"] = replace(bad["M2"], value=-1.0)
    result = simulate(replace(truth_model, parameters=bad), drive_of(clean), state_at(clean, 200))
    assert "not positive definite" in result.failure


def test_a_parameter_that_was_not_identified_stops_the_simulation(truth_model: Model) -> None:
    lost = dict(truth_model.parameters)
    lost["b"] = replace(lost["b"], value=np.nan)
    with pytest.raises(InputError, match="b not identified"):
        compiled(replace(truth_model, parameters=lost))


@dataclass(frozen=True)
class SmoothCoulomb(Term):
    """Friction of constant size at one joint, tanh(q'/v) for its sign: one class, one kernel."""

    name: ClassVar[str] = "test_coulomb"

    @property
    def kernel(self) -> Kernel:
        return _coulomb

    @property
    def joint(self) -> int:
        return int(self.where.split()[1]) - 1

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        return (Coefficient(f"Fc{self.joint + 1}", "N*m", "mechanical"),)

    def shape_names(self) -> tuple[str, ...]:
        return ("speed",)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        sign = np.tanh(signals.qd[:, self.joint] / shape[0])
        return {f"torque_{self.joint + 1}": {f"Fc{self.joint + 1}": sign}}

    def pack(self, rig: Rig, values: dict[str, float], shape: Sequence[float]) -> np.ndarray:
        return np.array([values[f"Fc{self.joint + 1}"], shape[0], self.joint])


@kernel
def _coulomb(phase, bench, x, z, par, out, M, dz):
    if phase == base.CONTRIBUTE:
        i = int(par[2])
        out[base.TORQUE, i] -= par[0] * np.tanh(x[base.QD, i] / par[1])


@dataclass(frozen=True)
class SpoolLag(Term):
    """A hidden state per joint: the opening follows the spool by a first-order lag."""

    name: ClassVar[str] = "test_lag"
    prepares: ClassVar[bool] = True

    @property
    def kernel(self) -> Kernel:
        return _lag

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        return ()

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        return {}

    def hidden(self, rig: Rig) -> int:
        return len(rig.joints)


@kernel
def _lag(phase, bench, x, z, par, out, M, dz):
    if phase == base.PREPARE:
        for i in range(x.shape[1]):
            dz[i] = (x[base.U, i] - z[i]) / par[0]
            x[base.U, i] = z[i]


def test_a_new_term_joins_regression_and_simulation_by_itself(
    truth_model: Model, clean: Signals, multisine_run: Run
) -> None:
    extra = Used(SmoothCoulomb("joint 1"), (0.02,))
    result = identify([multisine_run], terms=(*BASELINE, extra))
    Fc = result.estimates["Fc1"]
    # The other program's bench has none, and the regression says so.
    assert abs(Fc.value) < 0.15
    assert result.estimates["Fv1"].value == pytest.approx(TRUTH["Fv1"], rel=0.01)
    compilations = len(integrate.signatures)
    with_friction = replace(
        truth_model,
        terms=(*BASELINE, extra),
        parameters={**truth_model.parameters, "Fc1": replace(Fc, value=30.0)},
    )
    args = (drive_of(clean), state_at(clean, 200), 200, 1500)
    slowed, free = simulate(with_friction, *args), simulate(truth_model, *args)
    assert np.abs(slowed.qd[:, 0] - free.qd[:, 0]).max() > 1e-3
    # What the simulation did satisfies the extended torque balance with the friction in it.
    excess = _torque_excess(truth_model, slowed, clean)
    sign = np.tanh(slowed.qd[20:-20, 0] / 0.02)
    fit = float(sign @ excess[20:-20] / (sign @ sign))
    assert fit == pytest.approx(30.0, rel=0.05)
    assert len(integrate.signatures) == compilations


def _torque_excess(model: Model, result, clean: Signals) -> np.ndarray:
    """Joint 1's cylinder torque beyond what the baseline explains, by differences in time."""
    inner = slice(200, 200 + len(result.q))
    qdd = np.gradient(result.qd, 1e-3, axis=0)
    G = np.column_stack(
        [j.linkage.jacobian(result.q[:, i]) for i, j in enumerate(model.rig.joints)]
    )
    seen = replace(
        clean, q=result.q, qd=result.qd, qdd=qdd, theta=np.cumsum(result.q, axis=1), G=G,
        p_cap=result.p_cap, p_rod=result.p_rod, s=result.piston, sd=result.speed,
        u=clean.u[inner], p_s=clean.p_s[inner], p_tank=clean.p_tank[inner],
    )  # fmt: skip
    excess = right_sides(model.rig, seen)["torque_1"].copy()
    for used in BASELINE[:3]:
        for name, column in used.term.columns(model.rig, seen, ()).get("torque_1", {}).items():
            excess -= TRUTH[name] * column
    return excess


def test_hidden_states_are_integrated_with_the_rest(truth_model: Model, clean: Signals) -> None:
    args = (drive_of(clean), state_at(clean, 200), 200, 2500)
    free = simulate(truth_model, *args)
    quick = simulate(replace(truth_model, terms=(*BASELINE, Used(SpoolLag(), (5e-4,)))), *args)
    slow = simulate(replace(truth_model, terms=(*BASELINE, Used(SpoolLag(), (20e-3,)))), *args)

    # A lag of 20 ms delays the stroke by 20 ms, 0.5 ms hardly at all (the start transient apart).
    def lag(result) -> int:
        y, x = result.speed[500:, 1], free.speed[:, 1]
        return int(np.argmin([np.mean((y - x[500 - k : 2500 - k]) ** 2) for k in range(60)]))

    assert lag(quick) <= 1
    assert 15 <= lag(slow) <= 24
