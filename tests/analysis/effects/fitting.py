"""Least squares over rows with a search over shapes: what a user of the catalogue does by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.effects.base import Effect, ordered
from analysis.regression.rows import Filtering, Rows, default_filtering, record_rows
from analysis.signals.conditioning import Signals, condition
from analysis.simulation.model import Estimate, Model
from analysis.terms import baseline
from analysis.terms.base import FAMILIES, Used, family_of
from rig.model.records import Run
from rig.model.rig import Rig
from tests.studies.effects.simulated import searched


@dataclass(frozen=True)
class Fit:
    """Coefficients by parameter, the shape, RMS of the residual by equation."""

    values: dict[str, float]
    shape: tuple[float, ...]
    rms: dict[str, float]

    def of(self, effect: Effect) -> dict[str, float]:
        """Return all parameters, shapes beside coefficients."""
        return self.values | dict(
            zip(effect.shape_names()[: len(self.shape)], self.shape, strict=True)
        )


class Data:
    """The conditioned records of a run."""

    def __init__(self, run: Run) -> None:
        self.rig = run.rig
        self.records: list[tuple[Signals, Filtering]] = []
        for record in run.records:
            filters = default_filtering(record)
            self.records.append((condition(run.rig, record, filters.channels), filters))

    def rows(self, effects: Sequence[Used]) -> list[Rows]:
        terms = ordered((*(Used(t) for t in baseline()), *effects))
        return [
            rows
            for signals, filters in self.records
            for rows in record_rows(self.rig, terms, signals, filters).values()
        ]

    def solved(self, effects: Sequence[Used]) -> Fit:
        rows = self.rows(effects)
        values: dict[str, float] = {}
        for family in FAMILIES:
            here = [r for r in rows if family_of(r.equation) == family]
            X, y = np.concatenate([r.matrix for r in here]), np.concatenate([r.rhs for r in here])
            scale = np.linalg.norm(X, axis=0) + 1e-300
            beta = np.linalg.lstsq(X / scale, y, rcond=1e-9)[0] / scale
            values |= dict(zip(here[0].names, beta, strict=True))
        shape = effects[-1].shape if effects else ()
        return Fit(values, shape, residual(rows, values))


def residual(rows: Sequence[Rows], values: dict[str, float]) -> dict[str, float]:
    left: dict[str, list[np.ndarray]] = {}
    for r in rows:
        beta = np.array([values[name] for name in r.names])
        left.setdefault(r.equation, []).append(r.rhs - r.matrix @ beta)
    return {name: float(np.sqrt(np.mean(np.concatenate(e) ** 2))) for name, e in left.items()}


def fitted(data: Data, effect: Effect, floor: dict[str, float], tries: int = 60) -> Fit:
    """Search the effect's shape from its grid and solve; residuals are weighed by `floor`.

    A form with further fixed numbers is searched as well, the other forms are taken as they are.
    """

    def solved(shape: Sequence[float]) -> Fit:
        return data.solved([Used(effect, tuple(shape))])

    def cost(shape: Sequence[float]) -> float:
        fit = solved(shape)
        return sum((fit.rms[name] / floor[name]) ** 2 for name in floor)

    shapes = effect.shapes(data.rig)
    found = searched(shapes, cost, tries)
    forms = [found, *effect.further_points(data.rig)]
    for form in effect.other_form_starts(data.rig, found):
        n, fixed = len(found), form[len(found) :]
        own = searched(shapes[:n], lambda s, fixed=fixed: cost((*s, *fixed)), tries)
        forms.append((*own, *fixed))
    return solved(min(forms, key=cost))


def model_of(rig: Rig, effect: Effect, values: dict[str, float], shape: Sequence[float]) -> Model:
    """Return a model of given values; 1/b becomes b."""
    terms = ordered((*(Used(t) for t in baseline()), Used(effect, tuple(shape))))
    parameters = {
        c.parameter: Estimate(values[c.parameter], c.unit, 0.0, (0.0, 0.0))
        for used in terms
        for c in used.term.coefficients(rig)
    }
    k = len(parameters)
    return Model(rig, terms, parameters, np.zeros((k, k)))
