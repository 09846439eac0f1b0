"""The `stop` verb: outputs set to zero at once, of several benches at the same time."""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import suppress
from queue import SimpleQueue
from typing import TYPE_CHECKING, Final

import typer

from rig.cli.errors import alarm, code_and_message, print_error
from rig.cli.execution.device import device_of, pressure_text, refuse_endpoint_alone
from rig.cli.options import EndpointOption, KnownRigOption
from rig.cli.text.output import progress

if TYPE_CHECKING:
    from drivers.base import Driver
    from rig.bench.latch import Holder
    from rig.model.parts import Wire
    from rig.model.rig import Rig

News = SimpleQueue[str | BaseException | None]

NOT_IN_USE: Final = (
    "no process of this computer drives a bench, or has left one with outputs not confirmed at zero"
)
# Without an answer for so long the operator is asked to use the emergency stop.
SILENCE: Final = 1.0  # [s]
# A stopped run records its outputs at zero, for at most 6 s and two answer times.
RECORDS_ZERO: Final = 15.0  # [s]
# The next law of another computer's run may overwrite a single zero command.
ZEROS: Final = 6
BETWEEN_ZEROS: Final = 0.2  # [s]


def stop(rig: KnownRigOption = None, endpoint: EndpointOption = None) -> None:
    """Set all outputs to zero now, whoever is in control, and end the run that drives them.

    Without --rig it stops every bench that this computer drives, or has left without confirming
    that its outputs are at zero, all at once. A queue starts no further item.

    Example: bramah stop --rig shinshu-2dof
    """
    from rig.bench import probe  # noqa: F401 - before the threads, which all need it
    from rig.bench.latch import note_stop, rigs_to_stop
    from rig.model.parse import InputError

    refuse_endpoint_alone(rig, endpoint)
    rigs = [rig] if rig is not None else [str(path) for path in rigs_to_stop()]
    if not rigs:
        note_stop()
        raise InputError(f"{NOT_IN_USE}; name the bench: --rig RIG")
    news: News = SimpleQueue()
    stops = [BenchStop(name, endpoint, news) for name in rigs]
    for one in stops:
        one.start()
    if rig is None:
        note_stop()
    _warn_of_silence(stops)
    errors = _printed_news(news, len(stops))
    if errors and len(stops) == 1:
        raise errors[0]
    if errors:
        raise typer.Exit(code_and_message(errors[0])[0])


class BenchStop(threading.Thread):
    """One bench that is being stopped: its outputs set to zero, the run that drives it ended.

    A thread of its own, because a device that does not answer must not keep another bench moving;
    a daemon, so that Ctrl-C waits for no device. `answered` is set when the outputs are at zero or
    the stop has failed; `news` receives results, an error, and None at the end.
    """

    def __init__(self, rig: str, endpoint: str | None, news: News) -> None:
        super().__init__(name=f"stop {rig}", daemon=True)
        self.place = rig
        self.answered = threading.Event()
        self._rig, self._endpoint, self._news = rig, endpoint, news

    def run(self) -> None:
        """Stop the bench; every error becomes news."""
        try:
            self._stop()
        except BaseException as error:  # also a driver's sys.exit()
            self._news.put(error)
        finally:
            self.answered.set()
            self._news.put(None)

    def _stop(self) -> None:
        """Set the outputs to zero, end the run that drives them, state what is pressurised.

        The run is signalled first: it then zeroes the outputs too, whatever this device answers.
        Raises InputError and DeviceError.
        """
        from drivers.base import DeviceError, zeroed_without_host
        from rig.bench import probe as bench
        from rig.bench.latch import BenchState, note_stop
        from rig.bench.outputs import UNSURE

        bench_rig, driver = device_of(self._rig, self._endpoint)
        self.place = _place(bench_rig)
        holder = _signalled_holder(bench_rig.wire)
        note_stop(bench_rig.wire.endpoint)
        try:
            self._zero(driver, bench_rig.wire, holder)
        except DeviceError as error:
            otherwise = zeroed_without_host(driver, bench_rig.wire.watchdog)
            raise type(error)(
                f"{UNSURE}, {self.place}: {error}; use the emergency stop ({otherwise})"
            ) from error
        finally:
            driver.close()
        _await_end(bench_rig.wire, holder)
        if _holder(bench_rig.wire) is None:
            BenchState(bench_rig.wire).forget_session()
        self._news.put(f"outputs at zero, confirmed by the device of {self.place}")
        try:
            readings = bench.probe(device_of(self._rig, self._endpoint)[1], bench_rig)
        except DeviceError as error:
            progress(f"pressures not read, {self.place}: {error}")
        else:
            if text := pressure_text(readings, self.place):
                self._news.put(text)

    def _zero(self, driver: Driver, wire: Wire, holder: Holder | None) -> None:
        """Zero the outputs, several times where a run of another computer may still set them.

        A process of this computer that drives the bench may take the device's answers from the
        line: if they are missing, its end is awaited. Raises DeviceError without an answer after
        that.
        """
        from drivers.base import DeviceError
        from rig.bench.outputs import zero_patiently

        try:
            zero_patiently(driver)
        except DeviceError:
            if holder is None:
                raise
            _await_end(wire, holder)
            zero_patiently(driver)
        self.answered.set()
        for _ in range(ZEROS - 1 if holder is None else 0):
            time.sleep(BETWEEN_ZEROS)
            driver.zero_outputs()


def _warn_of_silence(stops: list[BenchStop]) -> None:
    """Wait for an answer about each bench; say after SILENCE which have none, whatever their wires.

    The time limit of a wire may be longer, and an operator must not wait for it.
    """
    from rig.bench.outputs import UNSURE

    deadline = time.monotonic() + SILENCE
    for one in stops:
        if not one.answered.wait(max(0.0, deadline - time.monotonic())):
            why = f"{UNSURE}, {one.place}: no answer for {SILENCE:g} s; use the emergency stop"
            progress(alarm(f"bramah: {why}"))


def _printed_news(news: News, benches: int) -> list[BaseException]:
    """Print what the stops of so many benches report, failures first; return the errors.

    Errors of several benches are printed, that of one is left to the caller.
    """
    errors: list[BaseException] = []
    known = sorted(
        (news.get() for _ in range(news.qsize())),
        key=lambda item: not isinstance(item, BaseException),
    )
    running = benches
    while running:
        item = known.pop(0) if known else news.get()
        if item is None:
            running -= 1
        elif isinstance(item, str):
            typer.echo(item)
        else:
            errors.append(item)
            if benches > 1:
                print_error(code_and_message(item)[1])
    return errors


def _place(rig: Rig) -> str:
    return f"{rig.name} at {rig.wire.endpoint}"


def _signalled_holder(wire: Wire) -> Holder | None:
    """Tell the process of this computer that drives the bench to end; return it, None if none.

    Its next law would move joints again.
    """
    holder = _holder(wire)
    if holder is not None:
        progress(f"stopping process {holder.pid}{_run_of(holder)} as well")
        with suppress(ProcessLookupError):  # the process has ended by itself
            os.kill(holder.pid, signal.SIGTERM)
    return holder


def _await_end(wire: Wire, holder: Holder | None) -> None:
    """Wait for the end of a process told to end; raises DeviceBusy if it does not end."""
    from drivers.base import DeviceBusy
    from rig.bench.outputs import UNSURE

    deadline = time.monotonic() + RECORDS_ZERO
    while holder is not None and _holder(wire) == holder:
        if time.monotonic() > deadline:
            raise DeviceBusy(
                f"{UNSURE}: process {holder.pid}{_run_of(holder) or ','} was told to stop but runs "
                "on; use the emergency stop"
            )
        time.sleep(0.05)


def _run_of(holder: Holder) -> str:
    return f", which writes {holder.run}," if holder.run else ""


def _holder(wire: Wire) -> Holder | None:
    """Return the other process of this computer that holds the bench, None if there is none."""
    from rig.bench.latch import holder_at

    holder = holder_at(wire)
    return None if holder is None or holder.pid == os.getpid() else holder
