"""A CAN bus behind an adapter, between host and device a link that fails: what the host reads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from drivers import make_driver, wire_at
from drivers.base import DeviceLost, OutputLaw
from drivers.can_stream import CanStreamDriver
from hil_sim.device.device import Device
from hil_sim.device.server import CAN, SLCAN
from hil_sim.faults.wire import (
    BitsFlipped,
    FrameDuplicated,
    FrameLost,
    FramesReordered,
    LateAnswer,
    WireFault,
)
from hil_sim.link.served import ServedDevice
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

BLOCKS = 25
SOME = 0.02  # of the frames
WIRES = (CAN, SLCAN)


@contextmanager
def served(wire: str, timeout: float = 2.0) -> Iterator[tuple[ServedDevice, CanStreamDriver]]:
    """A device on a bus, and the driver that reaches it through a link healthy so far."""
    rig = seed_rig()
    device = Device(rig, IntegratorPlant(rig), realtime=False)
    with ServedDevice(device, wire, seed=5) as bench:
        patient = rig.wire.model_copy(update={"timeout": timeout})
        driver = make_driver(wire_at(bench.link.endpoint, patient), rig)
        try:
            yield bench, driver
        finally:
            bench.link.use([])
            driver.close()


def streamed(driver: CanStreamDriver) -> np.ndarray:
    """Return ticks (blocks * samples, 1) and samples of a stream while joint 1 moves."""
    rows = []
    for _ in range(BLOCKS):
        block = driver.read_block()
        ticks = block.tick + np.arange(len(block.data))[:, None]
        rows.append(np.hstack([ticks, block.data]))
    return np.vstack(rows)


@pytest.mark.parametrize("wire", [CAN, pytest.param(SLCAN, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "fault",
    [
        FrameLost(name="frame_lost", probability=SOME),
        FrameDuplicated(name="frame_duplicated", probability=SOME),
        FramesReordered(name="frames_reordered", probability=SOME),
        LateAnswer(name="late_answer", probability=SOME),
        BitsFlipped(name="bits_flipped", probability=SOME),
    ],
    ids=lambda fault: fault.name,
)
def test_no_sample_is_lost_taken_twice_or_changed(wire: str, fault: WireFault) -> None:
    """The integrator's piston moves by the same step at every tick, so each sample is known."""
    with served(wire) as (bench, driver):
        driver.connect()
        driver.apply([OutputLaw(bias=0.5, limit=1.0), OutputLaw()])
        driver.start()
        streamed(driver)
        bench.link.use([fault])
        rows = streamed(driver)
        assert bench.link.injected[fault.name] >= 5
    assert (np.diff(rows[:, 0]) == 1).all()
    column = 1 + driver._rig.channels.index("piston_1")
    steps = np.diff(rows[:, column])
    assert steps.max() - steps.min() < 1e-4  # steps of the converter
    assert steps.mean() > 0


def test_text_that_an_adapters_line_damages_costs_no_session() -> None:
    damage = BitsFlipped(name="bits_flipped", probability=SOME, bits=3, past_checksum=True)
    with served(SLCAN) as (bench, driver):
        driver.connect()
        driver.start()
        bench.link.use([damage])
        rows = streamed(driver)
        assert bench.link.injected["bits_flipped"] >= 5
    assert (np.diff(rows[:, 0]) == 1).all()


@pytest.mark.parametrize("wire", WIRES)
def test_a_late_answer_is_not_taken_for_that_of_the_next_request(wire: str) -> None:
    with served(wire) as (bench, driver):
        driver.connect()
        driver.start()
        first = driver.apply([OutputLaw(bias=0.1, limit=1.0), OutputLaw()])
        for _ in range(5):
            driver.read_block()
        bench.link.use([LateAnswer(name="late_answer", probability=0.3)])
        second = driver.apply([OutputLaw(bias=0.2, limit=1.0), OutputLaw()])
        bench.link.use([])
        for _ in range(5):
            driver.read_block()
        assert driver.apply([OutputLaw(), OutputLaw()]) > second >= first + 10


def test_a_bus_of_error_frames_is_named_with_its_bit_rate() -> None:
    with served(CAN, timeout=0.1) as (bench, driver):
        bench.link.use([BitsFlipped(name="bits_flipped")])
        with pytest.raises(DeviceLost, match=r"\d+ error frames came: check that every node runs"):
            driver.connect()


def test_blocks_that_never_come_whole_are_named_as_damaged_not_as_unmeasured() -> None:
    with served(CAN, timeout=0.1) as (bench, driver):
        driver.connect()
        driver.start()
        driver.read_block()
        bench.link.use([BitsFlipped(name="bits_flipped", probability=0.12)])
        with pytest.raises(DeviceLost, match=r"no block came whole; .* error frames|not answered"):
            streamed(driver)
