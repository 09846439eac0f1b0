"""A protocol is proved on a twin before anything moves: an analytic one here, so that the
expected figures can be written down by hand."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
import pytest

from protocols.design.check import check
from protocols.design.check_report import CheckReport
from protocols.files.library import load
from protocols.files.plan import Overrides, resolve
from protocols.language.waveforms import Array
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs.rigs import load_rig

GAIN = 0.16  # m/s per volt
NULL = 0.04  # V


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("shinshu-2dof")


def twin(rig: Rig, commands: Array, start: Array, locked: Mapping[int, float]) -> dict[str, Array]:
    """Pistons that integrate; chamber pressures that follow the speed, 10 MPa per m/s."""
    speed = GAIN * (commands - NULL)
    for joint in locked:
        speed[:, joint] = 0.0
    piston = start + np.cumsum(speed, axis=0) / rig.sample_rate
    for joint, place in locked.items():
        assert np.all(piston[:, joint] == place)
    return {
        "piston": piston,
        "speed": speed,
        "cap_pressure": 3.5e6 + 1e7 * speed,
        "rod_pressure": 3.5e6 - 1e7 * speed,
    }


def of(report: CheckReport, step: str, quantity: str, joint: int | None):  # type: ignore[no-untyped-def]
    (entry,) = [s for s in report.steps if s.step == step]
    (line,) = [p for p in entry.predictions if (p.quantity, p.joint) == (quantity, joint)]
    return line


def test_the_predictions_are_those_written_by_hand(rig: Rig) -> None:
    report = check(resolve(load("lock-and-excite"), rig), rig, twin)
    assert report.ok
    half = GAIN * 1.0 / (2 * np.pi)  # A k / omega, 25.5 mm
    piston = of(report, "step1", "piston", 2)
    assert (piston.low, piston.high) == pytest.approx((-half - 3e-3, half + 3e-3), abs=3e-4)
    assert piston.margin == pytest.approx(36e-3 - half - 3e-3, abs=3e-4)
    speed = of(report, "step2", "piston speed", 1)
    assert speed.high == pytest.approx(GAIN, rel=0.01)
    flow = of(report, "step2", "pump flow", None)
    assert flow.high == pytest.approx(GAIN * 7e-4, rel=0.01)
    command = of(report, "step3", "command", 1)
    assert command.high == pytest.approx(1.0 + NULL, abs=2e-3)
    rate = of(report, "step3", "cap_pressure rate", 1)
    assert rate.high == pytest.approx(1e7 * GAIN * 2 * np.pi, rel=0.01)


def test_the_drift_of_the_twin_is_trimmed_away_not_predicted(rig: Rig) -> None:
    """At 0.04 V off its null a piston would be 64 mm away after a record of 10 s."""
    report = check(resolve(load("lock-and-excite-multisine"), rig), rig, twin)
    assert report.ok
    for entry in report.steps:
        for bias in entry.biases.values():
            assert bias == pytest.approx(NULL, abs=2e-3)


def test_a_limit_that_would_be_passed_refuses_the_protocol(rig: Rig) -> None:
    plan = resolve(load("lock-and-excite"), rig, Overrides(amplitude_scale=1.4))
    report = check(plan, rig, twin)
    assert not report.ok
    assert len(report.refused) == 3  # the piston of each step, nothing else
    with pytest.raises(InputError) as caught:
        report.require()
    message = str(caught.value)
    assert message.startswith(
        "lock-and-excite.yaml:8: protocol 'lock-and-excite' refused: step1, joint 2: piston -38."
    )
    assert "allowed -36 to 36 mm, about 0 s into the run (and 2 more)" in message


def test_a_supply_that_will_sag_is_a_note_and_no_refusal(rig: Rig) -> None:
    weak = rig.model_copy(update={"supply": rig.supply.model_copy(update={"flow": 1e-4})})
    report = check(resolve(load("validate"), weak, Overrides(steps=("both_1hz",))), weak, twin)
    assert report.ok
    assert any("pump flow" in note and "L/min" in note for note in report.notes)


def test_the_report_is_json(rig: Rig) -> None:
    report = check(resolve(load("validate"), rig, Overrides(steps=("both_3hz",))), rig, twin)
    read = json.loads(json.dumps(report.as_dict()))
    assert read["ok"] is True
    (step,) = read["steps"]
    assert {line["joint"] for line in step["predictions"]} == {1, 2, None}
    assert set(step["biases"]) == {"1", "2"}


def test_a_twin_whose_state_ceases_to_exist_refuses_in_words(rig: Rig) -> None:
    def breaks(
        rig: Rig, commands: Array, start: Array, locked: Mapping[int, float]
    ) -> dict[str, Array]:
        found = twin(rig, commands, start, locked)
        valid = np.ones(len(commands))
        valid[2500:] = 0.0
        return {**found, "valid": valid}

    with pytest.raises(InputError, match="step1: on the twin joint 2 cannot be centred"):
        check(resolve(load("lock-and-excite"), rig), rig, breaks)


def test_a_twin_that_does_not_follow_points_at_the_rig_file(rig: Rig) -> None:
    def dead(
        rig: Rig, commands: Array, start: Array, locked: Mapping[int, float]
    ) -> dict[str, Array]:
        return twin(rig, np.full_like(commands, NULL), start, locked)

    with pytest.raises(InputError, match="nominal parameters"):
        check(resolve(load("lock-and-excite"), rig), rig, dead)
