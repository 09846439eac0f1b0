"""Identify parameters with intervals, checks and a model from runs, by any method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from analysis.effects.supply import PortEffect
from analysis.identify import checks as ck
from analysis.identify.coupled import coupled, with_identified_bulk_modulus
from analysis.identify.estimation import OUTPUT_ERROR, refuse_unknown
from analysis.identify.geometry import tolerances_ignored
from analysis.identify.methods.population_search import search_parameters
from analysis.identify.methods.search import SearchOptions
from analysis.identify.methods.sequential import sequential
from analysis.identify.methods.simultaneous import simultaneous
from analysis.identify.result import PLAIN, Identification
from analysis.identify.settings import IDENTIFY
from analysis.regression.rows import Filtering, default_filtering
from analysis.terms import baseline_of
from analysis.terms.base import Used
from rig.model.parse import InputError
from rig.model.records import (
    Record,
    Run,
    refuse_malformed,
    refuse_repeated_runs,
    with_loads_stated,
)

METHODS = ("coupled", "sequential", "simultaneous", "pso", "ga")
HYDRAULIC = ("sequential", "pso", "ga")


def identify(
    runs: Sequence[Run],
    method: str = "coupled",
    terms: Sequence[Used] | None = None,
    filtering: Callable[[Record], Filtering] = default_filtering,
    reject_noise: bool = True,
    estimator: str = "auto",
    bootstrap: int = 0,
    rng: np.random.Generator | None = None,
    search: SearchOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> Identification:
    """Identify all parameters from all records of the runs at once (the paper's STEP4).

    `terms` defaults to the paper's model. `reject_noise` False also returns parameters that are
    determined mostly by sensor noise, for studies. Other methods than "coupled" are in
    `analysis.identify.methods`; `search` is for pso and ga. `estimator` is one of
    `analysis.identify.estimation.ESTIMATORS` ("auto": least squares, or instrumental variables
    where noise in the regressors biases it by more than matters) or "plain", without nuisances;
    `bootstrap` > 0 takes the intervals from so many draws of whole repeats; `rng` (default: seed 0)
    draws them; `progress` receives the share of the runs that the coupled method has processed.
    Raises InputError for another method or estimator, for runs of different rigs or with the same
    samples, and for records that cannot be used, naming record and channel.
    """
    refuse_malformed(runs)
    if method not in METHODS:
        raise InputError(f"unknown method {method!r}; known: {' '.join(METHODS)}")
    _refuse_estimator(estimator, bootstrap)
    rig, runs = ck.common_rig(runs), with_loads_stated(runs)
    refuse_repeated_runs(runs)
    used = tuple(terms) if terms is not None else tuple(map(Used, baseline_of(rig)))
    if method in HYDRAULIC and rig.electric:
        raise InputError(
            f"the method {method} needs pressures and flows, and rig {rig.name!r} is electric; "
            "expected coupled or simultaneous"
        )
    if method != "coupled":
        if method == "sequential":
            result = sequential(runs, used, filtering, reject_noise)
        elif method == "simultaneous":
            result = simultaneous(runs, used, filtering, reject_noise)
        else:
            rng, options = rng or np.random.default_rng(0), search or SearchOptions()
            result = search_parameters(method, runs, used, filtering, rng, options)
        if result.geometry is None and rig.uncertain_numbers:
            result = result.with_checks((*result.checks, tolerances_ignored(rig, method)))
        return result
    if any(isinstance(u.term, PortEffect) for u in used):
        (runs,) = with_identified_bulk_modulus(runs, used)
    result = coupled(runs, used, filtering, reject_noise, estimator, bootstrap, rng, progress)
    return replace(result, model=replace(result.model, rig=rig))


def _refuse_estimator(estimator: str, bootstrap: int) -> None:
    if estimator != PLAIN:
        refuse_unknown(estimator)
    if bootstrap and bootstrap < IDENTIFY.least_draws:
        raise InputError(
            f"{bootstrap} bootstrap draws are too few for a 95 % interval; "
            f"take {IDENTIFY.least_draws} or more"
        )
    if bootstrap and estimator in (PLAIN, OUTPUT_ERROR):
        raise InputError(f"--bootstrap does not go with --estimator {estimator}; take ls or iv")
