"""The simulated bench on a serial line: a `Device` behind a pty, until a signal.

When the last program closes the port, the device counts its host as lost, as if by DTR.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

from hil_sim.device.device import Device, PlantInterface
from hil_sim.device.lifetime import run_until, termination_signals
from hil_sim.device.pty_line import PtyLine
from hil_sim.device.serial_session import SerialSession
from hil_sim.faults.device import DeviceFault
from rig.model.rig import Rig

logger = logging.getLogger(__name__)


def serve_serial(
    rig: Rig,
    plant: PlantInterface,
    *,
    realtime: bool = False,
    on_ready: Callable[[str], None] = logger.info,
    parent: int | None = None,
    faults: Sequence[DeviceFault] = (),
) -> None:
    """Serve a plant on a new pty until SIGTERM, SIGINT or the end of process `parent`.

    `on_ready` is called once with the endpoint, ``serial:///dev/pts/3``. The sample clock starts
    with this call. Raises EndpointError where there are no pseudo terminals.
    """
    line = PtyLine()
    device = Device(rig, plant, realtime=realtime, faults=faults)
    try:
        with termination_signals() as ended:
            on_ready(f"serial://{line.name}")
            serve_port(line, device, ended, parent)
    finally:
        device.zero()
        line.close()


def serve_port(
    line: PtyLine,
    device: Device,
    ended: Sequence[object],
    parent: int | None = None,
    lock: AbstractContextManager[object] | None = None,
) -> None:
    """Serve a device on a pty until `ended` is not empty, or process `parent` has ended.

    `lock` is held except while waiting for bytes, for other users of the device.
    """
    lock = lock or nullcontext()
    session = SerialSession(device)

    def step() -> None:
        received = line.receive(device.idle_seconds())
        with lock:
            if received is None:
                session.ended()
            elif received:
                line.send(session.receive(received))
            device.poll()
            while line.free and (block := session.push()):
                line.send(block)

    run_until(ended, parent, step)
