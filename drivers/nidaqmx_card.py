"""An example of a small driver: a DAQ card of National Instruments, by the package `nidaqmx`.

The package is no dependency of this project; it is imported when a rig file names this kind.
It was tested with a substitute for the package's calls, never on hardware (docs/own-device.md).

Inputs and outputs are software-timed, one sample at a time; the sample clock, the waveform and the
position loop are those of `drivers.polled`.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar, Final, Literal, Unpack

import numpy as np
from pydantic import Field

from drivers.base import Array, DeviceLost, PackageMissing, WireSettings
from drivers.polled import Pacing, PolledDriver
from drivers.wire_entries import (
    inputs_by_channel,
    offset_of,
    outputs_by_joint,
    read_entry,
    refuse_short_reach,
    scale_of,
)
from rig.model.parse import InputError, read_quantity
from rig.model.parts import Part, Wire
from rig.model.rig import Rig

logger = logging.getLogger(__name__)

PACKAGE: Final = "nidaqmx"
_NO_WATCHDOG: Final = "none"
_CHANNEL: Final = r"^[^/\s,:]+(/[^/\s,:]+)+$"  # Dev1/ai0: one channel, no list and no range


class CardSettings(WireSettings):
    """The card's channels by their physical names, and its watchdog."""

    inputs: dict[str, Any]
    outputs: dict[int, Any]
    zero_by: dict[str, Any] | Literal["none"] = _NO_WATCHDOG
    accept_no_watchdog: bool = False


class CardInput(Part):
    """One analogue input: value = offset + scale * volts; `range` is the card's, either way."""

    channel: str = Field(pattern=_CHANNEL)
    scale: str | float
    offset: str | float | None = None
    range: str | float = "10 V"


class CardOutput(Part):
    """One analogue output to a joint's valve, in volts."""

    channel: str = Field(pattern=_CHANNEL)


class CardWatchdog(Part):
    """The card's own watchdog timer, where its model has one."""

    device: str = Field(min_length=1)
    milliseconds: int = Field(ge=1)


@dataclass(frozen=True)
class Wiring:
    """The connections: inputs and outputs as physical channels, volts to SI."""

    inputs: tuple[str, ...]
    ranges: tuple[float, ...]
    scales: Array
    offsets: Array
    outputs: tuple[str, ...]
    output_ranges: tuple[float, ...]
    watchdog: CardWatchdog | None


def wiring(settings: CardSettings, rig: Rig) -> Wiring:
    """Return the connections of a rig file; raises InputError naming the key at fault."""
    entries = inputs_by_channel(CardInput, settings.inputs, rig)
    outputs = outputs_by_joint(CardOutput, settings.outputs, rig)
    keys = [f"inputs.{name}" for name in rig.channels]
    units = [rig.unit_of(name) for name in rig.channels]
    ranges = [
        read_quantity(entry.range, "V", f"wire: {key}.range")
        for key, entry in zip(keys, entries, strict=True)
    ]
    for key, volts in zip(keys, ranges, strict=True):
        if volts <= 0.0:
            raise InputError(f"wire: {key}.range: {volts:g} V, expected one above 0 V")
    all_keys = [*keys, *(f"outputs.{i + 1}" for i in range(len(outputs)))]
    names = [*(entry.channel for entry in entries), *(entry.channel for entry in outputs)]
    key_of: dict[str, str] = {}
    for key, name in zip(all_keys, names, strict=True):
        if (other := key_of.setdefault(name, key)) != key:
            raise InputError(f"wire: {key}.channel: {name} is that of {other} as well")
    named_entries = zip(keys, entries, units, strict=True)
    values = [
        (scale_of(e.scale, unit, f"{k}.scale", "/V"), offset_of(e.offset, unit, f"{k}.offset"))
        for k, e, unit in named_entries
    ]
    scales, offsets = np.array(values).T
    for name, (scale, offset), volts in zip(rig.channels, values, ranges, strict=True):
        ends = (offset - scale * volts, offset + scale * volts)
        (low, high), limits = rig.range_of(name), rig.limits_of(name)
        needed = max(low, limits[0]), min(high, limits[1])
        refuse_short_reach(rig, name, ends, needed, step=0.0)
    return Wiring(
        tuple(entry.channel for entry in entries),
        tuple(ranges),
        scales,
        offsets,
        tuple(entry.channel for entry in outputs),
        tuple(joint.valve.command_range for joint in rig.joints),
        None
        if settings.zero_by == _NO_WATCHDOG
        else read_entry(CardWatchdog, settings.zero_by, "zero_by"),
    )


def _package() -> ModuleType:
    """Import the package; raises InputError where it is not installed."""
    try:
        for part in ("constants", "errors", "system"):
            importlib.import_module(f"{PACKAGE}.{part}")
        return importlib.import_module(PACKAGE)
    except ImportError as error:
        raise PackageMissing(
            f"wire: kind: {PACKAGE} needs the package of that name; install {PACKAGE} "
            f"(pip install {PACKAGE}) and NI's own NI-DAQmx driver ({error})"
        ) from error


class NidaqmxCard:
    """`drivers.polled.InputsOutputs` over one task of inputs, one of outputs and a watchdog."""

    def __init__(self, wiring_: Wiring, timeout: float) -> None:
        self._daq = _package()
        self._wiring, self._timeout = wiring_, timeout
        self._tasks: list[Any] = []

    @property
    def watchdog(self) -> float | None:
        """Seconds after which the card zeroes its outputs by itself, None if never."""
        entry = self._wiring.watchdog
        return None if entry is None else entry.milliseconds * 1e-3

    def open(self) -> str:
        """Make and start the tasks; return the names of the cards."""
        self.close()
        wiring = self._wiring
        with self._errors_as_lost(), ExitStack() as undo:
            undo.callback(self.close)
            reading, writing = self._task(), self._task()
            for channel, volts in zip(wiring.inputs, wiring.ranges, strict=True):
                reading.ai_channels.add_ai_voltage_chan(channel, min_val=-volts, max_val=volts)
            for channel, volts in zip(wiring.outputs, wiring.output_ranges, strict=True):
                writing.ao_channels.add_ao_voltage_chan(channel, min_val=-volts, max_val=volts)
            reading.start()
            if wiring.watchdog is not None:
                self._start_watchdog(wiring.watchdog)
            undo.pop_all()
        cards = sorted({name.split("/")[0] for name in (*wiring.inputs, *wiring.outputs)})
        return f"DAQ card {' '.join(cards)}"

    def read(self) -> Array:
        """Return one value [SI] of every channel, (channels,), in the order of the rig."""
        with self._errors_as_lost():
            volts = np.atleast_1d(self._opened(0).read(timeout=self._timeout))
        values: Array = self._wiring.offsets + self._wiring.scales * volts
        return values

    def write(self, volts: Array) -> None:
        """Put out one voltage [V] per joint, and feed the card's watchdog."""
        data: float | Sequence[float] = volts.tolist() if len(volts) > 1 else float(volts[0])
        with self._errors_as_lost():
            self._opened(1).write(data, auto_start=True, timeout=self._timeout)
            if self._wiring.watchdog is not None:
                self._opened(2).reset_timer()

    def close(self) -> None:
        """Release the card; the outputs stay as last written."""
        tasks, self._tasks = self._tasks, []
        for task in reversed(tasks):
            try:
                task.close()
            except self._daq.errors.Error as error:
                logger.debug("while closing: %s", error)

    def _task(self) -> Any:
        task = self._daq.Task()
        self._tasks.append(task)
        return task

    def _opened(self, index: int) -> Any:
        if not self._tasks:
            raise DeviceLost("the DAQ card is closed; connect first")
        return self._tasks[index]

    def _start_watchdog(self, entry: CardWatchdog) -> None:
        system = self._daq.system
        task = system.WatchdogTask(entry.device, timeout=entry.milliseconds * 1e-3)
        self._tasks.append(task)
        voltage = self._daq.constants.WatchdogAOExpirState.VOLTAGE
        task.cfg_watchdog_ao_expir_states(
            [system.AOExpirationState(name, 0.0, voltage) for name in self._wiring.outputs]
        )
        task.start()

    @contextmanager
    def _errors_as_lost(self) -> Iterator[None]:
        try:
            yield
        except self._daq.errors.Error as error:
            text = (str(error).strip() or repr(error)).splitlines()[0]
            raise DeviceLost(f"the DAQ card failed: {text}") from error


class NidaqmxDriver(PolledDriver):
    """`drivers.base.Driver` over a DAQ card; raises InputError for impossible wiring."""

    settings: ClassVar[type[WireSettings]] = CardSettings

    def __init__(self, wire: Wire, rig: Rig, **pacing: Unpack[Pacing]) -> None:
        settings = CardSettings.of(wire)
        super().__init__(
            wire,
            rig,
            NidaqmxCard(wiring(settings, rig), wire.timeout),
            accept_no_watchdog=settings.accept_no_watchdog,
            **pacing,
        )
