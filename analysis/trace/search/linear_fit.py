"""Linear fit: the energy that the columns of candidates remove, alone and in pairs.

All columns are made orthogonal to the baseline's, whose coefficients absorb the part of them along
its own columns. On the projected columns D (M, V) and residual r (M,), with K = D'D and c = D'r,
the energy that a candidate with columns j removes (its gain) is c_j' K_jj^-1 c_j. Beside another
candidate K and c change by a Schur complement, so that pairs of the whole catalogue cost products
of small matrices only. Of candidates that leave about the same energy, the one with the fewest free
numbers comes first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.regression.least_squares import shortest
from analysis.trace.data.regression_data import RegressionData, VariantColumns
from analysis.trace.settings import SEARCH, TRACE

Array = NDArray[np.float64]
Key = tuple[str, str]


@dataclass(frozen=True)
class CandidateColumns:
    """Candidates (`entries`) with columns orthogonal to the data's own.

    `columns` (M, V), `K` (V, V) their products, `basis` (M, r) of the data's own columns, `groups`
    the column numbers of each entry, `visibility_limit` (V,) the squared lengths from which columns
    count, `rows` the row numbers of each equation, `band` its noise band, `size` the free numbers
    of each entry. `admissible(entry, coefficients)` says whether physics allows these sizes.
    """

    entries: tuple[VariantColumns, ...]
    columns: Array
    K: Array
    basis: Array
    groups: tuple[tuple[int, ...], ...]
    visibility_limit: Array
    rows: dict[str, Array]
    band: dict[str, float]
    size: tuple[int, ...]
    admissible: Callable[[VariantColumns, Array], bool]


@dataclass(frozen=True)
class LinearFit:
    """A fitted set of candidates with its energy above noise by equation.

    `members` are numbers of entries, `coefficients` the fitted ones of each.
    """

    members: tuple[int, ...]
    coefficients: tuple[Array, ...]
    excess_energy: dict[str, float]

    @property
    def total(self) -> float:
        """Energy above noise of all equations, each counted as at least zero."""
        return sum(max(0.0, e) for e in self.excess_energy.values())


def project(
    data: RegressionData, columns: Sequence[VariantColumns], size: Callable[[VariantColumns], int],
    admissible: Callable[[VariantColumns, Array], bool], mask: Array | None = None,
) -> CandidateColumns:  # fmt: skip
    """Return the entries with columns orthogonal to the data's own.

    `mask` (M,) is 0 for rows that are not used.
    """
    used = np.ones(data.base.shape[0]) if mask is None else mask
    basis = orthonormal(data.base * used[:, None])
    groups, start = [], 0
    for entry in columns:
        groups.append(tuple(range(start, start + entry.columns.shape[1])))
        start += entry.columns.shape[1]
    stack = np.column_stack([e.columns for e in columns]) if columns else np.zeros((len(used), 0))
    stack = stack * used[:, None]
    names = [name for entry in columns for name in entry.names]
    shows = (SEARCH.least_exact_length if n else SEARCH.least_projected_length for n in names)
    least = np.square(list(shows)) * np.sum(stack**2, axis=0)
    projected = stack - basis @ (basis.T @ stack)
    rows: dict[str, list[Array]] = {}
    band: dict[str, float] = {}
    for segment in data.segments:
        where = np.arange(segment.where.start, segment.where.stop)
        where = where[used[where] > 0]
        rows.setdefault(segment.equation, []).append(where)
        noise = SEARCH.band**2 * segment.repeats * len(where)
        band[segment.equation] = band.get(segment.equation, 0.0) + noise
    return CandidateColumns(
        tuple(columns), projected, projected.T @ projected, basis, tuple(groups), least,
        {name: np.concatenate(parts) for name, parts in rows.items()}, band,
        tuple(size(entry) for entry in columns), admissible,
    )  # fmt: skip


def orthonormal(columns: Array, rank: float = TRACE.rank_limit) -> Array:
    """Return an orthonormal basis (M, r) of the columns' span.

    Directions of the scaled columns below `rank` times the largest singular value are left out.
    """
    scale = np.linalg.norm(columns, axis=0)
    scaled = columns[:, scale > 0] / scale[scale > 0]
    U, sigma, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(U[:, sigma > rank * sigma[0]]) if len(sigma) else U


def gains(K: Array, c: Array, groups: Sequence[tuple[int, ...]], visibility_limit: Array) -> Array:
    """Return the energy that each group of columns removes, 0 for groups without a visible column.

    `visibility_limit` (V,) holds the squared lengths from which columns count.
    """
    out = np.zeros(len(groups))
    for g, group in enumerate(groups):
        shown = [j for j in group if K[j, j] > visibility_limit[j]]
        if len(shown) == 1:
            out[g] = c[shown[0]] ** 2 / K[shown[0], shown[0]]
        elif shown:
            index = np.ix_(shown, shown)
            out[g] = c[shown] @ np.linalg.pinv(K[index], rcond=1e-6, hermitian=True) @ c[shown]
    return out


def schur_complement(K: Array, c: Array, group: Sequence[int]) -> tuple[Array, Array]:
    """Return K (V, V) and c (V,) after the fit of the columns of `group`."""
    j = list(group)
    inverse = np.linalg.pinv(K[np.ix_(j, j)], rcond=1e-8, hermitian=True)
    return K - K[:, j] @ inverse @ K[j], c - K[:, j] @ (inverse @ c[j])


def fit_members(candidates: CandidateColumns, members: Sequence[int], r: Array) -> LinearFit:
    """Fit a set to the projected whitened residual r (M,)."""
    columns = [j for m in members for j in candidates.groups[m]]
    residual, parts = r, []
    if columns:
        D = candidates.columns[:, columns]
        fit = shortest(D, r, 1e-6)
        residual = r - D @ fit
        start = 0
        for m in members:
            parts.append(fit[start : start + len(candidates.groups[m])])
            start += len(candidates.groups[m])
    excess_energy = {
        e: float(residual[w] @ residual[w]) - len(w) for e, w in candidates.rows.items()
    }
    return LinearFit(tuple(members), tuple(parts), excess_energy)


def sets_with_one_more(
    candidates: CandidateColumns, members: Sequence[int], r: Array, left_out: Collection[Key] = ()
) -> list[LinearFit]:
    """Return the sets with one more entry that removes enough energy, the best set first.

    Effects `left_out` (name, where) are not added.

    Sets that leave about the least come first, ordered by their count of free numbers; then the
    others by the energy that they leave.
    """
    current = fit_members(candidates, members, r)
    K, c = candidates.K, candidates.columns.T @ r
    for m in members:
        K, c = schur_complement(K, c, candidates.groups[m])
    g = gains(K, c, candidates.groups, candidates.visibility_limit)
    taken = {candidates.entries[m].used.term.key for m in members} | set(left_out)
    trials: list[LinearFit] = []
    for i in _best_of_each(candidates, g):
        entry = candidates.entries[i]
        if g[i] <= 0 or entry.used.term.key in taken:
            continue
        remaining = sum(max(0.0, current.excess_energy.get(e, 0.0)) for e in entry.touched)
        if g[i] < SEARCH.add_share * remaining:
            continue
        trial = fit_members(candidates, (*members, i), r)
        sizes = zip(trial.members, trial.coefficients, strict=True)
        if all(candidates.admissible(candidates.entries[m], k) for m, k in sizes):
            trials.append(trial)
    if not trials:
        return []
    best = min(t.total for t in trials)
    limit = max(SEARCH.simpler_ratio * best, best + 0.1 * sum(candidates.band.values()))

    def size(trial: LinearFit) -> int:
        return sum(candidates.size[m] for m in trial.members)

    similar = sorted((t for t in trials if t.total <= limit), key=lambda t: (size(t), t.total))
    return similar + sorted((t for t in trials if t.total > limit), key=lambda t: t.total)


def _best_of_each(candidates: CandidateColumns, g: Array) -> list[int]:
    """Return the entries with the largest gains g (V,), at most a few shapes of each effect.

    Otherwise the shapes of one effect, fitted with an impossible number, could fill the list.
    """
    fitted: Counter[Key] = Counter()
    best: list[int] = []
    for i in map(int, np.argsort(-g)):
        key = candidates.entries[i].used.term.key
        fitted[key] += 1
        if fitted[key] <= SEARCH.shapes_fitted:
            best.append(i)
        if len(best) == SEARCH.full_fits:
            break
    return best


def best_pairs(
    candidates: CandidateColumns, r: Array, left_out: Collection[Key] = ()
) -> list[LinearFit]:
    """Return the pairs of different candidates that leave least; each alone may remove little.

    Effects `left_out` (name, where) are in none.
    """
    best_variant = _best_variants(candidates, r, left_out, 6 * SEARCH.pair_starts)
    pairs: dict[frozenset[Key], LinearFit] = {}
    for first in list(best_variant.values())[: SEARCH.pair_starts]:
        for pair in sets_with_one_more(candidates, (first,), r, left_out)[:3]:
            keys = frozenset(candidates.entries[m].used.term.key for m in pair.members)
            if keys not in pairs or pair.total < pairs[keys].total:
                pairs[keys] = pair
    return sorted(pairs.values(), key=lambda p: p.total)[: SEARCH.refined_pairs]


def _best_variants(
    candidates: CandidateColumns, r: Array, left_out: Collection[Key], most: int | None = None
) -> dict[Key, int]:
    """Return the entry of each effect that removes most, the best first; of the `most` best ones.

    Effects `left_out` (name, where) and those that remove nothing are not among them.
    """
    g = gains(
        candidates.K, candidates.columns.T @ r, candidates.groups, candidates.visibility_limit
    )
    best: dict[Key, int] = {}
    for i in map(int, np.argsort(-g)[:most]):
        key = candidates.entries[i].used.term.key
        if g[i] > 0 and key not in left_out:
            best.setdefault(key, i)
    return best


def pairs_of_chambers(
    candidates: CandidateColumns, r: Array, left_out: Collection[Key] = ()
) -> list[LinearFit]:
    """Return the pairs of one effect at both chambers of a joint, those that leave least first.

    Both pipes longer than stated, or both pressures read against vacuum, are as likely as one, and
    details of form that the columns lack may hide each alone. Effects `left_out` are in none.
    """
    best = _best_variants(candidates, r, left_out)
    others = {(name, where): (name, where.removesuffix("cap") + "rod") for name, where in best}
    pairs = [
        fit_members(candidates, (best[cap], best[rod]), r)
        for cap, rod in others.items() if cap[1].endswith(" cap") and rod in best
    ]  # fmt: skip
    return sorted(pairs, key=lambda pair: pair.total)[: SEARCH.refined_pairs]
