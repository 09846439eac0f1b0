"""The numbers of the paper's sections IV and V from one's own runs, as data.

scatter     every repeat identified by itself: min, mean, max, relative standard deviation
conditions  condition numbers with scaled columns and, as the paper forms them, in plain SI
payload     which parameters respond to a mass at the tip, next to what rigid bodies demand
search_fit  FIT of a search's parameters on records that it has not seen
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.identify.methods.search import with_values
from analysis.identify.reduction import clusters_of, reduce_rows
from analysis.identify.result import Identification, estimates_of
from analysis.identify.stacked_rows import build_rows
from analysis.regression.rows import Filtering, default_filtering, parameters_of
from analysis.regression.solve import RowCluster, Solution, merge, solve
from analysis.simulation.model import Model
from analysis.simulation.validate import RecordValidation, validate
from analysis.terms import baseline
from analysis.terms.base import FAMILIES, Used
from rig.model import channels as ch
from rig.model.parameters import inertia_names
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig

RESPONDS = 0.01  # relative change beyond which a parameter has answered the payload

Choice = Callable[[Record], Filtering]


@dataclass(frozen=True)
class Spread:
    """One parameter over repeated experiments [SI]; `rsd` [%] is its relative scatter."""

    low: float
    mean: float
    high: float
    rsd: float


@dataclass(frozen=True)
class Conditions:
    """Over the experiments, least and largest: condition numbers of one family, and its rows."""

    scaled: tuple[float, float]
    plain: tuple[float, float]
    rows: int


@dataclass(frozen=True)
class Experiments:
    """Every repeat identified by itself; `solve_seconds` is the median."""

    count: int
    spreads: Mapping[str, Spread]
    conditions: Mapping[str, Conditions]
    solve_seconds: float
    masked_rows: int


@dataclass(frozen=True)
class Response:
    """One parameter without and with the payload [SI], and the change rigid bodies demand."""

    before: float
    after: float
    half_width: float
    expected: float

    @property
    def change(self) -> float:
        """After minus before."""
        return self.after - self.before

    @property
    def responds(self) -> bool:
        """Whether it has changed beyond `RESPONDS`."""
        return abs(self.change) > RESPONDS * abs(self.before)

    @property
    def as_expected(self) -> bool:
        """Whether it answers where, and only where, rigid bodies say so."""
        return self.responds == (abs(self.expected) > RESPONDS * abs(self.before))


def each_repeat(run: Run) -> list[Run]:
    """Return one run per repeat number, the first first."""
    numbers = sorted({record.repeat for record in run.records})
    return [
        replace(run, records=tuple(r for r in run.records if r.repeat == number))
        for number in numbers
    ]


def experiments(run: Run, filtering: Choice = default_filtering) -> Experiments:
    """Identify every repeat by itself by coupling; raises InputError for fewer than two repeats.

    Nothing is refused for resting on sensor noise: the paper refuses nothing either.
    """
    single = each_repeat(run)
    if len(single) < 2:
        raise InputError("scatter over experiments needs at least two repeats of every step")
    found = [_alone(one, filtering) for one in single]
    conditions = {
        family: Conditions(
            _ends([one.solutions[family].condition_number for one in found]),
            _ends([one.plain[family] for one in found]),
            found[0].solutions[family].rows,
        )
        for family in FAMILIES
    }
    names = found[0].values
    return Experiments(
        len(single),
        {name: spread([one.values[name] for one in found]) for name in names},
        conditions,
        float(np.median([one.seconds for one in found])),
        sum(one.masked for one in found),
    )


@dataclass(frozen=True)
class _Alone:
    """One experiment: parameters, solutions, plain condition numbers, seconds to solve."""

    values: Mapping[str, float]
    solutions: Mapping[str, Solution]
    plain: Mapping[str, float]
    seconds: float
    masked: int


def _alone(run: Run, filtering: Choice) -> _Alone:
    terms = tuple(Used(term) for term in baseline())
    rows = build_rows(run.rig, [run], terms, filtering)
    reductions = reduce_rows(run.rig, terms, rows)
    started = time.perf_counter()
    solutions, plain = {}, {}
    for family in FAMILIES:
        names = parameters_of(run.rig, terms, family)
        clusters = clusters_of(reductions, family)
        solutions[family] = solve(names, clusters)
        plain[family] = plain_condition(clusters)
    seconds = time.perf_counter() - started
    estimates, _ = estimates_of(run.rig, terms, solutions)
    masked = sum(part.masked for one in rows for part in one.rows.values())
    values = {name: estimate.value for name, estimate in estimates.items()}
    return _Alone(values, solutions, plain, seconds, masked)


def _ends(values: Sequence[float]) -> tuple[float, float]:
    return min(values), max(values)


def spread(values: Sequence[float]) -> Spread:
    """Return min, mean, max and RSD [%] of a parameter's values."""
    x = np.asarray(values, dtype=np.float64)
    mean = float(x.mean())
    rsd = 100.0 * float(x.std(ddof=1)) / abs(mean) if len(x) > 1 and mean else np.nan
    return Spread(float(x.min()), mean, float(x.max()), rsd)


def plain_condition(clusters: Sequence[RowCluster]) -> float:
    """Return the condition number of the stacked rows in SI, columns not scaled.

    The paper does not say how its matrices are scaled; in SI, 1/b in 1/Pa, nothing is.
    """
    R = merge(c.triangle for c in clusters)
    return float(np.linalg.cond(R[:-1, :-1]))


def payload_changes(rig: Rig, mass: float) -> dict[str, float]:
    """Return by how much a point mass [kg] at the tip of the last link changes each parameter.

    R_ij grows by m l_i l_j and W_i by m l_i (NOTES, "N DOF planar chain"), so that of two joints
    M1 grows by m (l1^2 + l2^2), M2 by m l2^2 and R12 by m l1 l2; nothing else changes.
    """
    lengths = np.array([joint.link_length for joint in rig.joints])
    N = len(lengths)
    R = mass * np.outer(lengths, lengths)
    if N == 1:
        out = {"M1": R[0, 0]}
    elif N == 2:
        out = {"M1": R[0, 0] + R[1, 1], "M2": R[1, 1], "R12": R[0, 1]}
    else:
        out = {name: R[int(name[1]) - 1, int(name[2]) - 1] for name in inertia_names(N)}
    out |= {f"W{i + 1}": mass * lengths[i] for i in range(N)}
    return {name: float(value) for name, value in out.items()}


def payload_response(
    rig: Rig, mass: float, before: Identification, after: Identification
) -> dict[str, Response]:
    """Set the parameters with and without the payload side by side."""
    expected = payload_changes(rig, mass)
    out = {}
    for name, one in before.estimates.items():
        other = after.estimates[name]
        one_half, other_half = (0.5 * (e.ci95[1] - e.ci95[0]) for e in (one, other))
        width = float(np.hypot(one_half, other_half))
        out[name] = Response(one.value, other.value, width, expected.get(name, 0.0))
    return out


def oil_temperatures(run: Run) -> dict[str, float]:
    """Return the mean measured oil temperature [degC] of every step; empty where not measured."""
    found: dict[str, list[float]] = {}
    for record in run.records:
        if ch.TEMPERATURE in record.channels:
            mean = float(np.mean(record.channels[ch.TEMPERATURE]))
            found.setdefault(record.step, []).append(mean)
    return {step: float(np.mean(values)) for step, values in found.items()}


def steps_of(run: Run, steps: Sequence[str]) -> Run:
    """Return the run's records of some steps only."""
    return replace(run, records=tuple(r for r in run.records if r.step in steps))


def search_fit(coupled: Model, found: Identification, run: Run) -> list[RecordValidation]:
    """Validate a search's parameters on records where they all play a part (STEP1's).

    The parameters that the search has no value for are lent by the coupled model; of them only
    the inertia that couples the joints plays a part, and only by what a locked joint gives.
    """
    values = {name: e.value for name, e in found.estimates.items() if e.identified}
    return validate(with_values(coupled, values), [run])
