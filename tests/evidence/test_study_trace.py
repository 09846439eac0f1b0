"""A maintainer asks what the trace is worth: cases are drawn by seed, answers judged by a table."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path

import pytest

from hil_sim.scenario.file import parse_scenario
from rig.model.parse import InputError
from tests.studies.trace import study as st
from tests.studies.trace.cases import NONE, OUTSIDE, PAIR, SINGLE, SINGLES, Case, cases
from tests.studies.trace.command import command_of
from tests.studies.trace.machines import cases_of, machine, scenario_of
from tests.studies.trace.text import text

LEAK, SPRING = ("internal_leakage", "joint 2"), ("joint_spring", "joint 1")
GAIN = ("sensor_gain", "joint 1 cap")


def outcome(
    kind: str, verdict: str, truth: tuple[tuple[str, str], ...] = (),
    named: tuple[tuple[str, str], ...] = (), tied: tuple[tuple[str, str], ...] = (),
    moves: str = "", depends_on: tuple[str, ...] = (), seed: int = 100,
) -> st.Outcome:  # fmt: skip
    case = Case(kind, "a case", "effects: []", truth, seed, (), moves)
    return st.Outcome(
        case, verdict, named, tied, (), 5.0, math.nan, 1.0, 0.01, 90.0, 99.0, depends_on, (), 3.0
    )


@pytest.mark.parametrize(
    ("given", "judged"),
    [
        (outcome(NONE, "clean"), "right"),
        (outcome(NONE, "explained", named=(LEAK,)), "false alarm"),
        (outcome(NONE, "unexplained"), "abstained"),
        (outcome(SINGLE, "explained", (LEAK,), (LEAK,)), "right"),
        (outcome(SINGLE, "explained", (LEAK,), (SPRING,)), "wrong"),
        (outcome(SINGLE, "explained", (LEAK,), (LEAK, SPRING)), "wrong"),
        (outcome(SINGLE, "confounded", (LEAK,), (SPRING,), (LEAK,)), "in class"),
        (outcome(SINGLE, "confounded", (LEAK,), (SPRING,), (GAIN,)), "wrong"),
        (outcome(SINGLE, "unexplained", (LEAK,)), "abstained"),
        (outcome(SINGLE, "clean", (LEAK,)), "quiet"),
        (outcome(PAIR, "explained", (LEAK, SPRING), (LEAK,)), "partly"),
        (outcome(PAIR, "explained", (LEAK, SPRING), (SPRING, LEAK)), "right"),
        (outcome(OUTSIDE, "explained", named=(SPRING,), moves="piston"), "wrong"),
        (outcome(OUTSIDE, "unexplained", moves="piston", depends_on=("piston_1",)), "right"),
        (outcome(OUTSIDE, "unexplained", moves="piston", depends_on=("time",)), "no clue"),
    ],
)
def test_an_answer_is_judged_by_what_was_hidden(given: st.Outcome, judged: str) -> None:
    assert st.right(given) == judged
    assert judged in text([given])


def test_every_case_is_a_scenario_that_the_bench_reads_and_seeds_draw_it_again() -> None:
    counts = {NONE: 2, SINGLE: 3, PAIR: 4, OUTSIDE: 4}
    drawn = cases(counts, 100)
    assert drawn == cases(counts, 100)
    assert drawn != cases(counts, 200)
    for kind in counts:
        seeds = [c.seed for c in drawn if c.kind == kind]
        assert seeds == list(range(100, 100 + len(seeds)))
    # More of one kind leaves the others as they are: a study can be enlarged.
    assert {c.label for c in drawn} <= {c.label for c in cases({**counts, NONE: 9}, 100)}
    assert len(drawn) == 2 + 3 * len(SINGLES) + 4 + 4
    for case in drawn:
        scenario = parse_scenario(case.scenario, case.label)
        hidden = {one.name for one in scenario.effects}
        if case.kind in (SINGLE, PAIR):
            assert hidden == {name for name, _ in case.truth}
        assert scenario.noise == case.noise
    with pytest.raises(InputError, match="expected none, single, pair or outside"):
        cases({"triple": 1}, 100)


def test_a_study_that_was_ended_goes_on_from_what_it_kept(tmp_path: Path) -> None:
    (case,) = cases({PAIR: 1}, 100)
    kept = outcome(PAIR, "explained", case.truth, case.truth)
    record = {**asdict(kept), "case": asdict(case)}
    (tmp_path / st.name_of(case)).write_text(json.dumps(record), encoding="utf-8")
    said: list[str] = []
    (again,) = st.all_of([case], 1, said.append, tmp_path)
    assert said == []  # nothing was simulated
    assert again.case == case
    assert again.named == case.truth
    assert st.right(again) == "right"


def test_the_command_beside_the_tables_is_the_one_that_makes_them_again() -> None:
    counts, page = {"--clean": 300, "--single": 3}, Path("docs/trace-rates.md")
    assert command_of(counts, 100, page) == (
        "python -m tests.studies trace --clean 300 --single 3 --seed 100 --docs docs/trace-rates.md"
    )
    assert command_of(counts, 7, page, quick=True, level=0) == (
        "python -m tests.studies trace --quick --seed 7 --level 0 --docs docs/trace-rates.md"
    )
    few = command_of({"--clean": 0}, 100, page, only="joint_spring backlash")
    assert "--clean 0 --seed 100 --only 'joint_spring backlash' --docs" in few


def test_a_machine_of_the_study_is_drawn_by_its_seed_and_can_be_built() -> None:
    for seed in range(6):
        rig = machine(seed)
        assert rig == machine(seed)
        # What was scaled is a rig that a file could describe: every check of the reader holds.
        assert type(rig).model_validate(rig.model_dump()) == rig
        truth = scenario_of(rig, seed, 1.0).parameters
        assert set(truth) == set(rig.nominal)
        apart = [truth[n] / rig.nominal[n] for n in truth]
        assert 0.8 < min(apart) < max(apart) < 1.25


def test_what_a_machine_hides_is_judged_by_name_place_and_size() -> None:
    cases = cases_of(40, 100)
    assert {c.kind for c in cases} == {NONE, SINGLE, PAIR, OUTSIDE}
    for case in cases:
        assert case.machine
        assert len(case.truth) == {NONE: 0, SINGLE: 1, PAIR: 2, OUTSIDE: 0}[case.kind]
        assert len(case.sizes) == len(case.truth)
        assert ("payload", "bench") not in case.truth  # mass of the last link to any record
        assert bool(case.moves) == (case.kind == OUTSIDE)
