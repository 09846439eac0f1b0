"""What the bench's converters show of the truth, and the output law they feed."""

from __future__ import annotations

import numpy as np
import pytest

from hil_sim.plant import kernel_loop
from hil_sim.plant.interface import Law
from hil_sim.plant.kernel_data import record as record_of
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from rig.model.channels import kind_of
from rig.model.rig import Rig
from rig.model.wire.codes import decode_input, decode_output, encode_output
from tests.hil_sim.plant_trace import CLOSED, Array, bench, scenario, sine

QUIET = Scenario(noise=0.0)


def record(rig: Rig, what: Scenario, laws: list[Law], ticks: int, seed: int = 3) -> Array:
    """Return decoded samples (ticks, channels + joints), as a driver would."""
    codes, outputs = Plant(rig, what, seed).advance(ticks, laws)
    columns = []
    for k, name in enumerate(rig.channels):
        sensor = rig.sensors.of(kind_of(name)[0])
        columns.append(decode_input(codes[:, k], *sensor.range, sensor.bits))
    for i, joint in enumerate(rig.joints):
        valve = joint.valve
        columns.append(decode_output(outputs[:, i], valve.command_range, valve.command_bits))
    return np.stack(columns, axis=1)


def column(rig: Rig, name: str) -> int:
    return rig.recorded.index(name)


def truth(rig: Rig, laws: list[Law], ticks: int, name: str) -> Array:
    """Return the true signal at every tick's instant, before that tick's output acts."""
    plant, rows = Plant(rig, QUIET, 3), []
    kind, joint = kind_of(name)
    for _ in range(ticks):
        rows.append(np.atleast_1d(plant.snapshot()[kind])[(joint or 1) - 1])
        plant.advance(1, laws)
    return np.array(rows)


def test_the_same_seed_gives_the_same_records_however_they_are_asked_for() -> None:
    rig = bench()
    laws = [CLOSED, sine(rig, 1.0, position_gain=20.0)]
    once, again = Plant(rig, Scenario(), 5), Plant(rig, Scenario(), 5)
    whole, outputs = once.advance(300, laws)
    parts = [again.advance(n, laws) for n in (1, 10, 89, 200)]
    assert np.array_equal(whole, np.concatenate([p[0] for p in parts]))
    assert np.array_equal(outputs, np.concatenate([p[1] for p in parts]))
    assert once.tick == again.tick == 300
    other, _ = Plant(rig, Scenario(), 6).advance(300, laws)
    assert not np.array_equal(whole, other)
    assert whole.dtype == np.int64
    assert whole.shape == (300, len(rig.channels))


def test_noise_is_what_the_rig_states_and_scales_with_the_scenario() -> None:
    rig = bench()
    still = [CLOSED, CLOSED]
    for scale in (1.0, 3.0):
        data = record(rig, Scenario(noise=scale), still, 4000)
        for k, name in enumerate(rig.channels):
            sensor = rig.sensors.of(kind_of(name)[0])
            step = (sensor.range[1] - sensor.range[0]) / 65535
            drift = np.std(np.diff(data[:, k])) / np.sqrt(2)
            assert drift == pytest.approx(np.hypot(scale * sensor.noise, step / 3.46), rel=0.06)
    noise = np.diff(data[:, : len(rig.channels)], axis=0)
    correlated = np.corrcoef(noise, rowvar=False) - np.eye(len(rig.channels))
    assert np.max(np.abs(correlated)) < 0.08


def test_without_noise_only_the_converters_step_is_left() -> None:
    rig = bench(skew=0.0)
    laws = [CLOSED, sine(rig, 1.0, position_gain=20.0)]
    data = record(rig, QUIET, laws, 400)
    for name in rig.channels:
        sensor = rig.sensors.of(kind_of(name)[0])
        step = (sensor.range[1] - sensor.range[0]) / ((1 << sensor.bits) - 1)
        error = data[:, column(rig, name)] - truth(rig, laws, 400, name)
        assert np.max(np.abs(error)) < 0.51 * step, name


def test_coarse_converters_show_their_steps_and_saturate() -> None:
    rig = bench()
    narrow = rig.sensors.chamber_pressure.model_copy(update={"range": (0.0, 3.5e6), "bits": 8})
    rig = bench(chamber_pressure=narrow)
    laws = [CLOSED, sine(rig, 1.0, position_gain=20.0)]
    shown = record(rig, QUIET, laws, 400)[:, column(rig, "rod_pressure_2")]
    assert np.all(np.abs(shown / (3.5e6 / 255) - np.rint(shown / (3.5e6 / 255))) < 1e-6)
    assert np.max(shown) == 3.5e6


def test_the_multiplexer_takes_each_channel_a_little_later() -> None:
    rig = bench(skew=0.0)
    slow = bench(skew=40e-6)
    laws = [CLOSED, sine(rig, 1.0, 2.0)]
    for name in ("piston_2", "cap_pressure_2", "spool_2", "supply_pressure"):
        k = column(rig, name)
        together, skewed = (record(r, QUIET, laws, 500)[100:, k] for r in (rig, slow))
        rate = np.gradient(truth(rig, laws, 500, name), 1e-3)[100:]
        late = float(np.dot(rate, skewed - together) / np.dot(rate, rate))
        assert late == pytest.approx(k * 40e-6, rel=0.05), name


@pytest.mark.parametrize("delay", [0.3e-3, 2e-3, 7.4e-3])
def test_a_delayed_channel_shows_the_past(delay: float) -> None:
    rig = bench(skew=0.0)
    laws = [CLOSED, sine(rig, 1.0, 2.0)]
    late = scenario(f"{{name: channel_delay, channel: cap_pressure_2, time: {delay} s}}")
    what = late.model_copy(update={"noise": 0.0})
    shown = record(rig, what, laws, 600)
    fine = bench(10_000.0, skew=0.0)
    # The same command, held over the same milliseconds, watched ten times as often.
    wave = np.repeat(record(rig, QUIET, laws, 600)[:, column(rig, "command_2")], 10)
    true = truth(fine, [CLOSED, Law(wave=wave, gain=1.0, limit=4.0)], 6000, "cap_pressure_2")
    past = np.interp(np.arange(600) * 1e-3 - delay, np.arange(6000) * 1e-4, true)
    error = shown[:, column(rig, "cap_pressure_2")] - past
    assert np.max(np.abs(error)) < 2e-3 * np.ptp(true)
    plain = record(rig, QUIET, laws, 600)
    others = [k for k in range(len(rig.channels)) if k != column(rig, "cap_pressure_2")]
    assert np.array_equal(shown[:, others], plain[:, others])
    assert shown[0, column(rig, "cap_pressure_2")] == plain[0, column(rig, "cap_pressure_2")]


def test_a_rigs_own_sensor_delay_is_the_same_thing() -> None:
    rig = bench()
    laws = [CLOSED, sine(rig, 1.0, 2.0)]
    slow = rig.sensors.piston.model_copy(update={"delay": 2e-3})
    effects = "{name: channel_delay, channel: piston_1, time: 2 ms}, "
    effects += "{name: channel_delay, channel: piston_2, time: 2 ms}"
    a = record(bench(piston=slow), Scenario(), laws, 300)
    assert np.array_equal(a, record(rig, scenario(effects), laws, 300))


def test_a_sensor_reads_too_much() -> None:
    rig = bench()
    laws = [CLOSED, CLOSED]
    plain = record(rig, QUIET, laws, 20)
    text = "{name: sensor_gain, channel: cap_pressure_1, gain: 1.02}, "
    text += "{name: sensor_offset, channel: piston_2, offset: 0.5 mm}"
    wrong = record(rig, scenario(text).model_copy(update={"noise": 0.0}), laws, 20)
    ratio = wrong[:, column(rig, "cap_pressure_1")] / plain[:, column(rig, "cap_pressure_1")]
    assert ratio == pytest.approx(1.02, abs=1e-4)
    more = wrong[:, column(rig, "piston_2")] - plain[:, column(rig, "piston_2")]
    assert more == pytest.approx(0.5e-3, abs=2e-6)


def test_the_oil_stays_in_its_band_and_moves_slowly() -> None:
    rig = bench()
    shapes = []
    for seed in (1, 2, 3):
        plant = Plant(rig, QUIET, seed)
        table = record_of(plant.tables.bench)
        heat = np.array([kernel_loop.temperature(t, table) for t in np.arange(0.0, 1800.0)])
        assert 38.0 <= np.min(heat) < 39.0
        assert 41.0 < np.max(heat) <= 42.0
        assert np.max(np.abs(np.diff(heat))) < 0.05
        shown = record(rig, QUIET, [CLOSED, CLOSED], 5, seed)[:, column(rig, "oil_temperature")]
        assert shown == pytest.approx(heat[0], abs=1e-3)
        shapes.append(heat)
    assert np.max(np.abs(shapes[0] - shapes[1])) > 0.5


def test_outputs_follow_the_law_of_what_was_measured() -> None:
    rig = bench()
    wave = np.linspace(-1.0, 1.0, 70)
    first = Law(
        wave=wave, start=13, gain=1.5, bias=-0.2, position_gain=60.0, setpoint=4e-3, limit=1.2
    )
    second = Law(position_gain=100.0, setpoint=-2e-3, limit=0.15)
    data = record(rig, Scenario(), [first, second], 500)
    tick = np.arange(500)
    s1, s2 = (data[:, column(rig, f"piston_{i}")] for i in (1, 2))
    v1 = np.clip(1.5 * wave[(tick - 13) % 70] - 0.2 + 60.0 * (4e-3 - s1), -1.2, 1.2)
    v2 = np.clip(100.0 * (-2e-3 - s2), -0.15, 0.15)
    for i, v in ((1, v1), (2, v2)):
        expected = decode_output(encode_output(v, 10.0, 12), 10.0, 12)
        assert data[:, column(rig, f"command_{i}")] == pytest.approx(expected, abs=1e-12)
    assert np.max(np.abs(data[:, column(rig, "command_2")])) == pytest.approx(0.15, abs=5e-3)
    assert data[-1, column(rig, "piston_2")] == pytest.approx(-2e-3, abs=1.5e-3)


def test_the_spool_follows_its_command_as_a_second_order_valve() -> None:
    rig = bench(10_000.0, skew=0.0)
    t = np.arange(300) * 1e-4
    data = record(rig, QUIET, [CLOSED, Law(bias=1.0, limit=2.0)], 300)
    omega, zeta = 2 * np.pi * 100.0, 0.8
    held = data[0, column(rig, "command_2")] * 0.1
    fast = omega * np.sqrt(1 - zeta**2)
    sway = np.cos(fast * t) + zeta * omega / fast * np.sin(fast * t)
    expected = held * (1 - np.exp(-zeta * omega * t) * sway)
    assert data[:, column(rig, "spool_2")] == pytest.approx(expected, abs=4e-5)
    # A large step is held by the valve's rate, and by its stroke.
    big = record(rig, QUIET, [CLOSED, Law(bias=10.0, limit=10.0)], 600)[:, column(rig, "spool_2")]
    assert np.max(np.diff(big)) / 1e-4 == pytest.approx(140.0, rel=0.02)
    tall = rig.joints[1].valve.model_copy(update={"spool_stroke": 0.6})
    joint = rig.joints[1].model_copy(update={"valve": tall})
    short = rig.model_copy(update={"joints": (rig.joints[0], joint)})
    held_back = record(short, QUIET, [CLOSED, Law(bias=10.0, limit=10.0)], 600)
    assert np.max(held_back[:, column(rig, "spool_2")]) < 0.6 + 1e-4


def test_the_wrong_number_of_laws_is_refused() -> None:
    with pytest.raises(ValueError, match=r"1 laws for 2 joint"):
        Plant(bench(), Scenario(), 1).advance(1, [CLOSED])
