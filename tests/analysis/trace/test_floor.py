"""The noise floor is what repeats do not share, but no lower than a data sheet has a meaning."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lombscargle

from analysis.effects.friction import CoulombFriction
from analysis.regression.noise import (
    mean_rounding,
    repeated_rounding,
    white_variance,
    with_added_rounding,
)
from analysis.signals.filters import row_filter
from analysis.simulation.synthetic import multisine, synthetic_run
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import conditioned_records, moving_filtering
from analysis.trace.data.noise_floor import (
    ABOVE,
    NEIGHBOURS,
    OTHER_STEPS,
    PERIODS,
    REPEATS,
    STATED,
    Floor,
    floors,
    sine_energy,
    stated_noise,
)
from analysis.trace.data.regression_data import regression_data
from analysis.trace.judge import invariance
from analysis.trace.judge.unrepeated import dominant_frequency, unrepeated_notes
from analysis.trace.settings import DATA
from rig.model import channels as ch
from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.model.wire.codes import decode_input, encode_input
from rig.runs.rigs import load_rig
from tests.analysis.carriage import Carriage, moves, record, to_and_fro
from tests.analysis.trace.hidden import pair_of_runs, with_filtered_noise


def floor_over_stated(rig: Rig, noise: float) -> dict[str, float]:
    """Return each equation's floor over the stated noise, with sensors of `noise` times it."""
    wave = multisine(np.random.default_rng(1), rig.sample_rate, 4.0, 9.5)
    run = synthetic_run(rig, np.random.default_rng(2), wave, rms=0.025, repeats=4, noise=noise)
    train_data = regression_data(
        rig, tuple(map(Used, baseline_of(rig))), conditioned_records(rig, [run])
    )
    found = {(f.group, f.equation): f.noise for f in train_data.floors}
    out: dict[str, float] = {}
    for conditioned, rows in zip(train_data.records, train_data.rows, strict=True):
        if conditioned.record.repeat == 1:
            stated = stated_noise(rig, train_data.terms, conditioned, rows, train_data.beta)
            for e in rows:
                out[f"{conditioned.group[1]} {e}"] = found[conditioned.group, e] / stated[e]
    return out


def test_sensors_as_stated_give_the_floor_that_their_data_sheet_says(rig: Rig) -> None:
    for name, ratio in floor_over_stated(rig, 1.0).items():
        assert 0.7 < ratio < 1.4, name  # a few hundred filtered rows know it to some tenths


def test_sensors_far_better_than_stated_do_not_make_a_floor_of_nothing(rig: Rig) -> None:
    ratios = floor_over_stated(rig, 0.0)
    assert ratios
    for name, ratio in ratios.items():
        assert ratio == pytest.approx(DATA.least_noise, rel=1e-6), name


def test_a_record_whose_rows_are_all_masked_has_the_stated_floor_and_nothing_left(rig: Rig) -> None:
    """A chamber below tank pressure throughout: the rows of its flow are gone."""
    wave = multisine(np.random.default_rng(1), rig.sample_rate, 4.0, 9.5)
    run = synthetic_run(rig, np.random.default_rng(2), wave, rms=0.025, repeats=1)
    terms = tuple(map(Used, baseline_of(rig)))
    train_data = regression_data(rig, terms, conditioned_records(rig, [run]))
    none = [
        {
            e: replace(r, matrix=r.matrix[:0], rhs=r.rhs[:0], time=r.time[:0])
            for e, r in rows.items()
        }
        for rows in train_data.rows
    ]
    for floor in floors(rig, terms, train_data.records, none, train_data.beta):
        assert (floor.total, floor.repeatable, floor.source) == (0.0, 0.0, STATED)
        assert floor.noise > 0.0


def test_white_noise_is_measured_beside_a_motion_a_thousand_times_as_large() -> None:
    rng, t = np.random.default_rng(7), np.arange(4000) / 500.0
    noise = 2e-5 * rng.standard_normal(len(t))
    motion = 0.02 * np.sin(2 * np.pi * 0.7 * t) + 1e-3 * np.sin(2 * np.pi * 9.0 * t) + 0.01 * t
    assert white_variance(motion + noise) == pytest.approx(4e-10, rel=0.25)
    assert white_variance(motion) < 1e-3 * 4e-10
    slow = np.convolve(noise, np.ones(5) / 5, mode="same")  # a filter leaves less of it up there
    assert white_variance(motion + slow) < 0.5 * np.var(slow)
    assert white_variance(noise[:100]) == 0.0


def floors_of(*runs: Run, others: Sequence[Floor] = ()) -> dict[str, Floor]:
    """Return the floors of a carriage's torque by step."""
    rig = runs[0].rig
    terms = (*map(Used, baseline_of(rig)), Used(CoulombFriction("joint 1"), (1e-5, 0.0, 0.0)))
    data = regression_data(rig, terms, conditioned_records(rig, runs), others=others)
    by_step = {f.group[1]: f for f in data.floors}
    assert len(by_step) == len(data.floors)
    return by_step


def floor_of(run: Run) -> Floor:
    (floor,) = floors_of(run).values()
    return floor


def test_a_motion_that_comes_back_shows_noise_that_the_rig_file_does_not_state() -> None:
    """Nobody says that the reference repeats; its states do."""
    once, thrice, known = (floor_of(to_and_fro(*n)) for n in ((1,), (3,), (1, 4)))
    assert (once.source, thrice.source, known.source) == (ABOVE, NEIGHBOURS, REPEATS)
    assert once.noise < 0.3 * known.noise  # above the rows, the encoder's noise hides the drive's
    assert thrice.noise == pytest.approx(known.noise, rel=0.35)


def test_rows_show_filtered_noise_above_the_motion_beside_an_effect(rig: Rig) -> None:
    """Four times the stated noise, and a leak that leaves twice as much in the flows."""

    def floors_with(leak: float) -> dict[str, Floor]:
        run = pair_of_runs(rig, c_internal=leak)[0]
        noisy = with_filtered_noise(replace(run, records=run.records[:1]), 4.0)
        terms = tuple(map(Used, baseline_of(rig)))
        split = regression_data(rig, terms, conditioned_records(rig, [noisy])).floors
        return {floor.equation: floor for floor in split}

    sound, leaking = floors_with(0.0), floors_with(2e-12)
    for equation, floor in sound.items():
        assert floor.source == ABOVE
        assert floor.noise > 3.0 * floor.stated
        assert floor.noise == pytest.approx(floor.total, rel=0.2)  # nothing but noise is left
        assert leaking[equation].noise == pytest.approx(floor.noise, rel=0.05)
    assert leaking["flow_cap_2"].total > 2.0 * sound["flow_cap_2"].total


@pytest.mark.parametrize("in_motion", [(), (0,)])
def test_stated_noise_agrees_with_repeats_of_a_slow_motion_without_its_rests_too(
    in_motion: tuple[int, ...],
) -> None:
    """A weight by the speed of one record would mix its noise with the acceleration of another."""
    emps = load_rig("emps")
    encoder = emps.sensors.position.model_copy(update={"noise": 3e-5})
    rig = emps.model_copy(update={"sensors": emps.sensors.model_copy(update={"position": encoder})})
    rng = np.random.default_rng(1)
    reference = np.tile(moves(rig.sample_rate, 4.0, 0.05, 0.25), 2)
    records = tuple(
        replace(
            record(rig, Carriage(), reference, rng, "moves", repeat),
            period=len(reference), lines=(2, 5),
        )
        for repeat in (1, 2, 3, 4)
    )  # fmt: skip
    conditioned = conditioned_records(rig, [Run(rig, records)], moving_filtering(in_motion))
    (floor,) = regression_data(rig, tuple(map(Used, baseline_of(rig))), conditioned).floors
    assert floor.source == REPEATS
    assert floor.stated == pytest.approx(floor.noise, rel=0.35)


def test_noise_that_repeats_of_one_step_show_holds_for_a_step_taken_once() -> None:
    """In the same records, and in held-out ones that have no repeats at all."""
    repeated, once = to_and_fro(1, 4, times=3.0), to_and_fro(1, times=3.0)
    other = replace(once, records=tuple(replace(r, step="other") for r in once.records))
    known = floor_of(repeated)
    together = floors_of(repeated, other)
    apart = floors_of(other, others=[known])
    for floor in (together["other"], apart["other"]):
        assert floor.source == OTHER_STEPS
        assert floor.noise == pytest.approx(known.noise, rel=0.1)
    assert together["moves"].source == REPEATS
    loud = floor_of(to_and_fro(1, 4))  # so loud that it is no noise of the sensors
    for unlike in ([], [loud]):
        assert floors_of(other, others=unlike)["other"].source == ABOVE


def test_noise_that_a_motion_shows_by_coming_back_holds_for_another_step() -> None:
    back, once = to_and_fro(3, times=3.0), to_and_fro(1, times=3.0)
    other = replace(once, records=tuple(replace(r, step="other") for r in once.records))
    together = floors_of(back, other)
    assert (together["moves"].source, together["other"].source) == (NEIGHBOURS, OTHER_STEPS)
    ratios = [floor.noise / floor.stated for floor in together.values()]
    assert ratios[0] == pytest.approx(ratios[1])
    # Repeats know it better than neighbours do.
    known = floor_of(to_and_fro(1, 4, times=3.0))
    beside = floors_of(back, other, others=[known])["other"]
    assert beside.noise / beside.stated == pytest.approx(known.noise / known.stated)


def test_blocks_of_many_equations_and_steps_are_numbered_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As of three joints with one repeat of each step, where nothing measures the noise."""
    blocks, count = 4, 60
    segments = [SimpleNamespace(where=slice(k * blocks, (k + 1) * blocks)) for k in range(count)]
    stated = SimpleNamespace(count=1)
    data: Any = SimpleNamespace(floors=[stated], segments=segments)
    numbers = np.tile(np.arange(blocks), count)
    monkeypatch.setattr(invariance, "flip_blocks", lambda _: numbers)
    found = invariance._blocks_as_noise(data)
    assert found is not None
    assert len(set(found.tolist())) == blocks * count


def test_a_hum_in_step_with_the_record_is_no_noise_where_repeats_show_the_noise() -> None:
    """Between two periods of a record it differs, between two repeats it does not."""

    def humming(run: Run) -> Run:
        def hummed(one: Record) -> Record:
            time = np.arange(one.samples) / one.sample_rate
            drive = one.channels["drive_1"] + 0.05 * np.sin(2 * np.pi * 1.37 * time)
            return replace(one, channels={**one.channels, "drive_1": drive})

        return replace(run, records=tuple(map(hummed, run.records)))

    known = floor_of(humming(to_and_fro(1, 4, times=3.0)))
    periodic = to_and_fro(3, times=3.0)
    (whole,) = periodic.records
    periodic = replace(periodic, records=(replace(whole, period=whole.samples // 3),))
    alone = floor_of(humming(periodic))
    assert alone.source == PERIODS
    assert alone.noise > 3 * known.noise
    beside = floors_of(humming(periodic), others=[known])[whole.step]
    assert beside.source == OTHER_STEPS
    assert beside.noise == pytest.approx(known.noise, rel=0.1)
    assert floors_of(periodic, others=[known])[whole.step].source == PERIODS


def test_the_rounding_of_a_coarse_converter_is_part_of_the_stated_noise() -> None:
    """One code of a drive's 10 bits is 6.5 times its noise; one record alone shows no noise."""
    rig = load_rig("emps")
    drive = rig.sensors.drive.model_copy(update={"bits": 10})
    sensors = rig.sensors.model_copy(update={"drive": drive})
    coarse = rig.model_copy(update={"sensors": sensors})
    rounded = []
    for x in to_and_fro(1, 4, times=0.0).records:
        codes = encode_input(x.channels["drive_1"], *drive.range, drive.bits)
        volts = decode_input(codes, *drive.range, drive.bits)
        rounded.append(replace(x, channels={**x.channels, "drive_1": volts}))
    known, once = (floor_of(Run(coarse, tuple(rounded[:n]))) for n in (4, 1))
    assert (known.source, once.source) == (REPEATS, STATED)
    assert once.noise == pytest.approx(known.noise, rel=0.25)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3])
def test_rounding_that_repeats_has_the_variance_of_rounded_samples(rig: Rig, noise: float) -> None:
    """Averages of several thousand rounded samples of each of many values, in codes."""
    rng = np.random.default_rng(1)
    sensor = rig.sensors.spool.model_copy(update={"range": (0, 1023), "bits": 10, "noise": noise})
    values = rng.uniform(0.0, 100.0, 1000)
    averages = np.mean(np.round(values + noise * rng.standard_normal((5000, 1000))), axis=0)
    assert np.var(averages - values) == pytest.approx(repeated_rounding(sensor), rel=0.15)
    missed = averages - values - mean_rounding(sensor, values)
    assert np.sqrt(np.mean(missed**2)) < 0.2 * np.std(averages - values)


@pytest.mark.parametrize(("frequency", "cutoff"), [(0.5, 8.0), (8.0, 12.0)])
def test_the_rounding_of_a_slow_signal_is_as_slow(
    multisine_run: Run, frequency: float, cutoff: float
) -> None:
    """Behind a filter, errors that are added are as large as those of the signal itself."""
    taken, rig = multisine_run.records[0], multisine_run.rig
    spool = rig.sensors.spool.model_copy(update={"range": (0.0, 1023.0), "bits": 10, "noise": 0.1})
    coarse = rig.model_copy(update={"sensors": rig.sensors.model_copy(update={"spool": spool})})
    x = 500.0 + 6.0 * np.sin(2 * np.pi * frequency * taken.time)
    noise, smoother = np.random.default_rng(1), row_filter(taken.sample_rate, cutoff)
    channel = np.round(x + 0.1 * noise.standard_normal(len(x)))
    measured, rng = replace(taken, channels={"spool_1": channel}), np.random.default_rng(2)
    drawn = [with_added_rounding(coarse, measured, rng, smoother) for _ in range(4)]

    def slow(errors: Sequence[np.ndarray]) -> float:
        return float(np.sqrt(np.mean([np.mean(smoother.apply(e) ** 2) for e in errors])))

    def repeated(true: np.ndarray) -> np.ndarray:
        draws = true + 0.1 * noise.standard_normal((200, len(true)))
        return np.asarray(np.round(draws).mean(axis=0) - true)

    own = [repeated(x + shift) for shift in np.linspace(0.0, 0.75, 4)]
    added = slow([y.channels["spool_1"] - channel for y in drawn])
    assert added == pytest.approx(slow(own), rel=0.25)


def test_what_a_coarse_converter_rounds_alike_in_every_repeat_is_no_residual(rig: Rig) -> None:
    """A code of ten bits is thirty times the noise: a clean bench has nothing above its floor."""
    noise = {"spool": 4 / 1023 / 30, "piston": 0.08 / 1023 / 30}
    coarse = {
        name: getattr(rig.sensors, name).model_copy(update={"bits": 10, "noise": value})
        for name, value in noise.items()
    }
    rig = rig.model_copy(update={"sensors": rig.sensors.model_copy(update=coarse)})
    wave = multisine(np.random.default_rng(1), rig.sample_rate, 4.0, 9.5)
    run = synthetic_run(rig, np.random.default_rng(2), wave, rms=0.025, repeats=4)

    def rounded(x: Record, name: str) -> np.ndarray:
        sensor = rig.sensors.of(ch.kind_of(name)[0])
        codes = encode_input(x.channels[name], *sensor.range, sensor.bits)
        return decode_input(codes, *sensor.range, sensor.bits)

    records = tuple(
        replace(x, channels={**x.channels, **{n: rounded(x, n) for n in rig.channels}})
        for x in run.records
    )
    terms = tuple(map(Used, baseline_of(rig)))
    data = regression_data(rig, terms, conditioned_records(rig, [replace(run, records=records)]))
    assert {f.source for f in data.floors} == {REPEATS}
    assert max(f.ratio for f in data.floors) < 0.7
    # The same records from converters that the rig file calls fine hold something it lacks.
    fine = {n: s.model_copy(update={"bits": 16}) for n, s in coarse.items()}
    told = rig.model_copy(update={"sensors": rig.sensors.model_copy(update=fine)})
    other = regression_data(told, terms, conditioned_records(told, [replace(run, records=records)]))
    assert max(f.ratio for f in other.floors) > 1.0


@pytest.mark.slow
def test_a_pump_that_does_not_follow_the_excitation_is_noted_with_its_frequency(rig: Rig) -> None:
    """7.3 Hz on joint 2, in another phase in every repeat: part of the floor, no residual."""
    wave = multisine(np.random.default_rng(1), rig.sample_rate, 4.0, 9.5)
    quiet = synthetic_run(rig, np.random.default_rng(2), wave, rms=0.025, repeats=4)
    rng = np.random.default_rng(5)

    def shaken(run: Run) -> Run:
        records = []
        for taken in run.records:
            time = np.arange(taken.samples) / taken.sample_rate
            pulse = 3e4 * np.sin(2 * np.pi * 7.3 * time + rng.uniform(0, 2 * np.pi))
            cap = taken.channels["cap_pressure_2"] + pulse
            records.append(replace(taken, channels={**taken.channels, "cap_pressure_2": cap}))
        return replace(run, records=tuple(records))

    terms = tuple(map(Used, baseline_of(rig)))
    still, moved = (
        regression_data(rig, terms, conditioned_records(rig, [run]))
        for run in (quiet, shaken(quiet))
    )
    assert unrepeated_notes(still) == []
    after = unrepeated_notes(moved)
    torque = next(note for note in after if note.startswith("torque_2"))
    at = re.search(r"at ([\d.]+) Hz", torque)
    assert at is not None
    assert float(at[1]) == pytest.approx(7.3, abs=0.05)
    assert not any(note.startswith("flow_cap_1") for note in after)
    # An equation whose rows are left out keeps its floor and is not noted.
    kept = np.ones(moved.base.shape[0], dtype=bool)
    for segment in moved.segments:
        kept[segment.where] = segment.equation != "torque_2"
    others = [note for note in after if not note.startswith("torque_2")]
    assert unrepeated_notes(moved.at(kept)) == others


def test_the_frequency_of_a_scatter_is_where_another_library_finds_its_energy() -> None:
    """Three repeats with samples left out: compared with scipy's Lomb-Scargle periodogram."""
    rng = np.random.default_rng(3)
    time = np.sort(rng.choice(np.arange(500), 430, replace=False)) / 50
    turns = 2 * np.pi * (6.31 * time + rng.uniform(size=(3, 1)))
    series = np.sin(turns) + rng.normal(size=(3, len(time)))
    series -= series.mean(axis=1, keepdims=True)
    found, share = dominant_frequency([(time, series)])
    near = np.arange(6.2, 6.4, 1e-4)
    power = sum(lombscargle(time, r, 2 * np.pi * near, normalize=True) * (r @ r) for r in series)
    assert found == pytest.approx(near[np.argmax(power)], abs=1e-3)
    assert share == pytest.approx(np.max(power) / np.sum(series**2), rel=1e-6)


def test_half_the_rate_of_the_instants_is_no_frequency_of_a_scatter() -> None:
    """There a sine and a cosine are one column, and whatever they fit is rounding."""
    rng = np.random.default_rng(4)
    time = 0.369 + 0.021 * np.arange(442)
    series = np.sin(2 * np.pi * 5.35 * time + rng.uniform(0, 6, (3, 1))) + rng.normal(size=(3, 442))
    found, share = dominant_frequency([(time, series)])
    assert found == pytest.approx(5.35, abs=0.01)
    assert 0.2 < share < 0.5  # a sine of amplitude 1 in noise of deviation 1: a third


def test_waves_that_are_nothing_fit_nothing() -> None:
    """Between states whole periods apart a sine of that period has no change."""
    rng = np.random.default_rng(0)
    c, s, series = np.zeros((50, 3)), np.zeros((50, 3)), rng.standard_normal((2, 50))
    c[:, 1], c[:, 2], s[:, 2] = 1.0, rng.standard_normal(50), rng.standard_normal(50)
    both = np.column_stack((c[:, 2], s[:, 2]))
    left = series.T - both @ np.linalg.lstsq(both, series.T, rcond=None)[0]
    mean = 50.0 * np.mean(series, axis=1) ** 2
    wanted = [0.0, mean.sum(), (series**2).sum() - (left**2).sum()]
    assert sine_energy(c, s, series) == pytest.approx(wanted)
