"""The bench as widgets: three header lines, notices, one panel per joint."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from rich.console import Group, RenderableType
from rich.text import Text
from textual.app import ComposeResult
from textual.containers import ItemGrid, Vertical
from textual.widgets import Static

from rig.bench.screens.sockets import ChannelView
from rig.model import channels as ch
from rig.tui.gauge import LABEL, gauge
from rig.tui.link import Frame
from rig.tui.plot import LivePlot, PlotTrace
from rig.tui.units import limit, shown
from rig.tui.words import OLD, Notice, header, value

_JOINT_CHANNEL = re.compile(r"^(?P<kind>.+)_(?P<joint>[1-9]\d*)$")

# What is drawn as a curve, with its name and colour; the rest of a joint's channels are gauges.
PLOTS: Final = {
    ch.CAP: ("cap", "cyan"),
    ch.ROD: ("rod", "magenta"),
    "position": ("position", "cyan"),
    "drive": ("drive", "magenta"),
}
WIDTH, HEIGHT = 38, 13  # of a joint's panel, at least [characters]
GAUGES: Final = (ch.PISTON, ch.SPOOL, ch.COMMAND)


@dataclass(frozen=True)
class PanelLook:
    """How the operator wants the bench shown: seconds of the past, and zoomed to the data."""

    seconds: float = 10.0
    zoomed: bool = False
    live: bool = True


def joints_in(channels: Iterable[str]) -> dict[int, list[str]]:
    """Return the channels of every joint, joints in order: {1: ["spool_1", ...], ...}."""
    found: dict[int, list[str]] = {}
    for name in channels:
        match = _JOINT_CHANNEL.match(name)
        if match is not None:
            found.setdefault(int(match["joint"]), []).append(name)
    return dict(sorted(found.items()))


class HeaderPanel(Static):
    """The three lines on top."""

    DEFAULT_CSS = "Header { height: 3; }"

    def show(self, frame: Frame, now: float) -> None:
        """Draw the header of this frame."""
        lines = header(frame, now, self.size.width or 80)
        for line in lines:
            line.no_wrap, line.overflow = True, "ellipsis"
        self.update(Group(*lines), layout=False)


class Notices(Static):
    """The lines that the operator must not miss; no height when there is none."""

    DEFAULT_CSS = """
    Notices { height: auto; max-height: 8; display: none; }
    """
    STYLES: Final = {
        "alarm": "bold white on red",
        "warn": "black on yellow",
        "good": "bold black on green",
        "info": "bold white on blue",
    }

    def __init__(self, id: str | None = None) -> None:
        super().__init__(id=id)
        self._shown: tuple[tuple[Notice, ...], int] = ((), 0)

    def show(self, notices: Sequence[Notice]) -> None:
        """Draw these notices, each on its own colour over the whole width."""
        width = max(self.app.size.width, 20)
        if self._shown == (tuple(notices), width):
            return
        self._shown = (tuple(notices), width)
        self.display = bool(notices)
        console = self.app.console
        lines: list[RenderableType] = []
        for notice in notices:
            for part in Text(notice.text).wrap(console, width - 2):
                part.rstrip()
                padded = f" {part.plain:<{width - 1}}"
                lines.append(Text(padded, self.STYLES[notice.level], no_wrap=True))
        self.update(Group(*lines))


class Curve(Vertical):
    """One channel: its newest value, its range over the window, and its plot."""

    DEFAULT_CSS = """
    Curve { height: 1fr; min-height: 3; }
    Curve Static { height: 1; }
    """

    def __init__(self, label: str, colour: str) -> None:
        super().__init__()
        self._label, self._colour = label, colour
        self._words = Static(classes="words")
        self._plot = LivePlot()

    def compose(self) -> ComposeResult:
        """Put the words above the plot."""
        yield self._words
        yield self._plot

    def show(self, name: str, view: ChannelView, frame: Frame, look: PanelLook) -> None:
        """Draw the channel as of this frame."""
        window = frame.window
        stop = float(window.time[-1]) if len(window.time) else 0.0
        start = stop - look.seconds
        low, high = window.of(name)
        how = shown(view.unit)
        line = Text(f"{self._label:<{LABEL}}", f"bold {self._colour}" if look.live else OLD)
        line.append_text(value(view, live=look.live))
        if (span := window.span(name, start)) is not None:
            line.append(f"   {how.number(span[0])} … {how.number(span[1])}", OLD)
        self._words.update(line, layout=False)
        self._plot.show(
            PlotTrace(
                window.time,
                low,
                high,
                start,
                stop,
                (limit(view.low), limit(view.high)),
                how,
                self._colour,
                look.live,
                look.zoomed,
            )
        )


class JointPanel(Vertical):
    """A joint: chamber pressures as curves, piston and spool as gauges."""

    DEFAULT_CSS = """
    JointPanel { border: round $primary; padding: 0 1; height: 1fr; }
    JointPanel.old { border: round $foreground-darken-3; }
    """

    def __init__(self, joint: int, channels: Sequence[str]) -> None:
        super().__init__()
        self.joint = joint
        names = {kind: ch.channel(kind, joint) for kind in (*PLOTS, *GAUGES)}
        self._curves = {
            names[kind]: Curve(*PLOTS[kind]) for kind in PLOTS if names[kind] in channels
        }
        self._gauges = [(kind, names[kind]) for kind in GAUGES if names[kind] in channels]
        self._bars = Static()
        self._bars.styles.height = len(self._gauges)

    def compose(self) -> ComposeResult:
        """Put the curves above the gauges."""
        self.border_title = f"joint {self.joint}"
        yield from self._curves.values()
        yield self._bars

    def show(self, frame: Frame, look: PanelLook, remark: str) -> None:
        """Draw the joint as of this frame; `remark` says beside its name when it is not live."""
        snapshot = frame.snapshot
        if snapshot is None:
            return
        self.set_class(not look.live, "old")
        self._entitle(f"joint {self.joint}{remark}", f"last {look.seconds:g} s")
        for name, curve in self._curves.items():
            if (view := snapshot.channels.get(name)) is not None:
                curve.show(name, view, frame, look)
        stop = float(frame.window.time[-1]) if len(frame.window.time) else 0.0
        lines = [
            gauge(
                kind,
                view,
                frame.window.span(name, stop - look.seconds),
                frame.window.reach.get(name),
                self._bars.size.width,
                live=look.live,
            )
            for kind, name in self._gauges
            if (view := snapshot.channels.get(name)) is not None
        ]
        self._bars.update(Group(*lines), layout=False)

    def _entitle(self, title: str, subtitle: str) -> None:
        # Setting a border's words lays the whole screen out anew, even where they stay the same.
        if self.border_title != title:
            self.border_title = title
        if self.border_subtitle != subtitle:
            self.border_subtitle = subtitle


class BenchPanel(ItemGrid):
    """The joints side by side, as many as fit; made anew when a run has others."""

    DEFAULT_CSS = "Bench { height: 1fr; overflow-y: auto; scrollbar-size-vertical: 1; }"

    def __init__(self, id: str | None = None) -> None:
        super().__init__(id=id, min_column_width=WIDTH)
        self._joints: dict[int, list[str]] = {}
        self._panels: list[JointPanel] = []

    def on_resize(self) -> None:
        """Give every row of joints its share of the height, but enough to be read."""
        columns = max(min(self.size.width // WIDTH, len(self._joints)), 1)
        rows = -(-len(self._joints) // columns) or 1
        share = max(self.size.height // rows, HEIGHT)
        self.styles.grid_rows = "1fr" if rows == 1 else str(share)

    def show(self, frame: Frame, look: PanelLook, remark: str) -> bool:
        """Draw the bench as of this frame; False when its panels have first to be mounted."""
        joints = joints_in(frame.snapshot.channels) if frame.snapshot else {}
        if joints != self._joints:
            for panel in self._panels:
                panel.remove()
            self._joints = joints
            self._panels = [JointPanel(joint, names) for joint, names in joints.items()]
            self.mount(*self._panels)
            self.on_resize()
            return False
        for panel in self._panels:
            panel.show(frame, look, remark)
        return True
