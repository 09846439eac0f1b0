"""Output laws and waveforms of the device: staged by register, applied together.

Glossary: *staged* values are written but without effect; *active* ones drive the outputs; `apply`
copies staged to active for all joints at one tick.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hil_sim.plant.interface import Law
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire.codes import Array, decode_output
from rig.model.wire.registers import Refusal

Words = NDArray[np.uint16]

_SINGLE = 1.0 + 1e-6  # registers hold single precision: 0.0375 arrives as 0.037500001
GAIN_MAX = 100.0  # of the waveform [1]
POSITION_GAIN_MAX = 1e5  # [V/m]


class Refused(Exception):
    """A request that the device refuses; `reason` is the value of its error register."""

    def __init__(self, reason: Refusal, joint: int = 0) -> None:
        super().__init__(reg.REFUSAL_TEXT[reason])
        self.reason = reason
        self.joint = joint


OFF = Law(np.zeros(1))  # plants read the waveform of every law


@dataclass
class _Upload:
    joint: int
    codes: NDArray[np.int16]
    received: NDArray[np.bool_]


class LawTable:
    """Staged and active laws of all joints with their waveforms."""

    def __init__(self, rig: Rig) -> None:
        self._ranges = [joint.valve.command_range for joint in rig.joints]
        # Largest values of one joint, in the order of LAW_FIELDS.
        travel = max(abs(edge) for edge in rig.sensors.piston.range)
        self._bounds = np.array([[GAIN_MAX, v, POSITION_GAIN_MAX, travel, v] for v in self._ranges])
        self._staged = np.zeros((len(rig.joints), len(reg.LAW_FIELDS)), dtype=">f4")
        self._waves: list[Array] = [OFF.wave for _ in rig.joints]
        self._upload: _Upload | None = None
        self.active: tuple[Law, ...] = tuple(OFF for _ in rig.joints)

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self._ranges)

    @property
    def armed(self) -> bool:
        """Whether an active law may put out a voltage."""
        return any(law.limit > 0.0 for law in self.active)

    def staged_bytes(self) -> bytes:
        """Return the staged laws as their registers are read."""
        return self._staged.tobytes()

    def stage(self, first: int, words: Words) -> None:
        """Write registers of the law area from word `first`; raises Refused without any change."""
        if first % 2 or len(words) % 2 or first + len(words) > 2 * self._staged.size:
            raise Refused(Refusal.NO_SUCH_REGISTER)
        values = self._staged.copy()
        values.ravel()[first // 2 : (first + len(words)) // 2] = words.astype(">u2").view(">f4")
        for joint, row in enumerate(values, start=1):
            if not np.isfinite(row).all():
                raise Refused(Refusal.NOT_FINITE, joint)
            if (np.abs(row) > self._bounds[joint - 1] * _SINGLE).any() or row[-1] < 0.0:
                raise Refused(Refusal.OUT_OF_RANGE, joint)
        self._staged = values

    def begin_upload(self, joint: int, length: int) -> None:
        """Open an upload for joint `joint` (1-based); an unfinished one is discarded."""
        self._upload = None
        if not 1 <= joint <= self.joints:
            raise Refused(Refusal.OUT_OF_RANGE, joint)
        if not 1 <= length <= reg.WAVE_CAPACITY:
            raise Refused(Refusal.OUT_OF_RANGE, joint)
        self._upload = _Upload(joint, np.zeros(length, np.int16), np.zeros(length, np.bool_))

    def write_page(self, offset: int, words: Words) -> None:
        """Store samples of the open upload from sample `offset` on."""
        if self._upload is None:
            raise Refused(Refusal.UPLOAD_TORN)
        end = offset + len(words)
        if end > len(self._upload.codes):
            raise Refused(Refusal.OUT_OF_RANGE, self._upload.joint)
        self._upload.codes[offset:end] = words.view(np.int16)
        self._upload.received[offset:end] = True

    def commit_upload(self, checksum: int) -> None:
        """Make the upload ready for the next apply; raises Refused if anything is missing."""
        upload, self._upload = self._upload, None
        if upload is None:
            raise Refused(Refusal.UPLOAD_TORN)
        if not upload.received.all() or reg.wave_checksum(upload.codes) != checksum:
            raise Refused(Refusal.UPLOAD_TORN, upload.joint)
        index = upload.joint - 1
        self._waves[index] = decode_output(upload.codes, self._ranges[index], reg.WAVE_BITS)

    def apply(self, tick: int, *, restart: bool) -> None:
        """Activate all staged laws and finished uploads from sample `tick` on."""
        laws = []
        for wave, row, old in zip(self._waves, self._staged.tolist(), self.active, strict=True):
            values = dict(zip(reg.LAW_FIELDS, row, strict=True))
            laws.append(Law(wave, tick if restart else old.start, **values))
        self.active = tuple(laws)

    def would_arm(self) -> bool:
        """Whether the staged laws, once applied, may put out a voltage."""
        return bool((self._staged[:, -1] > 0.0).any())

    def restart(self, tick: int) -> None:
        """Begin every waveform at sample `tick`."""
        self.active = tuple(replace(law, start=tick) for law in self.active)

    def zero(self) -> None:
        """Switch all outputs off and drop staged laws."""
        self._staged[:] = 0.0
        self.active = tuple(replace(OFF, start=law.start) for law in self.active)
