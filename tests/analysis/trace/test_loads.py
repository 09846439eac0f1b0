"""A load was on the arm in some records: stated or not, the trace names it and its mass.

The bench integrates closed two-joint equations of its own (`tests.analysis.small_bench`); a mass at
the tip is added to its parameters by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from analysis.effects.base import Effect
from analysis.effects.friction import CoulombFriction
from analysis.effects.mechanics import Payload
from analysis.identify.identify import identify
from analysis.simulation.validate import validate
from analysis.terms import baseline_of
from analysis.terms.base import FAMILIES, Used
from analysis.trace.data.candidates import catalogue
from analysis.trace.data.trace_rows import TraceRuns
from analysis.trace.engine import trace
from analysis.trace.notes import unseen_load_notes
from analysis.trace.search.undeclared_loads import UndeclaredLoad, undeclared_load
from rig.model.records import LOADED, Record, Run
from rig.model.rig import Rig
from tests.analysis.small_bench import TRUTH, default_excitations, experiment
from tests.analysis.trace.hidden import piston_speed, with_force

MASS = 1.5  # [kg] at the tip of two links of 0.5 m
NAMES = ("payload", "coulomb_friction", "torque_offset", "base_inclination")
HEAVY = TRUTH | {
    "M1": TRUTH["M1"] + 2 * MASS * 0.25, "M2": TRUTH["M2"] + MASS * 0.25,
    "R12": TRUTH["R12"] + MASS * 0.25,
    "W1": TRUTH["W1"] + MASS * 0.5, "W2": TRUTH["W2"] + MASS * 0.5,
}  # fmt: skip


def renamed(run: Run, word: str) -> tuple[Record, ...]:
    return tuple(
        replace(r, name=f"{r.step}{word}_r{r.repeat}", step=r.step + word) for r in run.records
    )


@pytest.fixture(scope="module")
def runs(rig: Rig) -> tuple[Run, Run]:
    """Training and held-out run: each step without and with the load."""
    out = []
    for seed, rms, repeats in ((1, 0.025, 2), (2, 0.018, 1)):
        waves = default_excitations(seed, rms)
        bare = experiment(rig, waves, repeats=repeats, seed=seed)
        heavy = experiment(rig, waves, repeats=repeats, seed=10 + seed, truth=HEAVY)
        out.append(replace(bare, records=(*bare.records, *renamed(heavy, "_heavy"))))
    return out[0], out[1]


def stated(run: Run, carries: Callable[[Record], bool]) -> Run:
    records = (replace(r, attributes={LOADED: int(carries(r))}) for r in run.records)
    return replace(run, records=tuple(records))


def heavy(record: Record) -> bool:
    return "heavy" in record.name


def chosen(run: Run, keep: Callable[[Record], bool]) -> Run:
    return replace(run, records=tuple(filter(keep, run.records)))


def test_a_stated_load_is_identified_with_the_bare_arm_beside_it(
    rig: Rig, runs: tuple[Run, Run]
) -> None:
    train = stated(runs[0], heavy)
    found = identify([train], terms=(*map(Used, baseline_of(rig)), Used(Payload("bench")))).model
    assert found.values["m_payload"] == pytest.approx(MASS, rel=0.01)
    for name in ("M1", "M2", "R12", "W1", "W2"):
        assert found.values[name] == pytest.approx(TRUTH[name], rel=0.02)
    # The load is simulated in the records that state it only.
    for fit in (v.fit for v in validate(found, [stated(runs[1], heavy)])):
        assert min(x for name, x in fit.items() if name.startswith("piston")) > 90.0


def load_in(train: Run, held_out: Run, beside: Sequence[Effect] = ()) -> UndeclaredLoad | None:
    """Return the load that the torque rows of the runs show in some of their records."""
    terms = tuple(map(Used, baseline_of(train.rig)))
    records = TraceRuns(train.rig, terms, (train,), (held_out,), (), tuple(FAMILIES))
    return undeclared_load(records, beside)


@pytest.mark.slow
def test_an_undeclared_load_is_named_with_the_steps_that_carry_it(
    rig: Rig, runs: tuple[Run, Run]
) -> None:
    result = trace([runs[0]], [runs[1]], catalogue(rig, NAMES), look_ahead=False, free_forms=False)
    assert result.verdict == "explained"
    (effect,) = result.effects
    assert (effect.name, effect.where) == ("payload", "bench")
    assert effect.parameters["m_payload"].value == pytest.approx(MASS, rel=0.02)
    (words,) = [note for note in result.notes if "no record states a load" in note]
    assert "step1_heavy step2_heavy step3_heavy carry about 1.5 kg more" in words


def test_held_out_records_may_all_be_without_the_load(rig: Rig, runs: tuple[Run, Run]) -> None:
    bare = chosen(runs[1], lambda r: not heavy(r))
    load = load_in(runs[0], bare)
    assert load is not None
    assert [r.loaded for r in load.records.train[0].records] == list(map(heavy, runs[0].records))
    assert not any(r.loaded for r in load.records.holdout[0].records)


def test_a_load_in_one_repeat_of_a_step_makes_it_a_step_of_its_own(
    rig: Rig, runs: tuple[Run, Run]
) -> None:
    """Somebody took the load off between two repeats and left the protocol as it was."""
    kept = [r for r in runs[0].records if heavy(r) == (r.repeat == 2)]
    mixed = replace(
        runs[0], records=tuple(replace(r, step=r.step.removesuffix("_heavy")) for r in kept)
    )
    load = load_in(mixed, runs[1])
    assert load is not None
    assert {(r.step, r.loaded) for r in load.records.train[0].records} == {
        (f"step{k}{word}", bool(word)) for k in (1, 2, 3) for word in ("", ", loaded")
    }
    assert "step1_heavy_r2" in load.words


def rubbing(run: Run, level: float) -> Run:
    """Return the run as if dry friction [N] braked piston 2."""
    return with_force(run, lambda record: level * np.tanh(piston_speed(record) / 2e-3))


@pytest.mark.slow
def test_a_load_is_found_beside_louder_friction(rig: Rig, runs: tuple[Run, Run]) -> None:
    train, held_out = (rubbing(run, 400.0) for run in runs)
    for known in ([], [CoulombFriction("joint 2")]):
        load = load_in(train, held_out, known)
        assert load is not None
        assert [r.loaded for r in load.records.train[0].records] == list(map(heavy, train.records))
        assert "carry about 1.5 kg more" in load.words


@pytest.mark.parametrize("word", [0, 1])
def test_no_load_is_looked_for_where_one_is_stated_or_all_records_are_alike(
    rig: Rig, runs: tuple[Run, Run], word: int
) -> None:
    known = stated(runs[0], lambda _: bool(word))
    alike = [chosen(run, lambda r: heavy(r) == bool(word)) for run in runs]
    assert load_in(known, runs[1]) is None
    assert load_in(*alike) is None


def test_an_offset_of_a_pressure_in_one_step_is_not_taken_for_a_mass(
    rig: Rig, runs: tuple[Run, Run]
) -> None:
    """It weighs and does not resist."""
    pushed = []
    for record in chosen(runs[0], lambda r: not heavy(r)).records:
        extra = 100e3 if record.step == "step2" else 0.0
        cap = np.asarray(record.channels["cap_pressure_1"]) + extra
        pushed.append(replace(record, channels={**record.channels, "cap_pressure_1": cap}))
    run = replace(runs[0], records=tuple(pushed))
    load = load_in(run, runs[1])
    assert load is None or not load.shows_inertia


def test_runs_that_state_no_load_have_none_where_another_run_states_one(
    rig: Rig, runs: tuple[Run, Run]
) -> None:
    """The runs from before the load was fastened say nothing of it."""
    before = chosen(runs[0], lambda r: not heavy(r))
    after = stated(chosen(runs[0], heavy), heavy)
    terms = (*map(Used, baseline_of(rig)), Used(Payload("bench")))
    assert identify([before, after], terms=terms).model.values["m_payload"] == pytest.approx(
        MASS, rel=0.01
    )


@pytest.mark.parametrize("mixed", [True, False])
def test_a_load_in_some_repeats_of_the_only_step_is_found(
    rig: Rig, runs: tuple[Run, Run], mixed: bool
) -> None:
    """Step 2 alone, two repeats of it with the load or none."""
    kept = [r for r in runs[0].records if r.step.startswith("step2") and (mixed or not heavy(r))]
    run = replace(runs[0], records=tuple(replace(r, step="step2") for r in kept))
    load = load_in(run, runs[1])
    if mixed:
        assert load is not None
        assert [r.loaded for r in load.records.train[0].records] == list(map(heavy, kept))
    else:
        assert load is None


def test_a_load_that_only_held_out_records_state_is_named(runs: tuple[Run, Run]) -> None:
    bare, carrying = chosen(runs[0], lambda r: not heavy(r)), stated(chosen(runs[0], heavy), heavy)
    (note,) = unseen_load_notes([bare], [carrying])
    assert note.startswith(f"{carrying.records[0].step}")
    assert "no training record carries" in note
    assert unseen_load_notes([bare, carrying], [carrying]) == []
    assert unseen_load_notes([bare], [bare]) == []
