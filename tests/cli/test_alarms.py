"""What must not be missed is red where the terminal has colour, and always in words."""

from __future__ import annotations

import io
import logging
import sys

import pytest

from drivers.base import DeviceLost
from rig.bench.outputs import UNSURE
from rig.cli.errors import LogFormatter, guarded


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def lost() -> None:
    error = DeviceLost("the device does not answer")
    error.add_note("look at the bench")
    error.add_note(UNSURE)
    raise error


def said(
    monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, no_colour: str | None = None
) -> list[str]:
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.delenv("NO_COLOR", raising=False)
    if no_colour is not None:
        monkeypatch.setenv("NO_COLOR", no_colour)
    record = logging.LogRecord("rig", logging.ERROR, "", 0, UNSURE, None, None)
    record.alarm = True
    plain = logging.LogRecord("rig", logging.ERROR, "", 0, "nothing much", None, None)
    assert guarded(lost, debug=False) == 4
    formatter = LogFormatter("%(message)s")
    return [stream.getvalue().strip(), formatter.format(record), formatter.format(plain)]


def test_outputs_that_may_not_be_zero_are_red_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    end, alarm, plain = said(monkeypatch, Terminal())
    for text in (end, alarm):
        assert text.startswith("\033[1;37;41m")
        assert text.endswith("\033[0m")
    assert plain == "nothing much"


@pytest.mark.parametrize(("stream", "no_colour"), [(Terminal, "1"), (io.StringIO, None)])
def test_without_colour_the_words_come_first(
    monkeypatch: pytest.MonkeyPatch, stream: type[io.StringIO], no_colour: str | None
) -> None:
    end, alarm, _ = said(monkeypatch, stream(), no_colour)
    assert end == (f"bramah: {UNSURE}; device: the device does not answer; look at the bench")
    assert alarm == UNSURE
