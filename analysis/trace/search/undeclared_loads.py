"""Find the records that carry a load which others lack, where no record states it.

A load of mass m at the tip adds m p to the torque rows: p = X g, of the baseline's columns X and
the growth g of its coefficients per kilogram. M, R and W absorb a load that all records carry, but
not one that only some carry. Two fits alternate to find these records:
 coefficients and m by least squares, with p in the rows of the records that carry the load;
 the state of each record, by whether r or r - m p is smaller in its rows (r: residual without m).
The first guess is of whole steps: from each single step on, one step after the other changes its
state while the energy that m removes grows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.effects.mechanics import Payload, growth, heaviest_payload
from analysis.regression.least_squares import shortest
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import RegressionData, regression_data
from analysis.trace.data.set_aside import in_judging_block
from analysis.trace.data.trace_rows import TraceRuns
from analysis.trace.search.linear_fit import orthonormal
from analysis.trace.settings import DATA, TRACE
from rig.model.records import LOADED, Run
from rig.model.rig import Rig
from rig.model.units import plain

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
MECHANICAL: Final = "mechanical"  # the family of torque rows
Key = tuple[int, str]  # number of the run, name of the record


@dataclass(frozen=True)
class UndeclaredLoad:
    """Runs with every record's load stated by its torque rows, and a note on that.

    `shows_inertia` as in `LoadFit`.
    """

    records: TraceRuns
    words: str
    shows_inertia: bool


@dataclass(frozen=True)
class LoadFit:
    """A load that some of the records carry and others do not.

    `mass` [kg]; `loaded` are the training records that carry it; `beta` are the coefficients of the
    torque rows beside it. `shows_inertia` is whether the records show its inertia, which then
    agrees with its weight.
    """

    mass: float
    loaded: frozenset[Key]
    beta: dict[str, float]
    shows_inertia: bool


@dataclass(frozen=True)
class _LoadRows:
    """Whitened torque rows (M,) of single records, and what 1 kg at the tip adds to them.

    `unit` (M,) numbers each row's record among `keys`.
    """

    data: RegressionData
    column: Array
    residual: Array
    unit: NDArray[np.int64]
    keys: tuple[Key, ...]

    def sums(self, values: Array) -> Array:
        """Return the sum of values (M,) over the rows of each record (U,)."""
        return np.bincount(self.unit, values, len(self.keys)).astype(np.float64)

    def with_load(self, loaded: Mask) -> Array:
        """Return what 1 kg adds (M,) where the records `loaded` (U,) carry it."""
        return np.where(loaded[self.unit], self.column, 0.0)

    def chosen(self, loaded: Mask) -> frozenset[Key]:
        """Return the records of a mask (U,)."""
        return frozenset(key for key, is_loaded in zip(self.keys, loaded, strict=True) if is_loaded)


def undeclared_load(records: TraceRuns, effects: Sequence[Effect] = ()) -> UndeclaredLoad | None:
    """Return the runs with the load that the torque rows show in some records, None if in none.

    The load is fitted alone, then beside `effects`. Whether a held-out record carries it follows
    from its own rows, where they are divided from the choosing rows.
    """
    rig, terms = records.rig, records.terms
    train, holdout, judge = records.train, records.holdout, records.judge
    if any(r.loaded is not None for run in (*train, *records.unseen) for r in run.records):
        return None
    load = fitted_load(rig, terms, train)
    if load is None and effects:
        terms = (*terms, *(at_start(rig, effect) for effect in effects))
        load = fitted_load(rig, terms, train)
    if load is None:
        return None
    loaded_by_task = [
        (train, load.loaded),
        (holdout, loaded_records(rig, terms, holdout, load, divided=not judge)),
        (judge, loaded_records(rig, terms, judge, load, divided=False) if judge else frozenset()),
    ]
    carry = [word for runs, loaded in loaded_by_task for word in _loaded_names(runs, loaded)]
    weighed = "" if load.shows_inertia else ", by its weight alone"
    words = (
        f"no record states a load: by the torque balances {' '.join(dict.fromkeys(carry))} carry "
        f"about {plain(load.mass, 2)} kg more at the tip than the other records{weighed}; state "
        "`loaded` of the records where it is known (import manifest)"
    )
    train, holdout, judge = (with_loads(runs, loaded) for runs, loaded in loaded_by_task)
    stated = replace(records, train=train, holdout=holdout, judge=judge)
    return UndeclaredLoad(stated, words, load.shows_inertia)


def _loaded_names(runs: Sequence[Run], loaded: frozenset[Key]) -> list[str]:
    """Return the names of loaded steps, and of loaded records of steps that are partly loaded."""
    out = []
    for number, run in enumerate(runs):
        unloaded_steps = {r.step for r in run.records if (number, r.name) not in loaded}
        carrying = [r for r in run.records if (number, r.name) in loaded]
        out += [r.name if r.step in unloaded_steps else r.step for r in carrying]
    return out


def fitted_load(rig: Rig, terms: Sequence[Used], runs: Sequence[Run]) -> LoadFit | None:
    """Return the load that separates the training records best.

    None on a rig without links, and where no load removes `DATA.load_share` of the energy above
    noise of the torque rows.
    """
    if not Payload.all_places(rig):
        return None
    rows = _load_rows(rig, terms, runs)
    basis = orthonormal(rows.data.base)
    before = rows.residual - basis @ (basis.T @ rows.residual)
    steps = _step_masks(runs, rows.keys)
    loaded = _first_guess(rows, basis, before, steps)
    for _ in range(DATA.load_rounds):
        mass, change = _fitted_mass(rows, loaded)
        states = _records_with_load(rows, rows.residual - rows.data.base @ change, mass)
        if (states == loaded).all():
            break
        loaded = states
    mass, change = _fitted_mass(rows, loaded)
    after = rows.residual - rows.data.base @ change - mass * rows.with_load(loaded)
    start = float(before @ before)
    removed, excess = start - float(after @ after), start - len(before)
    by_chance = TRACE.standard_errors * np.sqrt(2.0 * len(before))
    if loaded.all() or not loaded.any() or not 0.0 < mass < heaviest_payload(rig):
        return None
    agrees = _inertia_agrees(rows, basis, loaded)
    if excess < by_chance or removed < DATA.load_share * excess or agrees is False:
        return None
    beta = dict(rows.data.beta)
    for name, step in zip(rows.data.names, change, strict=True):
        beta[name] = beta.get(name, 0.0) + float(step)
    return LoadFit(mass, rows.chosen(loaded), beta, agrees is not None)


def loaded_records(
    rig: Rig, terms: Sequence[Used], runs: Sequence[Run], load: LoadFit, divided: bool
) -> frozenset[Key]:
    """Return the records of other runs that carry the load of the training records.

    With `divided`, rows of blocks that are set aside for judging are not used.
    """
    rows = _load_rows(rig, terms, runs, load.beta)
    used = np.ones(len(rows.column))
    for s in rows.data.segments if divided else ():
        used[s.where] = ~in_judging_block(rows.data.source(s)[1].time)
    rows = replace(rows, column=rows.column * used)
    return rows.chosen(_records_with_load(rows, rows.residual, load.mass))


def with_loads(runs: Sequence[Run], loaded: frozenset[Key]) -> tuple[Run, ...]:
    """Return the runs with every record's load stated.

    Loaded records of a partly loaded step become a separate step, since their motion differs.
    """
    out = []
    for number, run in enumerate(runs):
        unloaded_steps = {r.step for r in run.records if (number, r.name) not in loaded}
        records = []
        for record in run.records:
            is_loaded = (number, record.name) in loaded
            suffix = ", loaded" if is_loaded and record.step in unloaded_steps else ""
            step = f"{record.step}{suffix}"
            attributes = {**record.attributes, LOADED: int(is_loaded)}
            records.append(replace(record, step=step, attributes=attributes))
        out.append(replace(run, records=tuple(records)))
    return tuple(out)


def _load_rows(
    rig: Rig, terms: Sequence[Used], runs: Sequence[Run], beta: dict[str, float] | None = None
) -> _LoadRows:
    single = [
        replace(run, records=tuple(replace(r, step=r.name) for r in run.records)) for run in runs
    ]
    members = conditioned_records(rig, single, families=(MECHANICAL,))
    data = regression_data(rig, terms, members, beta)
    per_kilogram = growth(rig)
    column = data.base @ np.array([per_kilogram.get(name, 0.0) for name in data.names])
    keys = tuple(conditioned.group for conditioned in data.records)
    record_number = np.zeros(len(column), dtype=np.int64)
    for s in data.segments:
        record_number[s.where] = keys.index(s.group)
    return _LoadRows(data, column, data.mean_residual, record_number, keys)


def _step_masks(runs: Sequence[Run], keys: Sequence[Key]) -> list[Mask]:
    """Return masks (U,) of the records of each step of each run, of each record if all are one."""
    step_of = {(n, r.name): (n, r.step) for n, run in enumerate(runs) for r in run.records}
    step_of_record = [step_of[key] for key in keys]
    if len(set(step_of_record)) == 1:
        return list(np.eye(len(keys), dtype=bool))
    steps = dict.fromkeys(step_of_record)
    return [np.array([other == step for other in step_of_record]) for step in steps]


def _first_guess(rows: _LoadRows, basis: Array, residual: Array, steps: Sequence[Mask]) -> Mask:
    """Return a mask (U,) of the records of the steps that a load in them explains best."""
    columns = np.column_stack([rows.with_load(step) for step in steps])
    columns = columns - basis @ (basis.T @ columns)
    K, c, size = columns.T @ columns, columns.T @ residual, float(rows.column @ rows.column)

    def removed(chosen: Mask) -> float:
        energy = float(chosen @ K @ chosen)
        return float(chosen @ c) ** 2 / energy if energy > TRACE.rank_limit**2 * size else 0.0

    best = np.zeros(len(steps), dtype=bool)
    for start in np.eye(len(steps), dtype=bool):
        current = start
        while True:
            others = [current ^ step for step in np.eye(len(steps), dtype=bool)]
            better = max(others, key=removed)
            if removed(better) <= removed(current):
                break
            current = better
        best = max(best, current, key=removed)
    if best @ c < 0.0:  # the mass is negative: the others carry the load
        best = ~best
    return np.asarray(np.array(steps)[best].any(axis=0))


def _fitted_mass(rows: _LoadRows, loaded: Mask) -> tuple[float, Array]:
    """Return the mass [kg] and the changes (k,) of the baseline's coefficients."""
    matrix = np.column_stack((rows.data.base, rows.with_load(loaded)))
    solution = shortest(matrix, rows.residual, TRACE.rank_limit)
    return float(solution[-1]), solution[:-1]


def _inertia_agrees(rows: _LoadRows, basis: Array, loaded: Mask) -> bool | None:
    """Return whether the inertia of the load in the records `loaded` (U,) agrees with its weight.

    The masses from gravity terms alone and from inertia terms alone may differ by
    `TRACE.invariance_tolerance`, plus noise: a tilt of the base or an offset of a sensor adds a
    weight without inertia. None where M and R absorb the inertia, since the joint moves in no
    record without the load.
    """
    rates = growth(rows.data.rig)
    base = rows.data.base * np.where(loaded[rows.unit], 1.0, 0.0)[:, None]
    weights = [rates.get(n, 0.0) if n.startswith("W") else 0.0 for n in rows.data.names]
    inertias = [0.0 if n.startswith("W") else rates.get(n, 0.0) for n in rows.data.names]
    columns = base @ np.array([weights, inertias]).T
    size = np.linalg.norm(columns, axis=0)
    columns = columns - basis @ (basis.T @ columns)
    if np.any(np.linalg.norm(columns, axis=0) <= TRACE.rank_limit * size):
        return None
    weight, inertia = np.linalg.lstsq(columns, rows.residual, rcond=None)[0]
    error = np.linalg.inv(columns.T @ columns)
    deviation = float(np.sqrt(np.array([1.0, -1.0]) @ error @ np.array([1.0, -1.0])))
    if deviation > max(abs(weight), abs(inertia)) * TRACE.subset_error:
        return None
    allowed = TRACE.invariance_tolerance * max(abs(weight), abs(inertia))
    return bool(abs(weight - inertia) <= allowed + TRACE.standard_errors * deviation)


def _records_with_load(rows: _LoadRows, residual: Array, mass: float) -> Mask:
    """Return a mask (U,) of the records in which the load reduces `residual` (M,)."""
    added = mass * rows.column
    return np.asarray(rows.sums(residual * added) > 0.5 * rows.sums(added * added))
