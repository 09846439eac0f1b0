"""How good predicted errors are, and what a design gains: experiments on simulated benches.

Each protocol is run on benches of several seeds, in this process, twice: with the oil held at its
temperature, where sensor noise is all that differs between repeats, for plain least squares; and
with the oil swinging as the rig states, for the estimator that a person gets.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.design.predict import ParameterPrediction
from analysis.identify.identify import identify
from analysis.identify.result import PLAIN
from protocols.files import library
from protocols.files.plan import resolve
from rig.cli.proof.predicted_errors import of_plan, percent
from rig.cli.proof.twin_choice import TwinSource, load_twin
from rig.cli.text.output import table
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs.rigs import load_bench
from tests.studies.direct_bench import simulated_run

Say = Callable[[str], None]
DEFAULT = "ls"  # what `bramah identify` takes unasked: it allows for what the oil does


@dataclass(frozen=True)
class DesignScatter:
    """One parameter on the benches, relative to the truth.

    `std` is the root mean square of the standard errors identified, `scatter`
    the standard deviation of the estimates' errors between benches, `bias` their mean.
    """

    std: float
    scatter: float
    bias: float


@dataclass(frozen=True)
class Studied:
    """One protocol: predicted, found with steady oil, found with swinging oil, by parameter."""

    protocol: str
    seeds: int
    predicted: Mapping[str, ParameterPrediction]
    steady: Mapping[str, DesignScatter]
    swinging: Mapping[str, DesignScatter]


def study(protocols: Sequence[str], rig: str, first: int, seeds: int, say: Say) -> list[Studied]:
    """Run every protocol on `seeds` benches, `first` the first; raises InputError for bad ones."""
    bench = load_bench(rig)
    oil = bench.oil.model_copy(update={"temperature_band": 0.0})
    still = bench.model_copy(update={"oil": oil})
    out = []
    for name in protocols:
        forecast = of_plan(resolve(library.load(name), bench), load_twin(TwinSource(), bench))
        if forecast.prediction is None:
            raise InputError(f"{name}: {forecast.reason}")
        benches = range(first, first + seeds)
        found = [
            _found(name, still, benches, PLAIN, say),
            _found(name, bench, benches, DEFAULT, say),
        ]
        out.append(Studied(name, seeds, forecast.prediction.parameters, *found))
    return out


def _found(
    protocol: str, rig: Rig, seeds: Sequence[int], estimator: str, say: Say
) -> dict[str, DesignScatter]:
    errors: dict[str, list[float]] = {}
    stds: dict[str, list[float]] = {}
    for seed in seeds:
        band = rig.oil.temperature_band
        say(f"{protocol}, bench {seed}, oil +- {band:g} K")
        run, truth = simulated_run(rig, protocol, seed)
        for name, estimate in identify([run], estimator=estimator).estimates.items():
            errors.setdefault(name, []).append(estimate.value / truth[name] - 1.0)
            stds.setdefault(name, []).append(estimate.std / abs(truth[name]))
    return {
        name: DesignScatter(
            float(np.sqrt(np.mean(np.square(stds[name])))),
            float(np.std(values, ddof=1)) if len(values) > 1 else math.nan,
            float(np.mean(values)),
        )
        for name, values in errors.items()
    }


def study_text(found: Sequence[Studied]) -> str:
    """Return one table per protocol and, for two, what the second gains over the first."""
    parts = [_prediction_table(one) for one in found]
    if len(found) == 2:
        parts.append(_gain_table(*found))
    return "\n\n".join(parts)


def _prediction_table(one: Studied) -> str:
    header = [
        "parameter", "predicted %", "repeats %", "ratio", "benches %",
        "oil: given %", "oil: benches %", "oil: bias %", "oil's swing %",
    ]  # fmt: skip
    rows = []
    for name, expected in one.predicted.items():
        steady, swing = one.steady[name], one.swinging[name]
        rows.append([
            name, percent(expected.std), percent(steady.std), f"{steady.std / expected.std:.2f}",
            percent(steady.scatter), percent(swing.std), percent(swing.scatter),
            percent(swing.bias), percent(expected.oil),
        ])  # fmt: skip
    ratios = [one.steady[n].std / e.std for n, e in one.predicted.items()]
    return (
        f"{one.protocol}, {one.seeds} benches\n{table(header, rows)}\n"
        f"found over predicted: {min(ratios):.2f} to {max(ratios):.2f}"
    )


def _gain_table(before: Studied, after: Studied) -> str:
    header = ["parameter", "predicted", "", "ratio", "found", "", "ratio"]
    rows = []
    for name, expected in before.predicted.items():
        later, was, now = after.predicted[name], before.steady[name], after.steady[name]
        rows.append([
            name, percent(expected.std), percent(later.std), f"{later.std / expected.std:.2f}",
            percent(was.std), percent(now.std), f"{now.std / was.std:.2f}",
        ])  # fmt: skip
    return (
        f"from {before.protocol} to {after.protocol}, standard errors in %\n{table(header, rows)}"
    )


def study_json(found: Sequence[Studied]) -> list[dict[str, Any]]:
    """Return the figures as plain data, relative."""
    return [
        {
            "protocol": one.protocol,
            "benches": one.seeds,
            "parameters": {
                name: {
                    "predicted_std": e.std,
                    "predicted_oil": e.oil,
                    "steady_oil": vars(one.steady[name]),
                    "swinging_oil": vars(one.swinging[name]),
                }
                for name, e in one.predicted.items()
            },
        }
        for one in found
    ]
