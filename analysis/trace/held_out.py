"""Error before and after, on held-out records only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.nuisance import KAPPA
from analysis.model import Model
from analysis.trace.beside import plausible
from analysis.trace.board import Board
from analysis.trace.evidence import Scene, residual, scene_rows
from analysis.trace.floor import floors
from analysis.trace.refine import Fit, table
from analysis.validate import validate
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Errors:
    """RMS of each equation's residual over the held-out records, SI, beside its noise floor."""

    noise: Mapping[str, float]
    before: Mapping[str, float]
    after: Mapping[str, float]


def left(judge: Board, model: Fit) -> Array:
    """Return the whitened held-out residual (M,) of a model fitted to other records."""
    return table(judge, model.terms).left(settled(judge, model).beta)


def settled(judge: Board, model: Fit) -> Fit:
    """Return the model with the oil's temperature part of 1/b as the held-out records have it.

    Records at one temperature say nothing of it, and others then warm up: it is no parameter of
    the model and no effect, so that one number may be fitted on either side.
    """
    rows = table(judge, model.terms)
    if KAPPA not in rows.names:
        return model
    column = rows.matrix[:, rows.names.index(KAPPA)]
    size = float(column @ column)
    step = float(column @ rows.left(model.beta)) / size if size > 0 else 0.0
    kappa = plausible(model.beta.get(KAPPA, 0.0) + step, model.beta)
    return replace(model, beta={**model.beta, KAPPA: kappa})


def errors(rig: Rig, members: Sequence[Scene], before: Fit, after: Fit) -> Errors:
    """Return every equation's error under both models, and the noise floor, over all records.

    The floor is what does not repeat under the model after: its columns carry the sensors' noise
    into the residual as the baseline's do.
    """
    found: dict[str, dict[str, list[Array]]] = {}
    built = {}
    for label, model in (("before", before), ("after", after)):
        built[label] = [scene_rows(rig, model.terms, scene) for scene in members]
        found[label] = {}
        for rows_of in built[label]:
            for equation, rows in rows_of.items():
                found[label].setdefault(equation, []).append(residual(rows, model.beta))
    split = floors(rig, after.terms, members, built["after"], after.beta)
    floor = {(f.group, f.equation): f.noise for f in split}
    noise: dict[str, list[float]] = {}
    counts: dict[str, list[int]] = {}
    for scene, rows_of in zip(members, built["after"], strict=True):
        for equation, rows in rows_of.items():
            noise.setdefault(equation, []).append(floor[scene.group, equation])
            counts.setdefault(equation, []).append(len(rows.rhs))
    return Errors(
        {
            e: float(np.sqrt(np.average(np.square(noise[e]), weights=np.maximum(counts[e], 1))))
            for e in sorted(noise)
        },
        {e: _rms(found["before"][e]) for e in sorted(found["before"])},
        {e: _rms(found["after"][e]) for e in sorted(found["after"])},
    )


def rms_of(judge: Board, model: Fit) -> dict[str, float]:
    """Return the rms of every equation's held-out residual, SI, repeats averaged."""
    rest = left(judge, model)
    found: dict[str, list[Array]] = {}
    for s in judge.segments:
        found.setdefault(s.equation, []).append(rest[s.where] * s.noise / np.sqrt(s.repeats))
    return {e: _rms(parts) for e, parts in sorted(found.items())}


def sizes(rig: Rig, members: Sequence[Scene], model: Fit) -> dict[str, float]:
    """Return the rms of every equation's right side (torque, force or flow), SI."""
    found: dict[str, list[Array]] = {}
    for scene in members:
        for equation, rows in scene_rows(rig, model.terms, scene).items():
            found.setdefault(equation, []).append(rows.rhs)
    return {e: _rms(parts) for e, parts in sorted(found.items())}


def _rms(parts: Sequence[Array]) -> float:
    joined = np.concatenate(parts)
    return float(np.sqrt(np.mean(joined**2))) if len(joined) else float("nan")


@dataclass(frozen=True)
class FreeRuns:
    """Free runs over the held-out records, by channel: mean FIT [%], RMSE [SI]; NaN if failed."""

    fit: Mapping[str, float]
    rmse: Mapping[str, float]


def free_runs(holdout: Sequence[Run], before: Model, after: Model) -> tuple[FreeRuns, FreeRuns]:
    """Return the free runs of both models, driven by the measured spool or drive alone."""
    one = _free_runs(holdout, before)
    return one, one if after is before else _free_runs(holdout, after)


def _free_runs(holdout: Sequence[Run], model: Model) -> FreeRuns:
    try:
        results = validate(model, holdout)
    except InputError:  # a parameter that is not identified: there is no simulation
        return FreeRuns({}, {})
    fits: dict[str, list[float]] = {}
    squares: dict[str, list[float]] = {}
    for r in results:
        for channel in r.fit:
            lost = bool(r.failure)
            fits.setdefault(channel, []).append(float("nan") if lost else r.fit[channel])
            squares.setdefault(channel, []).append(float("nan") if lost else r.rmse[channel] ** 2)
    return FreeRuns(
        {c: float(np.mean(v)) for c, v in sorted(fits.items())},
        {c: float(np.sqrt(np.mean(v))) for c, v in sorted(squares.items())},
    )
