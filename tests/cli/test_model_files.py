"""A model with an effect goes wherever a model goes: simulate, export, identify, validate."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet
from typer.testing import CliRunner

from analysis.identify.identify import identify
from analysis.simulation.fmu.archive import LINUX
from analysis.simulation.model import load_model, save_model
from analysis.terms import with_effects
from analysis.terms.base import Used
from rig.cli.errors import WorkError
from rig.cli.main import app
from rig.model.parse import InputError
from rig.runs.archive import write_run
from rig.runs.store import load_run
from tests.analysis import small_bench as bench

FRICTION = 150.0  # [N]
PRESLIDING = 2e-5  # [m]


def bramah(*words: object) -> str:
    """Run a command in this process; what it refuses is raised."""
    done = CliRunner().invoke(app, [str(w) for w in words])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without friction, and a model of its machine to which dry friction was given."""
    folder = tmp_path_factory.mktemp("models")
    run = bench.experiment(bench.shinshu(), bench.default_excitations(1), repeats=2, seed=1)
    write_run(folder / "run", run)
    terms = [Used(t) for t in with_effects(run.rig, ["coulomb_friction@joint 2"])]
    terms[-1] = replace(terms[-1], shape=(PRESLIDING,))
    model = identify([run], terms=terms).model
    given = replace(model.parameters["Fc2"], value=FRICTION)
    save_model(
        replace(model, parameters={**model.parameters, "Fc2": given}), folder / "rubbing.json"
    )
    return folder


@pytest.fixture(scope="module")
def rubbed(folder: Path) -> Path:
    """The run as the rubbing model would have given it."""
    out = folder / "rubbed"
    assert bramah("simulate", folder / "rubbing.json", folder / "run", "--out", out) == f"{out}\n"
    return out


def test_a_simulated_run_gives_its_models_parameters_back(folder: Path, rubbed: Path) -> None:
    told = json.loads(
        bramah("identify", rubbed, "--like", folder / "rubbing.json", "--json", "-")
    )["parameters"]  # fmt: skip
    wanted = load_model(folder / "rubbing.json").values
    assert set(told) == set(wanted)
    assert told["Fc2"]["value"] == pytest.approx(FRICTION, rel=0.02)
    for name in ("M2", "W2", "b", "C_pp_2"):
        assert told[name]["value"] == pytest.approx(wanted[name], rel=0.02), name
    # Its samples have the skew that its rig states: without it Fv2 is 1.5 % off.
    assert told["Fv2"]["value"] == pytest.approx(wanted["Fv2"], rel=0.004)


def test_the_model_taken_over_keeps_its_shapes_in_model_and_output(
    folder: Path, rubbed: Path
) -> None:
    again = folder / "again.json"
    line = ("identify", rubbed, "--like", folder / "rubbing.json", "--physical", "--json", "-")
    found = json.loads(bramah(*line, "--model", again))
    assert found["shapes"]["presliding_2"]["value"] == PRESLIDING
    assert "physical" in found
    term = load_model(again).terms[-1]
    assert (term.term.name, term.term.where, term.shape) == (
        "coulomb_friction", "joint 2", (PRESLIDING,),
    )  # fmt: skip


@pytest.mark.slow
def test_record_by_record_the_same_terms_give_the_same_numbers(folder: Path, rubbed: Path) -> None:
    line = ("identify", rubbed, "--like", folder / "rubbing.json", "--json", "-")
    whole, streamed = (
        json.loads(bramah(*line, *more)) for more in (("--estimator", "plain"), ("--stream",))
    )
    for name, found in whole["parameters"].items():
        assert streamed["parameters"][name]["value"] == pytest.approx(found["value"], rel=1e-9)
    assert whole["shapes"] == streamed["shapes"]
    assert whole["shapes"]["presliding_2"] == {"value": PRESLIDING, "unit": "m"}
    with pytest.raises(InputError, match=r"valve_deadband has a shape .* --like"):
        bramah("identify", rubbed, "--with", "valve_deadband@joint 2", "--stream")


@pytest.mark.slow
def test_a_shape_that_the_records_give_is_stated_with_its_interval(
    rubbed: Path, tmp_path: Path
) -> None:
    """A dead band of edges that nothing on this bench has, in JSON and in text."""
    line = ("identify", rubbed, "--with", "coulomb_friction@joint 2")
    line = (*line, "--with", "valve_deadband@joint 2")
    model = tmp_path / "model.json"
    found = json.loads(bramah(*line, "--json", "-", "--model", model))
    for name, estimate in load_model(model).parameters.items():
        if estimate.identified:
            assert found["parameters"][name]["ci95"] == pytest.approx(estimate.ci95), name
    shape = found["shapes"]["w_ahead_2"]
    low, high = shape["ci95"]
    assert low < shape["value"] < high
    assert (shape["unit"], shape["std"] > 0.0) == ("V", True)
    assert f"shape: w_ahead_2 = {shape['value']:.4g} ± " in bramah(*line)


def test_what_the_model_was_driven_with_and_held_by_stays_measured(
    folder: Path, rubbed: Path
) -> None:
    for before, after in zip(
        load_run(folder / "run").records, load_run(rubbed).records, strict=True
    ):
        joint = 3 - before.locked[0] if before.locked else None
        changed = {
            name
            for name, y in before.channels.items()
            if not np.array_equal(y, after.channels[name])
        }
        parts = ("piston", "cap_pressure", "rod_pressure")
        assert changed == {f"{part}_{i}" for part in parts for i in ((joint,) if joint else (1, 2))}
        assert (before.name, before.period, before.lines) == (after.name, after.period, after.lines)


def test_another_program_gets_measured_and_modelled_side_by_side(folder: Path) -> None:
    out = folder / "for-others"
    line = ("export", folder / "run", "--format", "parquet", "--out", out)
    assert bramah(*line, "--model", folder / "rubbing.json") == f"{out}\n"
    (record,) = [r for r in load_run(folder / "run").records if r.name == "step1_r1"]
    table = parquet.read_table(out / "step1_r1.parquet")
    measured, modelled = (table[n].to_numpy() for n in ("piston_2", "model_piston_2"))
    np.testing.assert_array_equal(measured, record.channels["piston_2"])
    # Friction that the bench does not have: near, and not the same.
    assert 1e-4 < np.sqrt(np.mean((measured - modelled) ** 2)) < 2e-2
    assert "model_piston_1" not in table.column_names


def test_without_a_word_the_files_lie_beside_the_run(folder: Path) -> None:
    assert bramah("export", folder / "run").strip() == str(folder / "run-csv")
    assert (folder / "run-csv" / "manifest.yaml").is_file()


def test_a_model_leaves_as_a_mock_up_unit_with_its_effects(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("analysis.simulation.fmu.archive.TARGETS", (LINUX,))
    line = ("export", folder / "run", "--format", "fmu", "--model", folder / "rubbing.json")
    made = Path(bramah(*line, "--out", folder / "units").strip())
    units = sorted(made.iterdir())
    assert [u.name for u in units] == ["shinshu-2dof-fmi2.fmu", "shinshu-2dof-fmi3.fmu"]
    for unit in units:
        with zipfile.ZipFile(unit) as archive:
            described = archive.read("modelDescription.xml").decode()
        assert 'name="parameters.Fc2"' in described
    with pytest.raises(InputError, match="not empty"):
        bramah(*line, "--out", folder / "units")


def test_what_cannot_be_is_said_before_anything_is_written(
    folder: Path, rubbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, run, none = folder / "rubbing.json", folder / "run", folder / "none"
    with pytest.raises(InputError, match="--like uses the terms of a model"):
        bramah("identify", run, "--like", model, "--with", "payload")
    other = load_model(model)
    save_model(
        replace(other, rig=other.rig.model_copy(update={"name": "theirs"})), folder / "o.json"
    )
    for line in (("simulate", folder / "o.json", run, "--out", none),
                 ("export", run, "--model", folder / "o.json", "--out", none),
                 ("identify", run, "--like", folder / "o.json"),
                 ("identify", run, "--like", folder / "o.json", "--stream"),
                 ("trace", run, "--holdout", rubbed, "--like", folder / "o.json")):  # fmt: skip
        done = CliRunner().invoke(app, [str(w) for w in line])
        assert isinstance(done.exception, InputError)
        assert "another rig" in str(done.exception)
        assert done.output == ""  # refused before any work is announced
    lost = {
        n: replace(p, value=1e6 if n.startswith("C_") else p.value)
        for n, p in other.parameters.items()
    }
    save_model(replace(other, parameters=lost), folder / "wild.json")
    with pytest.raises(WorkError, match=r"step1_r1.*cannot be simulated"):
        bramah("simulate", folder / "wild.json", run, "--out", none)
    monkeypatch.setattr("rig.runs.exchange.export.library_missing", lambda kind: "pyarrow")
    with pytest.raises(WorkError, match=r"pyarrow.*bramah\[export\]"):
        bramah("export", run, "--format", "parquet", "--out", none)
    assert not none.exists()
