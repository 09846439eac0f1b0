"""Which rule of the trace changes which answer: each switched off, the same records traced again.

The records' columns and fits are made once and kept for all rules that leave them alone, and a rule
that does not act on a bench is not switched off there. What comes after the verdict (hidden states
by shooting, free runs, clues) is left out.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib import import_module
from typing import Any, Final

from analysis.trace import engine, fitted_model
from analysis.trace.data import trace_rows
from analysis.trace.judge import held_out
from analysis.trace.result import Trace
from analysis.trace.search import exchanges, extensions, hypothesis_set
from analysis.trace.stages import conclusion
from rig.model.records import Record, Run
from rig.runs.rigs import load_rig
from tests.studies.foreign.bench import runs_of
from tests.studies.foreign.cases import OUTSIDE, PAIR, SINGLE, Case, case_of
from tests.studies.foreign.study import answer_of, bounds
from tests.studies.pages import Section, Table
from tests.studies.trace.rules import FAULTS, RULES, Rule, by_name, switched_off, watched

log = logging.getLogger(__name__)

ALL: Final = "all rules"
KINDS: Final = (PAIR, SINGLE, PAIR, OUTSIDE)  # of seeds in turn: two causes need the most rules
WRONG: Final = ("wrong", "wrong beside unexplained", "false alarm", "partly")
SETTLED: Final = ("right", "right mechanism", "in class", "refused")


@dataclass(frozen=True)
class Answer:
    """What the trace says of a bench without a rule; plain data."""

    rule: str
    seed: int
    label: str
    kind: str
    answer: str
    verdict: str
    named: tuple[tuple[str, str], ...]
    loudness: float
    seconds: float

    def differs(self, other: Answer) -> bool:
        """Return whether verdict or names differ, in whatever order the names are."""
        return (self.verdict, set(self.named)) != (other.verdict, set(other.named))


class Kept:
    """Results of slow functions by their arguments, kept for one bench."""

    def __init__(self) -> None:
        self.results: dict[Any, Any] = {}
        self.alive: list[Any] = []  # what keys name by identity must not be freed

    def but(self, name: str) -> Kept:
        """Return what is kept, without the results of one function."""
        other = Kept()
        other.results = {key: value for key, value in self.results.items() if key[0] != name}
        other.alive = self.alive
        return other

    def __call__(self, function: Callable[..., Any], key: Callable[..., Any]) -> Any:
        """Return the function remembering what it returned for a key."""

        def remembered(*arguments: Any, **named: Any) -> Any:
            at = (function.__name__, key(*arguments, **named))
            if at not in self.results:
                self.results[at] = function(*arguments, **named)
                self.alive.append((arguments, named))
            return self.results[at]

        return remembered


def _arguments(*arguments: Any, **named: Any) -> tuple[Any, ...]:
    """Return a key of arguments: by value where they can be hashed, else by identity."""
    return (*map(_key, arguments), *((name, _key(value)) for name, value in sorted(named.items())))


def _key(value: Any) -> Any:
    """Return the value if it can be hashed, a sequence as the keys of its items, else its id."""
    if isinstance(value, (list, tuple)):
        return tuple(map(_key, value))
    try:
        hash(value)
    except TypeError:
        return id(value)
    return value


def _contents(runs: Sequence[Run]) -> tuple[Any, ...]:
    """Return what differs between runs of a trace: records by name, their channels by mean."""
    return tuple(
        (record.name, *(float(x.mean()) for x in record.channels.values()))
        for run in runs
        for record in run.records
    )


def _filters(runs: Sequence[Run], filtering: Callable[[Record], Any]) -> tuple[str, ...]:
    """Return the row filters of the records of runs."""
    return tuple(repr(filtering(record)) for run in runs for record in run.records)


@contextmanager
def decisions_only(kept: Kept) -> Iterator[None]:
    """Trace up to the verdict, columns and fits out of what was `kept`."""
    remembered: tuple[tuple[Any, str, Callable[..., Any]], ...] = (
        (
            trace_rows,
            "conditioned_records",
            lambda rig, runs, filtering, families: (
                rig.model_dump_json(),
                _contents(runs),
                families,
                _filters(runs, filtering),
            ),
        ),
        (
            trace_rows,
            "regression_data",
            lambda _, terms, members, beta=None, cache=None, **named: (
                terms,
                id(members),
                repr(beta),
                repr(named),
            ),
        ),
        (engine, "with_identified_bulk_modulus", lambda runs, *_: _contents(runs)),
        (
            fitted_model,
            "coupled",
            lambda runs, terms, filtering, **_: (
                _contents(runs),
                tuple(terms),
                _filters(runs, filtering),
            ),
        ),
        (hypothesis_set, "refine", _arguments),
        (exchanges, "rebased", _arguments),
        (extensions, "rebased", _arguments),
        (extensions, "variant_columns", _arguments),
        (hypothesis_set, "variant_columns", _arguments),
    )
    changes = (
        *((module, name, kept(getattr(module, name), key)) for module, name, key in remembered),
        (fitted_model, "_identified_with_effects", lambda runs, winner, before, *_: (before, {})),
        (
            fitted_model,
            "shoot_hidden_states",
            lambda runs, holdout, after, train, judged, one: (one, []),
        ),
        (conclusion, "clues_to", lambda *_: ((), ())),
        (held_out, "free_runs", lambda *_: (held_out.FreeRunErrors({}, {}, {}),) * 2),
    )
    with switched_off(Rule("", "", changes)):
        yield


def answers(
    case: Case, runs: tuple[Run, list[Run]], rules: Sequence[Rule] = RULES
) -> Iterator[Answer]:
    """Trace a bench with all rules, then without each that acts."""
    kept = Kept()
    started = time.process_time()
    with decisions_only(kept), watched(rules) as acting:
        found = engine.trace([runs[0]], runs[1], look_ahead=False)
    yield _answer(case, Rule(ALL, "", ()), found, time.process_time() - started)
    for rule in (rule for rule in rules if rule.name in acting):
        started = time.process_time()
        with switched_off(rule), decisions_only(kept.but("refine") if rule.refits else kept):
            found = engine.trace([runs[0]], runs[1], look_ahead=False)
        yield _answer(case, rule, found, time.process_time() - started)


def _answer(case: Case, rule: Rule, found: Trace, seconds: float) -> Answer:
    named = tuple((e.name, e.where) for e in found.effects)
    return Answer(
        rule.name, case.seed, case.label, case.kind,
        answer_of(case, found.verdict, set(named), set(found.tied)), found.verdict, named,
        max(f.ratio for f in found.floors), seconds,
    )  # fmt: skip


def perform(seed: int, rules: Sequence[Rule] = RULES) -> list[Answer]:
    """Make the records of a foreign bench and return its answers without each rule."""
    case = case_of(seed, kind=KINDS[seed // 2 % len(KINDS)])
    return list(answers(case, runs_of(case.bench, seed), rules))


def as_json(found: Sequence[Answer]) -> dict[str, Any]:
    """Return answers as plain data."""
    return {"answers": [asdict(a) for a in found]}


def loaded(_: int, data: Mapping[str, Any]) -> list[Answer]:
    """Return kept answers."""
    return [Answer(**{**a, "named": tuple((n, w) for n, w in a["named"])}) for a in data["answers"]]


@dataclass(frozen=True)
class SmallBench:
    """A small bench made for a rule or a fault: what is asserted of it, and what comes of that.

    `holds` with all rules; `lost` without the rule, or with the fault.
    """

    rule: Rule
    asserted: str
    holds: bool
    lost: bool


def small_benches() -> Iterator[SmallBench]:
    """Assert what `tests/analysis/trace/rule_stories.py` does of each rule, with and without it."""
    # By name: the tests' own modules are not typed as the studies are.
    stories: Any = import_module("tests.analysis.trace.rule_stories")
    benches, known = stories.Benches(load_rig("shinshu-2dof")), by_name(RULES + FAULTS)

    def holds(story: Callable[[Any], None]) -> bool:
        try:
            story(benches)
        except AssertionError:
            return False
        return True

    for story, names in stories.STORIES:
        with_all, words = holds(story), story.__name__.replace("_", " ")
        for name in names:
            with switched_off(known[name]):
                yield SmallBench(known[name], words, with_all, not holds(story))


def small_bench_section(found: Sequence[SmallBench]) -> Section:
    """Return the table of small benches, in the order of the rules."""
    order = [rule.name for rule in RULES + FAULTS]
    rows = [
        [b.rule.name, b.rule.off, b.asserted, _yes(b.holds), _yes(b.lost)]
        for b in sorted(found, key=lambda b: order.index(b.rule.name))
    ]
    return Section("Small benches, one for each rule", (
        "`tests/analysis/trace/rule_stories.py` has a small bench that needs the rule, for each "
        "rule but pairs, and one that notices each of a number of faults. The same command asserts "
        "them again, with all rules and with one switched off.",
        Table("What is asserted of a small bench, and lost without a rule",
              ("rule or fault", "without the rule, or with the fault", "asserted",
               "holds with all rules", "lost without"), rows),
    ))  # fmt: skip


def _yes(value: bool) -> str:
    return "yes" if value else "**no**"


def sections(found: Mapping[int, Sequence[Answer]], command: str) -> list[Section]:
    """Return the page: a table of rules with changed answers, and every change in words."""
    rows, changes = [], []
    for rule in RULES:
        pairs = [
            (next(a for a in answers if a.rule == ALL), without)
            for answers in found.values()
            for without in answers
            if without.rule == rule.name
        ]
        changed = [
            (a, b) for a, b in pairs if (a.verdict, sorted(a.named)) != (b.verdict, sorted(b.named))
        ]
        lost = sum(a.answer in SETTLED and b.answer not in SETTLED for a, b in changed)
        won = sum(a.answer not in SETTLED and b.answer in SETTLED for a, b in changed)
        wrong = sum(a.answer not in WRONG and b.answer in WRONG for a, b in changed)
        cured = sum(a.answer in WRONG and b.answer not in WRONG for a, b in changed)
        rows.append([
            rule.name, rule.off,
            *(str(n) for n in (len(pairs), len(changed), lost, wrong, won, cured)),
        ])  # fmt: skip
        changes += [
            [
                str(a.seed),
                a.label,
                rule.name,
                f"{a.answer}: {_words(a)}",
                f"{b.answer}: {_words(b)}",
            ]
            for a, b in changed
        ]
    base = [next(a for a in answers if a.rule == ALL) for answers in found.values()]
    settled, wrong = (sum(a.answer in set_of for a in base) for set_of in (SETTLED, WRONG))
    low, high = bounds(settled, len(base))
    idle = [row[0] for row in rows if row[3] == "0"]
    return [
        Section("", (
            f"{len(base)} benches of textbook physics (`python -m tests.studies foreign`), drawn "
            "by seed, hide in turn two effects, one, two, and a cause outside the catalogue; each "
            f"is traced with all rules and again without each of {len(RULES)} that acts there: one "
            "whose functions return anything else than what replaces them, or a setting. With all "
            f"rules {settled} answers are right, in class or a right refusal "
            f"({100 * low:.0f} to {100 * high:.0f} %, one-sided 95 % bounds), {wrong} "
            f"{'is' if wrong == 1 else 'are'} wrong or partial. Made by:",
            f"```sh\n{command}\n```",
            "*Changed*: verdict or names differ. *Lost*: right, in class or a right refusal with "
            "all rules, but not without this one. *Wrong*: a wrong or partial name, or a false "
            "alarm, that occurs only without the rule. *Won* and *cured* are the reverse of "
            "*lost* and *wrong*: answers that the rule makes worse.",
            Table("Answers that change without a rule",
                  ("rule", "without it", "acts on", "changed", "lost", "wrong", "won", "cured"),
                  rows),
            "No answer changes on these benches without: " + (", ".join(idle) or "none") + ". So "
            "few benches do not prove that a rule has no use: see the small benches below.",
        )),
        Section("Every change", (
            Table("With all rules, and without one",
                  ("seed", "hidden", "without", "all rules", "without it"), changes),
        )),
    ]  # fmt: skip


def _words(answer: Answer) -> str:
    named = ", ".join(f"{n} at {w}" for n, w in answer.named) or "nothing named"
    return f"{answer.verdict}, {named}"
