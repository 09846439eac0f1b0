"""`bramah monitor`: the operator's screen. It renders the link's newest frame, nothing else.

The screen may come, go, hang or crash: the run is another process and does not notice.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, Final

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.widgets import ContentSwitcher, Footer, OptionList, RichLog

from rig.tui.link import FRAME, Frame, Link, LinkStage, LocalSessions, Sessions
from rig.tui.panels import BenchPanel, HeaderPanel, Notices, PanelLook
from rig.tui.screens import Chooser, Help, Waiting
from rig.tui.units import age_text
from rig.tui.words import OLD, KeyAnswer, Stop, is_live, notices

SPANS: Final = (5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0)  # of the plots [s of device time]
CROSSING: Final = 5.0  # least wall time in which a curve crosses its plot [s]
SLOW: Final = 0.2  # ages and notices are redrawn this often even when nothing arrives [s]


def automatic_span(speed: float) -> float:
    """Return the shortest span that a curve does not cross too fast to be read."""
    # A run in real time jitters around speed 1 and must not flip between two spans.
    return next((s for s in SPANS[1:] if s / speed > CROSSING), SPANS[-1])


class Monitor(App[int]):
    """Attach, watch, stop."""

    TITLE = "bramah monitor"
    ENABLE_COMMAND_PALETTE = False
    CSS = """
    Screen { layout: vertical; }
    #main { height: 1fr; }
    #log { height: 3; padding: 0 1; scrollbar-size: 0 0; background: $background; }
    .tall #log { height: 6; }
    """
    # Priority: no widget that has the focus, and no page on top, may swallow a stop.
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("s,space", "stop", "STOP outputs", key_display="s/space", priority=True),
        Binding("p", "pause", "pause"),
        Binding("z", "zoom", "zoom"),
        Binding("plus,equals_sign", "span(1)", "longer", show=False),
        Binding("minus", "span(-1)", "shorter", show=False),
        Binding("0", "span(0)", "automatic span", show=False),
        Binding("up", "scroll(-1)", "scroll", show=False),
        Binding("down", "scroll(1)", "scroll", show=False),
        Binding("c", "choose", "runs"),
        Binding("question_mark", "help", "help", key_display="?"),
        Binding("q", "leave(0)", "quit, run goes on", priority=True),
        Binding("ctrl+c", "leave(130)", "quit", show=False, priority=True),
    ]

    def __init__(
        self,
        rig: str | None = None,
        sessions: Sessions | None = None,
        clock: Callable[[], float] = time.monotonic,
        *,
        threaded: bool = True,
    ) -> None:
        super().__init__()
        self._rig, self._clock, self._threaded = rig, clock, threaded
        self.link = Link(sessions or LocalSessions(rig), clock)
        self._span: float | None = None  # None: automatic
        self._look = PanelLook()
        self._held: Frame | None = None  # what a paused display shows
        self._drawn: object = None
        self._slow = -float("inf")
        self.stop_asked: Stop | None = None  # the newest stop and what became of it
        self._told = 0
        self._header, self._notices = HeaderPanel(id="header"), Notices(id="notices")
        self._chooser, self._bench = Chooser(id="chooser"), BenchPanel(id="bench")
        self._events = RichLog(id="log", markup=False, wrap=True, min_width=20, max_lines=500)
        self._events.can_focus = False

    def compose(self) -> ComposeResult:
        """Lay the screen out: header, notices, bench (or what stands in for it), log, keys."""
        yield self._header
        yield self._notices
        with ContentSwitcher(initial="waiting", id="main"):
            yield Waiting(self._rig, id="waiting")
            yield self._chooser
            yield self._bench
        yield self._events
        yield Footer()

    def on_mount(self) -> None:
        """Start the link and the clock of the screen."""
        if self._threaded:
            self.link.start()
            self.set_interval(FRAME, self.draw)
        self.draw()

    def on_unmount(self) -> None:
        """Let go of the run."""
        self.link.close()

    def on_resize(self) -> None:
        """Give a tall terminal a taller log."""
        self.screen.set_class(self.size.height >= 36, "tall")
        self.call_after_refresh(self.draw, force=True)

    def draw(self, *, force: bool = False) -> None:
        """Draw the newest frame if it has changed, and what depends on time every so often."""
        if not self._bench.is_attached:
            return  # the screen is being taken down around a last tick of its timer
        frame, now = self.link.frame, self._clock()
        if frame is self._drawn and now - self._slow < SLOW and not force:
            return
        self._drawn, self._slow = frame, now
        self._header.show(frame, now)
        paused = self._held is not None
        self._notices.show(notices(frame, self.stop_asked, now, paused=paused))
        self._draw_log(frame)
        self._draw_main(frame, now)

    def _draw_log(self, frame: Frame) -> None:
        fresh = min(frame.told - self._told, len(frame.story))
        self._told = frame.told
        for line in frame.story[len(frame.story) - fresh :]:
            time = (f"{line.device_time:9.2f} s  ", OLD)
            self._events.write(Text.assemble(time, (line.text, line.style)))

    def _draw_main(self, frame: Frame, now: float) -> None:
        main = self.query_one(ContentSwitcher)
        if frame.stage is LinkStage.CHOOSING:
            self._chooser.show(frame.sessions, appearing=main.current != "chooser")
            main.current = "chooser"
        elif frame.snapshot is None:
            main.current = "waiting"
        else:
            main.current = "bench"
            self._draw_bench(self._held or frame, frame, now)

    def _draw_bench(self, shown: Frame, newest: Frame, now: float) -> None:
        if shown.snapshot is None:
            return
        self.link.window_seconds = seconds = self._span or automatic_span(newest.speed)
        live = self._held is None and is_live(newest, now)
        self._look = replace(self._look, seconds=seconds, live=live)
        if live:
            remark = ""
        elif newest.over:
            remark = " · last picture"
        elif self._held is not None:
            remark = f" · paused at {shown.snapshot.device_time:.1f} s"
        else:
            remark = f" · OLD, {age_text(newest.age(now))}"
        if not self._bench.show(shown, self._look, remark):
            self.call_after_refresh(self.draw, force=True)

    def action_stop(self) -> None:
        """Zero the outputs of the run on the screen, or of the one marked in the chooser."""
        frame = self.link.frame
        choosing = frame.stage is LinkStage.CHOOSING
        endpoint = self._chooser.marked if choosing else frame.endpoint
        if endpoint is None:
            self.stop_asked = Stop(self._clock(), None, KeyAnswer.NOWHERE)
        else:
            self.stop_asked = stop = Stop(self._clock(), endpoint)
            self.link.stop(endpoint, lambda answered: self._answered(stop, answered))
            if choosing:
                self.link.choose(endpoint)
        self.draw(force=True)

    def _answered(self, stop: Stop, answered: bool) -> None:
        # Called by the sending thread; replacing one attribute needs no lock.
        if self.stop_asked is stop:
            self.stop_asked = replace(stop, answer=KeyAnswer.TAKEN if answered else KeyAnswer.NONE)
            self._slow = -float("inf")

    def action_pause(self) -> None:
        """Hold the picture, or let it live again."""
        self._held = None if self._held is not None else self.link.frame
        self.draw(force=True)

    def action_zoom(self) -> None:
        """Scale the plots to the data or to the limits."""
        self._look = replace(self._look, zoomed=not self._look.zoomed)
        self.draw(force=True)

    def action_span(self, step: int) -> None:
        """Show more or less of the past; 0 leaves it to the screen."""
        if step == 0:
            self._span = None
        else:
            at = SPANS.index(self._look.seconds) + step
            self._span = SPANS[min(max(at, 0), len(SPANS) - 1)]
        self.draw(force=True)

    def action_scroll(self, rows: int) -> None:
        """Scroll a bench of more joints than fit."""
        self._bench.scroll_relative(y=5 * rows, animate=False)

    def action_choose(self) -> None:
        """Go back to the list of runs; with a single one there is nothing to choose."""
        if len(self.link.frame.sessions) < 2:
            self.notify("No other run to choose.")
        else:
            self.link.choose(None)

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Attach to the chosen run."""
        self.link.choose(self._chooser.at(event.option_index))

    def action_help(self) -> None:
        """Show the page of help."""
        self.push_screen(Help())

    def action_leave(self, code: int) -> None:
        """Close the screen and say what becomes of the run."""
        self.exit(code, message=farewell(self.link.frame))


def farewell(frame: Frame) -> str:
    """Return the line left in the terminal when the screen closes."""
    if frame.endpoint is None or frame.snapshot is None:
        return "bramah: screen closed; no run was attached"
    if frame.over:
        return f"bramah: screen closed; run {frame.snapshot.run} had ended ({frame.snapshot.state})"
    return (
        f"bramah: screen closed; run {frame.snapshot.run} GOES ON "
        f"(watch it again: bramah monitor --rig {frame.endpoint.rig})"
    )


def main(rig: str | None) -> int:
    """Show the screen until the operator leaves it; return the exit code (0, or 130 on Ctrl-C)."""
    code = Monitor(rig).run()
    return 0 if code is None else code
