"""What two plain methods make of the benches on which the trace is judged.

*Stepwise regression*: columns of the catalogue join the baseline's rows, and leave them, one effect
at a time, as long as Schwarz's criterion n ln(RSS / n) + k ln(n) falls (Schwarz, Annals of
Statistics 6, 1978). The names are those of the effects that stay.

*Sparse regression*: products of up to two of a joint's variables join each of its equations, those
below a threshold are dropped, again and again (SINDy; Brunton, Proctor and Kutz, PNAS 113, 2016;
by the package pysindy). It names no effect.

All fit the training records and are judged on the held-out ones, by the share of the energy above
noise that they take away.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.clues.equation_rows import variables
from analysis.trace.data.candidates import catalogue, complexity, variants
from analysis.trace.data.conditioned_record import conditioned_records, filtered, prepared_signals
from analysis.trace.data.regression_data import (
    RegressionData,
    VariantColumns,
    evidence,
    regression_data,
    variant_columns,
)
from analysis.trace.engine import trace
from analysis.trace.judge.held_out import held_out_residual
from analysis.trace.result import CLEAN, EXPLAINED
from analysis.trace.search.hypothesis import energy_above_noise
from rig.model.records import Run
from tests.studies.foreign.bench import runs_of
from tests.studies.foreign.cases import NONE, Case, case_of
from tests.studies.foreign.study import LOUD, answer_of, bounds
from tests.studies.pages import Section, Table

Array = NDArray[np.float64]

TRACE, STEPWISE, SPARSE = "trace", "stepwise", "sparse"
MOST: Final = 20  # effects that stepwise regression may hold
DEGREE: Final = 2  # of the products of variables
PRICE: Final = 20.0  # energy that a product must take to stay: ten times what noise gives it
RIDGE: Final = 0.05  # on normalised products, as pysindy has it where nothing is said
SHOWN: Final = 3  # names in a cell of the table of benches
RIGHT: Final = ("right", "in class", "refused")
WRONG: Final = ("wrong", "wrong beside unexplained", "false alarm", "partly")


@dataclass(frozen=True)
class MethodAnswer:
    """What a method makes of a bench; plain data.

    `taken` is the share of the held-out energy above noise that it takes away; `answer` is empty
    for a method that names nothing, `terms` counts what it adds.
    """

    method: str
    seed: int
    label: str
    kind: str
    answer: str
    named: tuple[tuple[str, str], ...]
    terms: int
    taken: float
    loudness: float


def perform(seed: int) -> list[MethodAnswer]:
    """Make the records of a foreign bench and return what each method makes of them."""
    case = case_of(seed)
    train, held_out = runs_of(case.bench, seed)
    return answers(case, train, held_out)


def answers(case: Case, train: Run, held_out: Sequence[Run]) -> list[MethodAnswer]:
    """Return what each method makes of a bench's runs."""
    found = trace([train], held_out, look_ahead=False)
    rig = train.rig
    terms = tuple(map(Used, baseline_of(rig)))
    fitted = regression_data(rig, terms, conditioned_records(rig, [train]))
    judging = regression_data(rig, terms, conditioned_records(rig, held_out), fitted.beta)
    loud = max(f.ratio for f in found.floors)
    names = tuple((e.name, e.where) for e in found.effects)

    def answer(
        method: str, word: str, named: tuple[tuple[str, str], ...], terms: int, taken: float
    ) -> MethodAnswer:
        return MethodAnswer(
            method, case.seed, case.label, case.kind, word, named, terms, taken, loud
        )

    chosen = stepwise(fitted)
    keys = tuple(entry.used.term.key for entry in chosen)
    verdict = EXPLAINED if chosen else CLEAN
    products, count = _sparse(fitted, judging)
    return [
        answer(TRACE, answer_of(case, found.verdict, set(names), set(found.tied)), names,
               len(names), _share(*(_above(judging, held_out_residual(judging, rows))
                             for rows in (found.rows_before, found.rows_after)))),
        answer(STEPWISE, answer_of(case, verdict, set(keys), set()), keys, len(keys),
               _taken_by_entries(fitted, judging, chosen)),
        answer(SPARSE, "", (), count, products),
    ]  # fmt: skip


def stepwise(data: RegressionData) -> list[VariantColumns]:
    """Return the catalogue's entries that Schwarz's criterion lets join, in order of joining."""
    r = data.mean_residual
    looks = variants(data.rig, catalogue(data.rig), evidence(data, r))
    entries = variant_columns(data, looks)
    chosen: list[VariantColumns] = []
    now = _criterion(data, chosen, r)
    while len(chosen) < MOST:
        taken = {entry.used.term.key for entry in chosen}
        basis = _basis(data, chosen)
        left = r - basis @ (basis.T @ r)
        free = [entry for entry in entries if entry.used.term.key not in taken]
        if not free:
            break
        best = min(free, key=lambda entry: _joined(data, entry, basis, left))
        joined = _pruned(data, [*chosen, best], r)
        after = _criterion(data, joined, r)
        if after >= now:
            break
        chosen, now = joined, after
    return chosen


def _pruned(data: RegressionData, chosen: list[VariantColumns], r: Array) -> list[VariantColumns]:
    """Drop entries as long as the criterion falls."""
    while len(chosen) > 1:
        fewer = [[o for o in chosen if o is not entry] for entry in chosen]
        best = min(fewer, key=lambda some: _criterion(data, some, r))
        if _criterion(data, best, r) >= _criterion(data, chosen, r):
            break
        chosen = best
    return chosen


def _basis(data: RegressionData, chosen: Sequence[VariantColumns]) -> Array:
    columns = np.column_stack([data.base, *(entry.columns for entry in chosen)])
    scale = np.linalg.norm(columns, axis=0)
    U, sigma, _ = np.linalg.svd(columns[:, scale > 0] / scale[scale > 0], full_matrices=False)
    return np.asarray(U[:, sigma > 1e-6 * sigma[0]])


def _criterion(data: RegressionData, chosen: Sequence[VariantColumns], r: Array) -> float:
    """Return n ln(RSS / n) + k ln(n) of a set fitted together with the baseline."""
    basis = _basis(data, chosen)
    left = r - basis @ (basis.T @ r)
    k = complexity(data.rig, [entry.used for entry in chosen])[1]
    return float(len(r) * np.log(left @ left / len(r)) + k * np.log(len(r)))


def _joined(data: RegressionData, entry: VariantColumns, basis: Array, left: Array) -> float:
    """Return the criterion's change when an entry joins a set with an orthonormal basis."""
    own = entry.columns - basis @ (basis.T @ entry.columns)
    fit = np.linalg.lstsq(own, left, rcond=1e-6)[0]
    rest = left - own @ fit
    k = complexity(data.rig, [entry.used])[1]
    return float(len(left) * np.log((rest @ rest) / (left @ left)) + k * np.log(len(left)))


def _taken_by_entries(
    fitted: RegressionData, judging: RegressionData, chosen: Sequence[VariantColumns]
) -> float:
    """Return the share that chosen entries, fitted with the baseline, take on held-out records."""
    if not chosen:
        return 0.0
    seen = variant_columns(judging, [entry.used for entry in chosen])
    by_key = {entry.used.term.key: entry for entry in seen}
    pairs = [
        (entry, by_key[entry.used.term.key]) for entry in chosen if entry.used.term.key in by_key
    ]
    there = np.column_stack([entry.columns for entry, _ in pairs])
    here = np.column_stack([_as_named(other, entry.names) for entry, other in pairs])
    basis = _basis(fitted, ())
    sizes = _least_squares(
        there - basis @ (basis.T @ there),
        fitted.mean_residual - basis @ (basis.T @ fitted.mean_residual),
    )
    return _taken(fitted, there, judging, here, sizes)


def _as_named(entry: VariantColumns, names: Sequence[str]) -> Array:
    """Return an entry's columns in the order of names, zero where it lacks one."""
    out = np.zeros((len(entry.columns), len(names)))
    for k, name in enumerate(names):
        if name in entry.names:
            out[:, k] = entry.columns[:, entry.names.index(name)]
    return out


def _taken(
    fitted: RegressionData, there: Array, judging: RegressionData, here: Array, sizes: Array
) -> float:
    """Return the share of energy above noise that columns of given sizes take on held-out records.

    `there` are the columns on the training side, where the baseline's coefficients are fitted anew
    beside them, `here` those on the held-out side.
    """
    base = np.zeros((len(judging.mean_residual), len(fitted.names)))
    for k, name in enumerate(fitted.names):
        if name in judging.names:
            base[:, k] = judging.base[:, judging.names.index(name)]
    moved = _least_squares(fitted.base, fitted.mean_residual - there @ sizes)
    after = judging.mean_residual - here @ sizes - base @ moved
    return _share(_above(judging, judging.mean_residual), _above(judging, after))


def _least_squares(columns: Array, y: Array) -> Array:
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    return np.asarray(np.linalg.lstsq(columns / scale, y, rcond=1e-6)[0] / scale)


def _above(data: RegressionData, left: Array) -> float:
    return sum(max(0.0, value) for value in energy_above_noise(data, left).values())


def _share(before: float, after: float) -> float:
    return (before - after) / before if before > 0.0 else 0.0


def _sparse(fitted: RegressionData, judging: RegressionData) -> tuple[float, int]:
    """Return the share that sparse products of variables take, and how many products stay."""
    from pysindy import STLSQ, PolynomialLibrary

    scales = _largest(fitted)
    there, here = (
        _products(data, scales, PolynomialLibrary(degree=DEGREE)) for data in (fitted, judging)
    )
    basis = _basis(fitted, ())
    own = there - basis @ (basis.T @ there)
    left = fitted.mean_residual - basis @ (basis.T @ fitted.mean_residual)
    seen = np.linalg.norm(own, axis=0) > 1e-3 * np.linalg.norm(there, axis=0)
    own, there, here = own[:, seen], there[:, seen], here[:, seen]
    method = STLSQ(threshold=PRICE**0.5, alpha=RIDGE, normalize_columns=True, max_iter=50)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # where no product is worth its price
        method.fit(own, left[:, None])
    sizes = np.ravel(method.coef_)
    if not sizes.any():
        return 0.0, 0
    return _taken(fitted, there, judging, here, sizes), int(np.count_nonzero(sizes))


def _equations(data: RegressionData) -> list[str]:
    return sorted({s.equation for s in data.segments})


def _largest(data: RegressionData) -> dict[int, dict[str, float]]:
    """Return the largest size of every joint's variables, so that products are of order one."""
    out: dict[int, dict[str, float]] = {}
    for conditioned in data.records:
        seen = prepared_signals(data.rig, data.terms, conditioned)
        for joint in range(len(data.rig.joints)):
            sizes = out.setdefault(joint, {})
            for name, v in variables(data.rig, seen, joint).items():
                sizes[name] = max(sizes.get(name, 0.0), float(np.max(np.abs(v))), 1e-30)
    return out


def _products(
    data: RegressionData, scales: Mapping[int, Mapping[str, float]], library: Any
) -> Array:
    """Return columns (M, equations x products), filtered and whitened as the equations' rows."""
    blocks: dict[str, list[tuple[slice, Array]]] = {e: [] for e in _equations(data)}
    index = {conditioned.group: k for k, conditioned in enumerate(data.records)}
    for s in data.segments:
        joint = int(s.equation.rsplit("_", 1)[1]) - 1
        conditioned = data.records[index[s.group]]
        seen = prepared_signals(data.rig, data.terms, conditioned)
        v = variables(data.rig, seen, joint)
        X = np.column_stack([v[name] / scales[joint][name] for name in v])
        raw = np.asarray(library.fit_transform(X))
        named = {str(k): raw[:, k] for k in range(raw.shape[1])}
        found = filtered(named, conditioned, data.rows[index[s.group]][s.equation])
        columns = np.column_stack(list(found.values())) * np.sqrt(s.repeats) / s.noise
        blocks[s.equation].append((s.where, columns))
    M = len(data.mean_residual)
    out = []
    for parts in blocks.values():
        block = np.zeros((M, parts[0][1].shape[1]))
        for where, columns in parts:
            block[where] = columns
        out.append(block)
    return np.column_stack(out)


def as_json(found: Sequence[MethodAnswer]) -> dict[str, Any]:
    """Return answers as plain data."""
    return {"answers": [asdict(a) for a in found]}


def loaded(_: int, data: Mapping[str, Any]) -> list[MethodAnswer]:
    """Return kept answers."""
    return [
        MethodAnswer(**{**a, "named": tuple((n, w) for n, w in a["named"])})
        for a in data["answers"]
    ]


def sections(found: Mapping[int, Sequence[MethodAnswer]], command: str) -> list[Section]:
    """Return the page: pooled shares of each method, and every bench."""
    every = [a for answers in found.values() for a in answers]
    rows = []
    for method in (TRACE, STEPWISE, SPARSE):
        own = [a for a in every if a.method == method]
        loud = [a for a in own if a.kind != NONE and a.loudness >= LOUD]
        names = method != SPARSE
        rows.append([
            method,
            _of([a.answer in RIGHT for a in loud]) if names else "",
            _of([a.answer in WRONG for a in own]) if names else "",
            f"{np.median([a.terms for a in loud]):g}" if loud else "",
            f"{100 * np.median([a.taken for a in loud]):.0f} %" if loud else "",
            f"{100 * min(a.taken for a in loud):.0f} %" if loud else "",
        ])  # fmt: skip
    benches = [
        [str(seed), answers[0].label, f"{answers[0].loudness:.1f}",
         *(f"{a.answer}{': ' if a.answer else ''}{_words(a)}; {100 * a.taken:.0f} %"
           for a in answers)]
        for seed, answers in found.items()
    ]  # fmt: skip
    return [
        Section("", (
            f"{len(found)} benches of textbook physics (`python -m tests.studies foreign`), drawn "
            "by seed. *Stepwise*: effects of the catalogue enter and leave by Schwarz's criterion, "
            "from the same columns as the trace's, without its gates. *Sparse*: products of up to "
            "two variables of a joint in each of its equations, by pysindy; it names no effect. "
            "All are fitted to the training records. *Removed* is the share of the energy above "
            "noise that is removed from held-out records; it is negative where they are met worse "
            "than without. Made by:",
            f"```sh\n{command}\n```",
            Table("Wrong or partial names: of all benches; other columns: of those at three times "
                  "the noise or more; bounds one-sided, 95 %",
                  ("method", "right or in class", "wrong or partial names", "terms, median",
                   "removed, median", "removed, least"), rows),
        )),
        Section("Every bench", (
            Table("Answer of each method",
                  ("seed", "hidden", "x noise", TRACE, STEPWISE, SPARSE), benches),
        )),
    ]  # fmt: skip


def _of(hits: Sequence[bool]) -> str:
    low, high = bounds(sum(hits), len(hits))
    return f"{sum(hits)} of {len(hits)} ({100 * low:.0f} to {100 * high:.0f} %)"


def _words(answer: MethodAnswer) -> str:
    if answer.method == SPARSE:
        return f"{answer.terms} products"
    shown = ", ".join(f"{n} at {w}" for n, w in answer.named[:SHOWN]) or "nothing named"
    more = len(answer.named) - SHOWN
    return f"{shown} and {more} more" if more > 0 else shown
