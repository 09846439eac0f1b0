"""The studies' bench is the real one without its wire, and what they count is true."""

from __future__ import annotations

import numpy as np

from analysis.identify import identify
from rig.cli.studies import coverage_text, estimator_text
from rig.cli.study_jobs import MODEL, PLANT, Experiment, perform, records_of
from tests.cli.bench import bramah


def test_a_bench_without_a_wire_leaves_the_protocols_records() -> None:
    run, truth = records_of(Experiment(PLANT, 3, repeats=2))
    assert [r.name for r in run.records] == [f"step{s}_r{r}" for s in (1, 2, 3) for r in (1, 2)]
    assert all(r.samples == 10_000 and r.period == 10_000 for r in run.records)
    assert run.records[0].attributes["excited"] == "2"
    # The oil of this bench is not at its nominal temperature, and drifts.
    warm = [float(np.mean(r.channels["oil_temperature"])) - 40.0 for r in run.records]
    assert np.ptp(warm) > 0.5
    found, plain = identify([run]), identify([run], estimator="plain")
    worst = max(abs(p.value / truth[n] - 1) for n, p in found.estimates.items())
    assert worst < 0.005
    # Referred to the nominal temperature, b is nearer than the mean over whatever it was.
    assert abs(found.estimates["b"].value / truth["b"] - 1) < 0.0015
    assert abs(plain.estimates["b"].value / truth["b"] - 1) > 0.0015
    said = next(c for c in found.checks if c.name == "oil temperature")
    assert said.ok
    assert "% per kelvin" in said.detail


def test_the_models_own_data_are_estimated_without_bias_and_tables_say_it() -> None:
    trial = perform(Experiment(MODEL, 4, ("ls", "iv"), repeats=2))
    assert set(trial) == {"ls", "iv"}
    assert max(abs(e) for e in trial["ls"].error.values()) < 0.005
    row = {
        "name": "b", "count": 2, "coverage": 0.5, "coverage_low": 0.1, "coverage_high": 0.9,
        "bias": 0.01, "bias_error": 0.001, "rsd": 0.002, "half_width": 0.004,
    }  # fmt: skip
    data = {"experiments": 2, "overall": 0.5, "parameters": {"b": row}}
    text = coverage_text(
        {"estimator": "ls", "noise": 1.0, "repeats": 4, "goal": [0.92, 0.98],
         "kinds": {"model": data}}
    )  # fmt: skip
    assert "| b | 50.0 (10.0 to 90.0) | +1.0000" in text
    assert "outside of that by themselves: b" in text
    part = {"noise": 10.0, "flagged": 2, "estimators": {"ls": {"b": row}, "iv": {}}}
    assert "| b | +1.000 / 0.200 | — |" in estimator_text(
        {"kind": "plant", "experiments": 2, "noise": [part]}
    )


def test_the_verbs_tell_how_they_are_used() -> None:
    for verb in ("study", "study coverage", "study estimators", "study differentiation"):
        shown = bramah(*verb.split(), "--help")
        assert shown.returncode == 0, shown.stderr
        assert f"Example: bramah {verb}" in " ".join(shown.stdout.split())
    wrong = bramah("study", "coverage", "--kind", "moon")
    assert wrong.returncode == 2
    assert "expected model, plant or both" in wrong.stderr
