"""A person traces what a bench's model lacks: told right, told nothing, or told 'I do not know'."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.effects.base import Effect
from analysis.identify.identify import identify
from analysis.report.trace import body, render
from analysis.simulation.model import load_model, save_model
from analysis.terms import baseline_of, make
from analysis.terms.base import Used
from analysis.trace import engine
from analysis.trace.data.candidates import catalogue
from analysis.trace.engine import trace
from analysis.trace.result import Trace, to_json
from analysis.trace.stages.preparation import COLUMNS
from rig.cli.text.trace_text import trace_text
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis import small_bench
from tests.analysis.trace import gate_cases
from tests.analysis.trace.hidden import experiment, hardening, pair_of_runs, understated

BOTH = (
    "coulomb_friction", "stribeck_friction", "torque_offset", "valve_deadband", "spool_offset",
    "internal_leakage",
)  # fmt: skip


def traced(rig: Rig, **wrong: float) -> Trace:
    train, held_out = pair_of_runs(rig, **wrong)
    return trace([train], [held_out], look_ahead=False)


@pytest.fixture(scope="module")
def quiet(rig: Rig) -> tuple[Run, Run]:
    return pair_of_runs(rig)


@pytest.fixture(scope="module")
def shares() -> list[float]:
    """What the trace of the leaking bench told of its progress."""
    return []


@pytest.fixture(scope="module")
def leaking(rig: Rig, shares: list[float]) -> Trace:
    train, held_out = pair_of_runs(rig, c_internal=2e-12)
    return trace([train], [held_out], look_ahead=False, progress=shares.append)


def test_a_trace_tells_how_far_it_is(leaking: Trace, shares: list[float]) -> None:
    assert len(shares) > 20
    assert shares == sorted(shares)
    assert 0.0 < shares[0] < shares[-1] < 1.0
    # During the search, whose length is unknown, each fitted set reports that work goes on.
    assert shares.count(COLUMNS) > 5


def test_progress_does_not_go_back_where_a_search_is_repeated() -> None:
    shares: list[float] = []
    report = engine._without_steps_back(shares.append)
    for share in (0.1, 0.5, 0.1, 0.5, 0.55, 0.3, 0.8):
        report(share)
    assert shares == [0.1, 0.5, 0.5, 0.5, 0.55, 0.55, 0.8]


def test_a_bench_with_nothing_wrong_is_clean_and_nothing_is_named(quiet: tuple[Run, Run]) -> None:
    result = trace([quiet[0]], [quiet[1]], look_ahead=False)
    assert result.verdict == "clean"
    assert result.effects == ()
    assert result.after == result.before
    for equation, error in result.after.items():
        assert error < 1.2 * result.noise_floor[equation]
    for shown in (trace_text(result), render([quiet[1]], result)):
        assert "noise floor" in shown.lower()
        assert not re.search(r"\bbefore\b", shown, re.IGNORECASE)  # nothing was added: one figure


def test_a_leak_is_named_with_place_and_size_and_its_error_falls_to_the_noise(
    leaking: Trace,
) -> None:
    assert leaking.verdict == "explained"
    (found,) = leaking.effects
    assert (found.name, found.where) == ("internal_leakage", "joint 2")
    assert found.parameters["c_internal_2"].value == pytest.approx(2e-12, rel=0.03, abs=0)
    assert found.removed_fraction > 0.95
    assert found.rms_without > 5.0
    assert found.rms_with == pytest.approx(1.0, abs=0.2)
    assert found.p_value <= 0.01
    assert leaking.before["flow_cap_2"] > 3 * leaking.noise_floor["flow_cap_2"]
    assert leaking.after["flow_cap_2"] < 1.3 * leaking.noise_floor["flow_cap_2"]
    assert "pressure difference" in leaking.sentence
    assert all(rival.ratio > 1.1 for rival in found.rivals)


def test_parameters_that_the_leak_had_biased_come_back(leaking: Trace) -> None:
    from tests.analysis.small_bench import TRUTH

    before, after = (m.values for m in (leaking.model_before, leaking.model_after))
    off = {n: abs(m["b"] / TRUTH["b"] - 1) for n, m in (("before", before), ("after", after))}
    assert off["after"] < 0.02 < off["before"]


def test_the_page_shows_parameters_in_display_units(quiet: tuple[Run, Run], leaking: Trace) -> None:
    rows = {row[0]: row[1:] for row in body([quiet[1]], leaking)["parameters"]}
    before, after, change, unit = rows["b"]
    assert unit == "MPa"
    shown = float(after.split(" ± ")[0])
    assert shown == pytest.approx(1e-6 * leaking.model_after.values["b"], rel=1e-3)
    ratio = leaking.model_after.values["b"] / leaking.model_before.values["b"]
    assert change == f"{100 * (ratio - 1):+.1f} %".replace("-", "−")
    assert "±" in before
    assert all("-0.0" not in row[2] for row in rows.values())


def test_the_extended_model_is_a_model_file_like_any_other(leaking: Trace, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    save_model(leaking.model_after, path)
    again = load_model(path)
    assert [u.term.name for u in again.terms][-1] == "internal_leakage"
    assert again.values["c_internal_2"] == leaking.model_after.values["c_internal_2"]


def test_the_extended_model_lacks_nothing_any_more(rig: Rig, leaking: Trace) -> None:
    """Told what the machine has, the trace takes it as known and names no other in its place."""
    train, held_out = pair_of_runs(rig, c_internal=2e-12)
    known = leaking.model_after.terms
    result = trace([train], [held_out], look_ahead=False, terms=known)
    assert result.verdict == "clean"
    assert result.model_before.values["c_internal_2"] == pytest.approx(2e-12, rel=0.03, abs=0)


@pytest.mark.slow
def test_beside_a_known_dead_band_friction_alone_is_new(rig: Rig) -> None:
    train, held_out = pair_of_runs(rig, Fc=60, w_ahead=8e-3, w_astern=8e-3)
    band = Used(make("valve_deadband", "joint 2"), (8e-3, 8e-3, 0.0))
    known = (*map(Used, baseline_of(rig)), band)
    few = ("coulomb_friction", "stribeck_friction", "spool_lag", "valve_deadband")
    candidates = catalogue(rig, few)
    result = trace([train], [held_out], candidates, look_ahead=False, terms=known)
    assert result.verdict == "explained"
    assert [(e.name, e.where) for e in result.effects] == [("coulomb_friction", "joint 2")]
    kept = [u.term.name for u in result.model_after.terms if isinstance(u.term, Effect)]
    assert sorted(kept) == ["coulomb_friction", "valve_deadband"]


def test_the_result_has_the_contracts_keys(leaking: Trace) -> None:
    data = json.loads(json.dumps(to_json(leaking), allow_nan=False))
    assert {
        "verdict", "effects", "error", "fit", "parameters", "unexplained", "next_experiment",
    } <= set(data)  # fmt: skip
    assert {"name", "where", "parameters", "p_value", "removed_fraction", "rivals"} <= set(
        data["effects"][0]
    )
    assert {"noise_floor", "before", "after"} == set(data["error"])
    assert {"fraction", "depends_on"} <= set(data["unexplained"])
    assert set(data["error"]["after"]) == {"torque_2", "flow_cap_2", "flow_rod_2"}


@pytest.mark.slow
@pytest.mark.parametrize("names", [BOTH, pytest.param((), marks=pytest.mark.slow)])
def test_friction_and_a_dead_band_at_once_are_both_named(rig: Rig, names: tuple[str, ...]) -> None:
    train, held_out = pair_of_runs(rig, Fc=60, w_ahead=8e-3, w_astern=8e-3)
    candidates = catalogue(rig, names) if names else None
    result = trace([train], [held_out], candidates, look_ahead=False)
    assert result.verdict == "explained"
    assert {(e.name, e.where) for e in result.effects} == {
        ("coulomb_friction", "joint 2"), ("valve_deadband", "joint 2"),
    }  # fmt: skip
    sizes = {n: p.value for e in result.effects for n, p in e.parameters.items()}
    assert sizes["Fc2"] == pytest.approx(60, rel=0.12)
    assert sizes["w_ahead_2"] == pytest.approx(8e-3, rel=0.05)


@pytest.mark.slow
def test_what_only_the_held_out_records_show_is_not_called_clean(rig: Rig) -> None:
    """At a third of the size the supply's line drops a tenth: too little to be seen in training."""
    train = experiment(rig, rms=0.012, dp_supply=4e5)
    held_out = experiment(rig, repeats=2, seed=2, rms=0.04, dp_supply=4e5)
    result = trace([train], [held_out], look_ahead=False)
    assert (result.verdict, result.effects) == ("unexplained", ())
    assert any("train on records with as much excitation" in note for note in result.notes)


@pytest.mark.slow
def test_a_quiet_effect_is_found_beside_a_loud_one_of_other_equations(rig: Rig) -> None:
    """Beside so wide a dead band hardly anything hangs on which friction it is."""
    result = traced(rig, w_ahead=2e-2, w_astern=2e-2, Fs=15)
    assert result.verdict == "explained"
    assert {e.name for e in result.effects} == {"stribeck_friction", "valve_deadband"}
    assert result.refused == ()
    assert result.worst(result.after) < 1.3


@pytest.mark.slow
def test_a_leak_that_began_between_the_runs_gets_no_clue_from_the_noise_before_it(
    rig: Rig, quiet: tuple[Run, Run]
) -> None:
    """Only the held-out run leaks: whatever fits the training run's residual fits its noise."""
    leaking = pair_of_runs(rig, c_internal=5e-12)[1]
    result = trace([quiet[0]], [leaking], look_ahead=False)
    assert result.verdict == "unexplained"
    assert (result.effects, result.refused, result.depends_on, result.formulas) == ((), (), (), ())
    assert result.unexplained_fraction == 0.0
    assert "the held-out ones are not. Held-out errors over the noise floor: " in result.sentence
    assert "flow_cap_2" in result.sentence
    assert any("the machine has changed between the runs" in note for note in result.notes)


@pytest.mark.slow  # with few candidates: test_clue_formula
def test_what_the_catalogue_lacks_stays_unexplained_and_its_variable_is_told(
    quiet: tuple[Run, Run],
) -> None:
    train, held_out = (hardening(run, 2.0e7) for run in quiet)
    result = trace([train], [held_out], look_ahead=False, free_forms=False)
    assert result.verdict == "unexplained"
    assert result.unexplained_fraction > 0.05
    assert "piston_2" in [d.variable for d in result.depends_on[:2]]
    # What was refused is in no model that leaves the house.
    kept = [u.term.name for u in result.model_after.terms if isinstance(u.term, Effect)]
    assert kept == [e.name for e in result.effects]


@pytest.mark.slow
def test_a_spring_that_hardens_is_one_spring_as_far_as_forms_may_differ(rig: Rig) -> None:
    """With two hundredths of the energy left it is a spring; with more, a curve over position."""
    little, much = (
        trace([train], [held_out], look_ahead=False)
        for cube in (3.5e5, 7e5)
        for train, held_out in [[hardening(r, cube) for r in pair_of_runs(rig, k_spring=5.0)]]
    )
    assert little.verdict == much.verdict == "explained"
    assert [e.name for e in little.effects] == ["joint_spring"]
    assert any("within the tolerance for the form" in note for note in little.notes)
    assert [e.name for e in much.effects] == ["position_force"]


@pytest.mark.slow
def test_one_repeat_says_what_it_costs(rig: Rig) -> None:
    train = experiment(rig, repeats=1, c_internal=2e-12)
    held_out = experiment(rig, repeats=1, seed=2, rms=0.02, c_internal=2e-12)
    result = trace([train], [held_out], look_ahead=False)
    assert any("one repeat" in note for note in result.notes)
    assert result.verdict != "clean"


@pytest.mark.slow
@pytest.mark.parametrize(("leak", "verdict"), [(0.0, "clean"), (2e-12, "explained")])
def test_noise_above_the_stated_one_is_no_model_error_where_it_follows_nothing(
    rig: Rig, leak: float, verdict: str
) -> None:
    """Nothing repeats, and the rig file states two thirds of the noise that the sensors have."""
    stated = understated(rig)
    train, held_out = (
        replace(run, rig=stated, records=tuple(replace(r, period=0) for r in run.records))
        for run in (
            experiment(rig, repeats=1, c_internal=leak),
            experiment(rig, repeats=1, seed=2, rms=0.02, c_internal=leak),
        )
    )
    result = trace([train], [held_out], look_ahead=False)
    assert result.verdict == verdict
    assert any("what the octave above the rows' frequencies holds" in n for n in result.notes)


@pytest.mark.parametrize("kept", [[], ["same"]])
def test_held_out_records_must_exist_and_be_other_records(
    quiet: tuple[Run, Run], kept: list[str]
) -> None:
    train = quiet[0]
    renamed = replace(train, records=tuple(replace(r, name=f"x{r.name}") for r in train.records))
    with pytest.raises(InputError, match="sample for sample" if kept else "no held-out"):
        trace([train], [renamed] if kept else [])


def test_records_too_short_are_refused_with_what_is_needed(quiet: tuple[Run, Run]) -> None:
    short = replace(
        quiet[0],
        records=tuple(
            replace(r, channels={k: np.asarray(v)[:1200] for k, v in r.channels.items()})
            for r in quiet[0].records
        ),
    )
    with pytest.raises(InputError, match="take longer records"):
        trace([short], [quiet[1]], look_ahead=False)
    with pytest.raises(
        InputError, match=r"no rows of the mechanical equations remain: .* too short"
    ):
        identify([short])


def test_runs_of_different_rigs_are_refused(quiet: tuple[Run, Run]) -> None:
    other = replace(quiet[1], rig=quiet[1].rig.model_copy(update={"name": "another"}))
    with pytest.raises(InputError, match="different rigs"):
        trace([quiet[0]], [other], look_ahead=False)


def test_the_baseline_before_is_what_identify_finds(leaking: Trace, rig: Rig) -> None:
    alone = identify([experiment(rig, c_internal=2e-12)], estimator="ls").model
    assert leaking.model_before.values == pytest.approx(alone.values, nan_ok=True)


@pytest.mark.slow
def test_a_null_that_may_be_the_sensors_own_is_confounded_with_it(rig: Rig) -> None:
    train, held_out = pair_of_runs(rig, u_null=3e-3)
    result = trace([train], [held_out])
    assert result.verdict == "confounded"
    (found,) = result.effects
    assert (found.name, found.where) == ("spool_offset", "joint 2")
    assert found.parameters["u_null_2"].value == pytest.approx(3e-3, rel=0.05)
    assert ("sensor_offset", "joint 2") in [(r.name, r.where) for r in found.rivals if r.tied]
    assert result.next_experiment is None  # no data of this rig can tell them apart


def test_a_pipe_of_which_the_rig_file_states_too_much_is_found(rig: Rig) -> None:
    """The cap side's pipe of joint 2 holds 63 cm³; the file says 1.6 times as much."""
    joint = rig.joints[1]
    true = joint.cylinder.cap_pipe_volume
    cylinder = joint.cylinder.model_copy(update={"cap_pipe_volume": 1.6 * true})
    joints = (rig.joints[0], joint.model_copy(update={"cylinder": cylinder}))
    wrong = rig.model_copy(update={"joints": joints})
    train, held_out = (replace(run, rig=wrong) for run in pair_of_runs(rig))
    found = trace([train], [held_out], look_ahead=False)
    assert (found.verdict, [(e.name, e.where) for e in found.effects]) == (
        "explained", [("dead_volume", "joint 2 cap")]
    )  # fmt: skip
    assert found.effects[0].parameters["V_dead_2_cap"].value == pytest.approx(-0.6 * true, rel=0.01)
    assert found.model_after.values["b"] == pytest.approx(small_bench.TRUTH["b"], rel=2e-3)
    assert any("the pipe holds 63 cm³, not the 101 cm³ of the rig file" in n for n in found.notes)


def test_hoses_at_both_chambers_are_found_beside_the_smaller_b_that_hides_them(rig: Rig) -> None:
    """Rigid volumes at both chambers are nearly a smaller b: what shows is that hoses stiffen.

    Their walls give by another law than the catalogue's.
    """
    names = ("dead_volume", "entrained_air", "channel_delay")
    result = gate_cases.traced(rig, pair_of_runs(rig, hose=1e-4), *names)
    assert result.verdict == "explained"
    assert {e.where for e in result.effects} == {"joint 2 cap", "joint 2 rod"}
    at_half_supply = 1e-4 * math.exp(-3.5 / 5.0)
    for effect in result.effects:
        assert effect.name == "dead_volume"
        volume = effect.parameters[f"V_dead_2_{effect.where.split()[-1]}"]
        assert volume.value == pytest.approx(at_half_supply, rel=0.03)
    assert result.model_after.parameters["b"].value == pytest.approx(
        small_bench.TRUTH["b"], rel=0.01
    )
