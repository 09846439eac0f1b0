"""Estimate shapes of effects with a hidden state by multiple shooting, from the rows' estimates.

In the rows a hidden state (a lagging spool, a contact's deflection) follows the *measured* path,
through filters that round every reversal; in a simulation it follows the simulated one. So the
shapes of such an effect are searched again with free runs over short windows
(`analysis.identify.output_error.fit`), together with the coefficients of the equations that the
effect acts in; the others keep the rows' estimates. This estimate is not always better: a free run
integrates the measured spool's noise. `window_error` compares both on other records.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, Shape, shape_values, shapes_of
from analysis.identify.output_error.fit import Search
from analysis.identify.output_error.windows import Windows
from analysis.identify.settings import IDENTIFY
from analysis.simulation.model import Estimate, Model
from analysis.terms.base import inverted
from rig.model.parse import InputError
from rig.model.records import Run

Array = NDArray[np.float64]
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ShootingEstimate:
    """Shapes of one effect estimated by multiple shooting: estimates by name, number of windows.

    `before` and `after` are the window errors on other records with the rows' shapes and with these
    [sigma] (see `window_error`), `taken` whether these replaced the rows' shapes.
    """

    name: str
    where: str
    shapes: Mapping[str, Estimate]
    windows: int
    settled: bool
    before: float = math.nan
    after: float = math.nan
    taken: bool = False


def hidden_effects(model: Model) -> list[Effect]:
    """Return the effects of a model whose present shapes have hidden states."""
    return [
        u.term
        for u in model.terms
        if isinstance(u.term, Effect)
        and u.term.hidden(model.rig)
        and u.term.remembers(u.shape)
        and not u.term.free
    ]


def completed(runs: Sequence[Run], model: Model) -> Model | None:
    """Return the model with nominal values for unidentified parameters of joints that never move.

    None where a parameter of a moving joint was not identified, or there is no nominal value.
    """
    rig = model.rig
    never_moved = set(range(1, len(rig.joints) + 1))
    for record in (r for run in runs for r in run.records):
        never_moved &= set(record.locked)
    values = {}
    for name, estimate in model.parameters.items():
        if estimate.identified:
            continue
        joints = {int(digit) for digit in name if digit.isdecimal()}
        if not joints & never_moved or name not in rig.nominal:
            return None
        values[name] = replace(estimate, value=rig.nominal[name], ci95=(rig.nominal[name],) * 2)
    return replace(model, parameters={**model.parameters, **values})


def shot(runs: Sequence[Run], model: Model, effect: Effect) -> ShootingEstimate | None:
    """Estimate an effect's shapes by multiple shooting; None where no window can be simulated."""
    bounds = {s.parameter: s for s in _shapes(model, effect)}
    try:  # perhaps every window has a lost sample or a sensor at the end of its range
        windows = _windows(runs, model, effect, _free(model, effect))
        theta = _theta(windows, model)
        low, high = np.full(len(theta), -np.inf), np.full(len(theta), np.inf)
        for name, shape in bounds.items():
            index = windows.names.index(name)
            low[index], high[index] = shape.low, shape.high
        search = Search(windows, low, high).run(theta)
    except (InputError, np.linalg.LinAlgError) as error:
        log.info("%s is not fitted by shooting: %s", effect.name, error)
        return None
    shapes = {}
    for name, shape in bounds.items():
        k = windows.names.index(name)
        value, half = float(search.value[k]), float(search.spread.half[k])
        std = float(np.sqrt(search.spread.covariance[k, k]))
        shapes[name] = Estimate(value, shape.unit, std, (value - half, value + half))
    return ShootingEstimate(effect.name, effect.where, shapes, len(windows.placed), search.check.ok)


def window_error(runs: Sequence[Run], model: Model, effect: Effect) -> float:
    """Return the error of a model over windows of records, each from its best start [sigma].

    The rms of measured minus simulated piston and pressures over the sensors' noise; inf where a
    window cannot be simulated, or the joint moves in none.
    """
    try:
        windows = _windows(runs, model, effect, frozenset())
        starts = [windows.measured_start(s) for s in windows.placed]
        reduced = windows.linearised(_theta(windows, model), starts, windows.sigma())
    except (InputError, np.linalg.LinAlgError) as error:
        log.info("%s is not judged by windows: %s", effect.name, error)
        return float("inf")
    good = [r for r in reduced if r is not None]
    if len(good) < len(reduced):
        return float("inf")
    return float(np.sqrt(sum(r.least_cost for r in good) / sum(r.residual.size for r in good)))


def _windows(runs: Sequence[Run], model: Model, effect: Effect, free: frozenset[str]) -> Windows:
    """Return windows of the records that excite the effect's joint; InputError without one."""
    moving = [
        replace(run, records=tuple(r for r in run.records if effect.joint + 1 not in r.locked))
        for run in runs
    ]
    rig = model.rig
    if not any(run.records for run in moving):
        raise InputError(f"joint {effect.joint + 1} moves in no record")
    shapes = tuple(s.parameter for s in _shapes(model, effect))
    return Windows(rig, moving, model.terms, shapes, IDENTIFY.shape_seconds, free)


def _shapes(model: Model, effect: Effect) -> tuple[Shape, ...]:
    """Return the shapes that the effect has in the model and that a search may change."""
    used = next(u for u in model.terms if u.term == effect)
    shapes = zip(shapes_of(model.rig, used), used.shape, strict=True)
    return tuple(s for s, value in shapes if s.is_present(value) and not s.fixed)


def _theta(windows: Windows, model: Model) -> Array:
    """Return the windows' parameters (k,) from the model, 1/b for b."""
    values = inverted(model.rig, model.terms, model.values)
    for used in model.terms:
        values |= shape_values(model.rig, used)
    return np.array([values[n] for n in windows.names])


def _free(model: Model, effect: Effect) -> frozenset[str]:
    """Return the effect's own parameters and its joint's parameters of the equations it acts in."""
    rig, joint = model.rig, effect.joint + 1
    effect_parameters = {c.parameter for c in effect.coefficients(rig)}
    family = "mechanical" if effect_parameters else "fluid"
    others = {
        c.parameter
        for used in model.terms
        for c in used.term.coefficients(rig)
        if c.family == family and (c.parameter == "b" or c.parameter.endswith(str(joint)))
    }
    return frozenset(effect_parameters | others | {s.parameter for s in _shapes(model, effect)})
