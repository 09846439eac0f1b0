"""Identify from records that excite every joint at once (simultaneous; the paper's section V.C).

The rows and the solve are the coupled method's; only the choice of records differs. All parameters
share one excitation, so columns that lock-and-excite separates are nearly collinear: the condition
number states how nearly, the physical checks whether noise made values impossible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from analysis.identify.checks import Check, common_rig
from analysis.identify.coupled import coupled
from analysis.identify.result import Identification
from analysis.regression.rows import Filtering
from analysis.simulation.model import Estimate
from analysis.terms.base import Used
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig


def simultaneous(
    runs: Sequence[Run],
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering],
    reject_noise: bool,
) -> Identification:
    """Identify from the records without a locked joint; raises InputError where there is none."""
    rig = common_rig(runs)
    filtered = [replace(run, records=tuple(r for r in run.records if not r.locked)) for run in runs]
    count = sum(len(run.records) for run in filtered)
    total = sum(len(run.records) for run in runs)
    if not count:
        steps = " ".join(sorted({r.step for run in runs for r in run.records}))
        raise InputError(
            f"the simultaneous method needs records that excite all {len(rig.joints)} joints at "
            f"once; in the steps {steps} a joint is locked; record a step that locks none"
        )
    chosen = [run for run in filtered if run.records]
    # Least squares despite its bias by noise: the method is compared as published.
    result = coupled(chosen, tuple(terms), filtering, reject_noise, estimator="ls")
    statements = (
        Check(
            "records used", count == total,
            f"{count} of {total} records excite all joints at once; the others were left out",
        ),
        *gravity_order(rig, {n: e for n, e in result.estimates.items() if e.identified}),
        *result.checks,
    )  # fmt: skip
    return result.with_checks(statements, method="simultaneous")


def gravity_order(rig: Rig, estimates: dict[str, Estimate]) -> list[Check]:
    """State whether each W_i can belong to masses that lie within their links.

    W_i = m_i lg_i + l_i (masses beyond) and 0 <= lg <= l imply W_i/l_i >= W_(i+1)/l_(i+1) >= 0.
    """
    names = [f"W{i}" for i in range(1, len(rig.joints) + 1)]
    if any(name not in estimates for name in names):
        return []
    loads = [
        estimates[name].value / joint.link_length
        for name, joint in zip(names, rig.joints, strict=True)
    ]
    ok = all(a >= b for a, b in zip(loads, [*loads[1:], 0.0], strict=True))
    detail = ", ".join(f"{n} = {estimates[n].value:.4g} kg m" for n in names)
    expected = "masses within their links give W_i/l_i >= W_(i+1)/l_(i+1) >= 0"
    return [Check("gravity order", ok, f"{detail}; {expected}")]
