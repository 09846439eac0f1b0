"""The whole chain on rigs of one and of three joints: plan, run, identify, validate."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.identify.result import Identification
from analysis.simulation.validate import validate
from hil_sim.plant.interface import Law
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from protocols.design.generate import generate, validation
from protocols.files import library
from protocols.files.plan import resolve
from protocols.files.schema import Protocol
from protocols.files.writer import protocol_text
from protocols.steps.plans import StepPlan
from rig.cli.proof.step_planning import plan_steps, predictor
from rig.model.channels import kind_of
from rig.model.parameters import parameter_names
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.model.wire.codes import decode_input
from rig.runs.rigs import load_rig, rig_text
from rig.runs.store import load_run
from tests.cli.bench import bramah, simulated

SETTLE = 6.0  # [s] pistons come to their places, waveforms have started


def near(result: Identification, truth: dict[str, float], percent: float) -> None:
    worst = {
        name: 100 * abs(result.estimates[name].value / true - 1) for name, true in truth.items()
    }
    assert max(worst.values()) < percent, worst


def laws(step: StepPlan, rig: Rig) -> list[Law]:
    """What the device is told: pushes, closed valves, and a waveform under a slow loop."""
    out = [Law()] * len(rig.joints)
    for held in step.locks:
        if held.at != "closed":
            push = np.sign(held.piston) * 0.4
            out[held.joint] = Law(bias=push, position_gain=12.0, setpoint=held.piston, limit=0.6)
    for part in step.excite:
        limit = rig.joints[part.joint].limits.command
        out[part.joint] = Law(
            wave=part.wave.samples, gain=1.0, position_gain=12.0, setpoint=0.0, limit=limit
        )
    return out


def recorded(rig: Rig, steps: Sequence[StepPlan], seed: int, repeats: int, seconds: float) -> Run:
    """Records of steps straight from the plant, without a wire; every step from rest."""
    records = []
    for number, step in enumerate(steps):
        plant = Plant(rig, Scenario(), 10 * seed + number)
        told = laws(step, rig)
        # The waveform starts when the locked joints have reached their ends.
        still = [Law() if len(law.wave) else law for law in told]
        plant.advance(round(2.0 * rig.sample_rate), still)
        plant.advance(round(SETTLE * rig.sample_rate), told)
        for repeat in range(1, repeats + 1):
            codes, _ = plant.advance(round(seconds * rig.sample_rate), told)
            values = []
            for name, code in zip(rig.channels, codes.T, strict=True):
                sensor = rig.sensors.of(kind_of(name)[0])
                values.append(decode_input(code, *sensor.range, sensor.bits))
            channels = dict(zip(rig.channels, values, strict=True))
            locked = tuple(held.joint + 1 for held in step.locks)
            records.append(
                Record(
                    f"{step.name}_r{repeat}", step.name, locked, repeat, rig.sample_rate, channels,
                    period=step.period, lines=step.lines,
                )
            )  # fmt: skip
    return Run(rig, tuple(records), source=f"plant {seed}")


@pytest.fixture(scope="module")
def digger() -> Rig:
    return load_rig("digger-3dof")


@pytest.fixture(scope="module")
def planned(digger: Rig) -> Protocol:
    return generate(digger, predictor(), "three").protocol


@pytest.fixture(scope="module")
def three(digger: Rig, planned: Protocol) -> Run:
    return recorded(digger, resolve(planned, digger).steps, 3, 2, 10.0)


def test_three_joints_are_identified_with_the_planned_steps(three: Run, digger: Rig) -> None:
    result = identify([three])
    assert set(result.estimates) == set(parameter_names(3))
    assert {"R11", "R12", "R13", "R22", "R23", "R33"} < set(result.estimates)
    near(result, dict(digger.nominal), 1.0)
    said = {check.name: check for check in result.checks}
    assert said["identifiable mechanical"].ok
    assert said["inertia"].ok
    lengths = [check for check in result.checks if check.name == "link length"]
    assert len(lengths) == 3
    assert all(check.ok for check in lengths)


def test_a_model_of_three_joints_follows_all_of_them_at_once(three: Run, digger: Rig) -> None:
    plan = resolve(validation(digger, predictor().twin, "judge"), digger)
    together = tuple(step for step in plan.steps if step.name.startswith("all"))
    judged = recorded(digger, together, 4, 1, 4.0)
    results = validate(identify([three]).model, [judged])
    assert len(results) == 2
    for result in results:
        assert not result.failure
        assert set(result.fit) >= {"piston_1", "piston_2", "piston_3", "rod_pressure_3"}
        assert min(result.fit.values()) > 90.0, result.fit


def test_without_a_step_the_three_joints_inertia_stays_open_and_says_so(three: Run) -> None:
    kept = tuple(r for r in three.records if r.step in ("step1", "step4"))
    result = identify([Run(three.rig, kept)])
    assert not result.estimates["R12"].identified
    assert result.estimates["R33"].identified
    said = next(c for c in result.checks if c.name == "base parameters mechanical")
    assert "excite joint 2" in said.detail
    assert "R11" in said.detail


@pytest.fixture(scope="module")
def wire(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    with simulated("--rig", "boom-1dof", "--seed", 7) as (endpoint, _):
        yield tmp_path_factory.mktemp("boom"), endpoint


@pytest.mark.slow
def test_one_joint_goes_from_plan_to_validation_over_the_wire(wire: tuple[Path, str]) -> None:
    folder, endpoint = wire
    rig = ("--rig", "boom-1dof")
    steps, judge, model = folder / "steps.yaml", folder / "judge.yaml", folder / "model.json"
    made = bramah("plan", *rig, "--out", steps, "--validation", judge, "--json", folder / "p.json")
    assert made.returncode == 0, made.stderr
    assert "mechanical: all 3 parameters are determined" in made.stdout
    assert json.loads((folder / "p.json").read_text())["complete"]
    for name, words in (("run", [steps, "--repeats", 2]), ("new", [judge, "--step", "joint1_3hz"])):
        done = bramah("run", *words, *rig, "--out", folder / name, "--endpoint", endpoint)
        assert done.returncode == 0, done.stderr
    found = bramah("identify", folder / "run", "--model", model, "--report", folder / "r.html")
    assert found.returncode == 0, found.stderr
    assert {"M1", "Fv1", "W1", "b"} < set(found.stdout.split())
    near(identify([load_run(folder / "run")]), dict(load_rig("boom-1dof").nominal), 1.0)
    judged = bramah("validate", model, folder / "new", "--json", "-")
    assert judged.returncode == 0, judged.stderr
    for record in json.loads(judged.stdout)["records"]:
        assert record["fit"]["piston_1"] > 98.0


@pytest.mark.slow
def test_three_joints_speak_over_the_wire(tmp_path: Path, planned: Protocol, digger: Rig) -> None:
    """Fourteen channels and three outputs; one short step tells whether all arrive in place."""
    step = planned.steps[0]
    signal = step.excite[0].signal.model_copy(update={"base_frequency": 0.5, "amplitude": 0.3})
    excite = (step.excite[0].model_copy(update={"signal": signal}),)
    short = step.model_copy(update={"excite": excite, "repeats": 2, "duration": 4.0})
    path = tmp_path / "short.yaml"
    path.write_text(protocol_text(planned.model_copy(update={"steps": (short,)})))
    assert library.load(path).joints == 3
    with simulated("--rig", "digger-3dof", "--seed", 8) as (endpoint, _):
        done = bramah(
            "run", path, "--rig", "digger-3dof", "--out", tmp_path / "run", "--endpoint", endpoint
        )
    assert done.returncode == 0, done.stderr
    run = load_run(tmp_path / "run")
    assert set(run.records[0].channels) == set(digger.recorded)
    assert run.records[0].locked == (1, 2)
    result = identify([run])
    near(result, {name: digger.nominal[name] for name in ("R33", "W3", "C_pp_3", "b")}, 2.0)
    assert not result.estimates["R11"].identified


def test_a_protocol_that_leaves_a_parameter_open_is_not_proved(tmp_path: Path) -> None:
    """A script reads it from the exit code, a person from the last line."""
    sheet = tmp_path / "short.yaml"
    sheet.write_text(
        "name: short\njoints: 2\nsteps:\n  - name: one\n    lock: [{joint: 1, at: closed}]\n"
        "    excite: [{joint: 2, signal: {kind: sine, frequency: 1 Hz, amplitude: 1 V}}]\n"
        "    duration: 3 s\n    repeats: 1\n"
    )
    found = bramah("plan", "--rig", "shinshu-2dof", "--prove", sheet)
    assert found.returncode == 1
    assert "does not determine" in found.stderr.splitlines()[-1]
    assert "R12" in found.stderr.splitlines()[-1]


def test_a_plan_names_the_nominal_value_that_a_rig_lacks(tmp_path: Path) -> None:
    text, _ = rig_text("boom-1dof")
    mine = tmp_path / "mine.yaml"
    mine.write_text("\n".join(line for line in text.splitlines() if "Fv1:" not in line))
    with pytest.raises(InputError, match=r"has no nominal 'Fv1' \[N\*m\*s/rad\]"):
        plan_steps(str(mine))
