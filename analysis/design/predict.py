"""Predicted standard error of each parameter, before the experiment.

The plan's steps are simulated on the twin (nominal parameters), their rows are built exactly as
`identify` builds them, and the rig's stated sensor noise is carried through the filters
(`sensor_noise`). With A = sum n_s X_s'X_s and n_s repeats of step s the coupled solution has
    cov beta = A^-1 [ sum n_s cov g_s ] A^-1.
The prediction is the scatter between repeats. It excludes model error; the effect of the oil's
temperature on b between steps is separate (`oil`), because it differs between experiments but not
between the repeats of one. Glossary: `std` standard error of one experiment, `half` half width of
its 95 % interval, both relative to the nominal value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.design.lateness import BULK, LatenessCost, lateness_cost
from analysis.design.sensor_noise import score_covariance
from analysis.design.settings import DESIGN
from analysis.design.twin_records import Array, Played, TwinStep, ideal, play
from analysis.identify.settings import IDENTIFY
from analysis.identify.stacked_rows import build_rows
from analysis.regression.least_squares import scaled_inverse
from analysis.regression.noise import record_moments
from analysis.regression.rows import Rows, default_filtering, parameters_of
from analysis.regression.solve import RowCluster, half_width, solve, triangle
from analysis.signals.conditioning import condition
from analysis.simulation.model import finite, nominal_model
from analysis.terms import baseline_of
from analysis.terms.base import FAMILIES, Used, family_of, inverted
from rig.model.records import Run
from rig.model.rig import Rig


@dataclass(frozen=True)
class StepInformation:
    """Information of one record of a step, by family: X'X, cov g, noise moments, rows.

    `moments` is (k+1, k+1), the noise's part of [X y]'[X y], or empty if not requested; `triangle`
    is R of [X y].
    """

    step: str
    repeats: int
    matrix: Mapping[str, Array]
    scores: Mapping[str, Array]
    moments: Mapping[str, Array]
    triangle: Mapping[str, Array]
    rows: Mapping[str, int]
    oil: Array
    masked: int


@dataclass(frozen=True)
class ParameterPrediction:
    """One parameter's prediction; `std`, `half` and `oil` are relative, NaN where undetermined."""

    nominal: float
    unit: str
    std: float
    half: float
    oil: float
    note: str = ""


@dataclass(frozen=True)
class Prediction:
    """Expected half widths of an experiment, by parameter, and its conditioning by family.

    `covariance` is of the rows' coefficients (1/b), relative to their nominal values. `lateness` is
    the error of b by a host-timed device's samples; its interval includes that.
    """

    parameters: Mapping[str, ParameterPrediction]
    condition: Mapping[str, float]
    rank: Mapping[str, tuple[int, int]]
    covariance: Mapping[str, Array]
    names: Mapping[str, tuple[str, ...]]
    masked_share: float
    lateness: LatenessCost | None = None

    @property
    def worst(self) -> str:
        """The identifiable parameter with the largest relative standard error."""
        finite_std = {n: p.std for n, p in self.parameters.items() if math.isfinite(p.std)}
        return max(finite_std, key=lambda n: finite_std[n]) if finite_std else ""


def predict(
    rig: Rig,
    steps: Sequence[TwinStep],
    jitter: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Prediction:
    """Predict the result of identifying these steps on this rig.

    `jitter` [s] is that of a host-timed device's samples, None where the device has the clock;
    `progress` receives after each step the share of them that is done. Raises InputError for a rig
    without nominal values and for steps the twin cannot follow.
    """
    used = tuple(Used(term) for term in baseline_of(rig))
    played, parts = [], []
    for number, step in enumerate(steps, start=1):
        played.append(play(rig, step))
        parts.append(information(rig, played[-1], used, moments=True))
        if progress is not None:
            progress(number / len(steps))
    predicted = combine(rig, used, parts)
    cost = None if jitter is None else lateness_cost(rig, played, used, jitter)
    if cost is None:
        return predicted
    bulk = predicted.parameters[BULK]
    widened = {BULK: replace(bulk, half=cost.widened(bulk.half))}
    return replace(predicted, parameters={**predicted.parameters, **widened}, lateness=cost)


def coefficients(rig: Rig, terms: Sequence[Used]) -> dict[str, float]:
    """Return the rows' nominal coefficients (1/b for b); raises InputError where one is missing."""
    return inverted(rig, terms, nominal_model(rig, terms).values)


def information(
    rig: Rig, played: Played, terms: Sequence[Used], *, moments: bool = False
) -> StepInformation:
    """Return the information of one record of a simulated step; `moments` adds noise moments."""
    exact, record = ideal(rig), played.record
    filters = default_filtering(record)
    signals = condition(exact, record, filters.channels, np.full(len(rig.joints), np.inf))
    run = Run(exact, (record,), source="twin")
    (built,) = build_rows(exact, [run], terms)
    rows = built.rows
    scores = score_covariance(exact, terms, signals, filters, rows, coefficients(rig, terms))
    noise_moments = {}
    if moments:
        noise_moments = record_moments(
            exact, terms, built.conditioned, rows, np.random.default_rng(DESIGN.seed)
        )
    matrix, triangles, count = {}, {}, {}
    for family in FAMILIES:
        family_rows = [r for name, r in rows.items() if family_of(name) == family]
        X = np.concatenate([r.matrix for r in family_rows])
        y = np.concatenate([r.rhs for r in family_rows])
        matrix[family], triangles[family], count[family] = X.T @ X, triangle(X, y), len(y)
    return StepInformation(
        played.step.name, played.step.repeats, matrix, scores, noise_moments, triangles, count,
        _oil(rig, terms, rows), sum(r.masked for r in rows.values()),
    )  # fmt: skip


def _oil(rig: Rig, terms: Sequence[Used], rows: Mapping[str, Rows]) -> Array:
    """Return X' x_b (1/b) (k,): the scores that a relative change of 1/b in this step makes."""
    names = parameters_of(rig, terms, "fluid")
    if "b" not in names:
        return np.zeros(len(names))
    column = names.index("b")
    total = np.zeros(len(names))
    for name, r in rows.items():
        if family_of(name) == "fluid":
            total += r.matrix.T @ r.matrix[:, column] / rig.nominal["b"]
    return total


def combine(rig: Rig, terms: Sequence[Used], steps: Sequence[StepInformation]) -> Prediction:
    """Solve all steps together, each with its repeats, as the coupled method would."""
    parameters: dict[str, ParameterPrediction] = {}
    condition, rank, covariances, order = {}, {}, {}, {}
    nominal = coefficients(rig, terms)
    units = {c.parameter: c.unit for used in terms for c in used.term.coefficients(rig)}
    for family in FAMILIES:
        names = parameters_of(rig, terms, family)
        clusters = [
            RowCluster(s.step, r, s.triangle[family], s.rows[family])
            for s in steps
            for r in range(max(s.repeats, 2))
        ]
        noise_moments = None
        if all(s.moments for s in steps):
            parts = [max(s.repeats, 2) * s.moments[family] for s in steps]
            noise_moments = np.sum(parts, axis=0)
        solved = solve(names, clusters, noise_moments)
        scale = np.array([nominal[name] for name in names])
        mask = np.array([name not in solved.unidentifiable for name in names])
        cov, dof = covariance(steps, family, mask)
        std = np.sqrt(np.diag(cov)) / np.abs(scale)
        oil = _oil_scatter(rig, steps, mask) / np.abs(scale) if family == "fluid" else 0.0 * scale
        half = half_width(std, dof)
        for i, name in enumerate(names):
            note = solved.unidentifiable.get(name, "")
            value = rig.nominal[name]
            parameters[name] = ParameterPrediction(
                value, units[name], float(std[i]), float(half[i]), float(oil[i]), note
            )
        condition[family], rank[family] = solved.condition_number, (int(mask.sum()), len(names))
        covariances[family], order[family] = cov / np.outer(scale, scale), names
    rows = sum(sum(s.rows.values()) * s.repeats for s in steps)
    masked = sum(s.masked * s.repeats for s in steps)
    return Prediction(
        parameters, condition, rank, covariances, order, masked / max(rows + masked, 1)
    )


def covariance(
    steps: Sequence[StepInformation], family: str, mask: NDArray[np.bool_] | None = None
) -> tuple[Array, Array]:
    """Return cov beta (k, k) of one family and Satterthwaite's degrees of freedom (k,).

    Entries outside `mask` are NaN; columns without rows count as outside.
    """
    A = np.sum([s.repeats * s.matrix[family] for s in steps], axis=0)
    mask = np.diag(A) > 0 if mask is None else mask & (np.diag(A) > 0)
    inverse = scaled_inverse(A[np.ix_(mask, mask)])
    parts = [inverse @ s.scores[family][np.ix_(mask, mask)] @ inverse for s in steps]
    total = np.full(A.shape, np.nan)
    inner = np.sum([s.repeats * part for s, part in zip(steps, parts, strict=True)], axis=0)
    total[np.ix_(mask, mask)] = inner
    dof = np.full(len(A), np.nan)
    squares = np.zeros(int(mask.sum()))
    for s, part in zip(steps, parts, strict=True):
        # identify divides the only repeat of a step into segments.
        dof_step = (s.repeats if s.repeats > 1 else IDENTIFY.record_segments) - 1
        squares += (s.repeats * np.diag(part)) ** 2 / dof_step
    dof[mask] = np.diag(inner) ** 2 / squares
    return total, dof


def _oil_scatter(rig: Rig, steps: Sequence[StepInformation], mask: NDArray[np.bool_]) -> Array:
    """Return the scatter (k,) of the coefficients if 1/b differs from step to step with the oil."""
    A = np.sum([s.repeats * s.matrix["fluid"] for s in steps], axis=0)
    mask = mask & (np.diag(A) > 0)
    inverse = scaled_inverse(A[np.ix_(mask, mask)])
    spread = DESIGN.bulk_fall * rig.oil.temperature_band / math.sqrt(2.0)
    shifts = np.array([inverse @ (s.repeats * s.oil[mask]) for s in steps])
    out = np.full(len(A), np.nan)
    out[mask] = spread * np.sqrt(np.sum(shifts**2, axis=0))
    return out


def to_json(prediction: Prediction) -> dict[str, object]:
    """Return the prediction as plain data: relative figures, null where not determined."""
    return {
        "parameters": {
            name: {
                "nominal": finite(p.nominal),
                "unit": p.unit,
                "relative_std": finite(p.std),
                "relative_half_width_95": finite(p.half),
                "relative_oil_scatter": finite(p.oil),
                **({"note": p.note} if p.note else {}),
            }
            for name, p in prediction.parameters.items()
        },
        "condition_number": {f: finite(v) for f, v in prediction.condition.items()},
        "rank": {f: list(v) for f, v in prediction.rank.items()},
        "masked_share": finite(prediction.masked_share),
        "worst": prediction.worst,
        "lateness": None if prediction.lateness is None else asdict(prediction.lateness),
    }
