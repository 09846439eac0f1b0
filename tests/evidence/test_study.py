"""The studies' bench is the real one without its wire, and what they count is true."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from analysis.identify.identify import identify
from rig.model.parse import InputError
from tests.cli.bench import study
from tests.studies.__main__ import app
from tests.studies.estimators.jobs import MODEL, PLANT, Experiment, perform, records_of
from tests.studies.estimators.tables import coverage_text, estimator_text
from tests.studies.pages import replace_section


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
    off = {**row, "name": "M1", "bias": 0.006, "coverage": 1.0, "coverage_low": 0.981}
    data = {
        "experiments": 2, "overall": 0.5, "used": {"ls": 2}, "seconds": 1.2,
        "parameters": {"b": row, "M1": off},
    }  # fmt: skip
    text = coverage_text(
        {"estimator": "auto", "noise": 1.0, "repeats": 4, "goal": [0.92, 0.98],
         "seeds": [100, 101], "kinds": {"model": data}}
    )  # fmt: skip
    assert "estimator auto (ls in 2)" in text
    assert "| b | 50.0 (10.0 to 90.0) | +1.0000" in text
    assert "by themselves: b (50.0, too narrow), M1 (100.0, cautious)" in text
    # 1 % is allowed for b, 0.6 % is not for an inertia.
    assert "(b: 2 %): M1 (+0.600 %)" in text
    part = {
        "noise": 10.0, "used": {"auto": {"iv": 2}}, "estimators": {"ls": {"b": row}, "iv": {}},
        "seconds": {"ls": 1.234, "iv": None},
    }  # fmt: skip
    shown = estimator_text(
        {"kind": "plant", "experiments": 2, "seeds": [100, 101], "noise": [part]}
    )  # fmt: skip
    assert "| b | +1.000 / 0.200 | — |" in shown
    assert "| processor's seconds, median | 1.2 | — |" in shown
    assert "instruments in 2 of 2" in shown


def test_a_studys_tables_take_their_place_on_a_page_that_has_one(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("words\n<!-- study x -->\nold\n<!-- end of study x -->\nmore\n")
    replace_section(page, "study x", "new\n")
    replace_section(page, "study x", "newer\n")
    assert page.read_text() == "words\n<!-- study x -->\nnewer\n<!-- end of study x -->\nmore\n"
    for name in ("study y", "study x"):
        with pytest.raises(InputError, match=f"expected a page with the lines <!-- {name} -->"):
            replace_section(page if name == "study y" else tmp_path / "none.md", name, "")


def test_every_study_shows_an_example_and_refuses_an_unknown_word() -> None:
    for name in ("trace", "coverage", "estimators", "differentiation", "electric", "emps"):
        shown = CliRunner().invoke(app, [name, "--help"])
        assert shown.exit_code == 0, shown.output
        assert f"Example: python -m tests.studies {name}" in " ".join(shown.stdout.split())
    wrong = study("coverage", "--kind", "moon")
    assert wrong.returncode == 2
    assert "expected model, plant or both" in wrong.stderr
