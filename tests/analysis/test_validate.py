"""Validation on data no fit has seen, the model file between, and the twin before a run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.identify.result import Identification
from analysis.simulation.model import load_model, save_model
from analysis.simulation.twin import simulate_commands, spool_response
from analysis.simulation.validate import fit_percent, to_json, validate
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig


@pytest.fixture(scope="module")
def found(multisine_run: Run) -> Identification:
    return identify([multisine_run])


@pytest.fixture(scope="module")
def model_file(found: Identification, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.json"
    save_model(found.model, path)
    return path


def test_a_saved_model_predicts_both_joints_at_once(model_file: Path, both_run: Run) -> None:
    results = validate(load_model(model_file), [both_run])
    data = json.loads(json.dumps(to_json(results), allow_nan=False))
    (record,) = data["records"]
    channels = {f"{k}_{i}" for k in ("piston", "cap_pressure", "rod_pressure") for i in (1, 2)}
    assert record["record"] == "both_r1"
    assert record["step"] == "both"
    assert set(record["fit"]) == set(record["rmse"]) == set(record["window_rmse"]) == channels
    assert record["failure"] is None
    assert min(record["fit"].values()) > 95.0
    # Restarted from the data every quarter second, little beyond the sensors' noise is left.
    assert record["window_rmse"]["piston_1"] < 2.5e-5
    assert record["window_rmse"]["cap_pressure_2"] < 15e3


def test_locked_joints_are_not_judged(found: Identification, multisine_run: Run) -> None:
    run = replace(multisine_run, records=multisine_run.records[:1])
    (result,) = validate(found.model, [run])
    assert set(result.fit) == {"piston_2", "cap_pressure_2", "rod_pressure_2"}
    assert len(result.time) == len(result.simulation.piston)


def test_fit_is_the_notes_formula() -> None:
    y = np.array([1.0, 2.0, 3.0, 4.0])
    assert fit_percent(y, y) == 100.0
    assert fit_percent(y, np.full(4, 2.5)) == pytest.approx(0.0)
    assert np.isnan(fit_percent(np.ones(4), y))


def test_a_model_file_comes_back_as_it_was(found: Identification, model_file: Path) -> None:
    back = load_model(model_file)
    assert back.rig == found.model.rig
    assert back.parameters == dict(found.model.parameters)
    assert back.covariance == pytest.approx(found.model.covariance)
    assert [u.term for u in back.terms] == [u.term for u in found.model.terms]
    std = {name: p.std for name, p in back.parameters.items()}
    diagonal = np.sqrt(np.diag(back.covariance))
    assert diagonal == pytest.approx(list(std.values()), rel=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format="other"), "is not a model file"),
        (lambda d: d.update(version=99), "version 99"),
        (lambda d: d.pop("terms"), "damaged: KeyError at 'terms'"),
        (lambda d: d["parameters"].pop("b"), "'b' of 'compressibility' is missing"),
        (lambda d: d["terms"][0].update(name="magic"), "unknown term 'magic'"),
        (lambda d: d["rig"]["joints"][0].update(link_length=-1), "rig.joints.0.link_length"),
        (lambda d: d.update(covariance=[[1.0]]), "expected that of 16 parameters"),
    ],
)
def test_a_damaged_model_file_says_where(model_file: Path, tmp_path: Path, change, message) -> None:
    data = json.loads(model_file.read_text())
    change(data)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=message):
        load_model(path)


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00\xff", "[" * 100_000])
def test_a_file_that_is_no_model_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"not a model file|expected a model file"):
        load_model(path)


def test_a_missing_model_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file; expected a model file"):
        load_model(tmp_path / "none.json")
    with pytest.raises(InputError, match="is a folder; expected a model file"):
        load_model(tmp_path)


def test_a_model_of_another_rig_is_refused(found: Identification, both_run: Run, rig: Rig) -> None:
    other = replace(both_run, rig=rig.model_copy(update={"name": "elsewhere"}))
    with pytest.raises(InputError, match=r"another rig.*'elsewhere'"):
        validate(found.model, [other])


def test_the_twin_stands_still_without_a_command(rig: Rig) -> None:
    start = np.array([0.01, -0.005])
    found = simulate_commands(rig, np.zeros((500, 2)), start, {})
    assert found["piston"] == pytest.approx(np.tile(start, (500, 1)), abs=1e-5)
    assert found["valid"].all()
    cap, rod = found["cap_pressure"][-1], found["rod_pressure"][-1]
    q = [float(j.linkage.angle(s)) for j, s in zip(rig.joints, start, strict=True)]
    pull = 9.8 * rig.nominal["W2"] * np.sin(q[0] + q[1])
    force = 7.0e-4 * cap[1] - 5.4e-4 * rod[1]
    assert float(rig.joints[1].linkage.jacobian(q[1])) * force == pytest.approx(pull, rel=1e-2)


def test_the_twin_moves_as_fast_as_the_orifices_let_it(rig: Rig) -> None:
    """Steady extension: both edges carry the same piston speed at the balance of forces."""
    commands = np.zeros((400, 2))
    commands[:, 1] = 0.5
    found = simulate_commands(rig, commands, np.array([0.0, -0.02]), {0: 0.0})
    k = 300
    cap, rod = found["cap_pressure"][k, 1], found["rod_pressure"][k, 1]
    inflow = 6.0e-7 * np.sqrt(7e6 - cap) * 0.05 / 7.0e-4
    outflow = 6.0e-7 * np.sqrt(rod) * 0.05 / 5.4e-4
    assert found["speed"][k, 1] == pytest.approx(inflow, rel=0.03)
    assert found["speed"][k, 1] == pytest.approx(outflow, rel=0.03)
    assert found["piston"][:, 0] == pytest.approx(np.zeros(400))
    assert found["spool"][k, 1] == pytest.approx(0.05, rel=1e-3)


def test_the_twin_says_when_a_command_drives_the_piston_out(rig: Rig) -> None:
    found = simulate_commands(rig, np.full((3000, 2), 2.0), np.zeros(2), {})
    assert not found["valid"].all()
    assert np.abs(found["piston"][-1]).max() > 0.0375
    assert np.isfinite(found["piston"]).all()


def test_the_spool_lags_and_stops_at_its_stroke(rig: Rig) -> None:
    valve = rig.joints[0].valve
    step = spool_response(valve, np.full(200, 1.0), 1000.0)
    # Second order, 100 Hz, damping 0.8: overshoot exp(-pi d / sqrt(1 - d^2)) = 1.5 %.
    assert step.max() == pytest.approx(0.1 * 1.015, rel=5e-3)
    assert step[-1] == pytest.approx(0.1, rel=1e-6)
    assert spool_response(valve, np.full(200, 1e3), 1000.0).max() <= valve.spool_stroke


def test_commands_that_do_not_fit_the_rig_are_refused(rig: Rig) -> None:
    with pytest.raises(InputError, match="do not fit a rig of 2 joints"):
        simulate_commands(rig, np.zeros((10, 3)), np.zeros(2), {})


def test_a_rig_without_nominal_values_has_no_twin(rig: Rig) -> None:
    with pytest.raises(InputError, match="no nominal 'M1'"):
        simulate_commands(
            rig.model_copy(update={"nominal": {}}), np.zeros((10, 2)), np.zeros(2), {}
        )
