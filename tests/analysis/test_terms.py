"""Each term against an independent route: bodies, energies, and its own kernel against its rows."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.regression.rows import right_sides
from analysis.signals.conditioning import Signals
from analysis.terms import base, baseline, known, make
from analysis.terms.mechanics import chain_matrix, mass_matrix
from rig.model.parameters import inertia_names, parameter_names
from rig.model.parse import InputError
from rig.model.rig import Rig

Array = np.ndarray


def chain_rig(rig: Rig, joints: int) -> Rig:
    """A planar chain of the given number of joints made of the two shipped ones."""
    parts = tuple(rig.joints[i % 2] for i in range(joints))
    return rig.model_copy(update={"joints": parts, "nominal": {}})


def signals_of(rig: Rig, q: Array, qd: Array, qdd: Array, rng: np.random.Generator) -> Signals:
    """Signals with a given motion and random pressures and spools."""
    n, N = q.shape
    pick = lambda low, high: rng.uniform(low, high, (n, N))  # noqa: E731
    G = np.column_stack([j.linkage.jacobian(q[:, i]) for i, j in enumerate(rig.joints)])
    s = np.column_stack([j.linkage.piston(q[:, i]) for i, j in enumerate(rig.joints)])
    volumes = [rig.chamber_volumes(i, s[:, i]) for i in range(N)]
    return Signals(
        rate=1000.0, t=np.arange(n) / 1000, u=pick(-0.1, 0.1), s=s, sd=G * qd, q=q, qd=qd, qdd=qdd,
        theta=np.cumsum(q, axis=1), G=G, p_cap=pick(1e6, 6e6), p_rod=pick(1e6, 6e6),
        pd_cap=pick(-5e7, 5e7), pd_rod=pick(-5e7, 5e7),
        V_cap=np.column_stack([v[0] for v in volumes]),
        V_rod=np.column_stack([v[1] for v in volumes]),
        p_s=rng.uniform(6.8e6, 7e6, n), p_tank=np.zeros(n), temperature=np.full(n, 40.0),
        excited=np.ones(N, dtype=bool), valid=np.ones((n, N), dtype=bool),
        lost=np.zeros((n, N), dtype=bool), bands=np.full(N, np.inf),
    )  # fmt: skip


class Bodies:
    """A planar chain of rigid bodies: lengths, masses, centres and inertias of its own."""

    def __init__(self, joints: int, rng: np.random.Generator) -> None:
        self.length = rng.uniform(0.3, 0.7, joints)
        self.mass = rng.uniform(2, 9, joints)
        self.centre = rng.uniform(0.1, 0.4, joints)
        self.inertia = rng.uniform(0.05, 0.5, joints)

    def lagrangian(self, q: Array, qd: Array) -> complex:
        """T - V from the velocities of the centres of mass; no inertia parameter appears."""
        theta, rate = np.cumsum(q), np.cumsum(qd)
        x_dot = y_dot = height = 0.0 + 0.0j
        total = 0.0 + 0.0j
        for k in range(len(q)):
            vx = x_dot + self.centre[k] * np.cos(theta[k]) * rate[k]
            vy = y_dot + self.centre[k] * np.sin(theta[k]) * rate[k]
            total += 0.5 * self.mass[k] * (vx * vx + vy * vy)
            total += 0.5 * self.inertia[k] * rate[k] ** 2
            total += self.mass[k] * 9.8 * (height + self.centre[k] * np.cos(theta[k]))
            x_dot += self.length[k] * np.cos(theta[k]) * rate[k]
            y_dot += self.length[k] * np.sin(theta[k]) * rate[k]
            height += self.length[k] * np.cos(theta[k])
        return complex(total)

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """d/dt dL/dq' - dL/dq by complex steps in space and central differences in time."""
        N, tiny, dt = len(q), 1e-30, 1e-4

        def momentum(a: Array, b: Array) -> Array:
            eye = 1j * tiny * np.eye(N)
            return np.array([self.lagrangian(a, b + eye[i]).imag / tiny for i in range(N)])

        def at(t: float) -> Array:
            return momentum(q + t * qd + 0.5 * t * t * qdd, qd + t * qdd)

        rate = (8 * (at(dt) - at(-dt)) - (at(2 * dt) - at(-2 * dt))) / (12 * dt)
        eye = 1j * tiny * np.eye(N)
        force = np.array([self.lagrangian(q + eye[i], qd).imag / tiny for i in range(N)])
        return rate - force

    def parameters(self) -> dict[str, float]:
        """R_ij and W_i of the bodies, from the definition of T and V."""
        N = len(self.mass)
        beyond = [self.mass[k + 1 :].sum() for k in range(N)]
        W = [self.mass[k] * self.centre[k] + self.length[k] * beyond[k] for k in range(N)]
        R = np.zeros((N, N))
        for k in range(N):
            R[k, k] = self.inertia[k] + self.mass[k] * self.centre[k] ** 2
            R[k, k] += self.length[k] ** 2 * beyond[k]
            for j in range(k + 1, N):
                R[k, j] = R[j, k] = self.length[k] * W[j]
        values = {f"W{k + 1}": W[k] for k in range(N)}
        if N == 1:
            return values | {"M1": R[0, 0]}
        if N == 2:
            return values | {"M1": R[0, 0] + R[1, 1], "M2": R[1, 1], "R12": R[0, 1]}
        return values | {
            f"R{i + 1}{j + 1}": R[i, j] for i in range(N) for j in range(i, N)
        }  # fmt: skip


@pytest.mark.parametrize("joints", [1, 2, 3, 4])
def test_regressor_times_parameters_is_the_torque_of_rigid_bodies(rig: Rig, joints: int) -> None:
    rng = np.random.default_rng(joints)
    chain, bodies = chain_rig(rig, joints), Bodies(joints, rng)
    q, qd, qdd = (rng.uniform(-a, a, (5, joints)) for a in (1.5, 3.0, 20.0))
    signals = signals_of(chain, q, qd, qdd, rng)
    values = bodies.parameters()
    found = np.zeros((5, joints))
    for term in (make("inertia"), make("gravity")):
        for name, columns in term.columns(chain, signals, ()).items():
            for parameter, column in columns.items():
                found[:, int(name[-1]) - 1] += values[parameter] * column
    wanted = np.array([bodies.torque(*row) for row in zip(q, qd, qdd, strict=True)])
    assert found == pytest.approx(wanted, rel=1e-6, abs=1e-6)


def test_the_mass_matrix_of_two_joints_is_the_one_of_the_notes() -> None:
    values = {"M1": 4.47, "M2": 1.27, "R12": 1.37}
    q = np.array([0.9, -1.3])
    M = mass_matrix(chain_matrix(values, 2), q)
    c = np.cos(q[1])
    wanted = [[4.47 + 2 * 1.37 * c, 1.27 + 1.37 * c], [1.27 + 1.37 * c, 1.27]]
    assert pytest.approx(np.array(wanted)) == M


@pytest.mark.parametrize("joints", [1, 2, 3])
def test_kernels_and_rows_are_the_same_equations(rig: Rig, joints: int) -> None:
    """Sum of columns times coefficients equals what the simulation would integrate."""
    rng = np.random.default_rng(joints)
    chain = chain_rig(rig, joints)
    values = {name: float(rng.uniform(0.5, 2.0)) for name in parameter_names(joints)}
    values["b"] = 2.3e8
    motion = (rng.uniform(-1, 1, (6, joints)) for _ in range(3))
    signals = signals_of(chain, *motion, rng)
    rows = {name: np.zeros(6) for name in right_sides(chain, signals)}
    for term in baseline():
        for name, columns in term.columns(chain, signals, ()).items():
            for c in term.coefficients(chain):
                if c.parameter in columns:
                    value = values[c.parameter]
                    rows[name] += columns[c.parameter] * (1 / value if c.reciprocal else value)
    for k in range(6):
        x = np.zeros((base.X_ROWS, joints))
        fields = ("q", "qd", "theta", "G", "s", "sd", "u", "p_cap", "p_rod", "V_cap", "V_rod")
        for row, field in enumerate(fields):
            x[row] = getattr(signals, field)[k]
        bench = np.array([0.0, signals.p_s[k], 0.0, 40.0])
        out, M = np.zeros((base.OUT_ROWS, joints)), np.zeros((joints, joints))
        for term in baseline():
            par = term.pack(chain, values, ())
            term.kernel.function(
                base.CONTRIBUTE, bench, x, np.zeros(0), par, out, M, np.zeros(0)
            )  # fmt: skip
        for i in range(joints):
            torque = M[i] @ signals.qdd[k] - out[base.TORQUE, i]
            cap = out[base.FLOW_CAP, i] - out[base.COMP_CAP, i] * signals.pd_cap[k, i]
            rod = out[base.FLOW_ROD, i] - out[base.COMP_ROD, i] * signals.pd_rod[k, i]
            assert torque == pytest.approx(rows[f"torque_{i + 1}"][k], rel=1e-9)
            assert cap == pytest.approx(rows[f"flow_cap_{i + 1}"][k], rel=1e-9, abs=1e-12)
            assert rod == pytest.approx(rows[f"flow_rod_{i + 1}"][k], rel=1e-9, abs=1e-12)


def test_every_baseline_parameter_belongs_to_exactly_one_term(rig: Rig) -> None:
    for joints in (1, 2, 3):
        chain = chain_rig(rig, joints)
        names = [c.parameter for term in baseline() for c in term.coefficients(chain)]
        assert sorted(names) == sorted(parameter_names(joints))
        assert [n for n in names if n in inertia_names(joints)] == list(inertia_names(joints))


def test_samples_beyond_tank_and_supply_are_marked_and_flow_the_other_way(rig: Rig) -> None:
    rng = np.random.default_rng(5)
    signals = signals_of(rig, *(rng.uniform(-1, 1, (4, 2)) for _ in range(3)), rng)
    signals.p_cap[1, 0] = -1e4
    signals.p_rod[2, 1] = 7.2e6
    valid = make("orifice").valid(rig, signals, ())
    assert valid["flow_cap_1"].tolist() == [True, False, True, True]
    assert valid["flow_rod_2"].tolist() == [True, True, False, True]
    columns = make("orifice").columns(rig, signals, ())
    opened, closed = signals.u[:, 0] > 0, signals.u[:, 0] < 0
    for name, at, sign in (("C_pp_1", opened, 1.0), ("C_pm_1", closed, -1.0)):
        inward = np.sign(columns["flow_cap_1"][name][at])
        below = np.flatnonzero(at) == 1
        # From the tank into a chamber below it; else out of the chamber, or in from the supply.
        assert inward.tolist() == np.where(below & (name == "C_pm_1"), -sign, sign).tolist()


def test_an_unknown_term_is_named_with_those_known() -> None:
    with pytest.raises(InputError, match=r"unknown term 'magic'.*inertia"):
        make("magic")
    assert "orifice" in known()
