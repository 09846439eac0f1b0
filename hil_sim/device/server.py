"""The simulated bench as a server: a `Device` behind a wire, until a signal."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

from pymodbus.constants import ExcCodes
from pymodbus.exceptions import ModbusIOException
from pymodbus.pdu import ExceptionResponse
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.transport import ModbusProtocol

from hil_sim.device.device import Device
from hil_sim.device.laws import LawTable
from hil_sim.device.lifetime import (
    ParentProcess,
    WireEnd,
    WireSession,
    cannot_listen,
    serve_session,
    termination_signals,
    while_served,
)
from hil_sim.device.message_session import SerialSession
from hil_sim.device.pdu import REQUESTS, Request
from hil_sim.device.pty_line import PtyLine
from hil_sim.device.register_map import DeviceRegisters
from hil_sim.device.rtu_server import RtuSession
from hil_sim.faults.device import DeviceFault
from hil_sim.plant.interface import PlantInterface
from rig.model.parts import LOCALHOST
from rig.model.rig import Rig
from rig.model.wire import registers as reg

if TYPE_CHECKING:
    from rig.model.wire.can_layout import CanLayout

logger = logging.getLogger(__name__)

TCP: Final = "modbus-tcp"
RTU: Final = "modbus-rtu"
SERIAL: Final = "serial"
CAN: Final = "can"
SLCAN: Final = "can-slcan"
VALVES: Final = "canopen-408"  # always in real time: the host is the sample clock
WIRES: Final = (TCP, RTU, SERIAL, CAN, SLCAN, VALVES)
BITRATE: Final = 1_000_000  # of the simulated bus by default
ACCEPT_SECONDS: Final = 0.01  # for connections that have begun: they are closed, not reset


class _Connection(ServerRequestHandler):
    """One connection, which answers requests in order as they arrive, possibly several at once.

    The library would handle every request in another iteration of the event loop, which takes
    longer than the answer, and would lose a second request of the same segment.
    """

    def __init__(self, server: BenchServer, device: Device, registers: DeviceRegisters) -> None:
        super().__init__(server, None, None, self._connection)  # type: ignore[no-untyped-call]
        self._device = device
        self._registers = registers

    def data_received(self, data: bytes) -> None:
        """Answer every complete request; keep an incomplete one."""
        received = self.recv_buffer + data
        used = 1
        while received and used:
            used = self._answer_first(received)
            received = received[used:]
        self.recv_buffer = received if len(received) <= self.max_buffer_size else b""
        self._device.prefetch()

    def _answer_first(self, data: bytes) -> int:
        """Answer the request that begins `data`; return its length, 0 while it is incomplete."""
        try:
            used, request = self.framer.handleFrame(data, 0, 0)
        except ModbusIOException as error:
            refusal = ExceptionResponse(
                error.fcode or 0,
                ExcCodes.ILLEGAL_FUNCTION,
                device_id=error.dev_id,
                transaction=error.transaction_id,
            )
            self.pdu_send(refusal)
            return len(data)
        if request is None:
            return used
        if isinstance(request, Request):
            answer = request.response_to(self._registers, self)
        else:
            answer = ExceptionResponse(request.function_code, ExcCodes.ILLEGAL_FUNCTION)
        answer.transaction_id, answer.dev_id = request.transaction_id, request.dev_id
        if self.transport:  # the device may have restarted meanwhile
            self.pdu_send(answer)
        return used

    def _connection(self, connected: bool) -> None:
        """Pass the end of the connection on; a booting device accepts none."""
        if not connected:
            self._device.disconnected(self)
        elif self._device.restarting:
            _abort(self)


class BenchServer(ModbusTcpServer):
    """A Modbus TCP server with one device's registers."""

    def __init__(self, device: Device, host: str, port: int) -> None:
        # The library requires a store, which is not used.
        store = SimDevice(0, simdata=SimData(0, values=0, datatype=DataType.REGISTERS))
        super().__init__(store, address=(host, port), custom_pdu=REQUESTS)
        self._address = (host, port)
        self._device = device
        device.on_restart = self.abort_connections
        self._registers = DeviceRegisters(device)

    async def listen(self) -> bool:
        """Open the socket; raises EndpointError with the reason, which the library omits."""
        host, port = self._address
        self.is_closing = False
        self.is_listener = True
        try:
            self.transport = await self.call_create()
        except OSError as error:
            raise cannot_listen(host, port, error) from error
        return True

    def callback_new_connection(self) -> ServerRequestHandler:
        """Make the handler of one connection."""
        return _Connection(self, self._device, self._registers)

    def abort_connections(self) -> None:
        """Abort every connection, as a restart does."""
        for handler in list(self.active_connections.values()):
            _abort(handler)

    @property
    def endpoint(self) -> str:
        """The actual endpoint: ``modbus-tcp://127.0.0.1:40213``."""
        host, port = self.transport.sockets[0].getsockname()[:2]  # type: ignore[attr-defined]
        return f"modbus-tcp://{host}:{port}"


async def serve_tcp(
    device: Device,
    host: str,
    port: int,
    on_ready: Callable[[str], None],
    ended: Sequence[object],
    parent: ParentProcess | None = None,
) -> None:
    """Serve a device behind Modbus TCP until `ended` is not empty, or process `parent` has ended.

    `on_ready` gets the endpoint. Raises EndpointError.
    """
    server = BenchServer(device, host, port)
    await server.serve_forever(background=True)
    try:
        on_ready(server.endpoint)
        for _ in while_served(ended, parent):
            device.poll()
            await asyncio.sleep(device.idle_seconds())
    finally:
        device.zero()
        await asyncio.sleep(ACCEPT_SECONDS)
        await server.shutdown()  # type: ignore[no-untyped-call]


def open_wire(
    device: Device,
    wire: str,
    host: str = LOCALHOST,
    port: int = 0,
    layout: CanLayout | None = None,
    bitrate: int = BITRATE,
) -> tuple[str, WireEnd[Any], WireSession[Any]]:
    """Return endpoint, device's end and session of a wire without Modbus TCP; as `serve`."""
    if wire in (RTU, SERIAL):
        line = PtyLine()
        session = RtuSession(device) if wire == RTU else SerialSession(device)
        return f"{wire}://{line.name}", line, session
    # Half a second of imports that no other wire needs.
    from hil_sim.device.can import adapters, server  # noqa: PLC0415

    adapter = (
        adapters.SlcanLine(bitrate) if wire == SLCAN else adapters.SocketcandServer(host, port)
    )
    return adapter.endpoint, adapter, server.CanSession(device, layout)


def serve(
    rig: Rig,
    plant: PlantInterface,
    host: str = LOCALHOST,
    port: int = 0,
    *,
    realtime: bool = False,
    on_ready: Callable[[str], None] = logger.info,
    parent: ParentProcess | None = None,
    wire: str = TCP,
    layout: CanLayout | None = None,
    bitrate: int = BITRATE,
    faults: Sequence[DeviceFault] = (),
) -> None:
    """Serve a plant on a wire of `WIRES` until SIGTERM, SIGINT or the end of process `parent`.

    `layout` are the messages on a CAN bus (default: those of the DBC made for the rig), `bitrate`
    [bit/s] is its rate.

    `on_ready` is called once with the real endpoint, before any client is answered. The sample
    clock starts with this call and a host waits no longer than its timeout: where a plant's first
    ticks compile, `warm_up` a spare one before. `faults` are those of the device's electronics.
    Raises EndpointError when the address cannot be listened on.
    """
    if wire == VALVES:
        from hil_sim.device.can import adapters, valve_bench  # noqa: PLC0415 - as in `open_wire`

        bus = adapters.SocketcandServer(host, port)
        valve_bench.serve_valves(rig, plant, bus, on_ready, parent)
        return
    # The library logs frames only; errors of use are raised or logged here.
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
    device = Device(rig, plant, realtime=realtime, faults=faults)
    with termination_signals() as ended:
        if wire == TCP:
            asyncio.run(serve_tcp(device, host, port, on_ready, ended, parent))
            return
        endpoint, end, session = open_wire(device, wire, host, port, layout, bitrate)
        on_ready(endpoint)
        serve_session(end, session, device, ended, parent)


def warm_up(rig: Rig, spare: PlantInterface) -> None:
    """Run one block on a spare plant, to compile everything in advance."""
    table = LawTable(rig)
    spare.advance(reg.block_layout(len(rig.channels), len(rig.joints)).samples, table.active)


def _abort(connection: ModbusProtocol) -> None:
    if isinstance(connection.transport, asyncio.WriteTransport):
        connection.transport.abort()
