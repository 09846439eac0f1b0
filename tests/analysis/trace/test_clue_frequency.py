"""Hum that goes on whatever the joint does is told by its frequency, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.clues.dependence import FREQUENCY, frequency_clue
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import RegressionData, regression_data
from analysis.trace.data.spectral_lines import spectral_lines
from analysis.trace.result import Dependence
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis.trace.hidden import experiment, hardening, pair_of_runs


@pytest.fixture(scope="module")
def quiet(rig: Rig) -> tuple[Run, Run]:
    return pair_of_runs(rig)


def humming(run: Run, hertz: float, pascal: float) -> Run:
    """Return the run with hum on the cap side's pressure, beginning with every record."""
    records = []
    for record in run.records:
        hum = pascal * np.sin(2 * np.pi * hertz * record.time + 0.3)
        channels = dict(record.channels)
        channels["cap_pressure_2"] = np.asarray(channels["cap_pressure_2"]) + hum
        records.append(replace(record, channels=channels))
    return replace(run, records=tuple(records))


def clue_of(rig: Rig, train: Run, held_out: Run) -> Dependence | None:
    def laid_out(run: Run, train_data: RegressionData | None = None) -> RegressionData:
        # Two periods a record: the lines are those that the wave says it has.
        run = replace(run, records=tuple(replace(r, period=4000) for r in run.records))
        terms = tuple(map(Used, baseline_of(rig)))
        return regression_data(
            rig, terms, conditioned_records(rig, [run]), train_data.beta if train_data else None
        )

    train_data = laid_out(train)
    holdout_data = laid_out(held_out, train_data)
    return frequency_clue(
        spectral_lines(train_data, train_data.mean_residual),
        train_data,
        train_data.mean_residual,
        holdout_data,
        holdout_data.mean_residual,
    )


def test_hum_between_two_lines_is_told_by_its_frequency(rig: Rig, quiet: tuple[Run, Run]) -> None:
    train, held_out = (humming(run, 5.35, 1.5e4) for run in quiet)
    found = clue_of(rig, train, held_out)
    assert found is not None
    assert found.variable == FREQUENCY
    assert found.share > 0.8
    hertz = float(found.text.removeprefix("a frequency of ").removesuffix(" Hz"))
    assert hertz == pytest.approx(5.35, abs=0.02)


@pytest.mark.slow
def test_what_goes_with_the_motion_has_no_frequency_of_its_own(
    rig: Rig, quiet: tuple[Run, Run]
) -> None:
    assert clue_of(rig, *quiet) is None
    assert clue_of(rig, *(hardening(run, 2.0e7) for run in quiet)) is None
    rubbing = (experiment(rig, Fc=60), experiment(rig, repeats=2, seed=2, rms=0.02, Fc=60))
    assert clue_of(rig, *rubbing) is None


def test_drift_is_a_matter_of_time_not_of_a_frequency(rig: Rig, quiet: tuple[Run, Run]) -> None:
    assert clue_of(rig, *(humming(run, 0.06, 3e4) for run in quiet)) is None


def test_hum_that_the_held_out_records_do_not_have_is_no_clue(
    rig: Rig, quiet: tuple[Run, Run]
) -> None:
    assert clue_of(rig, humming(quiet[0], 5.35, 1.5e4), hardening(quiet[1], 2.0e7)) is None
