"""The acquisition figures: from a made-up stream with known faults, and from a real one."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from drivers.base import DeviceInfo, SampleBlock
from drivers.modbus_tcp import ModbusTcpDriver
from rig.cli.bench.acquisition import measure_acquisition
from tests.drivers.wires import device_process
from tests.hil_sim.integrator import seed_rig

INFO = DeviceInfo("made up", 1, 4, 1000.0, 10, virtual_time=False)


class Script:
    """A driver that hands out blocks of ten samples at given ticks, and its clock."""

    def __init__(self, stream: Iterable[tuple[int, float]]) -> None:
        self._stream = iter(stream)
        self.now = 0.0
        self.stopped = False

    def start(self) -> None:
        pass

    def stop(self) -> None:
        self.stopped = True

    def read_block(self) -> SampleBlock:
        tick, self.now = next(self._stream)
        none = np.zeros((10, 4), dtype=np.bool_)
        return SampleBlock(tick // 10, tick, np.zeros((10, 5)), none, 0, tripped=False)

    def clock(self) -> float:
        return self.now


def test_an_even_stream_has_no_losses_and_no_jitter() -> None:
    script = Script((tick, 5.0 + (tick + 10) * 1.0001e-3) for tick in range(0, 2000, 10))
    figures = measure_acquisition(script, INFO, 1.0, script.clock)  # type: ignore[arg-type]
    assert (figures["samples"], figures["lost_samples"], figures["blocks"]) == (1000, 0, 100)
    assert figures["lateness_max_s"] == pytest.approx(0.0, abs=1e-9)
    assert figures["clock_drift_ppm"] == pytest.approx(100.0, rel=1e-3)
    assert script.stopped


def test_losses_disorder_and_lateness_are_counted() -> None:
    ticks = [0, 10, 20, 50, 60, 40, 70, *range(80, 1000, 10)]
    late = {60: 0.004}
    script = Script((t, (t + 10) / 1000.0 + late.get(t, 0.0)) for t in ticks)
    figures = measure_acquisition(script, INFO, 1.0, script.clock)  # type: ignore[arg-type]
    assert figures["lost_samples"] == 20
    assert figures["out_of_order_blocks"] == 1
    assert figures["lateness_max_s"] == pytest.approx(0.004, rel=0.1)


def test_virtual_time_has_no_lateness_to_measure() -> None:
    virtual = DeviceInfo("made up", 1, 4, 1000.0, 10, virtual_time=True)
    script = Script([])
    with pytest.raises(ValueError, match="real time"):
        measure_acquisition(script, virtual, 1.0)  # type: ignore[arg-type]


def test_a_second_in_real_time_loses_nothing() -> None:
    with device_process("realtime") as (_, port):
        rig = seed_rig(port=port, timeout=10.0, watchdog=5.0)
        driver = ModbusTcpDriver(rig.wire, rig)
        figures = measure_acquisition(driver, driver.connect(), 1.0)
        driver.close()
    assert (figures["samples"], figures["lost_samples"]) == (1000, 0)
    assert figures["out_of_order_blocks"] == 0
    # The device's seconds are the wall's: rates agree as far as a loaded machine shows.
    assert abs(figures["clock_drift_ppm"]) < 2e5
