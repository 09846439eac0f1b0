"""The operator's choices of display, and all data of a page; immutable."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from rig.bench.screens.sockets import Endpoint
from rig.model.alarms.states import AlarmTable
from rig.tui.browse import BrowserState
from rig.tui.following.link import Frame
from rig.tui.words import Freshness, Stop, freshness

# The key of each page, its name, and a short name.
PAGES: Final = (
    ("1", "overview", "over"),
    ("2", "joint", "joint"),
    ("3", "channel", "chan"),
    ("4", "diagnostics", "diag"),
    ("5", "alarms", "alarm"),
    ("6", "protocol", "prot"),
    ("7", "log", "log"),
    ("8", "estimates", "est"),
    ("9", "manual", "man"),
    ("0", "runs", "runs"),
)
OF_A_RECORDED_RUN: Final = ("run log", "run trace")  # opened from the page of runs


@dataclass(frozen=True)
class ScreenStyle:
    """The operator's choices: page, joint, channel, marked line, span of the plots, filters."""

    page: str = "overview"
    joint: int = 1
    channel: int = 0
    marked: int = 0
    offset: int = 0  # lines scrolled away from the newest, or joints from the first
    seconds: float = 10.0
    zoomed: bool = False
    search: str = ""
    only: str = "all"
    blink: bool = True


@dataclass(frozen=True)
class Dialog:
    """A question above the page: a line of text, a choice, yes or no, or a page to read."""

    title: str
    body: tuple[str, ...] = ()
    text: str | None = None  # None: no line to type in
    choices: tuple[str, ...] = ()
    marked: int = 0
    keys: str = "Esc closes"


@dataclass(frozen=True)
class PlotView:
    """One picture: `frame` is shown, `newest` is the link's newest (they differ while held)."""

    frame: Frame
    newest: Frame
    now: float
    look: ScreenStyle = field(default_factory=ScreenStyle)
    alarms: AlarmTable = field(default_factory=AlarmTable)
    stop: Stop | None = None
    dialog: Dialog | None = None
    remark: str = ""  # result of the operator's newest action
    me: str = ""  # this screen, as a holder of the controls
    rig: str | None = None
    browsed: BrowserState = field(default_factory=BrowserState)
    marked_session: Endpoint | None = None

    @property
    def held(self) -> bool:
        """Whether the operator holds the picture."""
        return self.frame is not self.newest

    @property
    def fresh(self) -> Freshness:
        """Freshness of the numbers."""
        return freshness(self.newest, self.now, held=self.held)

    @property
    def in_command(self) -> bool:
        """Whether this screen holds the controls."""
        snapshot = self.newest.snapshot
        return snapshot is not None and bool(self.me) and snapshot.holder == self.me
