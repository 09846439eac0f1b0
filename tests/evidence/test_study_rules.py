"""The studies of the trace's rules count what they say they count."""

from __future__ import annotations

import numpy as np
import pytest

from rig.model.rig import Rig
from tests.analysis import small_bench
from tests.analysis.trace.gate_cases import LEAK, at_joint_2
from tests.analysis.trace.hidden import experiment, pair_of_runs
from tests.studies.foreign.cases import case_of
from tests.studies.pages import Table, text
from tests.studies.trace import ablations, baselines, isolability
from tests.studies.trace.ablations import ALL, Answer, sections
from tests.studies.trace.rules import RULES, by_name
from tests.studies.trace.rules import switched_off as without


@pytest.fixture(scope="module")
def rig() -> Rig:
    return small_bench.shinshu()


def answer(rule: str, word: str, *named: tuple[str, str]) -> Answer:
    return Answer(rule, 2, "leak", "single", word, "explained", named, 9.0, 1.0)


def test_a_rule_that_keeps_a_wrong_name_away_is_counted_so() -> None:
    leak, other = ("internal_leakage", "joint 2"), ("spool_offset", "joint 2")
    every = [answer(ALL, "right", leak), *(answer(rule.name, "right", leak) for rule in RULES[1:])]
    page = sections({2: [*every, answer(RULES[0].name, "wrong", other)]}, "the command")
    table = next(part for part in page[0].parts if isinstance(part, Table))
    assert table.rows[0][2:] == ["1", "1", "1", "1", "0", "0"]
    assert all(row[3] == "0" for row in table.rows[1:])
    assert "spool_offset at joint 2" in text(page)


@pytest.mark.slow
def test_an_answer_without_rules_kept_from_others_is_that_of_the_whole_trace(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Columns and fits kept for one rule change no answer for the next, in either order."""
    candidates = at_joint_2(rig, "internal_leakage", "spool_offset")
    monkeypatch.setattr("analysis.trace.engine.catalogue", lambda *_: candidates)
    monkeypatch.setattr("analysis.trace.stages.preparation.free_mechanisms", lambda *_: [])
    train, held_out = pair_of_runs(rig, c_internal=LEAK)
    rules = [by_name(RULES)[name] for name in ("held-out band", "rivals")]
    case = case_of(2)
    there = list(ablations.answers(case, (train, [held_out]), rules))
    back = list(ablations.answers(case, (train, [held_out]), rules[::-1]))
    assert {a.rule: a.named for a in there} == {a.rule: a.named for a in back}
    assert {a.named for a in there} == {(("internal_leakage", "joint 2"),)}


def test_a_rule_is_back_when_its_trace_failed() -> None:
    rule = by_name(RULES)["held-out band"]
    ((settings, name, _),) = rule.changes
    before = getattr(settings, name)

    def broken_off() -> None:
        with without(rule):
            assert getattr(settings, name) != before
            raise ValueError("broken off")

    with pytest.raises(ValueError, match="broken off"):
        broken_off()
    assert getattr(settings, name) == before


@pytest.fixture(scope="module")
def matrix(rig: Rig) -> isolability.Isolability:
    return isolability.isolability(experiment(rig))


@pytest.mark.slow
def test_another_effect_in_its_place_never_leaves_more_than_none(
    matrix: isolability.Isolability,
) -> None:
    alone = np.diag(matrix.distance)
    assert (matrix.distance <= alone[:, None] * (1 + 1e-9)).all()


def test_what_no_data_can_separate_is_said_to_be_so(matrix: isolability.Isolability) -> None:
    """Two levels hold one level; a leak and a spring share no equation."""
    pairs = {(a, b) for a, b, *_ in matrix.inseparable}
    assert ("coulomb friction", "asymmetric friction") in pairs
    at = {name: k for k, name in enumerate(matrix.names)}
    leak, spring = at["internal leakage"], at["joint spring"]
    assert matrix.distance[leak, spring] == pytest.approx(matrix.distance[leak, leak])


@pytest.mark.slow
def test_plain_methods_add_more_than_the_cause_and_the_page_says_how_much(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A leak: stepwise regression finds it, sparse products take its energy without a name."""
    candidates = at_joint_2(rig, "internal_leakage", "spool_offset")
    for module in ("analysis.trace.engine", "tests.studies.trace.baselines"):
        monkeypatch.setattr(f"{module}.catalogue", lambda *_: candidates)
    monkeypatch.setattr("analysis.trace.stages.preparation.free_mechanisms", lambda *_: [])
    train, held_out = pair_of_runs(rig, c_internal=LEAK)
    found = baselines.answers(case_of(2), train, [held_out])
    trace, stepwise, sparse = found
    leak = ("internal_leakage", "joint 2")
    assert trace.named == (leak,)
    assert stepwise.named[0] == leak
    assert sparse.named == ()
    assert sparse.terms > len(stepwise.named)
    assert min(trace.taken, stepwise.taken) > 0.95
    assert 0.3 < sparse.taken < trace.taken
    page = text(baselines.sections({2: found}, "the command"))
    assert "internal_leakage at joint 2" in page
    assert f"{sparse.terms} products" in page
