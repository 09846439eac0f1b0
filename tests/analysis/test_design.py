"""A design as a person gets it: better than before, within the limits, the same every time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from analysis.design.limits import bounds, forecast_of
from analysis.design.moves import tone_of
from analysis.design.optimise import Design, improve
from analysis.design.predict import predict
from analysis.design.settings import DESIGN
from analysis.design.twin_records import Array, play
from analysis.simulation.twin import simulate_commands
from protocols.files.library import load
from protocols.files.plan import resolve
from rig.cli.proof.predicted_errors import planned_steps
from rig.model.parse import InputError
from rig.model.rig import Rig
from tests.analysis.designed_steps import LINES, steps

EMPTY = {("step1", 1): (19, 23)}


def designed(rig: Rig, budget: int = 14, criterion: str = "b") -> Design:
    return improve(rig, steps(periods=2), EMPTY, criterion, budget, np.random.default_rng(3))


@pytest.fixture(scope="module")
def design(rig: Rig) -> Design:
    return designed(rig)


def test_b_gets_better_and_no_other_parameter_pays_too_much(rig: Rig, design: Design) -> None:
    assert design.accepted > 0
    assert design.after["b"] < 0.9 * design.before["b"]
    for name, error in design.after.items():
        assert error <= 1.01 * max(DESIGN.kept_error * design.before[name], design.before["b"])
    # The prediction of the finished steps says the same as the search did.
    again = predict(rig, design.steps)
    assert again.parameters["b"].std == pytest.approx(design.after["b"], rel=0.02)


def test_every_limit_is_kept_on_the_twin(rig: Rig, design: Design) -> None:
    for step in design.steps:
        motion = play(rig, step).motion
        for bound in bounds(rig, step, motion):
            assert bound.share <= 1.02 * DESIGN.fill * DESIGN.over_fill, (step.name, bound.name)
    for step in design.steps:
        for joint, wave in step.waves.items():
            assert np.abs(wave).max() < rig.joints[joint].limits.command


def test_detection_lines_stay_empty(design: Design) -> None:
    wave = design.steps[0].waves[1]
    spectrum = np.abs(np.fft.rfft(wave)) / len(wave)
    used = set(np.flatnonzero(spectrum > 1e-9))
    assert used == set(design.tones[0][1].chosen) == set(design.steps[0].lines)
    assert not used & {19, 23}


@pytest.mark.slow
def test_the_same_seed_gives_the_same_design(rig: Rig) -> None:
    one, other = designed(rig, budget=5), designed(rig, budget=5)
    for a, b in zip(one.steps, other.steps, strict=True):
        assert all(np.array_equal(a.waves[j], b.waves[j]) for j in a.waves)
    assert one.after == other.after


def test_other_phases_lower_the_worst_peak_and_leave_the_amplitudes(rig: Rig) -> None:
    played = play(rig, steps(periods=2)[1])
    tone = tone_of(0, played.step.waves[0], ())
    known = forecast_of(rig, played, 0, tone.lines)
    before = known.shares(known.motion(tone.spectrum)).max()
    flat, share = known.flattened(tone.spectrum, 60)
    assert np.abs(flat) == pytest.approx(np.abs(tone.spectrum))
    assert share == pytest.approx(known.shares(known.motion(flat)).max())
    assert share < before
    # The forecast is linear, the twin is not: near its own motion they agree.
    truth = max(b.share for b in bounds(rig, played.step, played.motion))
    assert before == pytest.approx(truth, rel=0.25)


def test_more_than_the_lines_are_offered_but_no_empty_one(rig: Rig) -> None:
    wave = steps()[0].waves[1]
    tone = tone_of(1, wave, (19,))
    assert set(LINES) <= set(tone.lines)
    assert 19 not in tone.lines
    assert 21 in tone.lines
    assert tone.chosen == LINES


def test_what_cannot_be_designed_is_said(rig: Rig) -> None:
    with pytest.raises(InputError, match="expected D, E or a parameter: M1"):
        designed(rig, criterion="C_pp")
    with pytest.raises(InputError, match=r"do not determine .*W1"):
        improve(rig, steps()[:1], {}, "E", 5, np.random.default_rng(0))
    sine = steps()
    t = np.arange(2000) / 2000
    one = [s.__class__(**{**vars(s), "waves": {j: 0.3 * np.sin(2 * np.pi * 2 * t) for j in s.waves},
                          "lines": (2,)}) for s in sine]  # fmt: skip
    with pytest.raises(InputError, match="no step has a multisine"):
        improve(rig, one, {}, "b", 5, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("factor", "said"), [(40.0, "the twin's simulation fails"), (-1.0, "the twin of joint 2 does")]
)
def test_a_step_that_the_twin_cannot_follow_is_named_with_its_file_and_line(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, factor: float, said: str
) -> None:
    step = planned_steps(resolve(load("lock-and-excite"), rig))[0]

    def moved(rig: Rig, commands: Array, *rest: Any) -> dict[str, Array]:
        return simulate_commands(rig, factor * commands, *rest)

    monkeypatch.setattr("analysis.design.twin_records.simulate_commands", moved)
    with pytest.raises(InputError, match=rf"^lock-and-excite\.yaml:8: step 'step1': {said}"):
        play(rig, step)
