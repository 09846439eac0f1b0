"""Records that judge are read once: they choose no name, and may refuse what others have chosen."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import RegressionData, regression_data
from analysis.trace.data.set_aside import in_judging_block, set_aside
from analysis.trace.engine import trace
from analysis.trace.judge import held_out
from analysis.trace.notes import masked_row_notes
from analysis.trace.result import Trace
from analysis.trace.search.exact_fit import design_matrix, fit_coefficients
from analysis.trace.settings import TRACE
from rig.cli.main import app
from rig.model.parse import InputError
from rig.model.records import Record, Run, of_bandwidth
from rig.model.rig import Rig
from rig.runs.archive import write_run
from tests.analysis.trace import foreign_bench
from tests.analysis.trace.gate_cases import LEAK, at_joint_2, joined
from tests.analysis.trace.hidden import (
    RMS,
    experiment,
    hardening,
    pair_of_runs,
    pushed,
    with_filtered_noise,
)

FEW = ("internal_leakage", "external_leakage", "spool_offset")
PUSH = 10.0  # [N], five times the torque's noise in a block
BORDER = 1e-3  # relative, of what a row filter's tails carry over a block's border


def traced(rig: Rig, train: Run, held_out: Run, *judge: Run) -> Trace:
    return trace(
        [train], [held_out], at_joint_2(rig, *FEW), look_ahead=False, free_forms=False, judge=judge
    )


def chosen(result: Trace) -> dict[str, object]:
    """Return all that was chosen: names, sizes, gates and the model with them."""
    return {
        "effects": [(e.name, e.where, e.parameters, e.gates) for e in result.effects],
        "refused": [(e.name, e.where, e.gates) for e in result.refused],
        "model": {k: v for k, v in result.model_after.values.items() if np.isfinite(v)},
        "depends": result.depends_on,
    }


@pytest.fixture(scope="module")
def leaky(rig: Rig) -> tuple[Run, Run]:
    return pair_of_runs(rig, c_internal=LEAK)


@pytest.fixture(scope="module")
def found(rig: Rig, leaky: tuple[Run, Run]) -> Trace:
    return traced(rig, *leaky)


def test_the_note_says_what_judges(found: Trace) -> None:
    (note,) = [n for n in found.notes if "--judge RUN" in n]
    assert "a third of the held-out rows" in note
    assert "the rest chooses" in note


def test_what_only_the_judging_rows_show_changes_no_name_but_the_verdict(
    rig: Rig, leaky: tuple[Run, Run], found: Trace
) -> None:
    assert found.verdict == "explained"
    result = traced(rig, leaky[0], pushed(leaky[1], PUSH, (1,)))
    assert chosen(result) == chosen(found)
    assert result.verdict == "unexplained"
    assert result.after["torque_2"] > 1.5 * result.noise_floor["torque_2"]
    (note,) = [n for n in result.notes if n.startswith("torque_2: held-out error")]
    assert note.endswith("times the noise floor in the records that judge")


@pytest.mark.slow
def test_what_only_the_choosing_rows_show_is_in_no_reported_error(
    rig: Rig, leaky: tuple[Run, Run], found: Trace
) -> None:
    result = traced(rig, leaky[0], pushed(leaky[1], PUSH, (0, 2)))
    assert result.verdict == "unexplained"  # seen while choosing
    assert not any("records that judge" in n for n in result.notes)
    assert result.before == pytest.approx(found.before, rel=BORDER)
    assert [e.name for e in result.effects] == [e.name for e in found.effects]
    assert result.after == pytest.approx(found.after, rel=BORDER)
    assert result.noise_floor == pytest.approx(found.noise_floor, rel=BORDER)


@pytest.mark.slow
def test_records_given_to_judge_are_read_once(
    rig: Rig, leaky: tuple[Run, Run], found: Trace
) -> None:
    """All of the held-out rows choose then; another day's push at the piston refuses the name."""
    other = experiment(rig, repeats=2, seed=3, rms=0.8 * RMS, c_internal=LEAK)
    good, bad = (traced(rig, *leaky, pushed(other, force, (0, 1, 2))) for force in (0.0, PUSH))
    assert (good.verdict, bad.verdict) == ("explained", "unexplained")
    assert chosen(good) == chosen(bad)
    assert [e.name for e in good.effects] == [e.name for e in found.effects]
    assert not any("--judge RUN" in note for note in good.notes)
    assert any("in the records that judge" in note for note in bad.notes)


@pytest.mark.parametrize("kind", ["training", "held-out"])
def test_records_that_have_been_seen_cannot_judge(
    leaky: tuple[Run, Run], tmp_path: Path, kind: str
) -> None:
    seen = leaky[kind == "held-out"]
    runs = (*leaky, replace(seen, records=seen.records[1:2]))
    train, held_out, judge = (
        str(write_run(tmp_path / name, run)) for name, run in zip("abc", runs, strict=True)
    )
    words = ["trace", train, "--holdout", held_out, "--judge", judge]
    done = CliRunner().invoke(app, words, standalone_mode=False)
    assert isinstance(done.exception, InputError), done.exception
    assert re.match(
        rf"judging record 'step1_r2' is {kind} record 'step1_r2', .* give --judge other records",
        str(done.exception),
    )


def rows_of(rig: Rig, *runs: Run) -> RegressionData:
    terms = tuple(map(Used, baseline_of(rig)))
    beta = {name: rig.nominal[name] for name in rig.nominal if name != "b"}
    return regression_data(rig, terms, conditioned_records(rig, runs), beta)


def same(one: RegressionData, other: RegressionData) -> None:
    np.testing.assert_array_equal(one.base, other.base)
    np.testing.assert_array_equal(one.residual, other.residual)
    assert one.segments == other.segments
    for mine, theirs in zip(one.rows, other.rows, strict=False):
        assert mine.keys() == theirs.keys()
        for equation, rows in mine.items():
            np.testing.assert_array_equal(rows.matrix, theirs[equation].matrix)
            np.testing.assert_array_equal(rows.time, theirs[equation].time)
    now, later = (design_matrix(data, data.terms) for data in (one, other))
    np.testing.assert_array_equal(now.matrix, later.matrix)
    np.testing.assert_array_equal(now.rhs, later.rhs)


def test_a_part_of_the_data_is_what_its_records_alone_would_make(
    rig: Rig, leaky: tuple[Run, Run]
) -> None:
    train, held_out = (replace(run, records=run.records[:2]) for run in leaky)
    both, first = rows_of(rig, train, held_out), rows_of(rig, train)
    assert (
        design_matrix(both, both.terms).matrix.shape == both.base.shape
    )  # remembered from here on
    mask = np.arange(len(both.base)) < len(first.base)
    part = both.at(mask)
    assert part.cache is not both.cache
    same(part, first)
    same(both.at(np.ones(len(both.base), dtype=bool)), both)
    every_other = np.arange(len(first.base)) % 2 == 0
    thinned = design_matrix(first.at(every_other), first.terms)
    np.testing.assert_allclose(
        thinned.matrix, design_matrix(first, first.terms).matrix[every_other], rtol=1e-12
    )


def test_every_third_second_is_set_aside_and_no_row_is_in_both(
    rig: Rig, leaky: tuple[Run, Run]
) -> None:
    data = rows_of(rig, leaky[1])
    unseen = set_aside(data, data, (), (leaky[1],))
    for equation, rows in unseen.judging.rows[0].items():
        others = unseen.choosing.rows[0][equation].time
        assert in_judging_block(rows.time).all()
        assert not in_judging_block(others).any()
        assert len(rows.time) + len(others) == len(data.rows[0][equation].time)
    (lost,) = unseen.choosing_runs
    nan = np.isnan(lost.records[0].channels["piston_2"])
    np.testing.assert_array_equal(nan, in_judging_block(np.asarray(lost.records[0].time)))


def test_a_record_too_short_to_be_divided_chooses_and_judges(
    rig: Rig, leaky: tuple[Run, Run]
) -> None:
    short = replace(leaky[1], records=tuple(
        replace(r, channels={k: np.asarray(v)[:3000] for k, v in r.channels.items()})
        for r in leaky[1].records
    ))  # fmt: skip
    data = rows_of(rig, short)
    assert all(s.where.stop - s.where.start >= TRACE.least_rows for s in data.segments)
    unseen = set_aside(data, data, (), (short,))
    same(unseen.choosing, data)
    same(unseen.judging, data)
    assert unseen.divided == frozenset()
    assert "too short to set rows aside" in unseen.notes[0]


def test_what_the_judging_records_know_far_better_is_no_error_of_the_model(
    rig: Rig, leaky: tuple[Run, Run]
) -> None:
    """An inertia lost in noise while joints were locked in turn: its error is not the model's."""
    data = {}
    for name, run in zip(("train", "held"), leaky, strict=True):
        terms = tuple(map(Used, baseline_of(rig)))
        data[name] = regression_data(rig, terms, conditioned_records(rig, [run]))
    model = fit_coefficients(data["train"], data["train"].terms)
    at = list(model.beta).index("M2")
    wrong = replace(model, beta={**model.beta, "M2": 1.5 * model.beta["M2"]})
    poor = wrong.information.copy()
    poor[at, :], poor[:, at] = 0.1 * poor[at, :], 0.1 * poor[:, at]
    poor[at, at] *= 0.1
    sizes = [
        float(np.linalg.norm(held_out.held_out_residual(data["held"], m)))
        for m in (model, wrong, replace(wrong, information=poor))
    ]
    assert sizes[1] > 2 * sizes[0]
    assert sizes[2] == pytest.approx(sizes[0], rel=0.02)
    settled = held_out.refitted_to_held_out(data["held"], replace(wrong, information=poor))
    assert held_out.refitted_names(wrong, settled) == ["M2"]


@pytest.mark.slow
def test_an_equation_whose_rows_a_step_masks_is_traced_with_the_other_steps(rig: Rig) -> None:
    """A chamber stands above the supply's pressure for most of one step."""
    train, held_out = pair_of_runs(rig, c_internal=LEAK)
    other = experiment(rig, seed=5, c_internal=LEAK)

    def high(record: Record) -> Record:
        pressure = np.asarray(record.channels["cap_pressure_2"]).copy()
        pressure[int(1.3 * record.sample_rate) :] = 1.05 * rig.supply.pressure
        return replace(record, channels=record.channels | {"cap_pressure_2": pressure})

    masked = replace(other, records=tuple(map(high, other.records)))
    candidates = at_joint_2(rig, "internal_leakage")
    result = trace([joined(train, masked)], [held_out], candidates, look_ahead=False)
    note = "flow_cap_2: step 'step2' is left out of training, since fewer than 40 rows are usable"
    assert sum(n.startswith(note) for n in result.notes) == 1
    assert {f.equation for f in result.floors if f.group[1] == "step1"} <= set(result.after)
    whole = trace([train], [held_out], candidates, look_ahead=False)
    assert not any("left out of training" in n for n in whole.notes)
    with pytest.raises(InputError, match=r"rows of flow_cap_2; the trace needs 40: \d+ others are"):
        trace([masked], [held_out], candidates, look_ahead=False)


def test_a_short_step_is_left_out_where_others_have_its_equations(
    rig: Rig, leaky: tuple[Run, Run]
) -> None:
    train, held_out = leaky
    first = train.records[0]
    cut = {name: x[: int(0.8 * first.sample_rate)] for name, x in first.channels.items()}
    short = replace(train, records=(replace(first, channels=cut, period=0),))
    result = traced(rig, joined(train, short), held_out)
    assert [e.name for e in result.effects] == ["internal_leakage"]
    left_out = [n for n in result.notes if "is left out of training" in n]
    assert {n.split(": ")[1].split(" is")[0] for n in left_out} == {"step 'step2'"}
    with pytest.raises(InputError, match="the trace needs 40: take longer records"):
        traced(rig, short, held_out)


def test_records_too_short_for_narrower_rows_keep_their_answer(rig: Rig) -> None:
    """Their filter would leave hardly any row of what a quarter of their bandwidth holds."""
    runs = [with_filtered_noise(hardening(run, 1e7), 1.0) for run in pair_of_runs(rig)]
    train, held_out = of_bandwidth(runs, 2.0)
    result = traced(rig, train, held_out)
    assert (result.verdict, result.effects) == ("unexplained", ())


def test_a_clean_answer_says_what_slow_rows_keep_that_nothing_explains(rig: Rig) -> None:
    """Noise of the accelerations hides a spring, and the only candidate is a leak."""
    runs = foreign_bench.pair_of_runs(rig, foreign_bench.Hidden(spring=9.0))
    noisy = [with_filtered_noise(replace(r, records=r.records[:1]), 8.0, 1e4) for r in runs]
    train, held_out = of_bandwidth(noisy, 10.0)
    leaks = at_joint_2(rig, "internal_leakage")
    result = trace([train], [held_out], leaks, look_ahead=False, free_forms=False)
    assert (result.verdict, result.effects) == ("clean", ())
    assert result.notes[0].startswith("torque_2: in rows for a motion up to 2.5 Hz, 2.")


def test_rows_that_are_left_out_are_spoken_of(rig: Rig, leaky: tuple[Run, Run]) -> None:
    terms = tuple(map(Used, baseline_of(rig)))
    data = regression_data(rig, terms, conditioned_records(rig, [leaky[0]]))
    few, many = (
        replace(
            data,
            rows=tuple(
                {e: replace(r, masked=round(share * len(r.rhs))) for e, r in rows.items()}
                for rows in data.rows
            ),
        )
        for share in (0.01, 0.1)
    )
    assert masked_row_notes("training", few) == []
    notes = masked_row_notes("training", many)
    assert any(n.startswith("flow_cap_2: 9 % of the training rows") for n in notes), notes


def test_oil_a_percent_thinner_on_another_day_is_allowed_for_where_rows_show_it(rig: Rig) -> None:
    """A machine with little noise shows it at three times its noise, and lacks nothing else."""
    terms = tuple(map(Used, baseline_of(rig)))
    train, day = (
        regression_data(rig, terms, conditioned_records(rig, [run]))
        for run in foreign_bench.pair_of_runs(rig, foreign_bench.Hidden(), noise=0.1)
    )
    model = fit_coefficients(train, terms)
    thicker = replace(model, beta={**model.beta, "Fv2": 1.009 * model.beta["Fv2"]})
    assert held_out.oil_changes(day, thicker)["Fv2"] == pytest.approx(-0.009, abs=0.002)
