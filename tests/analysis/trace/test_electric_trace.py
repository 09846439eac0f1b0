"""A carriage whose model lacks two effects at once: both are named, with nothing said of them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from analysis.effects.base import Effect
from analysis.effects.friction_levels import AsymmetricFriction
from analysis.terms import make
from analysis.trace.data.candidates import catalogue
from analysis.trace.engine import trace
from analysis.trace.result import CLEAN, EXPLAINED, Trace, to_json
from rig.cli.main import app
from rig.cli.text.trace_text import trace_text
from rig.model.records import Record, Run
from rig.model.rig import ElectricRig
from rig.runs.archive import write_run
from rig.runs.rigs import load_rig
from rig.tui.pages.trace import errors_of
from rig.tui.recorded_run import read_trace
from tests.analysis.carriage import Carriage, moves, record
from tests.studies.machines import electric_plant as plant
from tests.studies.machines import emps as study

Array = NDArray[np.float64]

PLACE = Path(os.environ.get("BRAMAH_DATA", Path(__file__).parents[4] / "shared" / "data"))
FILE = PLACE / "emps" / "DATA_EMPS.mat"


def experiment(carriage: Carriage, seed: int, amplitude: float, wave: float) -> Run:
    rig, rng = load_rig("emps"), np.random.default_rng(seed)
    reference = moves(rig.sample_rate, 12.0, amplitude, wave)
    records = [record(rig, carriage, reference, rng, "moves", repeat) for repeat in (1, 2, 3, 4)]
    return Run(rig, tuple(records))


@pytest.fixture(scope="module")
def two_hidden() -> tuple[Run, Run]:
    machine = Carriage(dry=18.0, offset=-4.0)
    return experiment(machine, 1, 0.05, 0.25), experiment(machine, 2, 0.07, 0.2)


@pytest.fixture(scope="module")
def found(two_hidden: tuple[Run, Run]) -> Trace:
    return trace([two_hidden[0]], [two_hidden[1]])


def named(result: Trace) -> set[tuple[str, str]]:
    return {(e.name, e.where) for e in result.effects}


BOTH = {("coulomb_friction", "joint 1"), ("torque_offset", "joint 1")}


def test_both_hidden_effects_are_named_at_their_size(found: Trace) -> None:
    assert found.verdict == EXPLAINED
    assert named(found) == BOTH
    values = {n: e.value for f in found.effects for n, e in f.parameters.items()}
    assert values["Fc1"] == pytest.approx(18.0, rel=0.03)
    assert values["offset1"] == pytest.approx(-4.0, rel=0.03)


def test_the_stored_trace_holds_a_free_run_to_be_drawn_and_a_screen_reads_it(
    found: Trace, tmp_path: Path
) -> None:
    (tmp_path / "trace.json").write_text(json.dumps(to_json(found), allow_nan=False))
    read = read_trace(tmp_path)
    assert read.trouble == ""
    assert read.stored is not None
    assert read.stored.verdict == EXPLAINED
    assert read.stored.effects[0].where == found.effects[0].where
    run = read.stored.free_run
    assert run is not None
    assert 0 < len(run.time) <= 500
    before, after = errors_of(run.channels["position_1"])
    assert abs(before[0]) < 1e-3, "both begin where the carriage was [m]"
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))


def test_force_and_free_run_are_far_better_on_records_not_seen(found: Trace) -> None:
    assert found.before["torque_1"] / found.size["torque_1"] > 0.05
    assert found.after["torque_1"] < 0.2 * found.before["torque_1"]
    assert found.rmse_after["position_1"] < 0.05 * found.rmse_before["position_1"]
    (row,) = [line for line in trace_text(found).splitlines() if line.startswith("position_1 ")]
    assert row.endswith(" mm")
    assert float(row.split()[5]) == pytest.approx(1e3 * found.rmse_before["position_1"], rel=0.01)
    told = to_json(found)
    assert told["rmse"]["after"]["position_1"] == found.rmse_after["position_1"]
    windows = told["window_rmse"]
    assert windows["after"]["position_1"] < 0.5 * windows["before"]["position_1"]
    assert windows["after"]["position_1"] < told["rmse"]["after"]["position_1"]
    assert "spool" not in json.dumps(told)
    assert "N·m" not in told["sentence"]


def test_a_machine_without_them_is_clean() -> None:
    plain = Carriage(dry=0.0, offset=0.0)
    result = trace([experiment(plain, 3, 0.05, 0.25)], [experiment(plain, 4, 0.07, 0.2)])
    assert result.verdict == CLEAN


def test_a_machine_noisier_than_its_data_sheet_is_clean_without_repeats() -> None:
    """Its records show the white noise of the position, above all motion."""
    rig, runs = load_rig("emps"), []
    for seed, wave in ((3, 0.3), (4, 0.23)):
        rng = np.random.default_rng(seed)
        reference = moves(rig.sample_rate, 12.0, 0.05, wave)
        one = record(rig, Carriage(dry=0.0, offset=0.0), reference, rng, "moves")
        position = one.channels["position_1"]
        further = np.sqrt(6.0**2 - 1.0) * rig.sensors.position.noise
        noisy = position + further * rng.standard_normal(one.samples)
        channels = {**one.channels, "position_1": noisy}
        runs.append(Run(rig, (replace(one, channels=channels),)))
    result = trace([runs[0]], [runs[1]], look_ahead=False)
    assert (result.verdict, result.effects) == (CLEAN, ())


def test_an_electric_joint_has_no_lever_to_tell_asymmetry_from_an_offset() -> None:
    assert AsymmetricFriction.places(load_rig("emps")) == ()
    names = {e.name for e in catalogue(load_rig("emps"))}
    assert {"coulomb_friction", "stribeck_friction", "torque_offset"} <= names
    assert not names & {"payload", "base_inclination", "valve_deadband"}
    arm = {e.name for e in catalogue(load_rig("electric-2dof"))}
    assert "payload" in arm
    assert "base_inclination" not in arm  # that rig's inclination is a parameter already


def test_a_drive_that_is_recorded_late_is_named_with_its_delay() -> None:
    def late(run: Run) -> Run:
        def delayed(one: Record) -> Record:
            drive = np.roll(one.channels["drive_1"], 3)
            return replace(one, channels={**one.channels, "drive_1": drive})

        return replace(run, records=tuple(map(delayed, run.records)))

    plain = Carriage(dry=0.0, offset=0.0)
    train, unseen = (late(experiment(plain, *how)) for how in ((3, 0.05, 0.25), (4, 0.07, 0.2)))
    result = trace([train], [unseen], look_ahead=False)
    first = result.effects[0]
    assert (first.name, first.at, first.where) == ("channel_delay", "joint 1 drive", "joint 1")
    delay = first.parameters["delay_drive_1"]
    assert delay.value == pytest.approx(3e-3, rel=0.02)
    # A command that is recorded and held is half a sample later than its interpolation.
    assert delay.ci95 == pytest.approx((delay.value - 5e-4, delay.value + 5e-4), rel=1e-6)
    assert result.tied in ([], [("sensor_lag", "joint 1")])


@pytest.mark.parametrize(
    ("channel", "misread", "effect", "parameter", "size"),
    [
        ("drive_2", lambda x: 1.2 * x, ("sensor_gain", "joint 2 drive"), "gain_drive_2", 1.2),
        (
            "position_2", lambda x: x + 0.03, ("sensor_offset", "joint 2 position"),
            "offset_position_2", 0.03,
        ),
    ],
)  # fmt: skip
def test_a_wrong_motor_constant_and_a_turned_encoder_of_an_arm_are_named(
    channel: str, misread: Callable[[Array], Array], effect: tuple[str, str], parameter: str,
    size: float,
) -> None:  # fmt: skip
    rig = load_rig("electric-2dof").model_copy(update={"inclination": 0.0})
    assert isinstance(rig, ElectricRig)
    arm = replace(plant.draw_arm(np.random.default_rng(5), slope=0.0), dry=(1e-6, 1e-6))

    def measured(seed: int) -> Run:
        run = plant.records(rig, arm, np.random.default_rng(seed), repeats=2)
        records = (
            replace(r, channels={**r.channels, channel: misread(r.channels[channel])})
            for r in run.records
        )
        return replace(run, records=tuple(records))

    result = trace([measured(6)], [measured(7)], look_ahead=False)
    (first, *others) = result.effects
    assert (first.name, first.at, others) == (*effect, [])
    assert first.parameters[parameter].value == pytest.approx(size, rel=0.02)
    for name in ("M1", "M2", "R12", "W1", "W2"):
        assert result.model_after.values[name] == pytest.approx(arm.truth()[name], rel=0.02)


def test_a_single_electric_joint_has_no_gain_that_its_parameters_do_not_absorb() -> None:
    assert not {"sensor_gain", "sensor_offset"} & {e.name for e in catalogue(load_rig("emps"))}


def test_a_revolute_joint_rubs_along_an_angle() -> None:
    """Belts and gears give by milliradians before they slip, a seal by a few hundredths of a mm."""
    arm, carriage = load_rig("electric-2dof"), load_rig("emps")
    for name in ("coulomb_friction", "friction_curve"):
        units = [
            {s.unit for s in make_effect(name).shapes(rig) if not s.parameter.startswith("tail")}
            for rig in (arm, carriage)
        ]
        assert units[0] <= {"rad", "rad/s", "s/m", "1/rad"}
        assert units[1] <= {"m", "m/s", "s/m", "1/m"}
    assert make_effect("coulomb_friction").outside(arm, (3e-3,)) == ""
    assert "m lies at the edge" in make_effect("coulomb_friction").outside(carriage, (3e-3,))
    assert make_effect("coulomb_friction").variable_on(arm) == "the sign of the joint's velocity"


def make_effect(name: str) -> Effect:
    effect = make(name, "joint 1")
    assert isinstance(effect, Effect)
    return effect


def test_an_electric_rig_has_no_flows_to_trace_alone(
    two_hidden: tuple[Run, Run], tmp_path: Path
) -> None:
    train, unseen = (
        str(write_run(tmp_path / name, run)) for name, run in zip("ab", two_hidden, strict=True)
    )
    words = ["trace", train, "--holdout", unseen, "--equations", "flow"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code != 0
    assert "is electric and has no flow equations" in str(done.exception)


@pytest.mark.slow
def test_the_same_command_writes_result_model_and_report(
    two_hidden: tuple[Run, Run], tmp_path: Path
) -> None:
    train, holdout_data = (
        str(write_run(tmp_path / name, run)) for name, run in zip("ab", two_hidden, strict=True)
    )
    paths = {key: str(tmp_path / f"trace.{key}") for key in ("json", "model", "html")}
    words = ["trace", train, "--holdout", holdout_data, "--json", paths["json"], "--model"]
    done = CliRunner().invoke(app, [*words, paths["model"], "--report", paths["html"]])
    assert done.exit_code == 0, done.output
    assert json.loads(Path(paths["json"]).read_text())["verdict"] == EXPLAINED
    validated = CliRunner().invoke(app, ["validate", paths["model"], holdout_data, "--json", "-"])
    assert json.loads(validated.stdout)["records"][0]["rmse"]["position_1"] < 1e-3
    page = Path(paths["html"]).read_text()
    assert "coulomb friction" in page
    assert "<svg" in page


@pytest.mark.slow
@pytest.mark.skipif(not FILE.exists(), reason=f"no measured record at {FILE}")
@pytest.mark.parametrize(("train", "holdout_data"), [("first", "second"), ("second", "first")])
def test_on_the_measured_carriage_both_are_found(train: str, holdout_data: str) -> None:
    data = study.load(FILE, period=study.PERIOD)
    result = trace([getattr(data, train)], [getattr(data, holdout_data)])
    # Between an offset and a drag that differs by direction the force over the speed decides.
    assert named(result) == {
        ("coulomb_friction", "joint 1"),
        ("asymmetric_viscous_friction", "joint 1"),
    }
    assert result.before["torque_1"] > 0.13 * result.size["torque_1"]
    assert result.after["torque_1"] <= 0.05 * result.size["torque_1"]
    assert result.rmse_before["position_1"] > 35e-3
    assert result.rmse_after["position_1"] <= 8.5e-3


def test_an_electric_rigs_identification_has_its_report(
    two_hidden: tuple[Run, Run], tmp_path: Path
) -> None:
    run, page = str(write_run(tmp_path / "a", two_hidden[0])), tmp_path / "found.html"
    words = ["identify", run, "--with", "coulomb_friction", "--with", "torque_offset"]
    done = CliRunner().invoke(app, [*words, "--report", str(page)])
    assert done.exit_code == 0, done.output
    text = page.read_text()
    assert "1 electric joint" in text
    assert "35.1506 N/V" in text
    assert "Drive and position of joint 1 in time" in text
    assert "hydraulic joint" not in text
