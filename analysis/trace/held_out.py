"""Error before and after, on held-out records only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.model import Model
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
    return table(judge, model.terms).left(model.beta)


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


def _rms(parts: Sequence[Array]) -> float:
    joined = np.concatenate(parts)
    return float(np.sqrt(np.mean(joined**2))) if len(joined) else float("nan")


def fits(
    rig: Rig, holdout: Sequence[Run], before: Model, after: Model
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the mean free-run FIT [%] of every channel under both models, NaN where it failed."""
    one = _fit(holdout, before)
    return one, one if after is before else _fit(holdout, after)


def _fit(holdout: Sequence[Run], model: Model) -> dict[str, float]:
    try:
        results = validate(model, holdout)
    except InputError:  # a parameter that is not identified: there is no simulation
        return {}
    values: dict[str, list[float]] = {}
    for r in results:
        for channel, fit in r.fit.items():
            values.setdefault(channel, []).append(fit if not r.failure else float("nan"))
    return {c: float(np.mean(v)) for c, v in sorted(values.items())}
