"""Small benches for the gates: few candidates at joint 2, searched once and judged many times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace import engine, finding
from analysis.trace.data.candidates import catalogue
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import RegressionData, regression_data
from analysis.trace.data.set_aside import TraceRows
from analysis.trace.judge import gates
from analysis.trace.judging import Judge
from analysis.trace.result import JudgedEffect, Trace
from analysis.trace.search.exchanges import exchanged
from analysis.trace.search.forward_search import search
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.search.linear_fit import CandidateColumns
from analysis.workers.pool import Pool
from rig.model.records import Run
from rig.model.rig import Rig

Array = NDArray[np.float64]

LEAK = 2e-12  # [m^3/(s Pa)]


def at_joint_2(rig: Rig, *names: str) -> list[Effect]:
    """Return the named candidates at joint 2 and those of the whole bench."""
    return [e for e in catalogue(rig, names) if e.where.startswith(("joint 2", "bench"))]


@dataclass(frozen=True)
class Searched:
    """A bench's rows, its candidates' sets, and the set that the search prefers."""

    hypotheses: HypothesisSet
    winner: Hypothesis
    holdout_data: RegressionData

    def judged(self, *names: str, seed: int = 0) -> list[JudgedEffect]:
        """Return the gates' verdict on a set: the winner, or that of the named candidates."""
        one = self.set_of(*names) if names else self.winner
        rng = np.random.default_rng(seed)
        return list(gates.judge_effects(self.hypotheses, one, self.holdout_data, rng))

    def set_of(self, *names: str) -> Hypothesis:
        """Return the fitted set of the named candidates, each at its first look."""
        entries = [entry.used for entry in self.hypotheses.columns]
        return self.hypotheses.refined(
            [next(u for u in entries if u.term.name == name) for name in names]
        )

    def named(self) -> set[str]:
        """Return the names that pass the gates, quiet equations searched again."""
        rng = np.random.default_rng(0)
        found = self.judge(rng).apply_gates(self.winner)
        return {f.name for f in found.effects if gates.passes_gates(f)}

    def judge(self, rng: np.random.Generator) -> Judge:
        """Return who judges the bench's sets, without free forms."""
        held_out = self.holdout_data
        rows = TraceRows(self.hypotheses.train_data, held_out, held_out, (), ())
        return Judge(rows, self.hypotheses, (), rng)

    def vetoes(self, one: Hypothesis) -> str:
        """Return what is left and speaks against a set, in words; '' for nothing."""
        rest = finding.remainders(self.hypotheses, one, self.holdout_data)
        return "; ".join(r.words for r in rest if r.veto)

    def left_in(self, one: Hypothesis) -> dict[str, str]:
        """Return what equations keep that is more than the bands allow, in words."""
        out: dict[str, str] = {}
        for equation, words in gates.equations_above_band(self.hypotheses, one, self.holdout_data):
            out[equation] = f"{out.get(equation, '')} {words}".strip()
        return out


def searched(
    rig: Rig, train: Run, held_out: Run, *names: str, pool: Pool | None = None
) -> Searched:
    """Lay out records and search the named candidates."""
    terms = tuple(map(Used, baseline_of(rig)))
    data = regression_data(rig, terms, conditioned_records(rig, [train]))
    judged = regression_data(rig, terms, conditioned_records(rig, [held_out]), data.beta)
    hypotheses = HypothesisSet(data, at_joint_2(rig, *names), pool=pool)
    return Searched(hypotheses, exchanged(hypotheses, search(hypotheses)), judged)


def traced(rig: Rig, runs: tuple[Run, Run], *names: str, free_forms: bool = False) -> Trace:
    """Trace a bench with few candidates."""
    return engine.trace(
        [runs[0]], [runs[1]], at_joint_2(rig, *names), look_ahead=False, free_forms=free_forms
    )


def joined(first: Run, second: Run) -> Run:
    """Return both runs' records in one, the second's as another step."""
    renamed = [replace(r, name=f"other_{r.name}", step="step2") for r in second.records]
    return replace(first, records=(*first.records, *renamed))


def with_residual(data: RegressionData, residual: Array) -> RegressionData:
    """Return rows whose repeats leave other residuals (R, M)."""
    return replace(data, residual=residual)


def gains(candidates: CandidateColumns, r: Array) -> Array:
    """Return the energy that each entry takes from a projected residual (M,), by least squares."""
    out = []
    for group in candidates.groups:
        X = candidates.columns[:, list(group)]
        visible = np.linalg.norm(X, axis=0) > np.sqrt(candidates.visibility_limit[list(group)])
        X = X[:, visible]
        out.append(r @ X @ np.linalg.lstsq(X, r, rcond=1e-6)[0] if X.shape[1] else 0.0)
    return np.array(out)


def gate(found: Sequence[JudgedEffect], name: str) -> bool:
    """Return whether a gate of the first effect holds."""
    return next(g.ok for g in found[0].gates if g.name == name)
