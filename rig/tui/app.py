"""`bramah monitor`: the operator's screen. It renders the link's newest frame, nothing else.

Closing, hanging or crashing does not affect the run, which is another process.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import ClassVar, Final

from textual import events
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.driver import Driver
from textual.message import Message

from rig.bench.screens.commands import own_command
from rig.bench.screens.sockets import Endpoint
from rig.model.alarms.states import AlarmTable
from rig.model.parts import Wire
from rig.tui.acting.starts import Starts
from rig.tui.browse import BrowserState
from rig.tui.canvas import Canvas
from rig.tui.following.event_lines import KINDS
from rig.tui.following.link import Frame, Link, LinkStage, LocalSessions
from rig.tui.look import OF_A_RECORDED_RUN, PAGES, Dialog, PlotView, ScreenStyle
from rig.tui.pages.operation import in_order
from rig.tui.pages.parts import joints_in
from rig.tui.pages.whole import compose
from rig.tui.words import LINGER, Stop

SPANS: Final = (2.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0)  # of plots [s of device time]
LEAST_CROSSING: Final = 5.0  # least wall time in which a curve crosses its plot [s]
SLOW: Final = 0.2  # interval of redrawing ages while nothing arrives [s]
BLINK: Final = 0.5  # half a period of an unacknowledged alarm [s]
DOUBLE_PRESS: Final = 0.7  # two presses of Escape within this time stop [s]
ALARM_WINDOW: Final = 60.0  # of samples held while alarms are on the screen [s]

HELP: Final = (
    "SPACE, s or Esc-Esc STOP: all outputs to zero, at once, on every page",
    "1 … 9, 0            pages: overview, joint, channel, diagnostics,",
    "                    alarms, protocol, log, estimates, manual, runs",
    "t                   take the controls, or release them",
    "p  n  x  a          pause or resume, skip the step, abort, answer",
    "k  r                acknowledge an alarm; reset a latched one",
    "l  u  d             manual: lock, unlock, let the pressure out",
    "Enter               manual: start; runs: what can be done",
    "/  f  e             logs: search, filter, newest line",
    "← → ↑ ↓  PgUp PgDn  joint, channel, marked line, scroll",
    "+  −  =             plots: longer, shorter, automatic; z zooms to data",
    "h                   hold the picture; the run goes on",
    "c                   choose another run",
    "q                   quit this screen; the run goes on",
    "",
    "● normal  ? asks you  ▲ warning  ■ alarm  □ ended",
    "◌ stale   ⊘ disconnected   ✕ invalid   ‖ held",
)


def with_early_keys(kind: type[Driver], early: Callable[[events.Key], None]) -> type[Driver]:
    """Return a driver class that passes keys to `early` as soon as they are read."""

    class EarlyKeys(kind):  # type: ignore[misc, valid-type]
        def process_message(self, message: Message) -> None:
            if isinstance(message, events.Key):
                early(message)
            super().process_message(message)

    return EarlyKeys


def automatic_span(speed: float) -> float:
    """Return the shortest span in which a curve moves slowly enough to be read."""
    # A run in real time has a speed around 1, which must not alternate between two spans.
    return next((s for s in SPANS[2:] if s / speed > LEAST_CROSSING), SPANS[-1])


class Monitor(Starts, App[int]):
    """The operator's screen: attach, watch, stop, command."""

    TITLE = "bramah monitor"
    ENABLE_COMMAND_PALETTE = False
    CSS = "Screen, Canvas { background: ansi_default; color: ansi_default; }"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("ctrl+c", "leave(130)", "quit", show=False, priority=True),
        Binding("ctrl+q", "leave(0)", "quit", show=False, priority=True),
    ]

    def __init__(
        self,
        rig: str | None = None,
        sessions: LocalSessions | None = None,
        clock: Callable[[], float] = time.monotonic,
        *,
        threaded: bool = True,
        browsed: BrowserState | None = None,
    ) -> None:
        App.__init__(self, ansi_color=True)  # the 16 colours of the terminal itself
        self.rig, self.clock, self._threaded = rig, clock, threaded
        self.link = Link(sessions or LocalSessions(rig), clock)
        self.me = own_command("take").holder
        self.look = ScreenStyle()
        self.browsed = browsed or BrowserState()
        self.dialog: Dialog | None = None
        self.accept: Callable[[str], None] | None = None  # takes the answer to the open question
        self.remark = ""
        self.stop_asked: Stop | None = None  # the newest stop and its result
        self.seen_alarms: frozenset[tuple[int, str]] = frozenset()  # acknowledged after the end
        self.reset_alarms: frozenset[tuple[int, str]] = frozenset()
        self.marked_session: Endpoint | None = None
        self._span: float | None = None  # None: automatic
        self._held_frame: Frame | None = None  # frame of a held picture
        self._drawn_frame: object = None
        self._listed_state: object = None  # state of the link when the folder was read
        self._last_drawn = -float("inf")
        self._last_escape = -float("inf")
        self._stopped_by: events.Key | None = None  # the newest key that has already stopped
        self._tick_task: asyncio.Task[None] | None = None
        self._wake: Callable[[], None] = lambda: None  # ends the wait for the next picture
        self.canvas = Canvas()
        self.pictures = 0  # drawn since the start; none while nothing changes

    def compose(self) -> ComposeResult:
        """The whole screen is one widget."""
        yield self.canvas

    def on_mount(self) -> None:
        """Start the link and the clock of the screen."""
        if self._threaded:
            self.link.start()
            self._tick_task = asyncio.create_task(self._tick())
        self.draw()

    async def _tick(self) -> None:
        """Draw as soon as the link has a new window; more rarely while nothing can change."""
        loop, woken = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            with suppress(RuntimeError):  # the screen has closed
                loop.call_soon_threadsafe(woken.set)

        self._wake = self.link.on_window = wake
        while True:
            frame = self.link.frame
            idle = self._drawn_frame is frame and not frame.live
            with suppress(TimeoutError):
                await asyncio.wait_for(woken.wait(), BLINK if idle else SLOW)
            woken.clear()
            self.draw()

    def on_unmount(self) -> None:
        """Detach from the run."""
        if self._tick_task is not None:
            self._tick_task.cancel()
        self.link.close()

    def on_resize(self) -> None:
        """Draw in the new size."""
        self.call_after_refresh(self.draw, force=True)

    # The picture

    def view(self) -> PlotView:
        """Return all data of the picture."""
        newest = self.link.frame
        if newest.stage is LinkStage.CHOOSING and self.marked_session not in newest.sessions:
            self.marked_session = newest.sessions[0] if newest.sessions else None
        span = self._span or automatic_span(newest.speed)
        self.link.window_seconds = max(span, ALARM_WINDOW) if self.look.page == "alarms" else span
        if self.look.seconds != span:
            self.look = replace(self.look, seconds=span)
        return PlotView(
            frame=self._held_frame or newest,
            newest=newest,
            now=self.clock(),
            look=self.look,
            alarms=self.alarms_of(newest),
            stop=self.stop_asked,
            dialog=self.dialog,
            remark=self.remark,
            me=self.me,
            rig=self.rig,
            browsed=self.browsed,
            marked_session=self.marked_session,
        )

    def draw(self, *, force: bool = False) -> None:
        """Draw changed parts, and time-dependent parts while anything is in progress."""
        frame, now = self.link.frame, self.clock()
        self._list_again(frame)
        blink = int(now / BLINK) % 2 == 0 if self.alarms_of(frame).unacknowledged else True
        if blink != self.look.blink:
            self.look = replace(self.look, blink=blink)
            force = True
        unchanged = self._drawn_frame is frame and not force
        stop_shown = self.stop_asked is not None and now - self.stop_asked.at < LINGER
        idle = not frame.live and not stop_shown
        if unchanged and (idle or now - self._last_drawn < SLOW):
            return
        self._drawn_frame, self._last_drawn = frame, now
        size = self.size
        self.canvas.show(compose(self.view(), size.width, size.height))
        self.pictures += 1

    def alarms_of(self, frame: Frame) -> AlarmTable:
        """Return the alarms of a frame, with acknowledgements and resets made after its end."""
        snapshot = frame.snapshot
        if snapshot is None:
            return AlarmTable()
        alarms = []
        for alarm in snapshot.alarms:
            name = (snapshot.pid, alarm.key)
            if name not in self.reset_alarms:
                alarms.append(
                    replace(alarm, acknowledged=True) if name in self.seen_alarms else alarm
                )
        return AlarmTable(tuple(alarms))

    # Keys

    def get_driver_class(self) -> type[Driver]:
        """Return the terminal's driver, which passes keys to `early_key` before any queue."""
        return with_early_keys(super().get_driver_class(), self.early_key)

    def early_key(self, event: events.Key) -> None:
        """Stop a live run from the thread that reads the terminal, before any drawing."""
        stops = event.key == "space" or (event.key == "s" and self.dialog is None)
        if stops and self.link.frame.live:
            self._stopped_by = event
            self.act_stop()

    def on_key(self, event: events.Key) -> None:
        """Handle a key; the stop comes before everything else."""
        event.stop()
        event.prevent_default()
        key = event.key
        typing = self.dialog is not None and self.dialog.text is not None
        choosing = self.link.frame.stage is LinkStage.CHOOSING
        if event is self._stopped_by:
            self._stopped_by = None
        elif key == "space" and (self.link.frame.live or choosing or not typing):
            self.act_stop()
        elif key == "escape":
            self._escape()
        elif self.dialog is not None:
            self._answer(self.dialog, key, event.character)
        elif key == "s":
            self.act_stop()
        else:
            self._page_key(key, event.character or "")
        self.draw(force=True)

    def _escape(self) -> None:
        now = self.clock()
        if now - self._last_escape <= DOUBLE_PRESS:
            self._last_escape = -float("inf")
            self.act_stop()
        else:
            self._last_escape = now
        self.dialog, self.accept = None, None

    def ask(self, dialog: Dialog, accept: Callable[[str], None] | None = None) -> None:
        """Open a question above the page; `accept` is called with its answer."""
        self.dialog, self.accept = dialog, accept

    def _answer(self, dialog: Dialog, key: str, character: str | None) -> None:
        """Pass a key to the open question: type, mark, accept."""
        if key == "enter" or (dialog.text is None and not dialog.choices):
            accept, self.dialog, self.accept = self.accept, None, None
            if accept is not None and key == "enter":
                chosen = dialog.choices[dialog.marked] if dialog.choices else ""
                accept(chosen if dialog.text is None else dialog.text)
        elif dialog.choices and key in ("up", "down"):
            marked = dialog.marked + (1 if key == "down" else -1)
            self.dialog = replace(dialog, marked=marked % len(dialog.choices))
        elif dialog.text is not None and key == "backspace":
            self.dialog = replace(dialog, text=dialog.text[:-1])
        elif dialog.text is not None and character and character.isprintable():
            self.dialog = replace(dialog, text=(dialog.text + character)[:400])

    def _page_key(self, key: str, character: str) -> None:
        page = next((name for number, name, _ in PAGES if number == character), None)
        if key not in ("up", "down"):  # a held key must not clear its own answer
            self.remark = ""
        if page is not None:
            self.open_page(page)
        elif self.link.frame.stage is LinkStage.CHOOSING and key in ("up", "down", "enter"):
            self._choose(key)
        elif key in ("up", "down", "left", "right", "pageup", "pagedown", "home", "end"):
            self._move(key)
        elif character in self.ACTS:
            getattr(self, f"act_{self.ACTS[character]}")()
        elif key == "enter":
            self.act_enter()

    def open_page(self, page: str) -> None:
        """Show a page from its beginning."""
        back = self.look.page in OF_A_RECORDED_RUN and page in ("runs", *OF_A_RECORDED_RUN)
        opens = self.look.page == "runs" and page in OF_A_RECORDED_RUN
        marked = self.look.marked if back or opens else 0
        self.look = replace(self.look, page=page, marked=marked, offset=0)
        if page == "runs":
            self._list_again(self.link.frame, force=True)

    def _list_again(self, frame: Frame, *, force: bool = False) -> None:
        """Read the folder of an open page of runs if a run has begun or ended since it was read."""
        state = (frame.stage, frame.snapshot is None)
        is_open = self.look.page == "runs" and not self.browsed.reading
        if force or (is_open and state != self._listed_state):
            self._listed_state = state
            self.read_folder()

    def _choose(self, key: str) -> None:
        sessions = self.link.frame.sessions
        if key == "enter":
            self.link.choose(self.marked_session)
        elif sessions:
            index = sessions.index(self.marked_session) if self.marked_session in sessions else 0
            self.marked_session = sessions[(index + (1 if key == "down" else -1)) % len(sessions)]

    def _move(self, key: str) -> None:
        look, snapshot = self.look, self.link.frame.snapshot
        steps = {"up": -1, "down": 1, "pageup": -10, "pagedown": 10, "home": -9999, "end": 9999}
        step = steps.get(key, 0)
        joints = len(joints_in(snapshot.channels)) if snapshot else 0
        if look.page == "run trace" and key in ("left", "right"):
            self.look = replace(look, channel=max(look.channel + (1 if key == "right" else -1), 0))
        elif look.page == "run trace":
            self.look = replace(look, offset=max(look.offset + step, 0))
        elif look.page in ("log", "run log"):
            self.look = replace(look, offset=max(look.offset - step, 0))
        elif look.page == "overview":
            self.look = replace(look, offset=min(max(look.offset + step, 0), max(joints - 1, 0)))
        elif look.page == "channel":
            last = len(snapshot.channels) - 1 if snapshot else 0
            self.look = replace(look, channel=min(max(look.channel + step, 0), max(last, 0)))
        elif look.page in ("joint", "manual") and key in ("left", "right"):
            joint = look.joint + (1 if key == "right" else -1)
            self.look = replace(look, joint=min(max(joint, 1), max(joints, 1)))
        elif look.page == "manual":
            self.act_jog(key)
        elif look.page == "runs" and key in ("left", "right"):
            self.act_tab(1 if key == "right" else -1)
        elif look.page == "runs" and key in ("pageup", "pagedown"):
            self.look = replace(look, offset=max(look.offset + step, 0))
        else:
            self.look = replace(look, marked=min(max(look.marked + step, 0), self.last_marked()))

    def last_marked(self) -> int:
        """Return the number of the last line that can be marked on this page."""
        if self.look.page == "alarms":
            return max(len(in_order(self.view())) - 1, 0)
        return max(self.browsed.lines - 1, 0)

    # How it is shown

    def act_help(self) -> None:
        """Show the keys."""
        self.ask(Dialog("keys", HELP, keys="any key closes; SPACE stops"))

    def act_hold(self) -> None:
        """Hold the picture, or let it continue."""
        self._held_frame = None if self._held_frame is not None else self.link.frame

    def act_zoom(self) -> None:
        """Scale the plots to the data or to the limits."""
        self.look = replace(self.look, zoomed=not self.look.zoomed)

    def _step_span(self, step: int) -> None:
        index = SPANS.index(self.look.seconds) + step
        self._span = SPANS[min(max(index, 0), len(SPANS) - 1)]

    def act_longer(self) -> None:
        """Show more of the past."""
        self._step_span(1)

    def act_shorter(self) -> None:
        """Show less of the past."""
        self._step_span(-1)

    def act_automatic(self) -> None:
        """Choose the span automatically."""
        self._span = None

    def act_filter(self) -> None:
        """Show one kind of line in the log, or all."""
        index = (KINDS.index(self.look.only) + 1) % len(KINDS)
        self.look = replace(self.look, only=KINDS[index], offset=0)

    def act_search(self) -> None:
        """Ask for a text to search in the log."""

        def search(text: str) -> None:
            page = self.look.page if self.look.page == "run log" else "log"
            self.look = replace(self.look, search=text.strip(), page=page, offset=0)

        lines = ("Lines that contain the text are kept; an empty text keeps all.",)
        self.ask(Dialog("search", lines, text="", keys="Enter keeps, Esc closes"), search)

    def act_end(self) -> None:
        """Go to the newest line."""
        self.look = replace(self.look, offset=0)

    def act_choose(self) -> None:
        """Return to the list of runs, or after the end of one to the only other."""
        frame = self.link.frame
        others = [session for session in frame.sessions if session != frame.endpoint]
        if not others:
            self.remark = "No other run to choose."
        else:
            self.link.choose(others[0] if frame.over and len(others) == 1 else None)

    def act_quit(self) -> None:
        """Close the screen; the run goes on."""
        self.action_leave(0)

    def action_leave(self, code: int) -> None:
        """Close the screen and state what happens to the run."""
        self.exit(code, message=farewell(self.link.frame))

    def redraw(self) -> None:
        """Draw at once; any thread may call this."""
        self._drawn_frame = None
        self._wake()


def farewell(frame: Frame) -> str:
    """Return the line left in the terminal when the screen closes."""
    if frame.endpoint is None or frame.snapshot is None:
        return "bramah: screen closed; no run was attached"
    snapshot = frame.snapshot
    what = f"run {snapshot.run}" if snapshot.run else f"the {snapshot.kind} session"
    if frame.over:
        return f"bramah: screen closed; {what} had ended ({snapshot.state})"
    return (
        f"bramah: screen closed; {what} GOES ON "
        f"(watch it again: bramah monitor --rig {frame.endpoint.rig})"
    )


def main(rig: str | None, browsed: BrowserState | None = None, wire: Wire | None = None) -> int:
    """Show the screen until the operator leaves it; return the exit code (0, or 130 on Ctrl-C).

    Of several runs of a rig it shows that at `wire`.
    """
    code = Monitor(rig, LocalSessions(rig, wire), browsed=browsed).run()
    return 0 if code is None else code
