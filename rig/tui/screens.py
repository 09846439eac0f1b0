"""What takes the bench's place when there is none, and the page of help."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from textual.app import ComposeResult
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

from rig.bench.screens.sockets import Endpoint

HELP: Final = """\
[b]s[/b] or [b]space[/b]   STOP: zero all outputs, at once, without asking;
             the run ends as aborted and keeps what it measured
[b]p[/b]            pause the display; the run goes on
[b]z[/b]            plots: from limit to limit, or zoomed to the data
[b]+[/b]  [b]-[/b]         plots: more or less of the past ([b]0[/b]: automatic)
[b]↑[/b]  [b]↓[/b]         scroll a bench of more joints than fit
[b]c[/b]            choose another run
[b]q[/b]            quit this screen; the run goes on
[b]?[/b]            this page; any key closes it

Dashed red lines are the limits: passing one zeroes the outputs.
Pressures are gauge. Piston 0 is mid-stroke, positive extends.
A yellow number is within 2 % of the range to its limit.
Grey numbers are old: the run has ended, is silent, or the
display is paused. A gap in a curve is data that did not arrive."""


def waiting_text(rig: str | None) -> str:
    """Return what the screen says while there is no run: how to start one."""
    which = f" on rig {rig}" if rig else ""
    return (
        f"No protocol is running{which}.\n\n"
        "Start one in another terminal:\n\n"
        f"bramah run lock-and-excite --rig {rig or 'shinshu-2dof'} --out RUN\n\n"
        "This screen attaches as soon as it runs.  q quits."
    )


class Waiting(Vertical):
    """No run: what to do about it."""

    DEFAULT_CSS = """
    Waiting { align: center middle; }
    Waiting Static { width: 100%; text-align: center; }
    """

    def __init__(self, rig: str | None, id: str) -> None:
        super().__init__(id=id)
        self._rig = rig

    def compose(self) -> ComposeResult:
        """Put the words in the middle."""
        yield Static(waiting_text(self._rig), markup=False)


class Chooser(Vertical):
    """Several runs: a list to choose from."""

    DEFAULT_CSS = """
    Chooser { align: center middle; }
    Chooser Static { width: 100%; text-align: center; height: auto; margin-bottom: 1; }
    Chooser OptionList { width: 60; max-width: 100%; height: auto; max-height: 70%; }
    """

    def __init__(self, id: str) -> None:
        super().__init__(id=id)
        self._sessions: tuple[Endpoint, ...] = ()
        self._list = OptionList(markup=False)

    def compose(self) -> ComposeResult:
        """Put the list under its question."""
        yield Static(
            "Several protocols are running. Which one?\n"
            "Enter attaches; s stops the one marked and attaches to it."
        )
        yield self._list

    def show(self, sessions: Sequence[Endpoint], *, appearing: bool) -> None:
        """List these sessions, the mark staying where it was."""
        if appearing:
            self.call_after_refresh(self._list.focus)  # not before it can be seen
        if self._sessions == tuple(sessions):
            return
        marked = self.marked
        self._sessions = tuple(sessions)
        self._list.clear_options()
        self._list.add_options([Option(f"{e.rig}   process {e.pid}") for e in self._sessions])
        self._list.highlighted = self._sessions.index(marked) if marked in self._sessions else 0

    @property
    def marked(self) -> Endpoint | None:
        """The session under the mark."""
        at = self._list.highlighted
        return self._sessions[at] if at is not None and at < len(self._sessions) else None

    def at(self, index: int) -> Endpoint:
        """Return the session in a line of the list."""
        return self._sessions[index]


class Help(ModalScreen[None]):
    """The keys and how to read the screen; any key closes it (and s still stops)."""

    DEFAULT_CSS = """
    Help { align: center middle; }
    Help Static {
        width: 70; max-width: 100%; height: auto; padding: 1 2;
        border: round $primary; background: $surface; border-title-style: bold;
    }
    """

    def compose(self) -> ComposeResult:
        """Put the page in the middle."""
        page = Static(HELP)
        page.border_title = "bramah monitor"
        yield page

    def on_key(self) -> None:
        """Close."""
        self.dismiss()
