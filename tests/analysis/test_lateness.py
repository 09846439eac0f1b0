"""What it costs b that a host, not the device, takes the samples: against a direct computation."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources

import numpy as np
import pytest

from analysis.design.lateness import late_times, lateness_cost, taken_late
from analysis.design.predict import predict
from analysis.design.twin_records import TwinStep, play
from analysis.identify.identify import identify
from analysis.terms import baseline
from analysis.terms.base import Used
from rig.model.parse import parse_model
from rig.model.records import Record, Run
from rig.model.rig import Rig
from tests.analysis.designed_steps import steps

RATE = 200.0  # [Hz] of the host
FINER = 5  # times that is the clock of the direct computation
JITTER = 0.8e-3


def rig_at(rate: float) -> Rig:
    text = (resources.files("rig") / "shipped" / "shinshu-2dof.yaml").read_text("utf-8")
    return parse_model(Rig, text, "shinshu-2dof.yaml").model_copy(update={"sample_rate": rate})


def at_rate(rate: float) -> list[TwinStep]:
    """The steps of `designed_steps`, which are of 1 kHz, at another rate."""
    every = round(1000.0 / rate)
    return [
        replace(
            step,
            waves={joint: wave[::every] for joint, wave in step.waves.items()},
            samples=step.samples // every,
        )
        for step in steps(periods=2)
    ]


def test_a_sine_loses_what_linear_interpolation_takes() -> None:
    n, period = 20_000, 40.0
    w = 2 * np.pi / period
    t = np.arange(n)
    record = Record("r", "s", (), 1, 1.0, {"x": np.sin(w * t)})
    jitter, rng = 0.1, np.random.default_rng(3)
    found = taken_late(record, jitter, rng).channels["x"]
    # Between t0 = k - 1 + e and t1 = k + f the chord misses x'' (k - t0)(t1 - k) / 2 on average;
    # E[(1 - e) f] = (1 - j) j with e, f independent and exponential of mean j.
    lost = 0.5 * w**2 * (1 - jitter) * jitter
    kept = np.isfinite(found)
    wave = np.sin(w * t[kept])
    amplitude = found[kept] @ wave / (wave @ wave)
    assert kept.mean() > 0.98
    assert 1.0 - amplitude == pytest.approx(lost, rel=0.1)


def test_a_host_that_is_late_never_serves_two_ticks_at_once() -> None:
    times = late_times(3000, 1.0, np.random.default_rng(1))
    assert (np.diff(times) > 0).all()
    assert (np.diff(np.floor(times)) >= 1).sum() > 1000
    assert late_times(5, 0.0, np.random.default_rng(1)).tolist() == [0, 1, 2, 3, 4]


def test_the_cost_is_that_of_identifying_a_finer_twin_at_those_times() -> None:
    rig, fine = rig_at(RATE), rig_at(FINER * RATE)
    played = [play(rig, step) for step in at_rate(RATE)]
    used = [Used(term) for term in baseline()]
    cost = lateness_cost(rig, played, used, JITTER)
    assert cost is not None

    rng = np.random.default_rng(77)
    finer = [play(fine, step).record for step in at_rate(FINER * RATE)]

    def resampled(record: Record, late: float) -> Record:
        n = record.samples // FINER
        ticks, instants = np.arange(n) / RATE, np.arange(record.samples) / (FINER * RATE)
        times = ticks + rng.exponential(late, n) if late else ticks
        channels = {}
        for name, values in record.channels.items():
            taken = np.interp(times, instants, values)
            channels[name] = np.interp(ticks, times, taken)
        return replace(record, sample_rate=RATE, channels=channels, period=0, lines=())

    def bulk(late: float) -> float:
        records = tuple(
            replace(resampled(record, late), name=f"{record.step}_r{k}", repeat=k)
            for record in finer
            for k in (1, 2)
        )
        found = identify([Run(rig, records, source="twin")], estimator="plain")
        return found.estimates["b"].value

    shifts = [bulk(JITTER) / bulk(0.0) - 1.0 for _ in range(4)]
    assert abs(cost.shift) > 3e-4  # there is something to compare
    room = 3 * (cost.scatter + np.std(shifts)) + 0.15 * abs(cost.shift)
    assert cost.shift == pytest.approx(np.mean(shifts), abs=room)


def test_too_late_for_the_rate_leaves_no_b() -> None:
    rig, plan = rig_at(RATE), at_rate(RATE)
    told = predict(rig, plan, jitter=1.0 / RATE)
    assert told.lateness is not None
    assert np.isnan(told.lateness.shift)
    assert told.lateness.missing > 0.1
    assert np.isnan(told.parameters["b"].half)


@pytest.mark.slow
def test_the_predicted_interval_of_b_alone_is_widened_and_by_more_with_more_jitter() -> None:
    rig, plan = rig_at(RATE), at_rate(RATE)
    clocked = predict(rig, plan)
    late = [predict(rig, plan, jitter=jitter) for jitter in (0.2e-3, 0.8e-3)]
    assert clocked.lateness is None
    halves = [p.parameters["b"].half for p in (clocked, *late)]
    assert halves == sorted(halves)
    assert halves[2] > 1.2 * halves[0]
    for name, before in clocked.parameters.items():
        assert name == "b" or late[1].parameters[name].half == before.half
    for one, half in zip(late, halves[1:], strict=True):
        assert one.lateness is not None
        assert half == pytest.approx(one.lateness.widened(halves[0]))
        assert half >= halves[0] + abs(one.lateness.shift)
