"""The page about the CAN wire says what Python does."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import drivers.message_link
from drivers.base import OFF, DeviceError, OutputLaw
from drivers.can_stream import CanStreamDriver
from drivers.message_stream import MessageStreamDriver
from drivers.settings import DRIVER
from hil_sim.device.can.server import CanSession, layout_of
from hil_sim.device.device import Device
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire import can_layout as names
from rig.model.wire import registers as reg
from rig.model.wire.can_frames import CanFrame, stream_seconds
from rig.runs.rigs import load_rig
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

PAGE = (Path(__file__).parents[2] / "docs" / "wire-can.md").read_text("utf-8")
SESSION = 0x1A2B3C4D
BUSES = ((500e3, 500e3), (1e6, 1e6), (1e6, 2e6), (1e6, 5e6))


def test_every_signal_stands_on_the_page_with_its_message() -> None:
    layout = layout_of(seed_rig())
    table = dict(re.findall(r"^\| `(\w+)`(?: \.\.\.)? \| (0x[0-9A-F]{3}.*)", PAGE, re.M))
    messages = [*layout.from_host, *layout.from_bench[:3], layout.check]
    assert set(table) == {message.name for message in messages}
    for message in messages:
        assert table[message.name].startswith(f"0x{message.identifier:03X}")
        for signal in message.signals.values():
            if signal.name not in layout.columns:
                assert f"`{signal.name}` {signal.bits}" in table[message.name]
    assert f"more than {100 * DRIVER.bus_load:.0f} % of the bus" in PAGE
    assert names.SESSION_BITS == 15


def of_rate(name: str, rate: float) -> Rig:
    return load_rig(name).model_copy(update={"sample_rate": rate})


def loads() -> Iterator[str]:
    for name, rate in (
        ("boom-1dof", 1000.0),
        ("shinshu-2dof", 500.0),
        ("shinshu-2dof", 1000.0),
        ("digger-3dof", 1000.0),
        ("digger-3dof", 2000.0),
    ):
        rig = of_rate(name, rate)
        block = reg.block_layout(len(rig.channels), len(rig.joints))
        shares = []
        for slow, fast in BUSES:
            layout = layout_of(rig, fd=slow != fast)
            seconds = stream_seconds(layout, block, slow, fast)
            shares.append(f"{100 * seconds * rate / block.samples:.0f} %")
        shown = f"{rate / 1000:g} kHz" if rate >= 1000 else f"{rate:g} Hz"
        yield f"| {len(rig.channels)} + {len(rig.joints)} | {shown} | {' | '.join(shares)} |"


def test_the_table_of_loads_is_what_the_driver_reckons_with() -> None:
    table = PAGE.split("<!-- loads -->")[1].split("<!-- end -->")[0].strip().splitlines()
    assert table[2:] == list(loads())


class Loop:
    """A `CanPort` to a device in this process; what passes is written down."""

    where = "loop"

    def __init__(self, rig: Rig) -> None:
        self.device = Device(rig, IntegratorPlant(rig), realtime=False, clock=lambda: 0.0)
        self.session = CanSession(self.device, layout_of(rig))
        self.is_open = False
        self.lines: list[str] = []
        self._waiting: list[CanFrame] = []

    def open(self, *, shared: bool = False) -> None:
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def send(self, frame: CanFrame) -> None:
        self.lines.append(said("->", frame))
        answers = self.session.receive([frame])
        while block := self.session.push():
            answers += block
        self.lines += [said("<-", answer) for answer in answers]
        self._waiting += answers

    def receive(self, timeout: float) -> list[tuple[int, bytes]]:
        frames, self._waiting = self._waiting, []
        return [(frame.identifier, frame.data) for frame in frames]


def said(arrow: str, frame: CanFrame) -> str:
    return f"{arrow} {frame.identifier:03X}  {frame.data.hex(' ').upper()}"


@contextmanager
def known_session() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drivers.message_link.secrets, "randbits", lambda _bits: SESSION)
        yield


def spoken() -> list[str]:
    """The frames of a little session, as the page prints them."""
    rig = seed_rig()
    loop = Loop(rig)
    wire = Wire(kind="can", bus="virtual/loop", watchdog=0.5)
    with known_session():
        driver: MessageStreamDriver = CanStreamDriver(wire, rig, port=loop)  # type: ignore[arg-type]
        driver.connect()
    driver._heartbeat = 8
    driver.start()
    driver.apply([OutputLaw(bias=0.5, limit=1.0), OFF])
    driver.read_block()
    with pytest.raises(DeviceError, match="out of range"):
        driver.apply([OFF, OutputLaw(limit=-1.0)])
    driver.close()
    return loop.lines


def test_the_printed_frames_are_those_of_a_session() -> None:
    listing = re.search(r"## Frames of a session.*?```\n(.*?)```", PAGE, re.S)
    assert listing is not None
    printed = [re.split(r"(?<=\S)   ", line)[0] for line in listing[1].splitlines()]
    frames = spoken()
    skipping = False
    for line in printed:
        if line == "...":
            skipping = True  # whatever follows, up to the next line that is printed
            continue
        while skipping and frames and frames[0] != line:
            frames.pop(0)
        assert frames[:1] == [line]
        frames.pop(0)
        skipping = False
    assert len(printed) > 15
    assert frames == []
