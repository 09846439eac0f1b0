"""Selection of steps: the fewest that determine all parameters, then the best conditioned.

Greedily, the step is added that increases log det of the information most, with unit columns and a
floor, so that a new direction counts more than a better determined one, until every parameter is
determined. Further steps are added only while the worse condition number is above `condition`
and falls by a tenth or more. Then unnecessary steps are removed, and single steps are exchanged
while that improves the worse condition number (Fedorov's exchange).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from protocols.design.proof import Triangles, Verdicts, complete
from protocols.design.settings import DESIGN
from protocols.engine.centring import Array
from protocols.steps.excite import Step
from protocols.steps.parts import CLOSED

Judge = Callable[[Sequence[Triangles]], Verdicts]


@dataclass(frozen=True, eq=False)
class SizedStep:
    """A step with an amplitude that the rig allows, and the rows of its record."""

    step: Step
    rows: Triangles


def smallest(pool: Sequence[SizedStep], judge: Judge) -> list[SizedStep]:
    """Return the fewest steps found that determine all that the pool can, in the pool's order."""
    chosen = _exchanged(_pruned(extended([], pool, judge), judge), pool, judge)
    return sorted(chosen, key=pool.index)


def extended(
    start: Sequence[SizedStep], pool: Sequence[SizedStep], judge: Judge
) -> list[SizedStep]:
    """Return `start` with steps added from the pool until all is determined."""
    chosen = list(start)
    scales = _scales([*start, *pool])
    for _ in pool:
        remaining = [candidate for candidate in pool if candidate not in chosen]
        verdicts = _verdicts(chosen, judge)
        if not complete(verdicts):
            score = _score(chosen, scales)
            gain = {
                id(candidate): _score([*chosen, candidate], scales) - score
                for candidate in remaining
            }
            best = max(
                remaining,
                key=lambda step: gain[id(step)] - DESIGN.closed_valve_cost * _closed_beyond(step),
            )
            if gain[id(best)] < 1.0:
                break  # no step adds a direction
        else:
            if condition_of(verdicts) <= DESIGN.condition:
                break
            trials = {id(c): condition_of(_verdicts([*chosen, c], judge)) for c in remaining}
            best = min(remaining, key=lambda candidate: trials[id(candidate)])
            if trials[id(best)] > DESIGN.condition_ratio * condition_of(verdicts):
                break
        chosen.append(best)
    return chosen


def condition_of(verdicts: Verdicts) -> float:
    """Return the largest condition number of the families."""
    return max(verdict.condition for verdict in verdicts.values())


def _verdicts(steps: Sequence[SizedStep], judge: Judge) -> Verdicts:
    return judge([step.rows for step in steps])


def _pruned(chosen: Sequence[SizedStep], judge: Judge) -> list[SizedStep]:
    """Remove steps without which the rank is the same and the condition number acceptable."""
    kept = list(chosen)
    initial = _verdicts(kept, judge)
    allowed = max(DESIGN.condition, condition_of(initial))
    for step in sorted(chosen, key=_closed_beyond, reverse=True):
        fewer = [other for other in kept if other is not step]
        verdicts = _verdicts(fewer, judge)
        equal_rank = all(verdicts[family].rank == initial[family].rank for family in verdicts)
        if fewer and equal_rank and (condition_of(verdicts) <= allowed or not complete(initial)):
            kept = fewer
    return kept


def _exchanged(
    chosen: Sequence[SizedStep], pool: Sequence[SizedStep], judge: Judge
) -> list[SizedStep]:
    """Exchange single steps for others while that improves the worse condition number."""
    current = list(chosen)
    for _ in pool:
        trials = [
            [*current[:index], other, *current[index + 1 :]]
            for index in range(len(current))
            for other in pool
            if other not in current
        ]
        best = min(trials, key=lambda steps: _log_cost(steps, judge), default=current)
        if not _log_cost(best, judge) < _log_cost(current, judge) + np.log(DESIGN.condition_ratio):
            break
        current = best
    return current


def _log_cost(steps: Sequence[SizedStep], judge: Judge) -> float:
    """Return the log of the worse condition number, plus a tenth for each valve closed beyond."""
    verdicts = _verdicts(steps, judge)
    if not complete(verdicts):
        return float("inf")
    closed = sum(_closed_beyond(step) for step in steps)
    return float(np.log(condition_of(verdicts)) - np.log(DESIGN.condition_ratio) * closed)


def _closed_beyond(step: SizedStep) -> int:
    """Return the number of valves closed beyond the excited joint, whose oil yields under load."""
    excited = min(part.joint for part in step.step.excite)
    return sum(lock.at == CLOSED and lock.joint > excited for lock in step.step.lock)


def _scales(steps: Sequence[SizedStep]) -> dict[str, Array]:
    """Return the columns' norms over all candidates, a scale independent of the choice."""
    return {
        family: np.maximum(
            np.linalg.norm(np.vstack([step.rows[family] for step in steps]), axis=0), 1e-300
        )
        for family in steps[0].rows
    }


def _score(steps: Sequence[SizedStep], scales: Mapping[str, Array]) -> float:
    total = 0.0
    for family, scale in scales.items():
        rows = np.vstack(
            [np.zeros((1, len(scale))), *(step.rows[family] / scale for step in steps)]
        )
        sigma = np.zeros(len(scale))
        singular = np.linalg.svd(rows, compute_uv=False)
        sigma[: len(singular)] = singular
        total += float(np.sum(np.log(sigma**2 + DESIGN.singular_floor**2)))
    return total
