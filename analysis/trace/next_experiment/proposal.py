"""The next experiment, or none: open questions, and the excitation that answers them.

`confounded`: the excitation on which the best set and its tied rivals differ most. `unexplained`:
the one that separates the sets which leave least, else the one with the widest range of a variable
that the residual depends on, else one with many more lines than the records. `clean`: the one that
shows effects at their smallest size of interest which these records could not show. An experiment
is proposed only where the predicted separation exceeds the noise and clearly exceeds that of the
records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from analysis.effects.base import Effect
from analysis.terms import baseline_of, known
from analysis.terms.base import Used, joint_of
from analysis.trace.clues.equation_rows import variables
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.rivals import tied_sets
from analysis.trace.next_experiment import excitations as ex
from analysis.trace.next_experiment.discrimination import (
    ComparisonRows,
    Explanation,
    MeasurementView,
    OpenQuestion,
    largest_rms,
    measurement_view,
    noise_ratios,
    present_separation,
    separation,
    smallest_effect,
)
from analysis.trace.next_experiment.excitations import CandidateExcitation
from analysis.trace.result import CLEAN, CONFOUNDED, UNEXPLAINED, Dependence, JudgedEffect
from analysis.trace.search.exact_fit import parameter_values
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import EXPERIMENT, SEARCH
from rig.model.rig import Rig

TELL, COVER, SHOW = "tell apart", "cover", "make visible"
LEAST_SEPARATION: Final = SEARCH.band  # over noise; less would be within the noise's band
LINES: Final = "lines"
TIME: Final = "time"  # no excitation extends it


@dataclass(frozen=True)
class PredictedAnswer:
    """Separation of a question [noise]: by the records, and as predicted for an experiment."""

    question: OpenQuestion
    present: float
    predicted: float = 0.0
    equation: str = ""

    @property
    def open(self) -> bool:
        """Whether the experiment separates the explanations clearly better than the records do."""
        return self.predicted >= max(LEAST_SEPARATION, EXPERIMENT.least_gain * self.present)


def propose(
    hypotheses: HypothesisSet, winner: Hypothesis, effects: Sequence[JudgedEffect], verdict: str,
    clues: Sequence[Dependence],
) -> Mapping[str, Any] | None:  # fmt: skip
    """Return the next experiment as plain data, None where none would give an answer.

    Its `protocol` and `holdout` are contents of protocol files; `present` and `predicted` are the
    weakest question's separation in units of one record's noise.
    """
    train_data = hypotheses.train_data
    present = ComparisonRows(train_data)
    questions = _open_questions(hypotheses, winner, effects, verdict, present)
    if not questions and not (verdict == UNEXPLAINED and clues):
        return None
    rng = np.random.default_rng(EXPERIMENT.seed)
    candidates = list(ex.excitations(rig_with_estimates(train_data), train_data.records, rng))
    if not candidates:
        return _experiment_in_words(effects, questions) if verdict == CONFOUNDED else None
    ratios = noise_ratios(train_data)
    views = [measurement_view(train_data, candidate, ratios) for candidate in candidates]
    kind = SHOW if verdict == CLEAN else TELL
    chosen = _best_steps(questions, candidates, views, present)
    if chosen is not None:
        return _proposal(train_data, kind, *chosen)
    if verdict == UNEXPLAINED and clues:
        return _covering_experiment(train_data, winner, clues, candidates, views)
    return None


def rig_with_estimates(train_data: RegressionData) -> Rig:
    """Return the rig with nominal values from the records, so that its twin is more accurate."""
    baseline = tuple(map(Used, baseline_of(train_data.rig)))
    parameters = parameter_values(train_data.rig, baseline, train_data.beta)
    stated, most = train_data.rig.nominal, EXPERIMENT.parameter_ratio
    plausible = {
        name: value
        for name, value in parameters.items()
        # A parameter that the records hardly determine may have any estimate.
        if (nominal := stated.get(name, abs(value))) != 0.0 and 1 / most < value / nominal < most
    }
    return train_data.rig.model_copy(update={"nominal": {**stated, **plausible}})


def _open_questions(
    hypotheses: HypothesisSet,
    winner: Hypothesis,
    effects: Sequence[JudgedEffect],
    verdict: str,
    present: ComparisonRows,
) -> list[PredictedAnswer]:
    if verdict == CLEAN:
        rig = hypotheses.train_data.rig
        smallest = [smallest_effect(effect, rig) for effect in dict.fromkeys(hypotheses.effects)]
        questions = [OpenQuestion(h, Explanation(), False) for h in smallest if h is not None]
        answers = [PredictedAnswer(q, present_separation(q, present)) for q in questions]
        return [a for a in answers if a.present < LEAST_SEPARATION]
    if verdict == CONFOUNDED:
        others = tied_sets(hypotheses, winner, effects)
        pairs = [OpenQuestion(explanation(winner), explanation(o)) for o in others]
    elif verdict == UNEXPLAINED:
        pairs = _undecided_questions(hypotheses)
    else:
        return []
    return [PredictedAnswer(q, present_separation(q, present)) for q in pairs]


def explanation(hypothesis: Hypothesis) -> Explanation:
    """Return a fitted set as an explanation."""
    return Explanation(hypothesis.effects, hypothesis.fit.beta)


def _undecided_questions(hypotheses: HypothesisSet) -> list[OpenQuestion]:
    """Return questions between the best set and others that leave about as little."""
    fitted = [o for o in hypotheses.fitted.values() if o.effects]
    possible = [o for o in fitted if not hypotheses.physical_problem(o)]
    possible.sort(key=lambda o: o.total)
    if not possible or possible[0].total >= hypotheses.empty.total:
        return []
    best, band = possible[0], sum(hypotheses.noise_band.values())
    limit = max(EXPERIMENT.near_energy * best.total, best.total + 0.1 * band)
    # A set that only adds effects to the best one is no other explanation.
    others = [o for o in possible[1:] if o.total <= limit and not best.keys <= o.keys]
    others = others[: EXPERIMENT.rivals]
    return [OpenQuestion(explanation(best), explanation(o)) for o in others]


def _best_steps(
    questions: Sequence[PredictedAnswer],
    candidates: Sequence[ex.CandidateExcitation],
    views: Sequence[MeasurementView],
    present: ComparisonRows,
) -> tuple[list[ex.CandidateExcitation], list[PredictedAnswer]] | None:
    """Return the steps that answer most questions, and their answers; None if there is none."""
    if not questions:
        return None
    table: list[list[PredictedAnswer]] = []
    for view in views:
        new = ComparisonRows(present.train_data, view, present)
        row = []
        for answer in questions:
            predicted, equation = separation(answer.question, present, new)
            row.append(replace(answer, predicted=predicted, equation=equation))
        table.append(row)
    chosen: list[int] = []
    count = len(candidates)
    while len(chosen) < min(EXPERIMENT.steps, count):
        scores = [_total_answered(_best_answers(table, [*chosen, k])) for k in range(count)]
        k = int(np.argmax(scores))
        before = _total_answered(_best_answers(table, chosen)) if chosen else 0.0
        if scores[k] - before < EXPERIMENT.least_step_gain:
            break
        chosen.append(k)
    if not chosen:
        return None
    answered = [a for a in _best_answers(table, chosen) if a.open]
    return ([candidates[k] for k in chosen], answered) if answered else None


def _best_answers(
    table: Sequence[Sequence[PredictedAnswer]], chosen: Sequence[int]
) -> list[PredictedAnswer]:
    rows = [table[k] for k in chosen]
    return [max(column, key=lambda a: a.predicted) for column in zip(*rows, strict=True)]


def _total_answered(answers: Sequence[PredictedAnswer]) -> float:
    return sum(min(a.predicted, EXPERIMENT.useful_separation) for a in answers if a.open)


def _covering_experiment(
    train_data: RegressionData,
    winner: Hypothesis,
    clues: Sequence[Dependence],
    candidates: Sequence[ex.CandidateExcitation],
    views: Sequence[MeasurementView],
) -> Mapping[str, Any] | None:
    """Return an experiment with a wider range or more lines than the records, None if none."""
    extension = wider_range(train_data, clues, views, EXPERIMENT.least_gain)
    extension = extension or more_lines(train_data, clues, candidates)
    if extension is None:
        return None
    present_rms = largest_rms(train_data, winner.fit.residual)
    return {
        "kind": COVER,
        "separates": [],
        "covers": {"variable": extension.variable, "times": extension.times},
        "present": present_rms,
        "predicted": present_rms * (extension.times if extension.variable != LINES else 1.0),
        "equation": extension.equation,
        "text": f"{candidates[extension.index].text}: {extension.words}",
        **_protocols(train_data, [candidates[extension.index]]),
    }


def _proposal(
    train_data: RegressionData,
    kind: str,
    chosen: Sequence[ex.CandidateExcitation],
    answers: Sequence[PredictedAnswer],
) -> Mapping[str, Any]:
    weakest = min(answers, key=lambda a: a.predicted)
    separates = _separated_effects(answers)
    what = (
        f"predicted separation {weakest.predicted:.1f} times the noise, {weakest.present:.1f} with "
        "the present records"
    )
    if kind == SHOW:
        names = ", ".join(dict.fromkeys(k["name"].replace("_", " ") for k in separates))
        what = f"would show small sizes of {names}, which the present records cannot show"
    return {
        "kind": kind,
        "separates": separates,
        "questions": [
            {
                "one": list(a.question.one.keys), "other": list(a.question.other.keys),
                "present": a.present, "predicted": a.predicted, "equation": a.equation,
            }
            for a in answers
        ],
        "present": weakest.present,
        "predicted": weakest.predicted,
        "equation": weakest.equation,
        "text": f"{'; then '.join(candidate.text for candidate in chosen)} ({what})",
        **_protocols(train_data, chosen),
    }  # fmt: skip


def _separated_effects(answers: Sequence[PredictedAnswer]) -> list[dict[str, str]]:
    """Return names and places of the effects that only one side of a question has, each once."""
    names: dict[tuple[str, str], None] = {}
    for answer in answers:
        one, other = (
            [(k["name"], k["where"]) for k in h.keys]
            for h in (answer.question.one, answer.question.other)
        )
        names |= dict.fromkeys(k for k in (*one, *other) if (k in one) != (k in other))
    return [{"name": name, "where": where} for name, where in names]


def _protocols(
    train_data: RegressionData, chosen: Sequence[ex.CandidateExcitation]
) -> dict[str, Any]:
    rng = np.random.default_rng([EXPERIMENT.seed, 1])
    return {
        "protocol": ex.protocol(train_data.rig, chosen, "next"),
        "holdout": ex.protocol(
            train_data.rig, chosen, "next-holdout", EXPERIMENT.held_out_amplitude, rng
        ),
    }


def _experiment_in_words(
    effects: Sequence[JudgedEffect], questions: Sequence[PredictedAnswer]
) -> Mapping[str, Any] | None:
    """Describe an experiment in words, for rigs without a twin."""
    pairs = [(e.name, r.name) for e in effects for r in e.rivals if r.tied]
    texts = [_separated_by(*pair) for pair in pairs]
    return {
        "kind": TELL,
        "separates": _separated_effects(questions),
        "text": next((t for t in texts if t), "another amplitude and frequency"),
    }


def _separated_by(name: str, rival: str) -> str:
    """Return the stated excitation that separates two confounded effects, '' if none is stated."""
    for first, second in ((rival, name), (name, rival)):
        kind = known()[first]
        if issubclass(kind, Effect) and second in kind.confounders:
            return kind.separated_by
    return ""


@dataclass(frozen=True)
class RangeExtension:
    """An excitation, by its index, with `times` the records' range of a variable."""

    index: int
    variable: str
    times: float
    equation: str
    words: str


def wider_range(
    train_data: RegressionData, clues: Sequence[Dependence], views: Sequence[MeasurementView],
    least: float,
) -> RangeExtension | None:  # fmt: skip
    """Return the excitation with the widest range of a clue's variable, None if none is wider.

    The first clue in `clues` is used for which an excitation reaches `least` times the range of the
    records.
    """
    for clue in clues:
        joint = joint_of(clue.equation)
        moving = [s for s in train_data.records if joint + 1 not in s.record.locked]
        for name in (n for n in (clue.variable, clue.by) if n and n != TIME):
            of_records = [variables(train_data.rig, s.signals, joint).get(name) for s in moving]
            values = [v for v in of_records if v is not None]
            if not values:
                continue
            low, high = np.percentile(np.concatenate(values), [1, 99]).tolist()
            ratios = [_range_ratio(view, joint, name, low, high) for view in views]
            k = int(np.argmax(ratios))
            if ratios[k] >= least:
                words = (
                    f"covers {ratios[k]:.1f} times the range of {name}, on which the remaining "
                    "residual depends"
                )
                return RangeExtension(k, name, ratios[k], clue.equation, words)
    return None


def _range_ratio(view: MeasurementView, joint: int, name: str, low: float, high: float) -> float:
    """Return a variable's range in records and candidate together over that in the records."""
    if joint + 1 in view.conditioned.record.locked:
        return 0.0
    least, most = np.percentile(variables(view.train_data.rig, view.signals, joint)[name], [1, 99])
    return float((max(most, high) - min(least, low)) / max(high - low, 1e-30))


def more_lines(
    train_data: RegressionData,
    clues: Sequence[Dependence],
    candidates: Sequence[CandidateExcitation],
) -> RangeExtension | None:
    """Return the excitation with most lines where the records of the clue's joint have few.

    A single sine gives one path through a nonlinearity, which many forms fit equally well.
    """
    equation = clues[0].equation
    joint = joint_of(equation)
    records = [c.record for c in train_data.records if joint + 1 not in c.record.locked]
    present = [len(record.lines) for record in records]
    counts = [len(c.tones[joint].lines) if joint in c.tones else 0 for c in candidates]
    if not present or not min(present) or not counts:
        return None
    k = int(np.argmax(counts))
    times = counts[k] / max(present)
    if times < EXPERIMENT.line_ratio:
        return None
    words = f"excites joint {joint + 1} at {counts[k]} frequencies instead of {max(present)}"
    return RangeExtension(k, LINES, times, equation, words)
