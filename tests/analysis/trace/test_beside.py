"""The oil warms up between two days: that is no effect, and must not pass for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.simulation.synthetic import multisine, synthetic_run
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.nuisance_terms import (
    at_nominal_temperature,
    temperature_terms,
    within_plausible_slope,
)
from analysis.trace.data.regression_data import regression_data
from analysis.trace.judge import held_out
from analysis.trace.search.exact_fit import fit_coefficients
from rig.model.records import Run
from rig.model.rig import Rig


def day(rig: Rig, seed: int, kelvin: float, rms: float = 0.025) -> Run:
    """A day's records with the oil `kelvin` warmer, and softer by 0.4 % for each."""
    rng = np.random.default_rng([seed, 7])
    wave = multisine(np.random.default_rng(seed), rig.sample_rate, 4.0, 9.5)
    soft = {**rig.nominal, "b": rig.nominal["b"] * (1 - 0.004 * kelvin)}
    run = synthetic_run(rig.model_copy(update={"nominal": soft}), rng, wave, rms=rms, repeats=2)
    warm = rig.oil.temperature + kelvin
    records = tuple(
        replace(r, channels={**r.channels, "oil_temperature": np.full(r.samples, warm)})
        for r in run.records
    )
    return Run(rig, records, f"day {seed}")


@pytest.fixture(scope="module")
def days(rig: Rig) -> tuple[Run, Run]:
    return day(rig, 1, 0.0), day(rig, 2, 6.0, 0.02)


def test_the_column_is_there_where_temperature_was_measured_and_moved(
    rig: Rig, days: tuple[Run, Run]
) -> None:
    terms = tuple(map(Used, baseline_of(rig)))
    assert [u.term.name for u in temperature_terms(terms, days)] == ["bulk_temperature_nuisance"]
    assert temperature_terms(terms, days[:1]) == ()
    blind = [
        replace(run, records=tuple(
            replace(r, channels={k: v for k, v in r.channels.items() if k != "oil_temperature"})
            for r in run.records
        ))
        for run in days
    ]  # fmt: skip
    assert temperature_terms(terms, blind) == ()


@pytest.mark.slow
def test_a_warmer_day_is_judged_at_its_own_temperature(
    rig: Rig, days: tuple[Run, Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the factor for an oil whose temperature nobody measured."""
    monkeypatch.setattr(held_out, "_oil_changes", lambda *_: {})
    terms = tuple(map(Used, baseline_of(rig)))
    train, judged = (conditioned_records(rig, [run]) for run in days)
    found = {}
    for label, extra in (("without", ()), ("with", temperature_terms(terms, days[:1], days[1:]))):
        train_data = regression_data(rig, (*terms, *extra), train)
        holdout_data = regression_data(rig, (*terms, *extra), judged, train_data.beta)
        model = held_out.refitted_to_held_out(
            holdout_data, fit_coefficients(train_data, train_data.terms)
        )
        found[label] = held_out.errors(rig, judged, model, model)
    floor = found["with"].noise
    assert found["without"].after["flow_cap_2"] > 1.3 * floor["flow_cap_2"]
    for equation, error in found["with"].after.items():
        assert error < 1.15 * floor[equation], equation


def test_a_cold_morning_is_judged_though_the_fit_knows_warm_oil_alone(rig: Rig) -> None:
    terms = tuple(map(Used, baseline_of(rig)))
    warm = [day(rig, 1, 6.0), day(rig, 2, 6.2)]  # a fifth of a kelvin says nothing of the slope
    cold = [day(rig, 3, 0.0, 0.02)]
    every = (*terms, *temperature_terms(terms, warm, cold))
    train, judged = (conditioned_records(rig, runs) for runs in (warm, cold))
    train_data = regression_data(rig, every, train)
    holdout_data = regression_data(rig, every, judged, train_data.beta)
    model = held_out.refitted_to_held_out(
        holdout_data, fit_coefficients(train_data, train_data.terms)
    )
    found = held_out.errors(rig, judged, model, model)
    for equation, error in found.after.items():
        assert error < 1.15 * found.noise[equation], equation
    known = at_nominal_temperature(identify(warm, terms=every, estimator="plain").model).parameters[
        "b"
    ]
    assert known.value == pytest.approx(rig.nominal["b"], rel=0.01)
    assert known.ci95[0] < rig.nominal["b"] < known.ci95[1]


def test_oil_can_do_only_so_much() -> None:
    beta = {"b": 1e-9}  # 1/b of the rows
    assert within_plausible_slope(4e-12, beta) == 4e-12  # 0.4 % per kelvin
    assert within_plausible_slope(1.0, beta) == pytest.approx(15e-12, rel=1e-6, abs=0)
    assert within_plausible_slope(-1.0, beta) == pytest.approx(-9e-12)


def test_the_model_file_is_that_of_the_rigs_temperature(rig: Rig, days: tuple[Run, Run]) -> None:
    terms = tuple(map(Used, baseline_of(rig)))
    full = identify(days, terms=(*terms, *temperature_terms(terms, days)), estimator="plain").model
    kept = at_nominal_temperature(full)
    assert set(full.parameters) - set(kept.parameters) == {"1/b per kelvin"}
    assert kept.parameters["b"].value == pytest.approx(rig.nominal["b"], rel=0.01)
    assert kept.covariance.shape == (len(kept.parameters),) * 2
    assert at_nominal_temperature(kept) is kept
