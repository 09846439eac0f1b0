"""Errors of effects that the user names: those of their shapes, and of their forms."""

from __future__ import annotations

from analysis.effects.base import Effect, shapes_of
from analysis.simulation.model import Estimate, Model
from analysis.trace.judge import inference
from analysis.trace.judge.scatter import form_shift, with_form_errors
from analysis.trace.search.hypothesis import parameter_values
from analysis.trace.search.shapes import ShapeFit


def with_shape_errors(found: ShapeFit, model: Model) -> tuple[Model, dict[str, Estimate]]:
    """Return the model with wider intervals, and the shapes found with their 95 % intervals.

    `model` was identified with the shapes of `found` taken as exact. Its intervals then include the
    uncertainty of the shapes, and errors of the effects' forms (`scatter.with_form_errors`).
    """
    data, fit = found.data, found.fit
    values = parameter_values(data.rig, fit.terms, dict(fit.beta))
    shift = form_shift(data, fit)
    shapes: dict[str, Estimate] = {}
    for used in fit.terms:
        if used in data.terms or not isinstance(used.term, Effect):
            continue
        errors = inference.effect_errors(data, fit, used, values)
        own = {s.parameter for s in shapes_of(data.rig, used)}
        estimates = inference.estimates(data, used, errors, shift)
        shapes |= {name: e for name, e in estimates.items() if name in own}
    return with_form_errors(data, fit, model, shift), shapes
