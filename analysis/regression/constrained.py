"""Least squares under linear equalities, linear inequalities and a linear matrix inequality.

    minimise |X beta - y|^2   subject to   E beta = 0,   G beta >= 0,   sum_i beta_i F_i >= 0

The problem is convex, so the minimum is global. The equalities are eliminated with a basis of their
null space, the inequalities enter as logarithmic barriers, and Newton's method follows the central
path until the duality gap, (number of inequalities) / t, is negligible against |y|^2. Source: Boyd
and Vandenberghe, Convex Optimization, sections 11.3 and 11.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from analysis.regression.least_squares import Array, least_squares
from analysis.regression.settings import REGRESSION
from rig.model.parse import InputError


@dataclass(frozen=True)
class Feasible:
    """Constraints on beta (k,): E (e, k), G (g, k) and the symmetric forms F (k, n, n), labelled.

    n = 0 where there is no matrix inequality.
    """

    equal: Array
    equal_labels: tuple[str, ...]
    positive: Array
    positive_labels: tuple[str, ...]
    forms: Array
    form_label: str = ""

    def form(self, beta: Array) -> Array:
        """Return sum_i beta_i F_i (n, n)."""
        return np.asarray(np.tensordot(beta, self.forms, axes=1))


@dataclass(frozen=True)
class Minimum:
    """The constrained solution with its active constraints C beta = 0: rows C (q, k) and labels."""

    beta: Array
    active: Array
    labels: tuple[str, ...]


def minimise(X: Array, y: Array, feasible: Feasible) -> Minimum:
    """Solve the problem for rows or a triangle X (m, k), y (m,); raises InputError if it cannot."""
    scale = np.linalg.norm(X, axis=0)
    if not (scale > 0).all():
        raise InputError("the rows leave a parameter undetermined; nothing can be constrained")
    basis = null_space(feasible.equal / scale) if len(feasible.equal) else np.eye(len(scale))
    A = X / scale @ basis
    G = (feasible.positive / scale) @ basis
    G = G / np.maximum(np.linalg.norm(G, axis=1, keepdims=True), 1e-300)
    F = np.tensordot(basis.T, feasible.forms / scale[:, None, None], axes=1)
    F = F / max(float(np.abs(F).max(initial=0.0)), 1e-300)
    x = least_squares(A, y)
    unconstrained = x
    if not _is_inside(x, G, F):
        x = _follow(A, y, G, F, _interior(x, G, F))
    beta = basis @ x / scale
    rows, labels = list(feasible.equal), list(feasible.equal_labels)
    for label, row, slack, violation in zip(
        feasible.positive_labels, feasible.positive, G @ x, -(G @ unconstrained), strict=True
    ):
        if slack <= REGRESSION.active_share * abs(violation) and violation > 0:
            rows.append(row)
            labels.append(label)
    if F.shape[1] and (lowest := _smallest_eigenvalue(unconstrained, F)) < 0:
        values, vectors = np.linalg.eigh(np.tensordot(x, F, axes=1))
        for value, v in zip(values, vectors.T, strict=True):
            if value <= REGRESSION.active_share * abs(lowest):
                rows.append(np.einsum("i,kij,j->k", v, feasible.forms, v))
                labels.append(feasible.form_label)
    return Minimum(beta, np.array(rows).reshape(len(rows), len(scale)), tuple(labels))


def _smallest_eigenvalue(x: Array, F: Array) -> float:
    return float(np.linalg.eigvalsh(np.tensordot(x, F, axes=1))[0])


def _is_inside(x: Array, G: Array, F: Array, shift: Array | float = 0.0) -> bool:
    return bool((G @ x + shift > 0).all()) and (not F.shape[1] or _smallest_eigenvalue(x, F) > 0)


def _barrier(
    x: Array, G: Array, F: Array, shift: Array | float = 0.0
) -> tuple[float, Array, Array]:
    """Return - sum log(Gx + shift) - log det F(x), its gradient and Hessian; x inside."""
    c = G @ x + shift
    value, gradient = -float(np.log(c).sum()), -G.T @ (1.0 / c)
    hessian = (G / c[:, None] ** 2).T @ G
    if F.shape[1]:
        P = np.tensordot(x, F, axes=1)
        inverse = np.linalg.inv(P)
        inverse_forms = np.einsum("ij,kjl->kil", inverse, F)
        value -= float(np.linalg.slogdet(P)[1])
        gradient = gradient - np.einsum("kii->k", inverse_forms)
        hessian = hessian + np.einsum("kij,lji->kl", inverse_forms, inverse_forms)
    return value, gradient, hessian


def _interior(x: Array, G: Array, F: Array) -> Array:
    """Return a point strictly inside, by reducing a common slack s below zero.

    Raises InputError where the constraints leave no interior.
    """
    n = F.shape[1]
    G_slack = np.vstack((np.column_stack((G, np.ones(len(G)))), np.zeros((1, len(x) + 1))))
    G_slack[-1, -1] = 1.0  # with `shifted`: s > -size, without which s has no lower bound
    size = max(float(np.linalg.norm(x)), 1.0)
    F_slack = np.concatenate((F, np.eye(n)[None]))
    worst = float(np.min(G @ x, initial=0.0))
    worst = min(worst, _smallest_eigenvalue(x, F)) if n else worst
    z = np.append(x, -2.0 * worst + size)
    target, t = np.zeros(len(z)), 1.0
    for _ in range(400):
        shifted = np.append(np.zeros(len(G)), size)
        _, gradient, hessian = _barrier(z, G_slack, F_slack, shifted)
        target[:] = 0.0
        target[-1] = t / size
        # Staying near the unconstrained solution keeps the search bounded.
        pull = 1e-3 * np.append(z[:-1] - x, 0.0) / size**2
        ridge = 1e-3 * np.diag(np.append(np.ones(len(x)), 0.0)) / size**2
        step = -np.linalg.solve(hessian + ridge, gradient + target + pull)
        length = 1.0
        while length > 1e-12 and not _is_inside(z + length * step, G_slack, F_slack, shifted):
            length *= 0.5
        z = z + 0.9 * length * step
        if z[-1] < 0 and _is_inside(z[:-1], G, F):
            return np.asarray(z[:-1])
        t *= 1.2
    raise InputError("the constraints leave no parameter set strictly inside them")


def _follow(A: Array, y: Array, G: Array, F: Array, x: Array) -> Array:
    """Follow the central path from x, strictly inside, to the minimum."""
    constraints = len(G) + F.shape[1]
    size = max(float(y @ y), 1e-300)
    H, g = A.T @ A, A.T @ y
    t = constraints / size
    while True:
        for _ in range(REGRESSION.newton_steps):
            value, gradient, hessian = _barrier(x, G, F)
            slope = t * (H @ x - g) + gradient
            step = -np.linalg.solve(t * H + hessian, slope)
            decrement = -float(slope @ step)
            if decrement < 1e-10:
                break
            objective = 0.5 * t * float(x @ H @ x - 2 * g @ x) + value
            length = 1.0
            while length > 1e-14:
                trial = x + length * step
                if _is_inside(trial, G, F):
                    trial_objective = 0.5 * t * float(trial @ H @ trial - 2 * g @ trial)
                    trial_objective += _barrier(trial, G, F)[0]
                    if trial_objective <= objective - 0.1 * length * decrement:
                        break
                length *= 0.5
            else:
                break  # rounding: the path cannot be followed more closely
            x = x + length * step
        if constraints / t < REGRESSION.duality_gap * size:
            return x
        t *= REGRESSION.path_factor
