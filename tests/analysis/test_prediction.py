"""Errors predicted before an experiment against the scatter of experiments that are simulated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.design.predict import Prediction, predict, to_json
from analysis.design.sensor_noise import shifted
from analysis.design.twin_records import Played, ideal, play
from analysis.identify.reduction import reduce_rows, solve_reductions
from analysis.identify.stacked_rows import build_rows
from analysis.regression.rows import default_filtering
from analysis.signals.conditioning import condition
from analysis.terms import baseline
from analysis.terms.base import Used
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.model.wire.codes import decode_input, encode_input
from tests.analysis.designed_steps import steps

DRAWS = 32
USED = tuple(Used(term) for term in baseline())


@pytest.fixture(scope="module")
def played(rig: Rig) -> list[Played]:
    return [play(rig, step) for step in steps(repeats=1)]


@pytest.fixture(scope="module")
def predicted(rig: Rig) -> Prediction:
    return predict(rig, steps(repeats=1))


def measured(rig: Rig, record: Record, rng: np.random.Generator) -> Record:
    """What the rig's sensors and converters make of a record."""
    channels = dict(record.channels)
    for name in rig.channels:
        sensor = rig.sensors.of(ch.kind_of(name)[0])
        noisy = channels[name] + sensor.noise * rng.standard_normal(record.samples)
        codes = encode_input(noisy, *sensor.range, sensor.bits)
        channels[name] = decode_input(codes, *sensor.range, sensor.bits)
    return replace(record, channels=channels)


@pytest.mark.slow
def test_the_scatter_of_simulated_experiments_is_the_one_predicted(
    rig: Rig, played: list[Played], predicted: Prediction
) -> None:
    """Noise drawn at random, rounded by the converters, through the identification itself."""
    exact, rng = ideal(rig), np.random.default_rng(4)
    found: dict[str, list[float]] = {}
    for _ in range(DRAWS):
        records = tuple(measured(exact, one.record, rng) for one in played)
        rows = build_rows(exact, [Run(exact, records)], USED)
        for solution in solve_reductions(exact, USED, reduce_rows(exact, USED, rows)).values():
            for name, value in zip(solution.names, solution.value, strict=True):
                found.setdefault(name, []).append(float(value))
    ratios = {}
    for name, values in found.items():
        nominal = 1 / rig.nominal["b"] if name == "b" else rig.nominal[name]
        ratios[name] = np.std(values, ddof=1) / nominal / predicted.parameters[name].std
    assert len(ratios) == 16
    assert all(1 / 1.5 < ratio < 1.5 for ratio in ratios.values()), ratios
    # No parameter's own chance, all of them together: no systematic over- or understatement.
    assert np.mean(list(ratios.values())) == pytest.approx(1.0, abs=0.15)


def test_four_repeats_halve_the_error_and_two_steps_less_name_what_is_lost(
    rig: Rig, predicted: Prediction
) -> None:
    four = predict(rig, steps(repeats=4))
    for name, one in predicted.parameters.items():
        assert four.parameters[name].std == pytest.approx(one.std / 2, rel=1e-6)
        assert 1.9 * four.parameters[name].std < four.parameters[name].half
    alone = predict(rig, steps()[:1])
    lost = {name for name, p in alone.parameters.items() if p.note}
    assert {"M1", "Fv1", "W1", "C_pp_1", "C_mm_1"} <= lost
    assert not {"M2", "Fv2", "W2", "b", "C_pp_2"} & lost
    assert alone.rank["fluid"] == (5, 9)
    assert np.isnan(alone.parameters["W1"].std)
    assert to_json(alone)["parameters"]["W1"]["relative_std"] is None  # type: ignore[index]


def test_twice_the_noise_is_twice_the_error(rig: Rig, predicted: Prediction) -> None:
    sensors = rig.sensors
    parts = {}
    for name in type(sensors).model_fields:
        part = getattr(sensors, name)
        if hasattr(part, "noise"):
            # Finer converters, so that rounding does not blur the factor.
            parts[name] = part.model_copy(update={"noise": 2 * part.noise, "bits": 16})
    louder = rig.model_copy(update={"sensors": sensors.model_copy(update=parts)})
    for name, p in predict(louder, steps(repeats=1)).parameters.items():
        assert p.std == pytest.approx(2 * predicted.parameters[name].std, rel=0.01)


def test_a_shifted_piston_moves_everything_that_follows_from_it(
    rig: Rig, played: list[Played]
) -> None:
    """The pointwise sensitivities rest on this: geometry follows the piston, and nothing else."""
    record = played[1].record
    filters = default_filtering(record)
    bands = np.full(2, np.inf)
    signals = condition(ideal(rig), record, filters.channels, bands)
    from analysis.design.sensor_noise import Input

    by = 1e-4
    channels = {**record.channels, "piston_1": record.channels["piston_1"] + by}
    other = condition(ideal(rig), replace(record, channels=channels), filters.channels, bands)
    changed = shifted(rig, signals, Input("piston_1", 0, "s", 0), by)
    inner = slice(200, -200)
    for name in ("s", "sd", "q", "qd", "qdd", "G", "theta", "V_cap", "V_rod", "p_cap"):
        ours, theirs = getattr(changed, name)[inner], getattr(other, name)[inner]
        assert ours == pytest.approx(theirs, rel=1e-6, abs=1e-9 * np.abs(theirs).max()), name


def test_a_closed_valve_gives_on_the_twin_and_an_end_stop_does_not(
    played: list[Played],
) -> None:
    assert np.ptp(played[0].motion["piston"][:, 0]) > 1e-4
    assert np.ptp(played[1].motion["piston"][:, 1]) < 1e-12


def test_a_rig_without_nominal_values_is_told_what_is_missing(rig: Rig) -> None:
    nameless = rig.model_copy(update={"nominal": {}})
    with pytest.raises(InputError, match="nominal"):
        predict(nameless, steps())
