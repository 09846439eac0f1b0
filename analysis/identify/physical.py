"""Physically possible parameters (rigid bodies, real oil), and their cost in the residual.

Level 1, *signs*: friction, flow gains and 1/b are not negative, and the chain's R is positive
semidefinite. M_ij(q) sums R_kl cos(theta_k - theta_l) (`terms.mechanics`), and the cosines form a
Gram matrix, so by Schur's product theorem M(q) is then so in every posture; with all links in line
M(q) is made of R alone, so no weaker condition holds in all postures. Level 2, *rigid bodies*: R_ij
= l_i W_j for i < j besides, l_i being the rig's link lengths (`terms.mechanics`). Both levels
together say exactly that there are links with masses m_k > 0, first moments h_k and pseudo-inertias
[[I_k, h_k], [h_k, m_k]] >= 0 behind the parameters:
    R_kk = I_k + l_k^2 m_beyond(k),  W_k = h_k + l_k m_beyond(k),  m_beyond(k) = sum_{j>k} m_j;
eliminating the links from the tip inwards takes the same Schur complements as R >= 0.

Solved as constrained least squares on the triangle that the identification has made already: the
consistent parameters are those nearest to the free ones in the metric X'X of all rows. A
constraint that moves the parameters further than their scatter between repeats explains is
*rejected by the data* (Hotelling's T^2 on the active constraints, cluster covariance), and the
level below is returned instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from analysis.identify.checks import Check
from analysis.identify.geometry import GeometryShifts
from analysis.identify.result import Identification, estimates_of
from analysis.identify.settings import IDENTIFY
from analysis.regression.constrained import Feasible, Minimum, minimise
from analysis.regression.solve import Solution
from analysis.simulation.model import Estimate, estimate_json, finite
from analysis.terms.mechanics import chain_matrix, inertia_map
from rig.model.parameters import inertia_names
from rig.model.parse import InputError
from rig.model.rig import Rig

Array = NDArray[np.float64]

LEVELS = ("signs", "rigid bodies")


@dataclass(frozen=True)
class Cost:
    """The cost of a level for one family; `residual` is the relative growth of the residual's rms.

    `active` names the active constraints, `gap` states by how much the unconstrained estimate
    violates each; `p` is the p value of all violations, NaN where it cannot be judged.
    """

    residual: float
    active: tuple[str, ...]
    gap: tuple[str, ...]
    p: float

    @property
    def rejected(self) -> bool:
        """Whether the data contradict the constraints."""
        return bool(self.p < IDENTIFY.rejected_level)


@dataclass(frozen=True)
class Level:
    """One level's parameters and their cost by family."""

    name: str
    estimates: Mapping[str, Estimate]
    covariance: Array
    costs: Mapping[str, Cost]
    geometry: GeometryShifts | None = None  # without the directions of active constraints

    @property
    def rejected(self) -> bool:
        """Whether any family's data contradict it."""
        return any(cost.rejected for cost in self.costs.values())


@dataclass(frozen=True)
class Physical:
    """The free estimates, both levels, and the index of the level returned."""

    free: Mapping[str, Estimate]
    levels: tuple[Level, ...]
    returned: int

    @property
    def checks(self) -> tuple[Check, ...]:
        """One statement for each level."""
        return tuple(_statement(level) for level in self.levels)


def feasible(rig: Rig, names: tuple[str, ...], rigid: bool) -> Feasible:
    """Return the constraints on one family's coefficients, `names` in the rows' order."""
    k, N = len(names), len(rig.joints)
    index = {name: i for i, name in enumerate(names)}
    signed = [n for n in names if n == "b" or n.startswith(("Fv", "C_"))]
    positive = np.zeros((len(signed), k))
    for row, name in zip(positive, signed, strict=True):
        row[index[name]] = 1.0
    labels = tuple(f"{'1/b' if name == 'b' else name} >= 0" for name in signed)
    inertia = inertia_names(N)
    forms = np.zeros((k, 0, 0))
    equal, equal_labels = np.zeros((0, k)), tuple[str, ...]()
    if all(name in index for name in inertia):
        forms = np.zeros((k, N, N))
        weights = inertia_map(N)
        for name, weight in zip(inertia, weights, strict=True):
            forms[index[name]] = weight
        if rigid:
            equal, equal_labels = _rigid(rig, index, weights)
    return Feasible(equal, equal_labels, positive, labels, forms, "R positive definite")


def _rigid(rig: Rig, index: Mapping[str, int], weights: Array) -> tuple[Array, tuple[str, ...]]:
    """Return the rows of R_ij - l_i W_j = 0, i < j, with labels, where l_i and W_j exist."""
    N = len(rig.joints)
    inertia, rows, labels = inertia_names(N), [], []
    for i in range(N):
        length = rig.joints[i].link_length  # an electric rig may omit it
        for j in range(i + 1, N):
            if length is None or f"W{j + 1}" not in index:
                continue
            row = np.zeros(len(index))
            for name, weight in zip(inertia, weights, strict=True):
                row[index[name]] = weight[i, j]
            row[index[f"W{j + 1}"]] = -length
            rows.append(row)
            labels.append(f"R{i + 1}{j + 1} = l{i + 1} W{j + 1}")
    return np.array(rows).reshape(len(rows), len(index)), tuple(labels)


def physical(result: Identification) -> Physical:
    """Return the parameters of both levels and their cost in the residual.

    Raises InputError where a parameter is not identified, because nothing can be constrained then.
    """
    unidentified = [n for n, e in result.estimates.items() if not e.identified]
    if unidentified:
        raise InputError(
            f"--physical needs every parameter identified, and {' '.join(unidentified)} is not; "
            "record the step that excites it"
        )
    levels = tuple(_level(result, name, rigid=bool(k)) for k, name in enumerate(LEVELS))
    accepted = [k for k, level in enumerate(levels) if not level.rejected]
    # Signs hold for every body: level 1 is the last resort even where the data contradict it.
    return Physical(result.estimates, levels, max(accepted, default=0))


def with_physics(result: Identification, physical: Physical) -> Identification:
    """Return the identification with the consistent parameters in place of the free ones."""
    level = physical.levels[physical.returned]
    model = replace(result.model, parameters=level.estimates, covariance=level.covariance)
    constrained = replace(result, model=model, geometry=level.geometry)
    return constrained.with_checks((*result.checks, *physical.checks), physical=level.name)


def _level(result: Identification, name: str, rigid: bool) -> Level:
    rig, geometry = result.model.rig, result.geometry
    solutions, costs, shifts = {}, {}, {}
    for family, solution in result.solutions.items():
        k = len(solution.names)
        X, y = solution.triangle[:k, :k], solution.triangle[:k, k]
        # An estimator's solution may differ from the triangle's: project the estimator's.
        minimum = minimise(X, X @ solution.value, feasible(rig, solution.names, rigid))
        P = _projection(X, minimum)
        solutions[family] = free = solution
        if len(minimum.active):  # no variance across active constraints
            covariance = P @ solution.covariance @ P.T
            solutions[family] = replace(solution, value=minimum.beta, covariance=covariance)
        if geometry is not None:
            shifts[family] = P @ geometry.shifts[family]
            free = replace(solution, covariance=solution.covariance + geometry.covariance(family))
        costs[family] = _cost(rig, free, X, y, minimum)
    estimates, covariance = estimates_of(rig, result.model.terms, solutions)
    if geometry is not None:
        geometry = replace(geometry, shifts=shifts)
        estimates, covariance = geometry.widened(estimates, covariance)
    return Level(name, estimates, covariance, costs, geometry)


def _projection(X: Array, minimum: Minimum) -> Array:
    """Return P (k, k), which projects a small change onto the null space of active constraints."""
    k, C = len(minimum.beta), minimum.active
    if not len(C):
        return np.eye(k)
    scale = 1.0 / np.linalg.norm(X, axis=0)
    A = (X * scale).T @ (X * scale)
    constraints = C * scale
    lever = np.linalg.solve(A, constraints.T)
    P = np.eye(k) - lever @ np.linalg.pinv(constraints @ lever) @ constraints
    return np.asarray(P * np.outer(scale, 1.0 / scale))


def _cost(rig: Rig, solution: Solution, X: Array, y: Array, minimum: Minimum) -> Cost:
    k, C = len(minimum.beta), minimum.active
    if not len(C):
        return Cost(0.0, (), (), 1.0)
    rest = solution.triangle[k, k] ** 2
    before = float(np.sum((y - X @ solution.value) ** 2)) + rest
    after = float(np.sum((y - X @ minimum.beta) ** 2)) + rest
    growth = float(np.sqrt(after / before) - 1.0) if before > 0 else 0.0
    violation = C @ solution.value
    gap = tuple(
        _constraint_text(label, rig, solution, row, value)
        for label, row, value in zip(minimum.labels, C, violation, strict=True)
    )
    return Cost(growth, minimum.labels, gap, _probability(solution, C, violation))


def _constraint_text(label: str, rig: Rig, solution: Solution, row: Array, violation: float) -> str:
    """State by how much the unconstrained estimate violates one active constraint."""
    std = float(np.sqrt(row @ solution.covariance @ row))
    far = f", {abs(violation) / std:.3g} standard errors" if std > 0 else ""
    if "=" not in label or ">=" in label:
        return f"{label}: the data alone give {violation:.3g}{far}"
    i, j = (int(d) for d in label[1:3])
    values = dict(zip(solution.names, solution.value, strict=True))
    R = chain_matrix(values, len(rig.joints))[i - 1, j - 1]
    rigid = rig.joints[i - 1].link_length * values[f"W{j}"]
    return (
        f"{label}: the data alone give {R:.4g} and {rigid:.4g} kg m^2 ({R / rigid - 1:+.1%}{far})"
    )


def _probability(solution: Solution, C: Array, violation: Array) -> float:
    """Return p of T^2 = d' (C V C')^-1 d (Hotelling), with the least dof of the parameters in C."""
    V = C @ solution.covariance @ C.T
    dof = float(np.min(solution.dof[np.abs(C).sum(axis=0) > 0]))
    q = len(C)
    if not np.isfinite(V).all() or np.linalg.matrix_rank(V, hermitian=True) < q:
        return float("nan")
    denominator_dof = dof - q + 1.0
    if not denominator_dof > 0:
        return float("nan")
    t2 = float(violation @ np.linalg.solve(V, violation))
    return float(fdtrc(q, denominator_dof, t2 * denominator_dof / (dof * q)))


def _statement(level: Level) -> Check:
    active = [label for cost in level.costs.values() for label in cost.active]
    name = f"physical: {level.name}"
    if not active:
        return Check(name, True, "the free estimate satisfies it already: nothing was changed")
    costs = "; ".join(
        f"{family}: residual {cost.residual:+.3%}, {_verdict(cost)} ({'; '.join(cost.gap)})"
        for family, cost in level.costs.items()
        if cost.active
    )
    return Check(name, not level.rejected, costs)


def _verdict(cost: Cost) -> str:
    if not np.isfinite(cost.p):
        return "the repeats are too few to test it against the data"
    word = "REJECTED by the data" if cost.rejected else "compatible with the data"
    return f"{word}, p = {cost.p:.2g}"


def to_json(physical: Physical) -> dict[str, Any]:
    """Return both levels as plain data."""
    return {
        "given": physical.levels[physical.returned].name,
        "levels": [
            {
                "name": level.name,
                "rejected": level.rejected,
                "parameters": {n: estimate_json(e) for n, e in level.estimates.items()},
                "price": {
                    family: {
                        "residual_growth": finite(cost.residual),
                        "active": list(cost.active),
                        "p_value": finite(cost.p),
                    }
                    for family, cost in level.costs.items()
                },
            }
            for level in physical.levels
        ],
    }
