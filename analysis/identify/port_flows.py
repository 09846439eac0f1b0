"""The bulk modulus from which the flow through the valves' ports to supply and tank is computed.

Effects on the pressure at the ports need that flow, A s' + V p' / b, in the rows from which b is
identified. A first identification without them gives b; a nominal b may be wrong by a factor of 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from analysis.effects.supply import BULK, PortEffect
from analysis.identify.coupled import coupled
from analysis.terms.base import Used
from rig.model.records import Run


def with_identified_bulk_modulus(
    runs: Sequence[Run], terms: Sequence[Used], *more: Sequence[Run]
) -> tuple[tuple[Run, ...], ...]:
    """Return `runs` and `more` with the b [Pa] identified from `runs` as their rigs' nominal one.

    It is identified under those of `terms` that do not need the flow. All are returned unchanged
    where b is no parameter or not determined. Raises InputError as `identify` does.
    """
    every = (tuple(runs), *map(tuple, more))
    rig = runs[0].rig
    own = tuple(used for used in terms if not isinstance(used.term, PortEffect))
    if not any(c.parameter == BULK for used in own for c in used.term.parameters(rig)):
        return every
    b = coupled(runs, own, estimator="ls").estimates.get(BULK)
    if b is None or not b.identified or b.value <= 0.0:
        return every
    return tuple(tuple(_with_nominal(run, b.value) for run in part) for part in every)


def _with_nominal(run: Run, b: float) -> Run:
    nominal = {**run.rig.nominal, BULK: b}
    return replace(run, rig=run.rig.model_copy(update={"nominal": nominal}))
