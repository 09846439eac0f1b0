"""Exit codes and the one line a person reads when something went wrong (CONTRACT, "Commands")."""

from __future__ import annotations

import logging
import os
import sys
import traceback
from collections.abc import Callable

import typer
from typer.exceptions import TyperException

from drivers.base import DeviceError
from protocols.engine.errors import ProtocolAborted
from rig.model.parse import InputError
from rig.model.trips import Latched, OperatorStop, RecordingFailed, SafetyTrip

OK = 0
FAILED = 1
BAD_INPUT = 2
TRIPPED = 3
DEVICE_LOST = 4
INTERRUPTED = 130

log = logging.getLogger(__name__)


class WorkError(Exception):
    """The work could not be done; the message says why in one line (exit code 1)."""


def _say(message: str) -> None:
    print("bramah: " + " ".join(message.split()), file=sys.stderr)


def _os_error(error: OSError) -> str:
    name = f" ({error.filename})" if error.filename else ""
    return f"{error.strerror or error}{name}"


# First match wins. An error not listed is a fault of ours, and says so.
_CODES: tuple[tuple[tuple[type[BaseException], ...], int, Callable[..., str]], ...] = (
    ((InputError,), BAD_INPUT, str),
    ((SafetyTrip, Latched), TRIPPED, str),
    ((DeviceError,), DEVICE_LOST, lambda error: f"device: {error}"),
    ((OperatorStop, KeyboardInterrupt), INTERRUPTED, lambda error: str(error) or "stopped"),
    ((WorkError, RecordingFailed, ProtocolAborted), FAILED, str),
    ((OSError,), FAILED, _os_error),
)


def _code_and_message(error: BaseException) -> tuple[int, str]:
    for kinds, code, text in _CODES:
        if isinstance(error, kinds):
            return code, text(error)
    return FAILED, f"{type(error).__name__}: {error}; --debug shows where"


def guarded(work: Callable[[], int | None], *, debug: bool) -> int:
    """Run `work` and return the process's exit code; no traceback leaves without `debug`."""
    try:
        return work() or OK
    except typer.Exit as error:
        return error.exit_code
    except typer.Abort:
        _say("stopped")
        return INTERRUPTED
    except TyperException as error:
        _say(f"{error.format_message()}; see --help")
        return BAD_INPUT
    except BrokenPipeError:
        # The reader of our output went away (`| head`): not an error, and nothing more to say.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exc()
        code, message = _code_and_message(error)
        _say(message)
        return code
