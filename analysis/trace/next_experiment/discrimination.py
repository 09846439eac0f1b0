"""Separation of two explanations on records that have not been taken yet.

The twin simulates a candidate excitation's noise-free record, which gives its rows under the
baseline. An explanation (effects with sizes) predicts what it adds to these rows and to the rows
already taken: y, the sum of its columns times its sizes. Another explanation leaves of y the part
orthogonal to the baseline's columns, its own columns and the derivatives of its shapes, since it
would be fitted again. With E_e the whitened energy left in equation e, the separation is
    s_e = sqrt(max(0, E_e(old and new rows) - E_e(old rows)) / (R n_e)),
with n_e new rows and R repeats: the residual rms of one record in units of its noise. The
separation of a pair is the smaller of the two with one or the other taken as true, each in the
equation where it is largest. The criterion is T-optimality (Atkinson and Fedorov, Biometrika 62,
1975), with the baseline's parameters profiled out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from analysis.design.twin_records import ideal
from analysis.effects.base import Effect, shapes_of
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Rows, matrix_of
from analysis.signals.conditioning import Signals, condition
from analysis.terms.base import Used
from analysis.trace.data.cache import RowCache
from analysis.trace.data.candidates import effect_in
from analysis.trace.data.conditioned_record import model_rows, prepared_signals, trace_filtering
from analysis.trace.data.noise_floor import stated_noise
from analysis.trace.data.regression_data import RegressionData, candidate_columns, variant_columns
from analysis.trace.next_experiment.excitations import CandidateExcitation
from analysis.trace.search.linear_fit import orthonormal
from analysis.trace.settings import EXPERIMENT
from rig.model.rig import Rig

Array = NDArray[np.float64]

RANK: Final = 1e-6  # of the largest singular value: weaker directions of a fit get no value


@dataclass(frozen=True)
class Explanation:
    """Effects with shapes, and coefficients by parameter name; without effects the baseline."""

    effects: tuple[Used, ...] = ()
    beta: Mapping[str, float] = field(default_factory=dict)

    @property
    def key(self) -> object:
        """Effects and coefficients, hashable: equal ones predict the same."""
        return self.effects, tuple(self.beta.items())

    @property
    def keys(self) -> tuple[dict[str, Any], ...]:
        """Names and places for a result; `at` and `shape` as the catalogue has them."""
        return tuple(
            {
                "name": u.term.name,
                "where": effect_in(u).place,
                "at": u.term.where,
                "shape": list(u.shape),
            }
            for u in self.effects
        )


def smallest_effect(effect: Effect, rig: Rig, shape: tuple[float, ...] = ()) -> Explanation | None:
    """Return an effect at its smallest size of interest, None where it has none or cannot show.

    `shape` replaces the usual values of the shapes that do not state its size.
    With poor excitation an effect of this size may leave no residual: the verdict `clean` does not
    exclude it then.
    """
    size_shape = effect.shape_of_smallest_size()
    if effect.absorbed(rig) or not (size_shape or effect.smallest_coefficients):
        return None
    shapes = effect.shape_of(rig, shape)
    names = [c.parameter for c in effect.coefficients(rig)]
    used = Used(effect, (*size_shape, *shapes[len(size_shape) :]))
    return Explanation((used,), dict(zip(names, effect.smallest_coefficients, strict=False)))


@dataclass(frozen=True)
class OpenQuestion:
    """Which of two explanations, `one` or `other`, is true.

    Without `both_ways` the experiment must only show `one`, if it is true.
    """

    one: Explanation
    other: Explanation
    both_ways: bool = True


@dataclass(frozen=True)
class MeasurementView:
    """An excitation's rows on the twin under the baseline, and the `noise` by equation, SI.

    `train_data` are the training rows, of the rig with channels sampled at the tick (the twin's).
    """

    train_data: RegressionData
    conditioned: ConditionedRecord
    signals: Signals
    rows: Mapping[str, Rows]
    noise: Mapping[str, float]

    def columns(self, used: Used) -> Mapping[str, Mapping[str, Array]]:
        """Return an effect's columns (m,) in SI: equation -> name -> column."""
        return candidate_columns(self.train_data, self.conditioned, self.signals, self.rows, used)

    def weight(self, equation: str) -> float:
        """Return the factor that whitens an equation's averaged rows."""
        return float(np.sqrt(EXPERIMENT.repeats) / max(self.noise[equation], 1e-30))


def noise_ratios(train_data: RegressionData) -> dict[str, float]:
    """Return, by equation, the measured noise over that from the rig's stated sensor noise.

    Faster excitations have filters of larger bandwidth and so more noise; multiplied with this
    ratio, the stated noise predicts it.
    """
    by_equation: dict[str, list[float]] = {}
    for conditioned, rows in zip(train_data.records, train_data.rows, strict=True):
        stated = stated_noise(train_data.rig, train_data.terms, conditioned, rows, train_data.beta)
        for floor in train_data.floors:
            if floor.group == conditioned.group and stated.get(floor.equation, 0.0) > 0:
                by_equation.setdefault(floor.equation, []).append(
                    floor.noise / stated[floor.equation]
                )
    return {e: float(np.sqrt(np.mean(np.square(v)))) for e, v in by_equation.items()}


def measurement_view(
    train_data: RegressionData, excitation: CandidateExcitation, measured: Mapping[str, float]
) -> MeasurementView:
    """Return the rows of an excitation, as the trace would compute them from its record.

    `measured` are the training data's `noise_ratios`. Equations without one are left out: their
    joint has never moved.
    """
    rig = ideal(train_data.rig)
    record = excitation.played.record
    filters = trace_filtering(record)
    conditioned = ConditionedRecord(-1, record, condition(rig, record, filters.channels), filters)
    rows_of_record = model_rows(rig, train_data.terms, conditioned)
    rows = {e: r for e, r in rows_of_record.items() if e in measured and len(r.rhs)}
    stated = stated_noise(rig, train_data.terms, conditioned, rows, train_data.beta)
    noise = {e: measured[e] * stated[e] for e in rows}
    signals = prepared_signals(rig, train_data.terms, conditioned)
    model = replace(train_data, rig=rig, cache=RowCache())
    return MeasurementView(model, conditioned, signals, rows, noise)


class ComparisonRows:
    """Whitened rows on which explanations are compared: training data, then those of a view if any.

    `base` (m, k) holds the baseline's columns, `equation` (m,) each row's equation.
    """

    def __init__(
        self,
        train_data: RegressionData,
        view: MeasurementView | None = None,
        old: ComparisonRows | None = None,
    ) -> None:
        self.train_data, self.view, self._old = train_data, view, old
        self._known: dict[Used, dict[str, Array]] = {}
        label = np.empty(train_data.base.shape[0], dtype=object)
        for s in train_data.segments:
            label[s.where] = s.equation
        parts, labels = [train_data.base], [label]
        if view is not None:
            for equation, rows in view.rows.items():
                parts.append(matrix_of(rows, train_data.names) * view.weight(equation))
                labels.append(np.full(len(rows.rhs), equation, dtype=object))
        self.base, self.equation = np.concatenate(parts), np.concatenate(labels)
        self._places = {e: np.flatnonzero(self.equation == e) for e in dict.fromkeys(self.equation)}
        self._fitted: dict[object, Array] = {}
        self._left: dict[object, dict[str, float]] = {}

    def columns(self, used: Used) -> dict[str, Array]:
        """Return an effect's columns (m,) by name; '' is the change of the signals it makes."""
        if used not in self._known:
            if self._old is not None:
                before = self._old.columns(used)
            else:
                before = {}
                for variant in variant_columns(self.train_data, [used]):
                    before |= dict(zip(variant.names, variant.columns.T, strict=True))
            with_view = self.view is not None
            self._known[used] = self._with_view_columns(used, before) if with_view else before
        return self._known[used]

    def _with_view_columns(self, used: Used, before: Mapping[str, Array]) -> dict[str, Array]:
        assert self.view is not None
        new = self.view.columns(used)
        out = {}
        for name in dict.fromkeys([*before, *(n for c in new.values() for n in c)]):
            parts = [before.get(name, np.zeros(self.train_data.base.shape[0]))]
            for equation, rows in self.view.rows.items():
                column = new.get(equation, {}).get(name, np.zeros(len(rows.rhs)))
                parts.append(column * self.view.weight(equation))
            out[name] = np.concatenate(parts)
        return out

    def prediction(self, explanation: Explanation) -> Array:
        """Return the sum (m,) of an explanation's columns times its sizes."""
        total = np.zeros(len(self.equation))
        for used in explanation.effects:
            for name, column in self.columns(used).items():
                # The baseline's own parameters, which some effects have columns of, are free.
                if name not in self.train_data.names:
                    total += column * (explanation.beta.get(name, 0.0) if name else 1.0)
        return total

    def fit_columns(self, explanation: Explanation) -> Array:
        """Return the columns (m, k) of an explanation's fit, derivatives by its shapes included."""
        blocks = [self.base]
        for used in explanation.effects:
            blocks += [c[:, None] for c in self.columns(used).values()]
            for j, shape in enumerate(shapes_of(self.train_data.rig, used)):
                value = used.shape[j]
                if shape.fixed or not shape.is_present(value):
                    continue
                step = EXPERIMENT.shape_step * (abs(value) or shape.high - shape.low)
                near = value + step if value + step <= shape.high else value - step
                moved = Used(used.term, (*used.shape[:j], near, *used.shape[j + 1 :]))
                ends = [self.prediction(Explanation((u,), explanation.beta)) for u in (moved, used)]
                blocks.append((ends[0] - ends[1])[:, None])
        return np.column_stack(blocks)

    def residual(self, true: Explanation, wrong: Explanation) -> Array:
        """Return the noise-free residual (m,) of the fit of `wrong` where `true` is true.

        Many explanations are compared with one `wrong`, whose columns are factored once.
        """
        if wrong.key not in self._fitted:
            self._fitted[wrong.key] = orthonormal(self.fit_columns(wrong), RANK)
        y, basis = self.prediction(true), self._fitted[wrong.key]
        return np.asarray(y - basis @ (basis.T @ y))

    def energy(self, true: Explanation, wrong: Explanation) -> dict[str, float]:
        """Return the energy of `residual` by equation, computed once."""
        key = true.key, wrong.key
        if key not in self._left:
            residual = self.residual(true, wrong)
            self._left[key] = {
                str(e): float(residual[at] @ residual[at]) for e, at in self._places.items()
            }
        return self._left[key]


def separation(
    question: OpenQuestion, old: ComparisonRows, new: ComparisonRows
) -> tuple[float, str]:
    """Return the separation [noise] by an experiment, and its equation (see the module)."""
    assert new.view is not None
    separations = []
    for true, wrong in _ordered_pairs(question):
        before, after = old.energy(true, wrong), new.energy(true, wrong)
        by_equation = {
            e: float(
                np.sqrt(max(0.0, after[e] - before.get(e, 0.0)) / (EXPERIMENT.repeats * len(r.rhs)))
            )
            for e, r in new.view.rows.items()
        }
        largest = max(by_equation, key=lambda e: by_equation[e], default="")
        separations.append((by_equation.get(largest, 0.0), largest))
    return min(separations)


def present_separation(question: OpenQuestion, old: ComparisonRows) -> float:
    """Return the separation [noise] by the records already taken, in their largest segment."""
    return min(
        largest_rms(old.train_data, old.residual(true, wrong))
        for true, wrong in _ordered_pairs(question)
    )


def largest_rms(train_data: RegressionData, residual: Array) -> float:
    """Return the largest rms of a residual (M,) in one step and equation [noise of a record]."""
    return max(
        float(np.sqrt(np.mean(residual[s.where] ** 2) / s.repeats)) for s in train_data.segments
    )


def _ordered_pairs(question: OpenQuestion) -> Sequence[tuple[Explanation, Explanation]]:
    forward = (question.one, question.other)
    return (forward, forward[::-1]) if question.both_ways else (forward,)
