"""What each filter costs: bias and scatter of every parameter, measured on data of known truth.

`table` runs the comparison, `markdown` prints it for the documentation. The choice of
`analysis.regression.rows.default_filtering` rests on it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.identify.identify import identify
from analysis.identify.result import PLAIN
from analysis.regression.rows import Filtering, default_filtering
from analysis.signals.filters import (
    Smoother,
    butterworth,
    channel_filter,
    moving_average,
    row_filter,
    row_step,
)
from analysis.simulation.synthetic import multisine, sine, synthetic_run
from rig.model.records import Record, Run
from rig.model.rig import Rig
from tests.studies.estimators.other_filters import (
    FourierSmoother,
    savitzky_golay,
    smoothing_spline,
)
from tests.studies.pages import markdown_table

Choice = Callable[[Record], Filtering]

GROUPS: Mapping[str, tuple[str, ...]] = {
    "inertia": ("M", "R"),
    "friction": ("Fv",),
    "gravity": ("W",),
    "b": ("b",),
    "gains": ("C_",),
}


@dataclass(frozen=True)
class Entry:
    """One filter on one excitation: worst |bias| and worst scatter [%] of each parameter group."""

    excitation: str
    filtering: str
    bias: Mapping[str, float]
    scatter: Mapping[str, float]


def candidates(rate: float) -> dict[str, Choice]:
    """Return the filters compared, by name: channels' filter, then rows' filter."""

    def pair(channels: Smoother, cutoff: float | None) -> tuple[str, Choice]:
        rows = None if cutoff is None else row_filter(rate, cutoff)
        step = 1 if cutoff is None else row_step(rate, cutoff)
        name = f"{channels.name}; rows {'raw' if cutoff is None else f'{cutoff:g} Hz'}"
        return name, lambda _: Filtering(channels, rows, step)

    wide = channel_filter(rate)
    return dict(
        [
            pair(moving_average(rate), None),
            pair(moving_average(rate), 15.0),
            pair(savitzky_golay(rate), None),
            pair(savitzky_golay(rate), 15.0),
            pair(smoothing_spline(rate, 25.0), None),
            pair(smoothing_spline(rate, 80.0), 15.0),
            pair(butterworth(rate, 25.0), None),
            pair(butterworth(rate, 80.0), 15.0),
            pair(FourierSmoother(rate, 80.0), 15.0),
            pair(wide, None),
            pair(wide, 8.0),
            pair(wide, 15.0),
            pair(wide, 25.0),
            pair(wide, 40.0),
            ("default (windowed sinc, 80 Hz; rows 1.5 times the top line)", default_filtering),
        ]
    )


def table(rig: Rig, rng: np.random.Generator, repeats: int = 6) -> list[Entry]:
    """Return the comparison on the 1 Hz sine and on the multisine, both at stated noise."""
    rate = rig.sample_rate
    runs = {
        "sine 1 Hz": synthetic_run(rig, rng, sine(rate, 1.0), rms=0.05, repeats=repeats),
        "multisine 0.3-9.5 Hz": synthetic_run(
            rig, rng, multisine(rng, rate, 10.0, 9.5), rms=0.025, repeats=repeats
        ),
    }
    return [
        _entry(rig, run, excitation, name, choice)
        for excitation, run in runs.items()
        for name, choice in candidates(rate).items()
    ]


def _entry(rig: Rig, run: Run, excitation: str, name: str, choice: Choice) -> Entry:
    found = identify([run], filtering=choice, reject_noise=False, estimator=PLAIN).estimates
    bias, scatter = {}, {}
    for group, prefixes in GROUPS.items():
        members = [p for p in found if p.startswith(prefixes)]
        bias[group] = max(100 * abs(found[p].value / rig.nominal[p] - 1) for p in members)
        scatter[group] = max(100 * abs(found[p].std / rig.nominal[p]) for p in members)
    return Entry(excitation, name, bias, scatter)


def as_json(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Return the table as plain data."""
    return [
        {"excitation": e.excitation, "filtering": e.filtering, "bias_percent": dict(e.bias),
         "scatter_percent": dict(e.scatter)}
        for e in entries
    ]  # fmt: skip


def markdown(entries: Sequence[Entry]) -> str:
    """Return the table as Markdown: worst bias / standard error [%] of each group."""
    rows = [
        (e.excitation, e.filtering, *(f"{e.bias[g]:.3f} / {e.scatter[g]:.3f}" for g in GROUPS))
        for e in entries
    ]
    header = ("excitation", "filter of channels; of rows", *GROUPS)
    return "\n".join(markdown_table(header, rows))
