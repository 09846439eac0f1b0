"""The simulated bench on a CAN bus: a `Device` behind an adapter, until a signal.

A node of a bus cannot detect the end of a program; its watchdog zeroes the outputs then.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

from hil_sim.device.can.adapters import Adapter
from hil_sim.device.can.session import CanSession
from hil_sim.device.device import Device, PlantInterface
from hil_sim.device.lifetime import run_until, termination_signals
from hil_sim.faults.device import DeviceFault
from rig.model.rig import Rig
from rig.model.wire.can_database import database_text
from rig.model.wire.can_layout import CanLayout, read_layout

logger = logging.getLogger(__name__)


def layout_of(rig: Rig, *, fd: bool = False) -> CanLayout:
    """Return the messages of the default DBC file of a rig."""
    return read_layout(database_text(rig, fd=fd), f"the DBC made for {rig.name}", rig)


def serve_can(
    rig: Rig,
    plant: PlantInterface,
    adapter: Adapter,
    *,
    layout: CanLayout | None = None,
    realtime: bool = False,
    on_ready: Callable[[str], None] = logger.info,
    parent: int | None = None,
    faults: Sequence[DeviceFault] = (),
) -> None:
    """Serve a plant on a bus until SIGTERM, SIGINT or the end of process `parent`.

    `on_ready` is called once with the adapter's endpoint; the sample clock starts with this call.
    """
    device = Device(rig, plant, realtime=realtime, faults=faults)
    try:
        with termination_signals() as ended:
            on_ready(adapter.endpoint)
            run_device(adapter, device, layout or layout_of(rig), ended, parent)
    finally:
        device.zero()
        adapter.close()


def run_device(
    adapter: Adapter,
    device: Device,
    layout: CanLayout,
    ended: Sequence[object],
    parent: int | None = None,
    lock: AbstractContextManager[object] | None = None,
) -> None:
    """Serve a device until `ended` is not empty, or process `parent` has ended.

    `lock` is held except while waiting for frames, for other users of the device.
    """
    lock = lock or nullcontext()
    session = CanSession(device, layout)

    def step() -> None:
        received = adapter.receive(device.idle_seconds())
        with lock:
            for frame in received:
                adapter.send(session.receive(frame))
            device.poll()
            while adapter.free and (block := session.push()):
                adapter.send(block)

    run_until(ended, parent, step)
