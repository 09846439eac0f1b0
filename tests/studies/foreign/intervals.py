"""Whether the 95 % intervals of `identify` hold the truth on strangers' clean benches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rig.cli.text.output import table
from tests.studies.foreign.bench import TRAIN, records_of
from tests.studies.foreign.cases import NONE, case_of
from tests.studies.foreign.study import bounds

FOLLOWING = ("continuous", "first-order, held command", "second-order, held command")


@dataclass(frozen=True)
class Covered:
    """One bench: error over half-width and relative half-width of every parameter."""

    seed: int
    form: int
    repeats: int
    noise: float
    estimator: str
    ratio: Mapping[str, float]
    half_width: Mapping[str, float]

    @property
    def hits(self) -> int:
        """Intervals that hold the truth."""
        return sum(abs(r) <= 1.0 for r in self.ratio.values())


def perform(job: tuple[int, str]) -> Covered:
    """Identify a clean bench of a seed with an estimator."""
    from analysis.identify.identify import identify

    seed, estimator = job
    case = case_of(seed, kind=NONE)
    train = records_of(case.bench, TRAIN, 10 * seed, 1.0, case.bench.repeats)
    found = identify([train], estimator=estimator).model.parameters
    ratio, width = {}, {}
    for name, value in case.bench.truth.items():
        low, high = found[name].ci95
        half = max(0.5 * (high - low), 1e-300)
        ratio[name] = (found[name].value - value) / half
        width[name] = half / abs(value)
    b = case.bench
    return Covered(seed, b.form, b.repeats, b.noise, estimator, ratio, width)


def line_of(o: Covered) -> str:
    """Return a bench in one line, its misses with how far off they are."""
    missed = ", ".join(
        f"{n} {abs(r):.1f} x {100 * o.half_width[n]:.2g} %"
        for n, r in o.ratio.items()
        if abs(r) > 1.0
    )
    return (
        f"seed {o.seed}, {FOLLOWING[o.form]}, {o.repeats} repeats, noise {o.noise:g}: "
        f"{o.hits}/{len(o.ratio)}" + (f"; off {missed}" if missed else "")
    )


def text(outcomes: Sequence[Covered]) -> str:
    """Return the share of intervals that hold, pooled by the spool's path, and by parameter."""
    rows = []
    for k, word in (*enumerate(FOLLOWING), (-1, "all")):
        here = [o for o in outcomes if k in (-1, o.form)]
        hits, of = sum(o.hits for o in here), sum(len(o.ratio) for o in here)
        low, high = bounds(hits, of)
        width = sorted(w for o in here for w in o.half_width.values())
        middle = f"{100 * width[len(width) // 2]:.2g} %" if width else "-"
        share = f"{100 * hits / of:.1f} %" if of else "-"
        rows.append([word, str(len(here)), f"{hits} of {of}", share,
                     f"{100 * low:.0f} to {100 * high:.0f} %", middle])  # fmt: skip
    names = list(dict.fromkeys(n for o in outcomes for n in o.ratio))
    each = [[n, f"{sum(abs(o.ratio[n]) <= 1 for o in outcomes)} of {len(outcomes)}"] for n in names]
    head = [
        "spool's path",
        "benches",
        "hold",
        "share",
        "one-sided 95 % bounds",
        "half-width, median",
    ]
    return table(head, rows) + "\n\n" + table(["parameter", "hold"], each)


def loaded(job: tuple[int, str], data: Mapping[str, Any]) -> Covered:
    """Return a kept outcome."""
    return Covered(**data)
