"""Bytes on a wire to blocks of SI samples, behind one interface (`drivers.base`)."""

from __future__ import annotations

from drivers.base import Driver
from rig.model.parts import Wire
from rig.model.rig import Rig


def make_driver(wire: Wire, rig: Rig) -> Driver:
    """Return the unconnected driver for a wire; raises KeyError for a kind without one."""
    # Imported when asked for: a wire's library is needed only by those who use that wire.
    from drivers.modbus_tcp import ModbusTcpDriver  # noqa: PLC0415

    return {"modbus-tcp": ModbusTcpDriver}[wire.kind](wire, rig)


__all__ = ["Driver", "make_driver"]
