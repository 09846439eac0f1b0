"""What the trace makes of strangers' benches: judged, counted, with bounds."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from scipy.stats import beta as beta_distribution

from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.noise_floor import Floor
from analysis.trace.data.regression_data import regression_data
from rig.cli.text.output import table
from tests.studies.foreign.bench import Bench, runs_of, stated_rig, training_of
from tests.studies.foreign.cases import NONE, OUTSIDE, PAIR, Case, case_of

ABSTAINED_RIGHT = "abstained, truth found"
MECHANISM = "right mechanism"  # a free curve where a name of its mechanism is hidden
BESIDE = "wrong beside unexplained"
BETTER = ("repeats", "noise", "longer")
# Answers from weak to strong: better data may only move a bench upwards.
STRENGTH = ("quiet", "abstained", ABSTAINED_RIGHT, "refused", MECHANISM, "in class", "right")
LOUD = 3.0  # repeatable residual over the noise from which an effect must be found
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Job:
    """One case by its seed."""

    seed: int
    only: str = ""
    kind: str = ""  # one of `cases.MIX`, drawn where empty
    spool: int | None = None
    better: str = ""  # how the same bench is measured better: one of `BETTER`
    tolerances: bool = False  # the rig file states them, and its numbers are wrong within them


@dataclass(frozen=True)
class Outcome:
    """What the trace made of a case; plain data, so that it can be kept."""

    seed: int
    kind: str
    label: str
    bench: str
    answer: str
    verdict: str
    named: tuple[tuple[str, str], ...]
    tied: tuple[tuple[str, str], ...]
    refused: tuple[str, ...]
    loudness: float  # of a pair, of the quieter effect hidden alone
    size_error: float
    hits: tuple[int, int]  # sizes within their 95 % interval, sizes
    parameter_hits: tuple[int, int]
    parameter_error: float
    error_ratio: float
    notes: tuple[str, ...]
    seconds: float


def measured_better(bench: Bench, how: str) -> Bench:
    """Return the bench with twice the repeats, a third of the noise, or records twice as long."""
    if how == "repeats":
        return replace(bench, repeats=2 * bench.repeats)
    if how == "noise":
        return replace(bench, noise=bench.noise / 3)
    return replace(bench, seconds=2 * bench.seconds) if how == "longer" else bench


def perform(job: Job) -> Outcome:
    """Make a case's records and trace them."""
    from analysis.trace.engine import trace

    case = case_of(job.seed, job.only, job.kind, job.spool)
    case = replace(case, bench=measured_better(case.bench, job.better))
    train, held_out = runs_of(case.bench, job.seed)
    if job.tolerances:
        stated = stated_rig(case.bench.rig, job.seed)
        train, *held_out = (replace(run, rig=stated) for run in (train, *held_out))
    started = time.process_time()
    found = trace([train], held_out, look_ahead=False)
    seconds = time.process_time() - started
    named = tuple((e.name, e.where) for e in found.effects)
    after = found.model_after.parameters
    truth = case.bench.truth
    errors, hits = _sizes(case, found.effects)
    b = case.bench
    return Outcome(
        case.seed, case.kind, case.label,
        f"spool form {b.form}, noise {b.noise:g}, repeats {b.repeats}",
        answer_of(case, found.verdict, set(named), set(found.tied)), found.verdict,
        named, tuple(found.tied),
        tuple(f"{e.name} at {e.where} ({_failed(e)})" for e in found.refused),
        _loudness(job, case, found.floors), max(errors, default=math.nan), hits,
        (sum(_within(after[n], v) for n, v in truth.items()), len(truth)),
        max(abs(after[n].value / v - 1) for n, v in truth.items()),
        found.worst(found.after), found.notes, seconds,
    )  # fmt: skip


def _loudness(job: Job, case: Case, floors: Iterable[Floor]) -> float:
    """Return the largest repeatable residual over its noise; of a pair, of the quieter effect.

    A pair's quieter effect is hidden alone in the same bench: whether it can be found does not
    depend on how loud its partner is.
    """
    if case.kind != PAIR:
        return max(f.ratio for f in floors)
    return min(
        max(f.ratio for f in _floors_alone(job, position)) for position in range(len(case.hidden))
    )


def _floors_alone(job: Job, position: int) -> tuple[Floor, ...]:
    """Return the noise floors of the baseline where one effect of a pair is hidden alone."""
    case = case_of(job.seed, job.only, job.kind, job.spool, alone=position)
    bench = measured_better(case.bench, job.better)
    train = training_of(bench, job.seed)
    terms = tuple(map(Used, baseline_of(bench.rig)))
    return regression_data(bench.rig, terms, conditioned_records(bench.rig, [train])).floors


def _failed(found: Any) -> str:
    return "; ".join(f"{gate.name}: {gate.detail}" for gate in found.gates if not gate.ok)


def _within(estimate: Any, value: float) -> bool:
    return bool(estimate.ci95[0] <= value <= estimate.ci95[1])


def _sizes(case: Case, effects: Iterable[Any]) -> tuple[list[float], tuple[int, int]]:
    """Return relative errors of the sizes found at the right place, and intervals that hold."""
    errors, hits = [], []
    for wrong in case.hidden:
        for e in effects:
            if (e.name, e.where) != (wrong.name, wrong.where):
                continue
            for stem, size in wrong.sizes.items():
                name = next((n for n in e.parameters if n.startswith(stem)), None)
                if name is None:
                    continue
                estimate = e.parameters[name]
                one = 1.0 if wrong.name == "sensor_gain" else 0.0
                errors.append(abs((abs(estimate.value) - one) / (abs(size) - one) - 1))
                low, high = sorted(map(abs, estimate.ci95))
                hits.append(low <= abs(size) <= high)
    return errors, (sum(hits), len(hits))


def answer_of(  # noqa: PLR0911  a table of answers
    case: Case, verdict: str, named: set[tuple[str, str]], tied: set[tuple[str, str]]
) -> str:
    """Judge an answer: right, in class, quiet, partly, abstained, wrong, false alarm …"""
    from analysis.trace.data.candidates import catalogue, free_mechanisms

    drawn = {(w.curve, w.where): (w.name, w.where) for w in case.hidden if w.curve}
    named = {drawn.get(key, key) for key in named}
    truth, own = case.truth, named - case.allowed
    effects, free_forms = catalogue(case.bench.rig), free_mechanisms(case.bench.rig)
    known, curves = ({e.name for e in some} for some in (effects, free_forms))
    mechanisms = {e.name: e.mechanism for e in (*effects, *free_forms)}
    if case.kind == NONE:
        return "right" if verdict == "clean" else "false alarm" if named else "abstained"
    if case.kind == OUTSIDE or any(name not in known for name, _ in truth):
        right = {t for t in truth if t[0] in known}
        if verdict == "clean":
            return "quiet"
        free = named and named <= case.allowed
        if verdict == "unexplained" or free:
            return "refused" if free or named - case.related <= right else BESIDE
        return "in class" if verdict == "confounded" else "wrong"
    if verdict == "clean":
        return "quiet"
    settled = verdict in ("explained", "confounded")
    if settled and truth <= named and own <= truth:
        return "right"
    if verdict == "confounded" and truth <= named | tied:
        return "in class"
    if settled and own - truth and all(name in curves for name, _ in own - truth):
        found, hidden = (
            {(mechanisms[name], where) for name, where in keys} for keys in (named, truth)
        )
        if found <= hidden:
            return MECHANISM if found == hidden else "partly"
    if settled:
        return "partly" if own < truth else "wrong"
    if own <= truth:
        return ABSTAINED_RIGHT if truth <= named else "abstained"
    return BESIDE


def line_of(o: Outcome) -> str:
    """Return an outcome in one line."""
    named = ", ".join(f"{n} at {w}" for n, w in o.named) or "nothing"
    hit = f"{o.hits[0]}/{o.hits[1]}" if o.hits[1] else "-"
    return (
        f"[{o.answer}] seed {o.seed} {o.label} [{o.bench}] {o.loudness:.1f} x noise: {o.verdict}, "
        f"{named}" + (f"; tied {', '.join(' at '.join(t) for t in o.tied)}" if o.tied else "")
        + (f"; refused {'; '.join(o.refused)}" if o.refused else "")
        + (f"; size off {100 * o.size_error:.2g} %" if o.hits[1] else "")
        + f", ci {hit}, baseline ci {o.parameter_hits[0]}/"
        f"{o.parameter_hits[1]}, parameters off {100 * o.parameter_error:.2g} %, "
        f"error {o.error_ratio:.2f} x floor, {o.seconds:.0f} s"
        + "".join(f"; {note}" for note in o.notes)
    )  # fmt: skip


def bounds(hits: int, of: int) -> tuple[float, float]:
    """Return the one-sided 95 % bounds (Clopper and Pearson) of a share."""
    if of == 0:
        return 0.0, 1.0
    low = 0.0 if hits == 0 else float(beta_distribution.ppf(1 - CONFIDENCE, hits, of - hits + 1))
    high = 1.0 if hits == of else float(beta_distribution.ppf(CONFIDENCE, hits + 1, of - hits))
    return low, high


def text(outcomes: Sequence[Outcome]) -> str:
    """Return the pooled tables and the list of every wrong name."""
    loud = [o for o in outcomes if o.kind == NONE or o.loudness >= LOUD]
    columns = sorted({o.answer for o in outcomes})
    rows = []
    for kind in dict.fromkeys(o.kind for o in outcomes):
        for word, chosen in ((kind, outcomes), (f"{kind}, loud", loud)):
            if kind == NONE and chosen is loud:
                continue
            here = [o for o in chosen if o.kind == kind]
            count = Counter(o.answer for o in here)
            rows.append([word, str(len(here)), *(str(count[c] or "") for c in columns)])
    pooled = []
    hidden = [o for o in loud if o.kind not in (NONE, OUTSIDE)]
    clean = [o for o in outcomes if o.kind == NONE]
    for word, hits, of in (
        ("right or in class, loud", _count(hidden, "right", "in class", "refused"), len(hidden)),
        ("right mechanism, a curve in place of its name, loud", _count(hidden, MECHANISM),
         len(hidden)),
        ("wrong name, explained or confounded", _count(outcomes, "wrong"), len(outcomes)),
        ("wrong name beside unexplained", _count(outcomes, BESIDE),
         len(outcomes)),
        ("false alarm", _count(clean, "false alarm"), len(clean)),
        ("intervals of sizes that hold", *_sum(o.hits for o in outcomes)),
        ("intervals of the baseline that hold, right answers",
         *_sum(o.parameter_hits for o in outcomes if o.answer == "right")),
    ):  # fmt: skip
        if not of:
            continue
        low, high = (100 * bound for bound in bounds(hits, of))
        share = f"{100 * hits / of:.0f} %"
        pooled.append([word, f"{hits} of {of}", share, f"{low:.0f} to {high:.0f} %"])
    wrong = [line_of(o) for o in outcomes if o.answer.startswith(("wrong", "false", "partly"))]
    return "\n\n".join((
        table(["kind", "cases", *columns], rows),
        table(["pooled", "count", "share", "one-sided 95 % bounds"], pooled),
        "every wrong or partial name:\n" + ("\n".join(wrong) or "none"),
    ))  # fmt: skip


def _count(outcomes: Iterable[Outcome], *answers: str) -> int:
    return sum(o.answer in answers for o in outcomes)


def _sum(pairs: Iterable[tuple[int, int]]) -> tuple[int, int]:
    pairs = list(pairs)
    return sum(a for a, _ in pairs), sum(b for _, b in pairs)


def weakened(outcomes: Mapping[Job, Outcome]) -> str:
    """Return every bench whose answer is weaker when it is measured better."""
    lines, count = [], 0
    for job, found in outcomes.items():
        before = outcomes.get(replace(job, better=""))
        if not job.better or before is None:
            continue
        count += 1
        known = before.answer in STRENGTH and found.answer in STRENGTH
        if known and STRENGTH.index(found.answer) >= STRENGTH.index(before.answer):
            continue
        if found.answer != before.answer:
            lines.append(
                f"seed {job.seed}, {job.better}: {before.answer} -> {found.answer}\n"
                f"  {line_of(before)}\n  {line_of(found)}"
            )
    return f"weaker when measured better: {len(lines)} of {count}\n" + "\n".join(lines)


def loaded(job: Job, data: Mapping[str, Any]) -> Outcome:
    """Return a kept outcome."""
    plain = {k: tuple(data[k]) for k in ("refused", "hits", "parameter_hits", "notes")}
    pairs = {k: tuple((n, w) for n, w in data[k]) for k in ("named", "tied")}
    return Outcome(**{**data, **plain, **pairs})
