"""A trace's paragraph quotes what its named effects act on, each thing once."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from analysis.simulation.model import Estimate, nominal_model
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace import finding
from analysis.trace.finding import Remainder, tolerance_words
from analysis.trace.in_motion import rest_phase_notes
from analysis.trace.judge import gates
from analysis.trace.judge.gates import NO_RIVAL, passes_gates, tied_in_held_out
from analysis.trace.judge.held_out import completed
from analysis.trace.notes import not_judged_notes, rival_notes, undetermined_notes
from analysis.trace.result import EXPLAINED, UNEXPLAINED, Gate, JudgedEffect, Rival, Trace
from analysis.trace.search.exact_fit import ExactFit
from analysis.trace.words import quantity, sentence, tolerated_error_notes
from rig.cli.text.trace_text import RIVALS_SHOWN, trace_text
from rig.model.rig import Rig

FLOOR = {"flow_cap_1": 3.5e-8, "torque_2": 0.14}
BEFORE = {"flow_cap_1": 3.8e-8, "torque_2": 0.15}
AFTER = {"flow_cap_1": 3.8e-8, "torque_2": 0.13}


def effect(name: str, variable: str, numbers: dict[str, tuple[float, float, str]]) -> JudgedEffect:
    parameters = {
        n: Estimate(v, unit, half / 1.96, (v - half, v + half))
        for n, (v, half, unit) in numbers.items()
    }
    return JudgedEffect(name, "joint 2", parameters, 0.005, 1.0, (), (), variable)


def explained(
    rig: Rig,
    effects: tuple[JudgedEffect, ...],
    before: dict[str, float] = BEFORE,
    after: dict[str, float] = AFTER,
    notes: tuple[str, ...] = (),
) -> Trace:
    model = nominal_model(rig, tuple(map(Used, baseline_of(rig))))
    fit = ExactFit((), {}, np.zeros(0), np.zeros((0, 0)))
    return Trace(
        EXPLAINED, effects, FLOOR, before, after, {}, {}, model, model, 0.0, (), None, (), fit,
        fit, notes,
    )  # fmt: skip


def told(rig: Rig, *arguments: Any, **named: Any) -> str:
    return sentence(explained(rig, *arguments, **named))


SPRING = effect("joint_spring", "the joint's angle", {"k_spring_2": (2.2, 0.04, "N*m/rad")})


def test_the_quoted_error_is_of_an_equation_that_the_effect_lowers(rig: Rig) -> None:
    """Another equation stood farther above its noise, before and after alike."""
    text = told(rig, (SPRING,))
    assert "Held-out error of torque_2" in text
    assert "flow_cap_1" not in text


def test_a_variable_that_two_effects_share_is_said_once(rig: Rig) -> None:
    sign = "the sign of the piston's velocity"
    pair = tuple(effect("coulomb_friction", sign, {f"Fc{i}": (9.0, 1.0, "N")}) for i in (1, 2))
    text = told(rig, (*pair, SPRING))
    assert text.startswith(f"The residual follows {sign} and the joint's angle: ")
    assert told(rig, pair).startswith(f"The residual follows {sign}: ")


def test_a_number_less_certain_than_its_size_is_not_determined(rig: Rig) -> None:
    line = effect(
        "return_line", "the flow given back to the tank",
        {"dp_return": (0.7e7, 2.3e7, "Pa"), "return_laminar": (0.4, 0.1, "")},
    )  # fmt: skip
    note = "return_line: dp_return is the drop at the pump's whole flow; in these records 0.56 MPa"
    text = told(rig, (line,), notes=(note, "torque_1: another note"))
    assert "dp_return not determined: 0.7e7 ± 2.3e7 Pa, return_laminar = 0.40 ± 0.10" in text
    assert "dp_return is the drop at the pump's whole flow; in these records 0.56 MPa." in text
    assert "another note" not in text


def test_a_number_that_may_lie_anywhere_between_its_bounds_has_no_interval(rig: Rig) -> None:
    """The share of the pump's flow at which a line becomes turbulent is 0.001 to 3."""
    sag = {"dp_supply": (1e6, 1e5, "Pa"), "laminar_share": (1e-3, 72.0, "")}
    text = told(rig, (effect("supply_sag", "the flow drawn from the supply", sag),))
    assert "laminar_share not determined)" in text


def test_a_small_part_of_a_large_number_is_determined(rig: Rig) -> None:
    wave = {"T_sin_2": (1.5, 0.1, "N*m"), "T_cos_2": (0.01, 0.1, "N*m")}
    text = told(rig, (effect("periodic_disturbance", "time", wave),))
    assert "not determined" not in text


def test_an_error_above_the_noise_is_said_to_be_within_the_form(rig: Rig) -> None:
    after = AFTER | {"torque_2": 3.3 * FLOOR["torque_2"]}
    text = told(rig, (SPRING,), BEFORE | {"torque_2": 60 * FLOOR["torque_2"]}, after)
    assert "left in torque_2, 3.3 times the noise floor, is 0.27 % of the energy" in text
    assert "may miss 5 %" in text
    assert "may miss" not in told(rig, (SPRING,))


def test_an_error_that_includes_rests_or_other_rows_does_not_contradict_the_tolerance(
    rig: Rig,
) -> None:
    """A quarter of the energy is left, five times what a form may miss."""
    before, after = BEFORE | {"torque_2": 4 * FLOOR["torque_2"]}, AFTER
    after = after | {"torque_2": 2.2 * FLOOR["torque_2"]}
    rests = rest_phase_notes([1], included=True)
    for notes, reason in (
        ((), "in the records that choose, the error is within the band"),
        (rests, "it includes the samples at which the joint rests, which are not judged"),
    ):
        text = told(rig, (SPRING,), before, after, notes=tuple(notes))
        assert f"26 % of the energy that was above the noise: {reason}" in text
        assert "may miss" not in text
    (note,) = tolerated_error_notes(explained(rig, (SPRING,), before, after))
    assert note.endswith("26 % of the baseline's energy above noise, within the band in the "
                         "records that choose")  # fmt: skip


def test_what_only_held_out_records_keep_is_not_said_to_be_nothing(rig: Rig) -> None:
    result = replace(explained(rig, (SPRING,)), verdict=UNEXPLAINED, unexplained_fraction=0.004)
    assert (
        "0.4 % of the repeatable residual energy remains in the training records, more in the "
        "held-out ones"
    ) in sentence(result)
    most = replace(result, unexplained_fraction=1.0)
    assert "100 % of the repeatable residual energy remains unexplained" in sentence(most)
    quiet = {e: 1.15 * floor for e, floor in most.noise_floor.items()}
    unnamed = replace(most, effects=(), after=quiet)
    assert "Held-out errors over the noise floor: 1.15 in " in sentence(unnamed)
    assert sentence(unnamed).endswith("; what is above it is in other rows (see the notes).")


def test_an_error_that_no_effect_lowers_is_no_error_of_a_form(rig: Rig) -> None:
    high = {"flow_cap_1": 2 * FLOOR["flow_cap_1"], "torque_2": 3 * FLOOR["torque_2"]}
    before = high | {"torque_2": 60 * FLOOR["torque_2"]}
    of_form, untouched = tolerated_error_notes(explained(rig, (SPRING,), before, high))
    assert of_form.startswith("torque_2: held-out error 3.00 times the noise floor, 0.22 % of the")
    assert of_form.endswith("within the tolerance for the form of the named effect")
    assert untouched == (
        "flow_cap_1: held-out error 2.00 times the noise floor, no less than under the baseline: "
        "no named effect acts in it"
    )
    said = explained(rig, (SPRING,), before, high, notes=("torque_2: 3 % remains",))
    assert tolerated_error_notes(said) == [untouched]


def test_a_remainder_is_that_of_a_form_up_to_the_tolerance_of_the_held_out_records() -> None:
    of_form = "within the tolerance for the form of the named effect"
    assert tolerance_words(0.05, 0.05).endswith(of_form)
    assert "more than the form" in tolerance_words(0.13, 0.05)
    assert tolerance_words(0.02, 0.0).endswith("more than noise, unlike in held-out records")
    assert "no named effect acts there" in tolerance_words(0.9, 0.05)


def test_a_parameter_that_only_motion_alone_leaves_open_says_so(rig: Rig) -> None:
    before = nominal_model(rig, tuple(map(Used, baseline_of(rig))))
    lost = Estimate(np.nan, "kg m^2", np.nan, (np.nan, np.nan))
    model = replace(before, parameters=dict(before.parameters) | {"M2": lost})
    assert undetermined_notes(model, model) == []
    (always,), (moving,) = undetermined_notes(model), undetermined_notes(model, before, (1,))
    assert always.startswith("the records do not determine M2 ")
    assert moving.startswith("the records, with torque_2 judged in motion alone, do not determine")
    assert moving.endswith("the free run takes M2 from the model before")
    assert completed(model, before).parameters == before.parameters
    assert completed(before, model) is before


def test_beside_something_unknown_training_records_do_not_separate_a_rival() -> None:
    """Held out, the delay leaves as much as the gain: only what was fitted tells them apart."""
    near, far = (
        Rival("channel_delay", "joint 1", ratio, 1.4, False, "joint 1 piston")
        for ratio in (1.0, 1.5)
    )
    gain = replace(SPRING, gates=(Gate(NO_RIVAL, True, "none"),))
    open_one = tied_in_held_out(replace(gain, rivals=(far, near)))
    assert [r.tied for r in open_one.rivals] == [True, False]
    assert not open_one.named
    assert passes_gates(open_one)  # it fits, but is not the only one that does
    assert "cannot be separated from channel_delay" in open_one.gates[-1].detail
    assert "1.40 times the training rms" in open_one.gates[-1].detail
    clear = replace(gain, rivals=(far,))
    assert tied_in_held_out(clear) is clear


def test_a_lopsided_interval_is_stated_by_its_ends() -> None:
    """A breakaway of unknown form is known to a factor."""
    assert quantity(Estimate(96.0, "N", 50.0, (31.0, 196.0))) == "96 (31 to 200) N"
    assert quantity(Estimate(96.0, "N", 10.0, (76.0, 117.0))) == "96 ± 20 N"
    play = Estimate(0.040043, "V", 5e-5, (0.0400256, 0.0402338))
    assert quantity(play) == "0.04004 (0.04003 to 0.04023) V"


def test_what_only_some_rows_hold_is_stated_where_the_errors_do_not_show_it() -> None:
    """A spool sticks in some blocks: those that judge have none, and all is at the floor."""
    left = [
        Remainder("flow_cap_1", "the repeatable energy is 7 times the band", True),
        Remainder("flow_cap_1", "held-out error 4.1 times the noise floor", True),
        Remainder("flow_rod_1", "2 % of the repeatable energy remains", False),
        Remainder("torque_1", "the repeatable energy is 9 times the band", True),
    ]
    noise = dict.fromkeys(("flow_cap_1", "flow_rod_1", "torque_1"), 1.0)
    (note,) = not_judged_notes(left, noise, noise | {"torque_1": 3.0})
    assert note.startswith(
        "flow_cap_1: the repeatable energy is 7 times the band, held-out error 4.1 times the noise "
        "floor; the rows that judge hold noise alone"
    )


def test_a_parameter_that_a_tied_rival_leaves_open_is_said_to_be_open() -> None:
    """No interval of W1 holds 190 % less."""
    rival = Rival("joint_spring", "joint 1", 1.0, 1.0, True, "joint 1", ("W1", -1.9))
    offset = replace(effect("torque_offset", "a constant", {}), rivals=(rival,))
    (note,) = rival_notes([offset])
    assert "W1 would hardly be determined: its interval is wider for it" in note
    (note,) = rival_notes([replace(offset, rivals=(replace(rival, moved=("W1", -0.2)),))])
    assert "W1 would be 20 % smaller: its interval is wider for it" in note


def test_an_equation_that_the_effects_make_worse_is_said_to_be_worse() -> None:
    """The baseline left noise alone: a share of nothing is no figure."""
    rows = {"torque_1": 1600, "flow_cap_1": 1600}
    data = SimpleNamespace(row_counts=rows, rig=None)
    empty = SimpleNamespace(excess_energy={"torque_1": -30.0, "flow_cap_1": 1700.0})
    after = SimpleNamespace(
        effects=("an effect",), excess_energy={"torque_1": 500.0, "flow_cap_1": 10.0}
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gates, "equations_above_band", lambda *_: [])
        patch.setattr(gates, "form_share", lambda *_: 0.0)
        hypotheses: Any = SimpleNamespace(train_data=data, empty=empty)
        patch.setattr(finding, "effects_among", lambda _: [])
        (left,) = finding.remainders(hypotheses, cast("Any", after), cast("Any", data))
    assert left.equation == "torque_1"
    assert left.words == "the repeatable rms is 1.15 times the noise, more than under the baseline"


def test_of_many_rivals_a_terminal_shows_the_nearest(rig: Rig) -> None:
    """A refused effect of one crane had 38 rivals that could not be separated."""
    rivals = tuple(
        Rival("sensor_offset", f"joint {k}", 1.0, 1.0, k < 30, f"joint {k} cap") for k in range(40)
    )
    text = trace_text(explained(rig, (replace(SPRING, rivals=rivals),)))
    assert text.count("  rival ") == RIVALS_SHOWN
    further = 40 - RIVALS_SHOWN
    assert f"  and {further} further rivals, {30 - RIVALS_SHOWN} of which cannot be" in text
    assert "further" not in trace_text(explained(rig, (replace(SPRING, rivals=rivals[:3]),)))
