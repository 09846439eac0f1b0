"""Exit codes and error messages, one line each."""

from __future__ import annotations

import logging
import os
import select
import signal
import stat
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import typer
from typer.exceptions import TyperException

from rig.cli.text.output import discard, is_terminal, progress

OK = 0
FAILED = 1
BAD_INPUT = 2
TRIPPED = 3
DEVICE_LOST = 4
INTERRUPTED = 130

_STDOUT = 1  # file descriptor


class WorkError(Exception):
    """The work could not be done; the message gives the reason in one line (exit code 1)."""


def alarm(text: str) -> str:
    """Return a text in white on red if standard error is a terminal and NO_COLOR is not set."""
    coloured = is_terminal(sys.stderr) and not os.environ.get("NO_COLOR")
    return f"\033[1;37;41m{text}\033[0m" if coloured else text


class LogFormatter(logging.Formatter):
    """Formats a log record; one with the attribute `alarm` is shown in white on red."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        line = super().format(record)
        return alarm(line) if getattr(record, "alarm", False) else line


def print_error(message: str) -> None:
    """Print each line of an error's message; one about outputs not at zero is white on red."""
    from rig.bench.outputs import UNSURE

    for part in message.strip().splitlines() or [""]:
        line = "bramah: " + " ".join(part.split())
        progress(alarm(line) if UNSURE in line else line)


def _os_error(error: OSError) -> str:
    name = error.filename or _unwritable_output()
    return f"{error.strerror or error}{f' ({name})' if name else ''}"


def _unwritable_output() -> str:
    """Return the name of standard output if it is a full file or device, '' if it is not."""
    full = False
    try:
        is_file = stat.S_ISREG(os.fstat(_STDOUT).st_mode)
        full = is_file and not os.fstatvfs(_STDOUT).f_bavail
        os.write(_STDOUT, b"")  # /dev/full refuses even this
    except OSError:
        full = True
    name = Path(f"/proc/self/fd/{_STDOUT}")
    return f"standard output: {name.resolve() if name.exists() else 'closed'}" if full else ""


def _codes() -> tuple[tuple[tuple[type[BaseException], ...], int, Callable[..., str]], ...]:
    """Return error types with their exit code and message; the first match wins.

    Imports inside the function keep `--help` quick.
    """
    from drivers.base import DeviceBusy, DeviceError
    from protocols.engine.states import ProtocolAborted
    from rig.model.parse import InputError
    from rig.model.trips import Latched, OperatorStop, RecordingFailed, SafetyTrip

    return (
        ((InputError,), BAD_INPUT, str),
        ((SafetyTrip, Latched), TRIPPED, str),
        ((DeviceBusy,), DEVICE_LOST, lambda error: f"device in use: {error}"),
        ((DeviceError,), DEVICE_LOST, lambda error: f"device: {error}"),
        ((OperatorStop, KeyboardInterrupt), INTERRUPTED, lambda error: str(error) or "stopped"),
        ((WorkError, RecordingFailed, ProtocolAborted), FAILED, str),
        ((OSError,), FAILED, _os_error),
    )


def code_and_message(error: BaseException) -> tuple[int, str]:
    """Return the exit code of an exception, and the message that the user reads."""
    for kinds, code, text in _codes():
        if isinstance(error, kinds):
            return code, _with_notes(error, text(error))
    # pydantic reports an interruption within a serializer as an error of its own.
    interrupting = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    if any(getattr(signal.getsignal(n), "heard", False) for n in interrupting):
        return INTERRUPTED, _with_notes(error, "stopped")
    # An error that is not listed is a bug; its type is shown.
    return FAILED, f"{type(error).__name__}: {error}; --debug shows where"


def _with_notes(error: BaseException, message: str) -> str:
    """Return the message with the bench's notes, outputs that may not be at zero first."""
    from rig.bench.outputs import UNSURE

    notes = list(getattr(error, "__notes__", ()))
    unsure = [note for note in notes if note == UNSURE]
    return "; ".join([*unsure[:1], message, *(note for note in notes if note != UNSURE)])


def guarded(work: Callable[[], int | None], *, debug: bool) -> int:
    """Run `work` and return the exit code; print a traceback only with `debug`."""
    try:
        code = work() or OK
        if code == INTERRUPTED:
            print_error("stopped")
        return code
    except typer.Exit as error:
        return error.exit_code
    except typer.Abort:
        print_error("stopped")
        return INTERRUPTED
    except TyperException as error:
        print_error(f"{error.format_message().rstrip('.')}; see --help")
        return BAD_INPUT
    except SystemExit as error:
        # Typer ends the process at a closed pipe, without a message.
        if not isinstance(error.__context__, BrokenPipeError):
            raise
        return OK if _reader_has_closed() else _failed(error.__context__, debug)
    except (Exception, KeyboardInterrupt) as error:
        return _failed(error, debug)


def _failed(error: BaseException, debug: bool) -> int:
    if debug:
        traceback.print_exception(error)
    code, message = code_and_message(error)
    print_error(message)
    return code


def _reader_has_closed() -> bool:
    """Return whether the reader of standard output has closed it (`| head`); not an error."""
    output = select.poll()
    output.register(_STDOUT, 0)  # reports errors only
    closed = bool(output.poll(0))
    if closed:
        discard(_STDOUT)
    return closed
