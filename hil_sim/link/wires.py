"""The link of each kind of wire; a new kind is one line here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from hil_sim.device.lifetime import EndpointError
from hil_sim.faults.wire import Carrier, WireFault
from hil_sim.link import frames
from hil_sim.link.frames import Framing
from hil_sim.link.line import LineLink
from hil_sim.link.link import FaultyLink
from hil_sim.link.tcp import TcpLink


@dataclass(frozen=True)
class WireKind:
    """The link class of a kind of wire, and its framing."""

    carrier: type[TcpLink] | type[LineLink]
    framing: Framing


_MODBUS_TCP: Final = WireKind(TcpLink, Framing(frames.modbus_tcp, frames.modbus_tcp))
_SOCKETCAND: Final = WireKind(
    TcpLink,
    Framing(
        frames.socketcand_text,
        frames.socketcand_text,
        frames.socketcand_frame,
        Carrier.CAN,
        frames.socketcand_error,
    ),
)
_SLCAN: Final = WireKind(
    LineLink, Framing(frames.slcan_text, frames.slcan_text, frames.slcan_frame, Carrier.CAN)
)
_SLCAN_ENDPOINT: Final = "can://slcan"
WIRES: Final[Mapping[str, WireKind]] = {
    "modbus-tcp": _MODBUS_TCP,
    "modbus-map": _MODBUS_TCP,
    "modbus-rtu": WireKind(LineLink, Framing(frames.rtu_request, frames.rtu_answer)),
    "serial": WireKind(LineLink, Framing(frames.between_zeros, frames.between_zeros)),
    "can": _SOCKETCAND,
    "can-slcan": _SLCAN,
    "canopen-408": _SOCKETCAND,
}


def faulty_link(
    target: str,
    faults: Sequence[WireFault] = (),
    *,
    seed: int = 0,
    seconds: Callable[[], float] | None = None,
    port: int = 0,
) -> FaultyLink:
    """Return a link to the device at endpoint `target`; `seconds` is the device's time.

    `port` is its own port, on wires that have ports (0: any free one). Raises EndpointError for a
    kind of wire without a link, or an occupied place.
    """
    kind = "can-slcan" if target.startswith(_SLCAN_ENDPOINT) else target.partition("://")[0]
    if kind not in WIRES:
        raise EndpointError(f"no faults for wire {kind}; expected one of: {' '.join(WIRES)}")
    wire = WIRES[kind]
    return wire.carrier(target, wire.framing, faults, seed, seconds, port)
