"""A rig of any size gets its steps, and they are proven to determine everything."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analysis.simulation.twin import simulate_commands
from protocols.design.candidates import candidates
from protocols.design.check import check
from protocols.design.generate import GeneratedProtocol, generate, prove, validation
from protocols.files import library
from protocols.files.plan import resolve
from protocols.files.schema import Protocol
from protocols.files.writer import protocol_text
from rig.cli.proof.step_planning import predictor
from rig.model.parse import InputError, parse_model
from rig.model.rig import Rig
from rig.runs.rigs import load_rig


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("shinshu-2dof")


@pytest.fixture(scope="module")
def generated(rig: Rig) -> GeneratedProtocol:
    return generate(rig, predictor(), "mine")


def part(protocol: Protocol, *names: str) -> Protocol:
    kept = tuple(step for step in protocol.steps if step.name in names)
    return protocol.model_copy(update={"steps": kept})


def test_two_joints_get_the_papers_three_steps(generated: GeneratedProtocol) -> None:
    assert [reason.description for reason in generated.proof.reasons] == [
        "excite joint 2; joint 1 closed at 0 mm",
        "excite joint 1; joint 2 at end_min",
        "excite joint 1; joint 2 at end_max",
    ]
    assert generated.proof.complete
    assert [v.rank for v in generated.proof.verdicts.values()] == [7, 9]
    assert all(v.condition < 30.0 for v in generated.proof.verdicts.values())
    assert "determines M2 Fv2 W2" in generated.proof.reasons[0].why
    assert "determines M1 R12" in generated.proof.reasons[2].why


def test_what_was_generated_keeps_the_rigs_limits_and_survives_its_file(
    generated: GeneratedProtocol, rig: Rig, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(protocol_text(generated.protocol, "Two\nlines"), encoding="utf-8")
    read = library.load(path)
    assert read == generated.protocol
    report = check(resolve(read, rig), rig, simulate_commands)
    assert report.ok
    assert report.notes == ()


@pytest.mark.parametrize("name", library.shipped_names())
def test_every_shipped_protocol_survives_being_written(name: str) -> None:
    protocol = library.load(name)
    assert parse_model(Protocol, protocol_text(protocol), "again") == protocol


def test_one_joint_needs_one_step() -> None:
    made = generate(load_rig("boom-1dof"), predictor(), "one")
    assert len(made.protocol.steps) == 1
    assert [v.rank for v in made.proof.verdicts.values()] == [3, 5]
    assert made.proof.complete


def test_a_protocol_that_leaves_parameters_open_names_them_and_the_step_that_helps(
    generated: GeneratedProtocol, rig: Rig
) -> None:
    proof = prove(part(generated.protocol, "step1", "step2"), rig, predictor())
    verdict = proof.verdicts["mechanical"]
    assert not proof.complete
    assert verdict.rank == 6
    assert set(verdict.undetermined) == {"M1", "R12"}
    # M1 + 2 R12 cos(q2) is what joint 1 feels; q2 is -105 degrees at the stroke's end.
    (base,) = verdict.base
    assert base.text.startswith("M1 - 0.51")
    assert base.parts[1][1] == pytest.approx(2 * np.cos(np.radians(-105.0)), abs=0.02)
    assert proof.help == ("excite joint 1; joint 2 at end_max",)
    assert proof.as_dict()["families"]["mechanical"]["base_parameters"] == [base.text]


def test_there_are_candidates_for_more_joints_than_anyone_has(rig: Rig) -> None:
    nine = rig.model_copy(update={"joints": rig.joints[:1] * 9, "nominal": {}})
    found = candidates(nine)
    assert len(found) < 1000
    assert {step.excite[0].joint for step in found} == set(range(1, 10))
    for step in found:
        assert sorted(step.joints) == list(range(1, 10))


def test_new_data_for_validation_move_every_joint_alone_and_all_at_once(rig: Rig) -> None:
    made = validation(rig, simulate_commands, "judge")
    names = [step.name for step in made.steps]
    assert names == [
        "joint2_1hz", "joint1_1hz", "all_1hz", "joint2_3hz", "joint1_3hz", "all_3hz",
    ]  # fmt: skip
    assert parse_model(Protocol, protocol_text(made), "again") == made


def test_a_rig_sampled_too_slowly_for_the_steps_is_told_the_rate_they_need(rig: Rig) -> None:
    slow = rig.model_copy(update={"sample_rate": 50.0})
    with pytest.raises(InputError, match=r"sample_rate: .* up to 9.5 Hz.* more than 76 Hz"):
        generate(slow, predictor(), "none")
    slow = rig.model_copy(update={"sample_rate": 20.0})
    with pytest.raises(InputError, match=r"sample_rate: .* up to 3 Hz.* more than 24 Hz"):
        validation(slow, simulate_commands, "none")


def test_a_rig_that_bears_no_step_is_refused(rig: Rig) -> None:
    joints = tuple(
        joint.model_copy(update={"limits": joint.limits.model_copy(update={"command": 0.05})})
        for joint in rig.joints
    )
    with pytest.raises(InputError, match="no step keeps the rig's limits"):
        generate(rig.model_copy(update={"joints": joints}), predictor(), "none")
