"""What the `study` verbs compute, and their tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from analysis.estimators.coverage import GOAL, Row, Trial, overall, rows
from rig.cli.study_jobs import JUDGING_SEED, MODEL, Experiment, all_of

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
    workers: int,
    say: Say,
) -> dict[str, Any]:
    """Measure coverage on each kind; returns the table as JSON-ready data."""
    jobs = [
        Experiment(kind, JUDGING_SEED + k, (estimator,), noise, repeats)
        for kind in kinds
        for k in range(experiments)
    ]
    trials: dict[str, list[Trial]] = {kind: [] for kind in kinds}
    for experiment, found in all_of(jobs, workers, say):
        trials[experiment.kind].append(found[estimator])
    return {
        "estimator": estimator,
        "noise": noise,
        "repeats": repeats,
        "seeds": [JUDGING_SEED, JUDGING_SEED + experiments - 1],
        "goal": list(GOAL),
        "kinds": {
            kind: {
                "experiments": len(found),
                "overall": overall(table := rows(found)),
                "parameters": {r.name: asdict(r) for r in table},
            }
            for kind, found in trials.items()
        },
    }


def coverage_text(found: dict[str, Any]) -> str:
    """Return the coverage tables as Markdown."""
    lines = []
    for kind, data in found["kinds"].items():
        lines += [
            f"{kind}: {data['experiments']} experiments on {_SAID[kind]}; "
            f"estimator {found['estimator']}, noise x{found['noise']:g}, "
            f"{found['repeats']} repeats",
            "",
            "| parameter | coverage % (95 % interval) | bias % | RSD % | half width % |",
            "|---|---|---|---|---|",
        ]
        for p in data["parameters"].values():
            r = Row(**p)
            lines.append(
                f"| {r.name} | {100 * r.coverage:.1f} "
                f"({100 * r.coverage_low:.1f} to {100 * r.coverage_high:.1f}) | "
                f"{100 * r.bias:+.4f} ± {196 * r.bias_error:.4f} | {100 * r.rsd:.4f} | "
                f"{100 * r.half_width:.4f} |"
            )
        low, high = found["goal"]
        table = [Row(**p) for p in data["parameters"].values()]
        outside = [r.name for r in table if not low <= r.coverage <= high]
        worst = max(table, key=lambda r: abs(r.bias))
        lines += [
            "",
            f"all parameters together: {100 * data['overall']:.1f} % "
            f"(wanted {100 * low:g} to {100 * high:g} %); outside of that by themselves: "
            f"{', '.join(outside) or 'none'}; largest bias {100 * worst.bias:+.3f} % "
            f"({worst.name})",
            "",
        ]
    return "\n".join(lines).rstrip()


def estimator_study(
    estimators: tuple[str, ...],
    noise: Sequence[float],
    experiments: int,
    kind: str,
    workers: int,
    say: Say,
) -> dict[str, Any]:
    """Measure bias and scatter of each estimator at each noise, all on the same records."""
    jobs = [
        Experiment(kind, JUDGING_SEED + k, estimators, level)
        for level in noise
        for k in range(experiments)
    ]
    trials: dict[float, dict[str, list[Trial]]] = {n: {e: [] for e in estimators} for n in noise}
    for experiment, found in all_of(jobs, workers, say):
        for name, one in found.items():
            trials[experiment.noise][name].append(one)
    return {
        "kind": kind,
        "experiments": experiments,
        "noise": [
            {
                "noise": level,
                "flagged": sum(t.flagged for t in next(iter(by.values()))),
                "estimators": {
                    name: {r.name: asdict(r) for r in rows(found)} for name, found in by.items()
                },
            }
            for level, by in trials.items()
        ],
    }


def estimator_text(found: dict[str, Any]) -> str:
    """Return bias / RSD [%] per parameter, a column per estimator, a table per noise."""
    lines = []
    for part in found["noise"]:
        names = list(part["estimators"])
        lines += [
            f"noise x{part['noise']:g}, {found['experiments']} experiments on the {found['kind']}; "
            f"least squares called biased by its check in {part['flagged']}; bias / RSD in %",
            "",
            "| parameter | " + " | ".join(names) + " |",
            "|---" * (1 + len(names)) + "|",
        ]
        for parameter in part["estimators"][names[0]]:
            cells = []
            for name in names:
                p = part["estimators"][name].get(parameter)
                cells.append(
                    f"{100 * p['bias']:+.3f} / {100 * p['rsd']:.3f}" if p is not None else "—"
                )
            lines.append(f"| {parameter} | " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines).rstrip()
