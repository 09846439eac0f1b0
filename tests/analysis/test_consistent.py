"""Physically consistent parameters: an independent solver, real links, and what a user is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from analysis.identify.identify import identify
from analysis.identify.physical import feasible, physical, to_json, with_physics
from analysis.identify.result import Identification
from analysis.regression.constrained import minimise
from analysis.terms.mechanics import inertia_map
from rig.model.parameters import mechanical_names
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig
from tests.variants import kept

Array = NDArray[np.float64]


def random_chain(rng: np.random.Generator, lengths: Array) -> tuple[Array, Array]:
    """R and W of a chain of real links, by NOTES' sums, from masses, moments and inertias."""
    N = len(lengths)
    m = rng.uniform(1, 10, N)
    c = rng.uniform(-0.2, 1.0, N) * lengths
    inertia = m * c**2 + rng.uniform(1e-3, 1, N)
    R, W = np.zeros((N, N)), np.zeros(N)
    for k in range(N):
        beyond = m[k + 1 :].sum()
        W[k] = m[k] * c[k] + lengths[k] * beyond
        R[k, k] = inertia[k] + lengths[k] ** 2 * beyond
    for i in range(N):
        for j in range(i + 1, N):
            R[i, j] = R[j, i] = lengths[i] * W[j]
    return R, W


def oracle(X: Array, y: Array, length: float | None, rng: np.random.Generator) -> Array:
    """The same problem by SLSQP over Cholesky factors of R: consistent by construction."""

    def beta(z: Array) -> Array:
        L = np.array([[z[0], 0.0], [z[1], z[2]]])
        R = L @ L.T
        W2 = z[6] if length is None else R[0, 1] / length
        return np.array([R[0, 0] + R[1, 1], R[1, 1], R[0, 1], z[3], z[4], z[5], W2])

    best = None
    for _ in range(8):
        done = minimize(
            lambda z: np.sum((X @ beta(z) - y) ** 2) / np.sum(y**2),
            rng.uniform(0.2, 2.0, 7),
            bounds=[(None, None)] * 3 + [(0.0, None)] * 2 + [(None, None)] * 2,
            method="SLSQP",
            options={"maxiter": 500, "ftol": 1e-14},
        )
        if best is None or done.fun < best.fun:
            best = done
    assert best is not None
    return beta(best.x)


@pytest.mark.parametrize("rigid", [False, True])
@pytest.mark.parametrize("seed", kept(range(8), (1, 6)))
def test_the_solver_finds_what_an_independent_one_finds(rig: Rig, seed: int, rigid: bool) -> None:
    rng = np.random.default_rng(seed)
    set_ = feasible(rig, mechanical_names(2), rigid)
    X = rng.standard_normal((60, 7))
    # Truths that no body has: the data pull across the boundary.
    truth = rng.standard_normal(7) * np.array([1, 1, 2, 1, 1, 2, 2])
    y = X @ truth + 0.1 * rng.standard_normal(60)
    ours = minimise(X, y, set_).beta
    theirs = oracle(X, y, 0.5 if rigid else None, rng)
    cost = [float(np.sum((X @ b - y) ** 2)) for b in (ours, theirs)]
    assert cost[0] == pytest.approx(cost[1], rel=1e-6)
    assert ours == pytest.approx(theirs, abs=2e-3 * np.abs(theirs).max())
    assert (set_.positive @ ours > -1e-9).all()
    assert np.linalg.eigvalsh(set_.form(ours))[0] > -1e-9


def test_an_answer_that_is_consistent_already_is_left_alone(rig: Rig) -> None:
    rng = np.random.default_rng(1)
    R, W = random_chain(rng, np.array([0.5, 0.5]))
    beta = np.array([R[0, 0] + R[1, 1], R[1, 1], R[0, 1], 5.0, 1.0, *W])
    X = rng.standard_normal((50, 7))
    found = minimise(X, X @ beta, feasible(rig, mechanical_names(2), rigid=True))
    assert found.beta == pytest.approx(beta, rel=1e-9)


@pytest.mark.parametrize("joints", [2, 3, 4])
def test_the_constraints_are_those_of_real_links(rig: Rig, joints: int) -> None:
    """Every chain of bodies satisfies them."""
    chain = rig.model_copy(update={"joints": (rig.joints[0],) * joints})
    names = mechanical_names(joints)
    set_ = feasible(chain, names, rigid=True)
    lengths = np.array([joint.link_length for joint in chain.joints])
    index = {name: i for i, name in enumerate(names)}
    weights = inertia_map(joints)
    for seed in range(30):
        R, W = random_chain(np.random.default_rng(seed), lengths)
        beta = np.zeros(len(names))
        flat = np.linalg.lstsq(weights.reshape(len(weights), -1).T, R.ravel(), rcond=None)[0]
        beta[: len(flat)] = flat
        for k in range(joints):
            beta[index[f"W{k + 1}"]] = W[k]
        assert (set_.positive @ beta >= 0).all()
        assert np.linalg.eigvalsh(set_.form(beta))[0] >= 0
        assert set_.equal @ beta == pytest.approx(0.0, abs=1e-9)


@pytest.fixture(scope="module")
def identified(multisine_run: Run) -> Identification:
    return identify([multisine_run], estimator="plain")


def test_the_seed_bench_is_told_that_its_data_reject_rigid_bodies(
    identified: Identification,
) -> None:
    """Its truth has R12 = 0.415 m W2 where the link is 0.5 m long."""
    found = physical(identified)
    signs, rigid = found.levels
    assert not signs.rejected
    assert rigid.rejected
    price = rigid.costs["mechanical"]
    assert price.active == ("R12 = l1 W2",)
    assert price.residual > 0.5
    assert price.p < 1e-6
    returned = with_physics(identified, found)
    assert returned.estimates["W2"].value == pytest.approx(3.30, rel=0.01)
    last = returned.checks[-1]
    assert not last.ok
    assert "REJECTED by the data" in last.detail
    assert "(-16.9%" in last.detail  # 1.37 / (0.5 * 3.30) - 1
    assert returned.model.provenance["physical"] == "signs"
    R12, W2 = rigid.estimates["R12"].value, rigid.estimates["W2"].value
    assert pytest.approx(0.5 * W2) == R12
    assert to_json(found)["given"] == "signs"


def test_links_of_the_right_length_are_accepted(multisine_run: Run) -> None:
    """The same records with the length that the truth has: the constraint costs nothing."""
    true = 1.37 / 3.30
    first = multisine_run.rig.joints[0].model_copy(update={"link_length": true})
    joints = (first, multisine_run.rig.joints[1])
    rig = multisine_run.rig.model_copy(update={"joints": joints})
    free = identify([replace(multisine_run, rig=rig)], estimator="plain")
    found = physical(free)
    rigid = found.levels[1]
    assert not rigid.rejected
    assert found.returned == 1
    assert rigid.costs["mechanical"].residual < 1e-3
    returned = with_physics(free, found).estimates
    assert returned["R12"].value == pytest.approx(true * returned["W2"].value)
    # What is known need not be measured: the scatter of what it binds falls.
    assert returned["R12"].std < free.estimates["R12"].std


def test_friction_that_pushes_is_pulled_to_zero_and_its_price_said(
    identified: Identification,
) -> None:
    solution = identified.solutions["mechanical"]
    i = solution.names.index("Fv2")
    value = solution.value.copy()
    value[i] = -0.5
    triangle = solution.triangle.copy()
    triangle[:-1, -1] += triangle[:-1, :-1] @ (value - solution.value)
    moved = replace(solution, value=value, triangle=triangle)
    found = physical(replace(identified, solutions={**identified.solutions, "mechanical": moved}))
    signs = found.levels[0]
    assert signs.estimates["Fv2"].value == pytest.approx(0.0, abs=1e-4)
    assert signs.costs["mechanical"].active == ("Fv2 >= 0",)
    assert signs.costs["mechanical"].residual > 0


def test_without_scatter_to_judge_by_compatibility_is_not_claimed(
    identified: Identification,
) -> None:
    solution = identified.solutions["mechanical"]
    blind = replace(solution, covariance=np.full_like(solution.covariance, np.nan))
    found = physical(replace(identified, solutions={**identified.solutions, "mechanical": blind}))
    assert np.isnan(found.levels[1].costs["mechanical"].p)
    assert "too few" in found.checks[1].detail


def test_a_parameter_that_is_not_identified_is_named(multisine_run: Run) -> None:
    half = tuple(r for r in multisine_run.records if r.step == "step1")
    free = identify([replace(multisine_run, records=half)], estimator="plain")
    with pytest.raises(InputError, match="W1"):
        physical(free)
