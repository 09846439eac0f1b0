"""A plain I/O module behind a link that fails: no sample is ever that of another request."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.base import OFF, DeviceError, DeviceLost, OutputLaw
from drivers.modbus_map import ModbusMapDriver
from hil_sim.faults import CLASSES
from hil_sim.faults.wire import WireFault
from hil_sim.link.link import FaultyLink
from hil_sim.link.wires import faulty_link
from tests.drivers.plain_module import SPEED_PER_VOLT, STEP, module_process
from tests.drivers.test_modbus_map import COLUMN, in_fake_time, put_out, rig_of

KINDS = {kind.fault_name(): kind for kind in CLASSES if issubclass(kind, WireFault)}
TIMEOUT = ("timeout: 5 s", "timeout: 0.5 s")
BLOCKS = 12
# What TCP and transaction numbers make harmless, and what leaves a request without its answer.
HARMLESS = {
    "frame_late": {"delay": 0.02, "probability": 0.2},
    "frame_duplicated": {"probability": 0.2},
    "frame_split": {"probability": 0.2},
    "frames_merged": {"probability": 0.2},
    "bits_flipped": {"probability": 0.05},
    "slow_consumer": {},
    "stall": {"time": 0.1},
}
ENDING = {
    "frame_lost": {"probability": 0.05},
    "late_answer": {"probability": 0.05},
    "frames_reordered": {"probability": 0.05},
    "link_half_closed": {"probability": 0.05},
    "link_closed": {"probability": 0.05},
}


@pytest.fixture(scope="module")
def module() -> Iterator[int]:
    with module_process() as (_, port):
        yield port


@pytest.fixture
def link(module: int) -> Iterator[FaultyLink]:
    with faulty_link(f"modbus-map://127.0.0.1:{module}", seed=11) as link:
        yield link


def fault(name: str, keys: dict[str, float]) -> WireFault:
    return KINDS[name].model_validate({"name": name, **keys})


def reached(link: FaultyLink) -> ModbusMapDriver:
    return in_fake_time(rig_of(int(link.endpoint.rsplit(":", 1)[1]), TIMEOUT))


def streaming(driver: ModbusMapDriver) -> None:
    """Connect and play a sine on joint 2, whose piston integrates it write by write."""
    driver.connect()
    driver.start()
    driver.upload(1, 2.0 * np.sin(2 * np.pi * np.arange(40) / 40))
    driver.apply([OFF, OutputLaw(gain=0.5, limit=1.0)], restart=True)
    driver.read_block()


def assert_each_sample_is_of_its_own_request(blocks: list[np.ndarray]) -> None:
    """The piston of each sample is the one before plus what was put out in between."""
    data = np.vstack(blocks)
    steps = np.diff(data[:, COLUMN["piston_2"]])
    put = SPEED_PER_VOLT * STEP * data[:-1, COLUMN["command_2"]]
    assert steps == pytest.approx(put, abs=2e-6)  # registers hold steps of 1 um and 5 mV
    if len(put) > 20:  # half a period: the answer of the request before would be off by 30 um
        assert np.ptp(put) > 1e-4


def test_every_fault_of_the_wire_is_tried() -> None:
    assert set(HARMLESS) | set(ENDING) == set(KINDS)


@pytest.mark.parametrize("name", HARMLESS)
def test_what_only_disturbs_the_link_changes_no_sample(link: FaultyLink, name: str) -> None:
    driver = reached(link)
    streaming(driver)
    link.use([fault(name, HARMLESS[name])])
    blocks = [driver.read_block().data for _ in range(BLOCKS)]
    assert link.injected[name] >= 1
    driver.close()
    assert_each_sample_is_of_its_own_request(blocks)


@pytest.mark.parametrize("name", ENDING)
def test_a_request_without_its_answer_ends_the_link_and_the_next_one_begins_clean(
    link: FaultyLink, module: int, name: str
) -> None:
    driver = reached(link)
    streaming(driver)
    link.use([fault(name, ENDING[name])])
    blocks: list[np.ndarray] = []

    def read_on() -> None:
        for _ in range(100):
            blocks.append(driver.read_block().data)

    with pytest.raises(DeviceLost, match=r"does not answer|closed the connection"):
        read_on()
    if len(blocks) > 1:
        assert_each_sample_is_of_its_own_request(blocks)
    link.use([])
    end = time.monotonic() + 10.0
    while any(put_out(module)) and time.monotonic() < end:
        time.sleep(0.05)  # the module's own watchdog
    assert put_out(module) == [0.0, 0.0]
    again = reached(link)
    streaming(again)
    blocks = [again.read_block().data for _ in range(4)]
    again.close()
    assert_each_sample_is_of_its_own_request(blocks)


def test_answers_that_all_come_one_request_late_are_never_taken(link: FaultyLink) -> None:
    """Ask again and again over one link whose answers each wait for the next request."""
    driver = reached(link)
    link.use([fault("late_answer", {})])
    for _ in range(3):
        with pytest.raises(DeviceError, match="does not answer"):
            driver.connect()
    link.use([])
    driver.connect()
    driver.close()
