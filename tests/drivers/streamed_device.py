"""What every device that streams blocks and plays laws does, over any wire: tests for its driver.

A module of tests inherits them, and has a fixture `driver` (connected, reset) and a fixture
`made_for` (rig to unconnected driver).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from drivers.base import OFF, DeviceError, Driver, OutputLaw
from rig.model.rig import Rig
from rig.model.wire.codes import decode_input
from tests.hil_sim.integrator import SPEED_PER_VOLT, seed_rig


def read(driver: Driver, blocks: int) -> np.ndarray:
    return np.vstack([driver.read_block().data for _ in range(blocks)])


def changed(rig: Rig, **update: object) -> Rig:
    return rig.model_copy(update=update)


def without_oil(rig: Rig) -> Rig:
    return changed(rig, sensors=rig.sensors.model_copy(update={"oil_temperature": None}))


def wider_pressure(rig: Rig) -> Rig:
    sensor = rig.sensors.chamber_pressure.model_copy(update={"range": (-1e5, 2e7)})
    return changed(rig, sensors=rig.sensors.model_copy(update={"chamber_pressure": sensor}))


class StreamedDevice:
    """Inherit it as `class TestMyDevice(StreamedDevice)`."""

    def test_a_device_says_who_it_is(self, driver: Driver) -> None:
        info = driver.info
        assert info is not None
        assert (info.identity, info.joints, info.channels) == ("shinshu-2dof", 2, 10)
        assert (info.sample_rate, info.block_samples, info.virtual_time) == (1000.0, 10, True)

    def test_an_uploaded_waveform_is_played_sample_by_sample(self, driver: Driver) -> None:
        wave = 3.0 * np.sin(2 * np.pi * np.arange(250) / 250)
        driver.upload(1, wave)
        driver.start()
        driver.read_block()
        law = OutputLaw(gain=0.5, bias=0.25, limit=1.5)
        tick = driver.apply([OFF, law], restart=True)
        blocks = [driver.read_block() for _ in range(75)]
        assert blocks[0].tick == tick
        data = np.vstack([block.data for block in blocks])
        wanted = np.clip(0.5 * np.tile(wave, 3) + 0.25, -1.5, 1.5)
        # One step of the 12-bit converter is 10 V / 2047; the stored waveform is finer than that.
        assert data[:, 11] == pytest.approx(wanted, abs=0.51 * 10 / 2047 + 1e-4)
        assert np.all(data[:, 10] == 0.0)
        # The plant integrates exactly what was put out: s_k = s_0 + rate sum v.
        moved = SPEED_PER_VOLT * np.concatenate([[0.0], np.cumsum(data[:-1, 11])]) / 1000.0
        assert data[:, 5] - data[0, 5] == pytest.approx(moved, abs=80e-3 / 65535)
        assert [block.tick - tick for block in blocks] == list(range(0, 750, 10))
        assert not any(block.tripped for block in blocks)

    def test_a_second_apply_keeps_the_phase_unless_told_to_restart(self, driver: Driver) -> None:
        driver.upload(0, np.linspace(-1.0, 1.0, 1000))
        driver.start()
        driver.apply([OutputLaw(gain=1.0, limit=4.0), OFF], restart=True)
        before = read(driver, 10)[:, 10]
        driver.apply([OutputLaw(gain=2.0, limit=4.0), OFF])
        after = read(driver, 10)[:, 10]
        driver.apply([OutputLaw(gain=2.0, limit=4.0), OFF], restart=True)
        again = read(driver, 1)[:, 10]
        step = 10 / 2047
        assert before[-1] == pytest.approx(-1.0 + 2.0 * 99 / 999, abs=step)
        assert after[0] == pytest.approx(2 * (-1.0 + 2.0 * 100 / 999), abs=step)
        assert again[0] == pytest.approx(-2.0, abs=step)

    def test_an_upload_acts_from_the_next_apply_on(self, driver: Driver) -> None:
        driver.upload(0, np.full(3, 1.0))
        driver.start()
        law = OutputLaw(gain=1.0, limit=4.0)
        driver.apply([law, OFF], restart=True)
        driver.upload(0, np.full(5, -2.0))
        assert read(driver, 3)[:, 10] == pytest.approx(1.0, abs=0.01)
        driver.apply([law, OFF])
        assert read(driver, 3)[:, 10] == pytest.approx(-2.0, abs=0.01)

    def test_the_position_law_pulls_the_piston_to_its_setpoint(self, driver: Driver) -> None:
        driver.start()
        driver.apply([OutputLaw(position_gain=400.0, setpoint=0.01, limit=3.0), OFF])
        data = read(driver, 150)
        # Closed loop: ds/dt = 0.02 * 400 (r - s) has a time constant of 1/8 s.
        assert data[-1, 1] == pytest.approx(0.01, abs=20e-6)
        assert data[:, 10].max() <= 3.0

    def test_samples_are_decoded_with_the_rigs_sensors(self, driver: Driver) -> None:
        rig = seed_rig()
        driver.start()
        block = driver.read_block()
        for column, name in enumerate(rig.channels[:8]):
            value = 2.0e6 if "pressure" in name else block.data[0, column]
            sensor = rig.sensors.of(name[:-2])
            code = round((value - sensor.range[0]) / (sensor.range[1] - sensor.range[0]) * 65535)
            assert block.data[0, column] == decode_input(code, *sensor.range, 16)
        # The plant's temperature register counts samples, so code 0 would be saturated.
        count = block.data[:, 9] * 65535 / 100.0
        assert count == pytest.approx((block.tick + np.arange(10)) & 0xFFFF, abs=1e-6)
        assert block.data.shape == (10, 12)
        assert block.saturated.shape == (10, 10)
        assert not block.saturated[:, :9].any()

    @pytest.mark.parametrize(
        ("make", "says"),
        [
            (lambda r: changed(r, joints=r.joints[:1]), "joints 2, expected 1"),
            (without_oil, "channels 10, expected 9"),
            (lambda r: changed(r, sample_rate=2000.0), r"sample rate \[Hz\] 1000, expected 2000"),
            (lambda r: changed(r, name="other"), "rig 'shinshu-2dof', expected 'other'"),
            (wider_pressure, "other ranges or bits"),
        ],
    )
    def test_a_device_of_another_rig_is_refused(
        self, made_for: Callable[[Rig], Driver], make: Callable[[Rig], Rig], says: str
    ) -> None:
        with pytest.raises(DeviceError, match=says):
            made_for(make(seed_rig())).connect()

    @pytest.mark.parametrize(
        ("law", "says"),
        [
            (OutputLaw(bias=float("nan"), limit=1.0), "not finite"),
            (OutputLaw(gain=float("inf"), limit=1.0), "not finite"),
            (OutputLaw(limit=10.1), "out of range"),
            (OutputLaw(limit=-1.0), "out of range"),
            (OutputLaw(setpoint=0.05, limit=1.0), "out of range"),
            (OutputLaw(gain=1e39), "not finite"),
        ],
    )
    def test_an_impossible_law_is_refused_and_changes_nothing(
        self, driver: Driver, law: OutputLaw, says: str
    ) -> None:
        driver.start()
        driver.apply([OFF, OutputLaw(bias=0.5, limit=1.0)])
        with pytest.raises(DeviceError, match=rf"joint 2\): a value is {says}"):
            driver.apply([OFF, law])
        assert read(driver, 1)[-1, 11] == pytest.approx(0.5, abs=0.01)

    def test_a_waveform_that_cannot_be_put_out_is_refused(self, driver: Driver) -> None:
        wave = np.zeros(100)
        wave[37] = 10.5
        with pytest.raises(DeviceError, match=r"joint 1: sample 37 is 10.5 V.*\+-10 V"):
            driver.upload(0, wave)
        wave[37] = np.nan
        with pytest.raises(DeviceError, match="sample 37"):
            driver.upload(0, wave)
        for size, says in ((0, "is empty"), (131_073, "1 to 131072")):
            with pytest.raises(DeviceError, match=says):
                driver.upload(0, np.zeros(size))
        with pytest.raises(DeviceError, match="no joint 3"):
            driver.upload(2, np.zeros(3))

    def test_zero_outputs_acts_between_two_blocks(self, driver: Driver) -> None:
        driver.start()
        driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
        assert read(driver, 1)[:, 10].min() > 0.9
        driver.zero_outputs()
        assert np.all(read(driver, 1)[:, 10:] == 0.0)

    def test_reading_without_a_stream_says_so(self, driver: Driver) -> None:
        with pytest.raises(DeviceError, match="does not stream"):
            driver.read_block()
        driver.start()
        driver.read_block()
        driver.stop()
        with pytest.raises(DeviceError, match="does not stream"):
            driver.read_block()
