"""What the `study` verbs compute, and their tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tests.studies.estimators.coverage import (
    GOAL,
    MOST_BIAS,
    MOST_BIAS_OF_B,
    Row,
    Trial,
    overall,
    rows,
)
from tests.studies.estimators.jobs import JUDGING_SEED, MODEL, Experiment, all_of
from tests.studies.pages import markdown_table
from tests.studies.pool import Workers

Say = Callable[[str], None]
_SAID = {
    MODEL: "data of the model itself, fresh excitation and noise, against its parameters",
    "plant": "the simulated bench, whose physics is finer, against its true parameters",
}


def coverage_study(
    kinds: Sequence[str],
    experiments: int,
    estimator: str,
    noise: float,
    repeats: int,
    workers: Workers,
    say: Say,
    first: int = JUDGING_SEED,
    folder: Path | None = None,
) -> dict[str, Any]:
    """Measure coverage on each kind; returns the table as JSON-ready data."""
    out: dict[str, Any] = {}
    for kind in kinds:
        jobs = [
            Experiment(kind, first + k, (estimator,), noise, repeats) for k in range(experiments)
        ]
        found = [by[estimator] for _, by in all_of(jobs, workers, say, folder=folder)]
        out[kind] = {
            "experiments": len(found),
            "overall": overall(table := rows(found)),
            "used": _used(found),
            "seconds": float(np.median([t.taking + t.seconds for t in found])),
            "parameters": {r.name: asdict(r) for r in table},
        }
    return {
        "estimator": estimator,
        "noise": noise,
        "repeats": repeats,
        "seeds": [first, first + experiments - 1],
        "goal": list(GOAL),
        "kinds": out,
    }


def _used(found: Sequence[Trial]) -> dict[str, int]:
    return dict(sorted(Counter(t.used for t in found).items()))


def coverage_text(found: dict[str, Any]) -> str:
    """Return the coverage tables as Markdown."""
    lines = []
    for kind, data in found["kinds"].items():
        used = ", ".join(f"{name} in {count}" for name, count in data["used"].items())
        lines += [
            f"**{kind}**: {data['experiments']} experiments on {_SAID[kind]}; seeds "
            f"{found['seeds'][0]} to {found['seeds'][1]}, estimator {found['estimator']} "
            f"({used}), noise x{found['noise']:g}, {found['repeats']} repeats; "
            f"{data['seconds']:.1f} s of processor time each, "
            f"{data['experiments'] * data['seconds'] / 60.0:.0f} minutes in all",
            "",
        ]
        table = [Row(**p) for p in data["parameters"].values()]
        header = ("parameter", "coverage % (95 % interval)", "bias %", "RSD %", "half width %")
        rows = [
            (
                r.name,
                f"{100 * r.coverage:.1f} "
                f"({100 * r.coverage_low:.1f} to {100 * r.coverage_high:.1f})",
                f"{100 * r.bias:+.4f} ± {196 * r.bias_error:.4f}",
                f"{100 * r.rsd:.4f}",
                f"{100 * r.half_width:.4f}",
            )
            for r in table
        ]
        lines += markdown_table(header, rows)
        lines += ["", *_judged(table, data["overall"], found["goal"]), ""]
    return "\n".join(lines).rstrip()


def _judged(table: Sequence[Row], together: float, goal: Sequence[float]) -> list[str]:
    low, high = goal
    outside = [
        f"{r.name} ({100 * r.coverage:.1f}, "
        + ("too narrow" if r.coverage < low else "cautious")
        + (", within chance)" if r.coverage_high >= low and r.coverage_low <= high else ")")
        for r in table
        if not low <= r.coverage <= high
    ]
    biased = [f"{r.name} ({100 * r.bias:+.3f} %)" for r in table if not r.bias_kept]
    worst = max(table, key=lambda r: abs(r.bias))
    return [
        f"- coverage of all parameters together {100 * together:.1f} % (wanted {100 * low:g} to "
        f"{100 * high:g} %); outside of that by themselves: {', '.join(outside) or 'none'}",
        f"- largest bias {100 * worst.bias:+.3f} % ({worst.name}); beyond {100 * MOST_BIAS:g} % "
        f"(b: {100 * MOST_BIAS_OF_B:g} %): {', '.join(biased) or 'none'}",
    ]


def estimator_study(
    estimators: tuple[str, ...],
    noise: Sequence[float],
    experiments: int,
    kind: str,
    workers: Workers,
    say: Say,
    first: int = JUDGING_SEED,
    folder: Path | None = None,
) -> dict[str, Any]:
    """Measure bias, scatter and time of each estimator at each noise, all on the same records."""
    jobs = [
        Experiment(kind, first + k, estimators, level)
        for level in noise
        for k in range(experiments)
    ]
    trials: dict[float, dict[str, list[Trial]]] = {n: {e: [] for e in estimators} for n in noise}
    for experiment, found in all_of(jobs, workers, say, folder=folder):
        for name, one in found.items():
            trials[experiment.noise][name].append(one)
    return {
        "kind": kind,
        "experiments": experiments,
        "seeds": [first, first + experiments - 1],
        "noise": [
            {
                "noise": level,
                "used": {name: _used(found) for name, found in by.items()},
                "estimators": {
                    name: {r.name: asdict(r) for r in rows(found)} for name, found in by.items()
                },
                "seconds": {
                    name: float(np.median([t.seconds for t in found])) if found else None
                    for name, found in by.items()
                },
            }
            for level, by in trials.items()
        ],
    }


def estimator_text(found: dict[str, Any]) -> str:
    """Return bias / RSD [%] per parameter, a column per estimator, a table per noise."""
    lines: list[str] = []
    for part in found["noise"]:
        names = list(part["estimators"])
        lines += [
            f"**noise x{part['noise']:g}**, {found['experiments']} experiments on the "
            f"{found['kind']}, seeds {found['seeds'][0]} to {found['seeds'][1]}; bias / RSD in %"
            + _preferred(part["used"].get("auto", {}), found["experiments"]),
            "",
        ]
        rows = []
        for parameter in part["estimators"][names[0]]:
            cells = []
            for name in names:
                p = part["estimators"][name].get(parameter)
                cells.append(
                    f"{100 * p['bias']:+.3f} / {100 * p['rsd']:.3f}" if p is not None else "—"
                )
            rows.append((parameter, *cells))
        times = [part["seconds"].get(name) for name in names]
        cells = [f"{t:.2g}" if t is not None else "—" for t in times]
        rows.append(("processor's seconds, median", *cells))
        lines += [*markdown_table(("parameter", *names), rows), ""]
    return "\n".join(lines).rstrip()


def _preferred(used: Mapping[str, int], experiments: int) -> str:
    return f"; auto took instruments in {used.get('iv', 0)} of {experiments}" if used else ""
