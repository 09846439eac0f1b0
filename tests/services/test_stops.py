"""A signal stops a run even where a library has swallowed the exception that it raised."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import suppress

import pytest

from rig.bench.stops import StopFlag
from rig.cli.errors import FAILED, INTERRUPTED, guarded
from rig.cli.main import Interruption


@pytest.fixture
def handlers() -> Iterator[None]:
    """Put this process's own handlers back afterwards."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    for number in before:
        signal.signal(number, Interruption())
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (signal.SIGINT, "stopped by operator (Ctrl-C)"),
        (signal.SIGTERM, "stopped by SIGTERM"),
        (signal.SIGHUP, "stopped because the terminal closed"),
    ],
)
def test_a_swallowed_signal_stops_the_bench_that_is_driven_next(
    number: signal.Signals, reason: str
) -> None:
    with pytest.raises(KeyboardInterrupt):  # as a serialiser would that goes on after an error
        signal.raise_signal(number)
    flag = StopFlag()
    flag.install()
    assert flag.reason == reason
    flag.restore()


@pytest.mark.usefixtures("handlers")
def test_a_terminal_that_closes_interrupts_once_though_it_signals_twice() -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGHUP)
    signal.raise_signal(signal.SIGHUP)  # the report is being written


@pytest.mark.usefixtures("handlers")
def test_under_nohup_the_terminal_may_close() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    flag = StopFlag()
    flag.install()
    signal.raise_signal(signal.SIGHUP)
    assert flag.reason is None
    flag.restore()
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


@pytest.mark.usefixtures("handlers")
def test_a_signal_that_a_library_reports_as_its_own_error_is_a_stop(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Pydantic calls it "Error serializing to JSON: KeyboardInterrupt"."""

    def serialised() -> int:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        raise ValueError("Error serializing to JSON: KeyboardInterrupt: ")

    assert guarded(serialised, debug=False) == INTERRUPTED
    assert capsys.readouterr().err == "bramah: stopped\n"


@pytest.mark.usefixtures("handlers")
def test_an_error_without_a_signal_is_no_stop(capsys: pytest.CaptureFixture[str]) -> None:
    def failing() -> int:
        raise ValueError("wrong")

    assert guarded(failing, debug=False) == FAILED
    assert "ValueError: wrong" in capsys.readouterr().err


@pytest.mark.usefixtures("handlers")
def test_without_a_signal_nothing_stops() -> None:
    flag = StopFlag()
    flag.install()
    assert flag.reason is None
    flag.restore()
