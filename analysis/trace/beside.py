"""What is known to act beside the baseline and is no effect to be named: the oil's temperature.

Oil warms from record to record, and its bulk modulus falls with it. On records that measure the
temperature this is one column (`analysis.estimators.nuisance.BulkTemperature`) with nothing to
guess. Without it every long experiment leaves a residual that repeats, and true effects found in
the same equations could not be taken to the noise floor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from analysis.estimators.nuisance import (
    IMPLAUSIBLE,
    KAPPA,
    SLOPE,
    SLOPE_STD,
    BulkTemperature,
)
from analysis.model import Model
from analysis.terms import baseline_of
from analysis.terms.base import Used
from rig.model import channels as ch
from rig.model.records import Run
from rig.model.rig import Rig

LEAST_SPAN = 0.05  # [K] between all records: less moves b by a fraction of 0.001


def base_terms(rig: Rig, runs: Sequence[Run]) -> tuple[Used, ...]:
    """Return the rig's baseline terms with those that belong beside them on these records."""
    terms = tuple(map(Used, baseline_of(rig)))
    return (*terms, *beside(terms, runs))


def beside(terms: Sequence[Used], runs: Sequence[Run]) -> tuple[Used, ...]:
    """Return the terms that belong beside the baseline on these records, held-out ones included."""
    if "compressibility" not in {used.term.name for used in terms}:
        return ()
    records = [record for run in runs for record in run.records]
    if not records or any(ch.TEMPERATURE not in record.channels for record in records):
        return ()
    means = [float(np.nanmean(np.asarray(record.channels[ch.TEMPERATURE]))) for record in records]
    return (Used(BulkTemperature()),) if np.ptp(means) > LEAST_SPAN else ()


def plausible(kappa: float, beta: Mapping[str, float]) -> float:
    """Return 1/b's change per kelvin [1/(Pa K)], held to what oil and hoses can do."""
    size = abs(beta.get("b", 0.0))  # of the rows: 1/b
    low, high = (-(SLOPE + sign * IMPLAUSIBLE * SLOPE_STD) * size for sign in (1.0, -1.0))
    return float(np.clip(kappa, low, high))


def stripped(model: Model) -> Model:
    """Return the model at the rig's nominal temperature: the parameters without the nuisance."""
    names = list(model.parameters)
    if KAPPA not in names:
        return model
    kept = [k for k, name in enumerate(names) if name != KAPPA]
    return replace(
        model,
        terms=tuple(u for u in model.terms if not isinstance(u.term, BulkTemperature)),
        parameters={names[k]: model.parameters[names[k]] for k in kept},
        covariance=model.covariance[np.ix_(kept, kept)],
    )
