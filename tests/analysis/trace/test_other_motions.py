"""Records that are called repeats, but did not start with the excitation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from analysis.trace import engine
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.trace_rows import with_other_motions_apart
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis.trace.gate_cases import at_joint_2
from tests.analysis.trace.hidden import pair_of_runs


def started_late(run: Run, repeat: int, seconds: float) -> Run:
    """Return a run of a periodic excitation, one repeat recorded from later on."""
    records = []
    for record in run.records:
        if record.repeat == repeat:
            by = -round(seconds * record.sample_rate)
            channels = {name: np.roll(x, by) for name, x in record.channels.items()}
            records.append(replace(record, channels=channels))
        else:
            records.append(record)
    return replace(run, records=tuple(records))


def test_a_repeat_of_another_motion_is_a_step_of_its_own(rig: Rig) -> None:
    train, _ = pair_of_runs(rig)
    (alike,), nothing = with_other_motions_apart([train])
    assert ([r.step for r in alike.records], nothing) == (["step1"] * 4, ())
    (apart,), notes = with_other_motions_apart([started_late(train, 3, 0.4)])
    assert [r.step for r in apart.records] == ["step1", "step1", "step1 repeat 3", "step1"]
    (note,) = notes
    assert note.startswith("step 'step1': repeat 3 differs from the first by ")


def test_a_joint_that_drifts_between_repeats_still_repeats_its_motion(rig: Rig) -> None:
    """Nothing holds a joint at its place between repeats: its mean moves by a millimetre."""
    train, _ = pair_of_runs(rig)
    records = []
    for record in train.records:
        piston = record.channels["piston_2"] + 1e-3 * record.repeat
        records.append(replace(record, channels={**record.channels, "piston_2": piston}))
    (alike,), nothing = with_other_motions_apart([replace(train, records=tuple(records))])
    assert ([r.step for r in alike.records], nothing) == (["step1"] * 4, ())


def test_another_geometry_or_noise_is_that_of_the_repeats_too(rig: Rig) -> None:
    """The rows of an average of repeats that differ are made of the repeats' signals."""
    first, *others = conditioned_records(rig, [pair_of_runs(rig)[0]])
    average = replace(first, repeats=(first, *others))
    moved = average.with_changed_signals(lambda signals: replace(signals, u=2.0 * signals.u))
    for before, after in zip((first, first, *others), (moved, *moved.repeats), strict=True):
        np.testing.assert_array_equal(after.signals.u, 2.0 * before.signals.u)
    assert average.condition_alike(rig, first.record).repeats == ()


def test_a_clean_bench_stays_clean(rig: Rig) -> None:
    """Averaged with the other repeat, it left several times the noise."""
    train, held_out = pair_of_runs(rig)
    candidates = at_joint_2(rig, "internal_leakage", "coulomb_friction")
    found = engine.trace(
        [train], [started_late(held_out, 2, 0.4)], candidates, look_ahead=False, free_forms=False
    )
    assert (found.verdict, found.effects) == ("clean", ())
    assert found.notes[0].startswith("step 'step1': repeat 2 differs from the first by ")
