"""Samples lost on the wire cost the rows near them, not the record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.identify.stacked_rows import build_rows
from analysis.regression.rows import default_filtering
from analysis.report.identification.report import render_report
from analysis.simulation.model import Model
from analysis.simulation.validate import validate
from analysis.terms import baseline
from analysis.terms.base import Used
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig
from tests.analysis import small_bench as bench
from tests.analysis.small_bench import TRUTH

TERMS = tuple(Used(term) for term in baseline())


def without(record: Record, first: int, last: int) -> Record:
    """The record with a block of samples lost in every channel, as the archive has it."""
    channels = {name: x.copy() for name, x in record.channels.items()}
    for x in channels.values():
        x[first:last] = np.nan
    return replace(record, channels=channels)


def with_lost(run: Run, *blocks: tuple[int, int]) -> Run:
    first = run.records[0]
    for a, b in blocks:
        first = without(first, a, b)
    return replace(run, records=(first, *run.records[1:]))


def test_rows_beyond_the_filters_are_untouched_and_the_others_counted(
    multisine_run: Run, rig: Rig
) -> None:
    record = multisine_run.records[0]
    filters = default_filtering(record)
    assert filters.rows is not None
    reach = filters.channels.reach + filters.rows.reach + 17  # and the alignment's kernel
    whole = build_rows(rig, [multisine_run], TERMS)[0].rows
    holed = build_rows(rig, [with_lost(multisine_run, (4000, 4010))], TERMS)[0].rows
    for name, rows in holed.items():
        far = np.abs(whole[name].time - 4.0045) > (reach + 5) / 1000
        assert rows.time == pytest.approx(whole[name].time[far], abs=1e-9)
        size = np.abs(whole[name].matrix).max(axis=0)
        # Torque rows hold the locked joint at the mean of its samples, of which there are fewer.
        same = 1e-10 if name.startswith("flow") else 1e-6
        assert (np.abs(rows.matrix - whole[name].matrix[far]).max(axis=0) <= same * size).all()
        assert rows.masked == whole[name].masked + int((~far).sum()) > 0


def test_a_lost_block_costs_accuracy_nothing_and_is_said(multisine_run: Run) -> None:
    result = identify([with_lost(multisine_run, (3000, 3020), (7000, 7500))])
    for name, estimate in result.estimates.items():
        limit = 0.02 if name == "b" else 0.005
        assert abs(estimate.value / TRUTH[name] - 1) < limit, name
    check = next(c for c in result.checks if c.name == "lost samples")
    assert "520 samples never arrived" in check.detail
    assert multisine_run.records[0].name in check.detail
    assert result.masked_rows > identify([multisine_run]).masked_rows


def test_a_gap_in_a_lock_does_not_make_it_give(multisine_run: Run) -> None:
    holed = identify([with_lost(multisine_run, (100, 160))])
    assert holed.estimates["M2"].value == pytest.approx(TRUTH["M2"], rel=0.005)


def test_a_channel_lost_from_end_to_end_is_named(multisine_run: Run) -> None:
    with pytest.raises(InputError, match=r"'step1_r1', channel 'spool_2': every sample was lost"):
        identify([with_lost(multisine_run, (0, 10_000))])


def test_the_model_is_not_judged_by_samples_that_were_made_up(
    multisine_run: Run, both_run: Run
) -> None:
    model: Model = identify([multisine_run]).model
    (whole,) = validate(model, [both_run])
    (holed,) = validate(model, [with_lost(both_run, (2000, 2010))])
    for name, fit in whole.fit.items():
        assert holed.fit[name] == pytest.approx(fit, abs=0.5)
    with pytest.raises(InputError, match=r"'both_r1': 300 samples in a row were lost"):
        validate(model, [with_lost(both_run, (2000, 2300))])


@pytest.mark.slow
def test_a_report_can_be_made_of_records_with_gaps(multisine_run: Run) -> None:
    run = with_lost(multisine_run, (3000, 3020))
    assert "lost samples" in render_report(runs=[run], identification=identify([run]))


def test_a_repeat_cut_so_short_that_it_has_no_rows_leaves_the_other_one_to_be_identified(
    rig: Rig,
) -> None:
    steps = (bench.Step("step1", (1,), (0.0, 0.0)),)
    waves = {"step1": {1: bench.Excitation.sine(0.05)}}
    run = bench.experiment(rig, waves, repeats=2, seed=5, steps=steps, seconds=6.0)
    whole, other = run.records
    cut = replace(other, channels={name: x[:500] for name, x in other.channels.items()})
    found = identify([Run(rig, (whole, cut))])
    assert found.estimates["b"].value == pytest.approx(TRUTH["b"], rel=0.01)
    with pytest.raises(InputError, match="needs two or more repeats"):
        identify([Run(rig, (whole, cut))], estimator="iv")
