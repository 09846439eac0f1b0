"""The register map of the device: addresses to meanings (docs/wire-modbus-tcp.md)."""

from __future__ import annotations

import struct

import numpy as np

from hil_sim.device.device import Device
from hil_sim.device.laws import Refused, Words
from rig.model.parameters import MAX_JOINTS
from rig.model.wire import registers as reg
from rig.model.wire.registers import Refusal

_U32 = 0xFFFF_FFFF


class DeviceRegisters:
    """Reads and writes of registers, executed on one device."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._identity = _identity(device)
        self._refusal = Refused(Refusal.NONE)

    def read(self, client: object, address: int, count: int) -> bytes:
        """Return the bytes of `count` registers; raises Refused for an invalid span."""
        device = self._device
        if address == reg.BLOCK.address and count == device.layout.words:
            return device.read_block(client)
        laws = (reg.LAWS.address, reg.LAWS.address + reg.LAW_WORDS * device.laws.joints)
        for (first, end), register_bytes in (
            (reg.STATUS_SPAN, self._status),
            (reg.IDENTITY_SPAN, lambda: self._identity),
            (reg.CONTROL_SPAN, self._control),
            (laws, device.laws.staged_bytes),
        ):
            if first <= address and 0 < count <= end - address:
                return register_bytes()[2 * (address - first) : 2 * (address - first + count)]
        raise Refused(Refusal.NO_SUCH_REGISTER)

    def write(self, client: object, address: int, data: bytes) -> None:
        """Write the registers in `data` from `address` on; raises Refused without any change."""
        words = np.frombuffer(data, ">u2").astype(np.uint16)
        try:
            self._write(client, address, words)
        except Refused as refused:
            self._refusal = refused
            raise

    def _write(self, client: object, address: int, words: Words) -> None:
        device, count = self._device, len(words)
        if address == reg.CONTROL_ACK.address and count == 2:
            device.beat(client, int(words[1]))
            device.acknowledge(int(words[0]))
            return
        if address == reg.CONTROL_HEARTBEAT.address and count == 1:
            device.beat(client, int(words[0]))
            return
        if address == reg.CONTROL_ZERO.address and count == 1:
            # No control needed: any client may zero the outputs.
            _expect(words[0] == reg.ZERO_NOW)
            device.zero()
            return
        device.take_control(client)
        if count == 1:
            self._command(address, int(words[0]))
        elif reg.LAWS.address <= address < reg.LAWS.end:
            device.laws.stage(address - reg.LAWS.address, words)
        elif address == reg.UPLOAD_JOINT.address and count == 3:
            device.laws.begin_upload(int(words[0]), _u32(words[1:]))
        elif address == reg.UPLOAD_OFFSET.address and count > 2:
            device.laws.write_page(_u32(words), words[2:])
        elif address == reg.UPLOAD_COMMIT.address and count == 2:
            device.laws.commit_upload(_u32(words))
        else:
            raise Refused(Refusal.NO_SUCH_REGISTER)

    def _command(self, address: int, value: int) -> None:
        device = self._device
        if address == reg.CONTROL_STREAM.address:
            _expect(value in (reg.STREAM_START, reg.STREAM_STOP))
            if value == reg.STREAM_START:
                device.start()
            else:
                device.stop()
        elif address == reg.CONTROL_APPLY.address:
            _expect(value in (reg.APPLY, reg.APPLY_AND_RESTART))
            device.apply(restart=value == reg.APPLY_AND_RESTART)
        elif address == reg.CONTROL_RESET.address:
            _expect(value == reg.RESET_KEY)
            device.reset()
        elif address == reg.CONTROL_WATCHDOG.address:
            device.set_watchdog(value)
        else:
            raise Refused(Refusal.NO_SUCH_REGISTER)

    def _status(self) -> bytes:
        device = self._device
        device.catch_up()
        outputs = np.zeros(MAX_JOINTS, dtype=">i2")
        outputs[: len(device.outputs)] = device.outputs
        return (
            struct.pack(
                ">HHIIHHIIHHHH",
                device.status,
                device.cause,
                device.trip_tick & _U32,
                device.tick & _U32,
                device.queue.next_sequence,
                len(device.queue),
                device.queue.dropped & _U32,
                device.apply_tick & _U32,
                self._refusal.reason,
                self._refusal.joint,
                0,
                0,
            )
            + outputs.tobytes()
        )

    def _control(self) -> bytes:
        device = self._device
        # Command registers read as 0; stream reads as its state.
        return struct.pack(
            ">7H",
            device.acknowledged,
            device.heartbeat,
            0,
            device.streaming,
            0,
            0,
            device.watchdog_ms,
        )


def _identity(device: Device) -> bytes:
    rig = device.rig
    name = rig.name.encode("ascii")[: 2 * reg.IDENTITY_NAME.words]
    head = struct.pack(
        ">IHHHfHHIIHHH",
        reg.MAGIC,
        reg.PROTOCOL_VERSION,
        len(rig.joints),
        len(rig.channels),
        rig.sample_rate,
        device.layout.samples,
        not device.realtime,
        reg.WAVE_CAPACITY,
        reg.converter_checksum(rig),
        0,
        0,
        0,
    )
    return head + name.ljust(2 * reg.IDENTITY_NAME.words, b"\0")


def _u32(words: Words) -> int:
    return int(words[0]) << 16 | int(words[1])


def _expect(condition: bool | np.bool_) -> None:
    if not condition:
        raise Refused(Refusal.OUT_OF_RANGE)
