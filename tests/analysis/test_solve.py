"""The coupled solution against scipy and against the textbook's formula, written out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import lstsq

from analysis.regression.solve import RowCluster, half_width, merge, solve, triangle

NAMES = ("a", "b", "c")


def data(rng: np.random.Generator, clusters: int, rows: int = 200) -> list[tuple]:
    """Columns of wildly different size, noise correlated within a cluster."""
    out = []
    for _ in range(clusters):
        X = rng.standard_normal((rows, 3)) * [1e6, 1.0, 1e-4]
        common = rng.standard_normal() * X[:, 1]
        y = X @ [2e-6, -3.0, 5e4] + 0.1 * rng.standard_normal(rows) + 0.05 * common
        out.append((X, y))
    return out


def as_clusters(blocks: list[tuple], per_stratum: int) -> list[RowCluster]:
    return [
        RowCluster(k // per_stratum, k % per_stratum, triangle(X, y), len(y))
        for k, (X, y) in enumerate(blocks)
    ]


def test_merged_triangles_solve_what_scipy_solves_on_all_rows() -> None:
    blocks = data(np.random.default_rng(0), 12)
    solution = solve(NAMES, as_clusters(blocks, 4))
    X = np.vstack([b[0] for b in blocks])
    y = np.concatenate([b[1] for b in blocks])
    assert solution.value == pytest.approx(lstsq(X, y)[0], rel=1e-10)
    scaled = X / np.linalg.norm(X, axis=0)
    assert solution.condition_number == pytest.approx(np.linalg.cond(scaled), rel=1e-8)
    residual = y - X @ solution.value
    assert solution.residual_rms == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-9)
    assert solution.rows == len(y)


def test_triangles_merge_in_any_order() -> None:
    blocks = data(np.random.default_rng(1), 5)
    parts = [triangle(X, y) for X, y in blocks]
    one = merge(parts)
    two = merge([merge(parts[3:]), merge(parts[:3])])
    assert one.T @ one == pytest.approx(two.T @ two, rel=1e-10)


def test_a_triangle_of_fewer_rows_than_columns_is_still_one() -> None:
    X, y = np.array([[1.0, 2.0, 3.0]]), np.array([4.0])
    R = triangle(X, y)
    assert R.shape == (4, 4)
    assert pytest.approx(np.outer([1, 2, 3, 4], [1, 2, 3, 4])) == R.T @ R


def test_errors_are_the_stratified_cluster_formula_on_the_rows_themselves() -> None:
    blocks = data(np.random.default_rng(2), 10)
    solution = solve(NAMES, as_clusters(blocks, 5))
    X = np.vstack([b[0] for b in blocks])
    scale = np.linalg.norm(X, axis=0)
    bread = np.linalg.inv((X / scale).T @ (X / scale))
    total = np.zeros((3, 3))
    for stratum in (blocks[:5], blocks[5:]):
        g = np.array([(a / scale).T @ (y - a @ solution.value) for a, y in stratum])
        g -= g.mean(axis=0)
        total += 5 / 4 * g.T @ g
    covariance = bread @ total @ bread / np.outer(scale, scale)
    assert solution.covariance == pytest.approx(covariance, rel=1e-6)
    assert ((solution.dof >= 4) & (solution.dof <= 8)).all()


def test_intervals_cover_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(3)
    truth = np.array([2e-6, -3.0, 5e4])
    hits = np.zeros(3)
    for _ in range(400):
        solution = solve(NAMES, as_clusters(data(rng, 8, rows=30), 8))
        half = half_width(np.sqrt(np.diag(solution.covariance)), solution.dof)
        hits += np.abs(solution.value - truth) <= half
    # 95 % +- 4 standard errors of the count; the errors within a cluster are correlated.
    assert (hits / 400 > 0.90).all()
    assert (hits / 400 < 0.99).all()


def test_a_column_without_rows_is_unidentifiable_and_the_rest_is_not() -> None:
    blocks = [(X * [1, 1, 0], y) for X, y in data(np.random.default_rng(4), 4)]
    solution = solve(NAMES, as_clusters(blocks, 4))
    assert solution.unidentifiable == {"c": "no row contains it"}
    assert np.isnan(solution.value[2])
    assert np.isnan(solution.covariance[2]).all()
    assert np.isfinite(solution.value[:2]).all()


def test_parameters_that_only_show_together_are_named_together() -> None:
    blocks = []
    for X, y in data(np.random.default_rng(5), 4):
        X[:, 2] = 7.0 * X[:, 1]
        blocks.append((X, y))
    solution = solve(NAMES, as_clusters(blocks, 4))
    assert set(solution.unidentifiable) == {"b", "c"}
    assert "combination with c" in solution.unidentifiable["b"]
    assert np.isfinite(solution.value[0])
