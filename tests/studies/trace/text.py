"""The tables of the trace's study."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from rig.cli.text.output import table
from tests.studies.trace.cases import LOUD, NONE, OUTSIDE, PAIR, SINGLE
from tests.studies.trace.study import Outcome, right

WORDS = (
    "right", "in class", "partly", "abstained", "quiet", "no clue", "wrong", "false alarm",
)  # fmt: skip


def as_json(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return every outcome and its judgement as plain data."""
    return {"cases": [{**asdict(o), "judged": right(o)} for o in outcomes]}


def text(outcomes: Sequence[Outcome]) -> str:
    """Return counts by kind, the loud ones apart, detection by size, and the confusion."""
    parts = [
        "judged (loud: repeatable residual at least "
        f"{LOUD:g} times the noise in some equation)",
        _counts(outcomes), "", "detection against size", _detection(outcomes), "",
        "confusion: hidden -> named (how often)", _confusion(outcomes), "", _figures(outcomes),
    ]  # fmt: skip
    return "\n".join(parts)


def bent_text(outcomes: Sequence[Outcome]) -> str:
    """Return one row a case of bent records, in the order drawn, and the counts."""
    rows = [
        [
            o.case.label, f"{o.loudness:.1f}", o.verdict,
            ", ".join(f"{n} at {w}" for n, w in o.named) or "nothing",
            ", ".join(o.depends_on[:2]), right(o),
        ]
        for o in sorted(outcomes, key=lambda o: o.case.seed)
    ]  # fmt: skip
    head = ["records bent by", "x noise", "verdict", "named so far", "moves with", "judged"]
    return "\n".join([table(head, rows), "", _counts(outcomes)])


def _counts(outcomes: Sequence[Outcome]) -> str:
    rows = []
    for other, kind in itertools.product((False, True), (NONE, SINGLE, PAIR, OUTSIDE)):
        here = [o for o in outcomes if (o.case.machine, o.case.kind) == (other, kind)]
        loud = [o for o in here if o.loudness >= LOUD]
        name = f"other machines, {kind}" if other else kind
        for label, part in ((name, here), (f"{name}, loud", loud)):
            if not part or (kind == NONE and part is loud):
                continue
            count = Counter(right(o) for o in part)
            rows.append([label, str(len(part)), *(str(count.get(w, 0) or "") for w in WORDS)])
    return table(["kind", "cases", *WORDS], rows)


def _detection(outcomes: Sequence[Outcome]) -> str:
    edges = (0.0, 0.7, 1.5, 3.0, 6.0, 12.0, 25.0, np.inf)
    rows = []
    for low, high in itertools.pairwise(edges):
        here = [o for o in outcomes if o.case.truth and low <= o.loudness < high]
        if here:
            count = Counter(right(o) for o in here)
            good = count["right"] + count["in class"]
            rows.append(
                [f"{low:g} to {high:g} x noise", str(len(here)), str(good), str(count["wrong"])]
            )
    return table(["residual", "cases", "right or in class", "wrong"], rows)


def _confusion(outcomes: Sequence[Outcome]) -> str:
    count: Counter[tuple[str, str]] = Counter()
    for o in outcomes:
        if len(o.case.truth) > 1:
            continue
        # A machine's label begins with its name; what is left of it is what it hides.
        hidden = o.case.truth[0][0] if o.case.truth else o.case.label.rpartition(": ")[2] or NONE
        named = " + ".join(sorted({n for n, _ in o.named})) or o.verdict
        if o.verdict == "unexplained" and o.named:
            named += " (and more)"
        if o.verdict == "confounded":
            named += " (confounded)"
        count[hidden, named] += 1
    rows = [[hidden, named, str(n)] for (hidden, named), n in sorted(count.items())]
    return table(["hidden", "named", "cases"], rows)


def _figures(outcomes: Sequence[Outcome]) -> str:
    good = [o for o in outcomes if o.case.truth and right(o) == "right" and o.loudness >= LOUD]
    lines = []
    for label, values, unit in (
        ("size error", [100 * o.size_error for o in good], "%"),
        ("held-out error over noise floor", [o.error_ratio for o in good], "x"),
        ("largest error of a baseline parameter", [100 * o.parameter_error for o in good], "%"),
        ("FIT before", [o.fit_before for o in good], "%"),
        ("FIT after", [o.fit_after for o in good], "%"),
        ("trace", [o.seconds for o in outcomes], "s of processor"),
    ):
        known = np.array([v for v in values if np.isfinite(v)])
        if len(known):
            low, mid, high = np.quantile(known, (0.1, 0.5, 0.9))
            lines.append(
                f"{label}: median {mid:.3g} {unit}, 10 to 90 % of cases {low:.3g} to {high:.3g}"
            )
    return "\n".join(lines)
