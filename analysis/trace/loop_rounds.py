"""Rounds of a loop: the runs, the trace after them, and the separation that they achieved.

The separation is measured as it was predicted (`next_experiment.discrimination`): both explanations
are fitted to all records without and with the new ones. The energy that one leaves more than the
other, per new row, is given as an rms in units of one record's noise.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.terms import known
from analysis.terms.base import Used
from analysis.trace.data.candidates import effect_in
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.nuisance_terms import base_terms
from analysis.trace.data.regression_data import RegressionData, regression_data
from analysis.trace.next_experiment.discrimination import (
    ComparisonRows,
    Explanation,
    OpenQuestion,
    present_separation,
    smallest_effect,
)
from analysis.trace.next_experiment.proposal import SHOW
from analysis.trace.result import Trace, to_json
from analysis.trace.search.hypothesis import energy_above_noise
from analysis.trace.search.refinement import refine
from rig.model.records import Run
from rig.model.rig import Rig


@dataclass(frozen=True)
class Round:
    """One round: the `runs` taken in it, the `experiment` that led to it, and the trace after.

    `achieved` is the experiment's separation as measured, None where there is none to measure.
    """

    number: int
    runs: tuple[str, ...]
    experiment: Mapping[str, Any] | None
    result: Trace
    achieved: float | None = None

    @property
    def predicted(self) -> float | None:
        """The separation predicted for the experiment, in units of one record's noise."""
        return None if self.experiment is None else float(self.experiment["predicted"])

    @property
    def baseline_ratio(self) -> float:
        """The largest ratio of the baseline's repeatable residual to its noise."""
        return max(f.ratio for f in self.result.floors)

    @property
    def residual(self) -> float:
        """The largest ratio of a held-out error to its noise floor, with the effects found."""
        return self.result.worst(self.result.after)


def achieved(
    rig: Rig, before: Sequence[Run], new: Run, experiment: Mapping[str, Any]
) -> float | None:
    """Return the separation [noise] that an experiment's records achieved, None if none was asked.

    An experiment that was to make a small effect visible has no such effect to measure: then this
    is the rms that the effect would have in the records as they were taken.
    """
    if not experiment.get("questions"):
        return None
    terms = base_terms(rig, [*before, new])
    all_data = regression_data(rig, terms, conditioned_records(rig, [*before, new]))
    if experiment["kind"] == SHOW:
        separations = []
        for question in experiment["questions"]:
            (used,) = effects_of(question["one"])
            smallest = smallest_effect(effect_in(used), rig) or Explanation((used,))
            question_shown = OpenQuestion(smallest, Explanation(), False)
            separations.append(present_separation(question_shown, ComparisonRows(all_data)))
        return min(separations)
    old_data = regression_data(rig, terms, conditioned_records(rig, before))
    return min(
        _question_separation(old_data, all_data, terms, len(before), q["one"], q["other"])
        for q in experiment["questions"]
    )


def _question_separation(
    old: RegressionData, all_data: RegressionData, terms: tuple[Used, ...], index: int,
    first: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]],
) -> float:  # fmt: skip
    """Return one question's separation: the largest rms difference per new row of an equation."""

    def gap(data: RegressionData) -> dict[str, float]:
        """Return the energy above noise that `other` leaves more than `first`, by equation."""
        first_energy, other_energy = (
            energy_above_noise(data, refine(data, (*terms, *effects_of(side))).residual)
            for side in (first, other)
        )
        return {e: other_energy[e] - first_energy[e] for e in first_energy}

    before, after = gap(old), gap(all_data)
    rows: Counter[str] = Counter()
    for s in all_data.segments:
        if s.group[0] == index:
            rows[s.equation] += s.count * s.repeats
    energy = {e: abs(after[e] - before.get(e, 0.0)) for e in rows}
    return max((float(np.sqrt(energy[e] / count)) for e, count in rows.items()), default=0.0)


def effects_of(side: Sequence[Mapping[str, Any]]) -> list[Used]:
    """Return the terms that one side of a question names, with their shapes."""
    return [Used(known()[k["name"]](k["at"]), tuple(k["shape"])) for k in side]


def rounds_json(rounds: Sequence[Round], stopped: str) -> dict[str, Any]:
    """Return the loop as plain data: the last trace's keys, `stopped`, and every round."""
    last = to_json(rounds[-1].result) if rounds else {}
    return {
        **last,
        "stopped": stopped,
        "rounds": [
            {
                "round": r.number,
                "runs": list(r.runs),
                "experiment": dict(r.experiment) if r.experiment else None,
                "predicted": r.predicted,
                "achieved": r.achieved,
                "trace": to_json(r.result),
            }
            for r in rounds
        ],
    }
