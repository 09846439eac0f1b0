"""Selection of steps: the fewest that determine all parameters, then the best conditioned.

Greedily, the step is added that increases log det of the information most, with unit columns and a
floor, so that a new direction counts more than a better determined one, until every parameter is
determined. Further steps are added only while the worse condition number is above the wanted one
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
        rest = [candidate for candidate in pool if candidate not in chosen]
        now = _verdicts(chosen, judge)
        if not complete(now):
            before = _score(chosen, scales)
            gain = {
                id(candidate): _score([*chosen, candidate], scales) - before for candidate in rest
            }
            best = max(
                rest,
                key=lambda candidate: gain[id(candidate)] - DESIGN.closed_price * _cost(candidate),
            )
            if gain[id(best)] < 1.0:
                break  # no step adds a direction
        else:
            if worst(now) <= DESIGN.condition:
                break
            best = min(rest, key=lambda candidate: worst(_verdicts([*chosen, candidate], judge)))
            if worst(_verdicts([*chosen, best], judge)) > DESIGN.worth * worst(now):
                break
        chosen.append(best)
    return chosen


def worst(verdicts: Verdicts) -> float:
    """Return the larger condition number."""
    return max(verdict.condition for verdict in verdicts.values())


def _verdicts(steps: Sequence[SizedStep], judge: Judge) -> Verdicts:
    return judge([step.rows for step in steps])


def _pruned(chosen: Sequence[SizedStep], judge: Judge) -> list[SizedStep]:
    """Remove every step without which as much is determined, and as well as wanted."""
    kept = list(chosen)
    now = _verdicts(kept, judge)
    allowed = max(DESIGN.condition, worst(now))
    for step in sorted(chosen, key=_cost, reverse=True):
        fewer = [other for other in kept if other is not step]
        verdicts = _verdicts(fewer, judge)
        same = all(verdicts[family].rank == now[family].rank for family in verdicts)
        if fewer and same and (worst(verdicts) <= allowed or not complete(now)):
            kept = fewer
    return kept


def _exchanged(
    chosen: Sequence[SizedStep], pool: Sequence[SizedStep], judge: Judge
) -> list[SizedStep]:
    """Exchange single steps for others while that improves the worse condition number."""
    now = list(chosen)
    for _ in pool:
        trials = [
            [*now[:place], other, *now[place + 1 :]]
            for place in range(len(now))
            for other in pool
            if other not in now
        ]
        best = min(trials, key=lambda steps: _badness(steps, judge), default=now)
        if not _badness(best, judge) < _badness(now, judge) + np.log(DESIGN.worth):
            break
        now = best
    return now


def _badness(steps: Sequence[SizedStep], judge: Judge) -> float:
    """Return the log of the worse condition number, plus a tenth for each valve closed beyond."""
    verdicts = _verdicts(steps, judge)
    if not complete(verdicts):
        return float("inf")
    return float(
        np.log(worst(verdicts)) - np.log(DESIGN.worth) * sum(_cost(step) for step in steps)
    )


def _cost(step: SizedStep) -> int:
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
        total += float(np.sum(np.log(sigma**2 + DESIGN.visible**2)))
    return total
