"""The link to a run: a thread that receives snapshots and hands immutable frames to the screen.

The screen never waits for the wire and the run never waits for the screen. A stop has a separate
connection and thread, so that it is sent at once whatever the receiving side is doing.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Final

from rig.bench.latch import BenchState, bench_name
from rig.bench.screens.commands import own_command
from rig.bench.screens.snapshot import PlanLine
from rig.bench.screens.sockets import Attachment, Endpoint, Snapshot
from rig.model.parts import Wire
from rig.runs.runstate import read_events
from rig.tui.following.event_lines import EventLine, from_events, new_lines, with_earlier
from rig.tui.following.history import EMPTY, History, HistoryWindow

log = logging.getLogger(__name__)

FRAME: Final = 1 / 10  # shortest time between two frames [s]
POLL: Final = 0.1  # longest wait for a snapshot [s]
SEARCH_INTERVAL: Final = 0.5  # between two searches for a session while none is attached [s]
QUIET: Final = 0.5  # a run silent for this long is stale, and its process is checked [s]
KEPT_LINES: Final = 2000  # of the event log, and of estimates
ANSWER_TIME: Final = 1.0  # time limit of a run's answer with its recent history [s]
FIRST_WORD: Final = 0.5  # longest wait for the first snapshot of a session [s]
ENDED_STATES: Final = frozenset({"done", "aborted", "tripped", "interrupted"})


class LocalSessions:
    """The sessions of this machine's user, over the local sockets.

    `wire` is the bench whose session is wanted, None for every bench of the rig.
    """

    def __init__(self, rig: str | None, wire: Wire | None = None) -> None:
        self._rig, self._wire = rig, wire

    def find(self) -> Sequence[Endpoint]:
        """Return the live sessions of the rig (of every rig when it is None) and the bench."""
        sessions = Attachment.find(self._rig)
        if self._wire is None:
            return sessions
        holder = BenchState(self._wire).holder()
        return [s for s in sessions if holder is not None and s.pid == holder.pid]

    def open(self, endpoint: Endpoint) -> Attachment:
        """Connect to one of them; raises OSError if it has just ended."""
        return Attachment(endpoint)


class LinkStage(Enum):
    """State of the link."""

    WAITING = "waiting"  # no session: looking for one
    CHOOSING = "choosing"  # several: the operator chooses
    ATTACHED = "attached"
    ENDED = "ended"  # the run or its process has ended; the last picture stays


@dataclass(frozen=True)
class TrackedPoint:
    """Estimates at a time [s] since the run began.

    `values` holds [value, low, high] in SI by parameter, `residuals` [rms, size] by family.
    """

    time: float
    values: Mapping[str, Sequence[float | None]]
    residuals: Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class Frame:
    """All data of the screen; `received` is the arrival of the newest samples [monotonic s].

    A snapshot without new samples does not change it.
    """

    stage: LinkStage = LinkStage.WAITING
    sessions: tuple[Endpoint, ...] = ()
    endpoint: Endpoint | None = None
    snapshot: Snapshot | None = None
    received: float = 0.0
    window: HistoryWindow = EMPTY
    speed: float = 1.0  # device seconds per wall second
    event_lines: tuple[EventLine, ...] = ()  # oldest first, the newest KEPT_LINES of them
    plan: tuple[PlanLine, ...] = ()
    estimates: tuple[TrackedPoint, ...] = ()  # oldest first
    interval: float = 0.0  # between two snapshots, smoothed [s of wall time]
    worst_age: float = 0.0  # of a block since the screen attached [s]
    trouble: str = ""  # why sessions cannot be searched

    def age(self, now: float) -> float:
        """Return how old the newest sample is [s]: its age when published plus the time since."""
        block = self.snapshot.block_age if self.snapshot else 0.0
        return max(block, 0.0) + now - self.received

    @property
    def device_time(self) -> float:
        """The device's time at the newest sample [s]."""
        return float(self.window.time[-1]) if len(self.window.time) else 0.0

    @property
    def live(self) -> bool:
        """Whether a run is attached that has not ended."""
        return self.endpoint is not None and not self.over

    @property
    def over(self) -> bool:
        """Whether the run has ended: by its own message, or because its process has ended."""
        reported = self.snapshot is not None and self.snapshot.state in ENDED_STATES
        return self.stage is LinkStage.ENDED or reported


class Link:
    """Finds a session, follows it, and makes frames; `step` is one cycle of its thread."""

    def __init__(
        self, sessions: LocalSessions, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._sessions, self._clock = sessions, clock
        self._frame = Frame()
        self._source: Attachment | None = None
        self._history = History()
        self._chosen: Endpoint | None = None
        self._choosing = False
        self._expected = 0
        self._elsewhere: frozenset[Endpoint] = frozenset()  # sessions of other benches
        self._last_search = -float("inf")
        self._last_window = -float("inf")
        self._dirty = False
        self._past_requested = -float("inf")
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self.on_window: Callable[[], None] = lambda: None  # called by the thread of the link
        self.window_seconds = 10.0  # set by the screen: length of the history in a frame

    @property
    def frame(self) -> Frame:
        """The newest frame."""
        return self._frame

    def start(self) -> None:
        """Start the receiving thread; a daemon, so that a hung wire cannot keep the screen open."""
        self._thread = threading.Thread(target=self._run, name="bramah-link", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the receiving thread and detach from the run, which continues."""
        self._closing.set()
        if self._thread is None:
            self._detach()
        else:
            self._thread.join(timeout=10 * POLL)

    def choose(self, endpoint: Endpoint | None) -> None:
        """Attach to this session; None asks the operator to choose again."""
        self._chosen, self._choosing = endpoint, endpoint is None

    def expect(self, pid: int) -> None:
        """Attach to the session of a process that the operator has started, once it is there."""
        self._expected = pid

    def stop(
        self, endpoint: Endpoint | None, answered: Callable[[Endpoint | None, bool], None]
    ) -> None:
        """Send "stop" at once on a separate connection and thread, then report the answer.

        Without an endpoint it goes to the only live session: a run that has just begun is not
        attached yet. `answered` receives the session, None if there is none.
        """

        def send() -> None:
            where = endpoint or self._only_session()
            answered(where, where is not None and self._send_stop(where))

        threading.Thread(target=send, name="bramah-stop", daemon=True).start()

    def ask(
        self, endpoint: Endpoint, word: str, value: str, answered: Callable[[str | None], None]
    ) -> None:
        """Send a command on a separate thread; `answered` receives the refusal, or None."""

        def send() -> None:
            try:
                with closing(self._sessions.open(endpoint)) as source:
                    refusal = source.ask(own_command(word, value))
            except Exception as error:  # the operator must see any failure
                log.exception("asking %r of %s failed", word, endpoint)
                refusal = str(error) or repr(error)
            answered(refusal)

        threading.Thread(target=send, name="bramah-ask", daemon=True).start()

    def _only_session(self) -> Endpoint | None:
        try:
            live = self._sessions.find()
        except Exception:  # as in _send_stop
            log.exception("looking for a session to stop failed")
            return None
        return live[0] if len(live) == 1 else None

    def _send_stop(self, endpoint: Endpoint) -> bool:
        try:
            with closing(self._sessions.open(endpoint)) as source:
                return source.send("stop")
        except Exception:  # the operator must see "no answer", not a traceback
            log.exception("sending 'stop' to %s failed", endpoint)
            return False

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self.step(POLL)
            except Exception as error:  # a broken link is shown on the screen and must not end it
                log.exception("the link failed; looking for sessions again")
                self._detach()
                self._frame = replace(self._frame, trouble=str(error) or repr(error))
                self._closing.wait(QUIET)
        self._detach()

    def step(self, timeout: float) -> None:
        """Search for sessions if due, wait `timeout` [s] for a snapshot, make a frame."""
        self._follow_sessions()
        if self._source is None:
            self._closing.wait(5 * timeout)
            return
        snapshot = self._source.receive(timeout)
        now = self._clock()
        if snapshot is not None:
            self._update(snapshot, now)
            self._fetch_past(now)
        if self._dirty and (snapshot is None or snapshot.trip or now - self._last_window >= FRAME):
            window = self._history.window(self.window_seconds)
            self._frame = replace(self._frame, window=window)
            self._last_window, self._dirty = now, False
            self.on_window()

    def _update(self, snapshot: Snapshot, now: float) -> None:
        before = self._frame
        quiet = before.snapshot is not None and now - before.received > QUIET
        snapshot = _with_newest_values(before.snapshot, snapshot)
        self._history.add(snapshot, after_gap=quiet)
        event_lines = before.event_lines
        if lines := new_lines(before.snapshot, snapshot):
            event_lines = (*event_lines, *lines)[-KEPT_LINES:]
        estimates = before.estimates
        if snapshot.estimates and (not estimates or estimates[-1].values != snapshot.estimates):
            point = TrackedPoint(snapshot.done_s, snapshot.estimates, snapshot.residuals)
            estimates = (*estimates, point)[-KEPT_LINES:]
        # The window is updated at the frame rate, the text at every snapshot.
        self._frame = replace(
            before,
            snapshot=snapshot,
            received=now if _has_news(before.snapshot, snapshot) else before.received,
            speed=_speed(before, snapshot),
            event_lines=event_lines,
            estimates=estimates,
            interval=_interval(before, snapshot),
            worst_age=max(before.worst_age, snapshot.block_age),
        )
        self._dirty = True

    def _fetch_past(self, now: float) -> None:
        """Ask a run for its plan and its last minute, once, and again when its plan has changed."""
        frame = self._frame
        if frame.snapshot is None or self._source is None or frame.over:
            return
        plan_complete = len(frame.plan) == frame.snapshot.parts
        first = self._past_requested == -float("inf")
        if now - self._past_requested < ANSWER_TIME or (plan_complete and not first):
            return
        self._past_requested = now
        past = self._source.past(ANSWER_TIME)
        if past is None:
            return
        event_lines = frame.event_lines
        if first and self._history.begin_with(past) and frame.snapshot.run:
            earlier = from_events(read_events(Path(frame.snapshot.run)), frame.snapshot)
            event_lines = with_earlier(event_lines, earlier)[-KEPT_LINES:]
        self._frame = replace(self._frame, plan=past.plan, event_lines=event_lines)

    def _follow_sessions(self) -> None:
        now = self._clock()
        due = 2 * SEARCH_INTERVAL if self._source is not None else SEARCH_INTERVAL
        if now - self._last_search < due and self._chosen is None and not self._choosing:
            return
        self._last_search = now
        live = tuple(self._sessions.find())
        if (live, "") != (self._frame.sessions, self._frame.trouble):  # a new frame is drawn
            self._frame = replace(self._frame, sessions=live, trouble="")
        chosen, self._chosen = self._chosen, None
        choosing, self._choosing = self._choosing, False
        if chosen is not None and chosen in live:
            self._attach(chosen)
        elif choosing and len(live) > 1:
            self._detach()
            self._frame = self._blank(LinkStage.CHOOSING)
        elif self._source is not None:
            if self._frame.endpoint not in live:
                self._drain()
                self._detach()
                self._frame = replace(self._frame, stage=LinkStage.ENDED)
        elif started := [session for session in live if session.pid == self._expected]:
            self._attach(started[0])
        elif self._frame.endpoint is not None:
            self._join_next_of_bench(live)
        elif len(live) == 1:
            self._attach(live[0])
        elif live:
            self._frame = self._blank(LinkStage.CHOOSING)
        elif self._frame.stage is LinkStage.CHOOSING:
            self._frame = self._blank(LinkStage.WAITING)

    def _join_next_of_bench(self, live: Sequence[Endpoint]) -> None:
        """Attach to a new session of the bench that is shown, never to one of another bench.

        The keys, the stop among them, act on the bench shown: only the operator may change it.
        """
        self._elsewhere &= frozenset(live)
        for session in live:
            if session in self._elsewhere:
                continue
            source = self._sessions.open(session)
            first = source.receive(FIRST_WORD)
            if first is not None and self._of_this_bench(first):
                self._attach(session, source)
                self._update(first, self._clock())
                return
            source.close()
            if first is not None:  # else it starts or ends: asked again at the next search
                self._elsewhere |= {session}

    def _of_this_bench(self, snapshot: Snapshot) -> bool:
        """Return whether a snapshot is of the bench whose run is shown, by its wire."""
        shown, endpoint = self._frame.snapshot, self._frame.endpoint
        if shown is not None and shown.wire and snapshot.wire:
            return bench_name(snapshot.wire) == bench_name(shown.wire)
        return endpoint is not None and snapshot.rig.startswith(endpoint.rig)

    def _blank(self, stage: LinkStage, endpoint: Endpoint | None = None) -> Frame:
        """Return a frame without a run's data; the log stays."""
        current = self._frame
        return Frame(
            stage,
            current.sessions,
            endpoint,
            received=self._clock(),
            event_lines=current.event_lines,
        )

    def _drain(self) -> None:
        """Receive the last messages of a run that has ended."""
        while self._source is not None and (last := self._source.receive(0.0)) is not None:
            self._update(last, self._clock())
        self._frame = replace(self._frame, window=self._history.window(self.window_seconds))

    def _attach(self, endpoint: Endpoint, source: Attachment | None = None) -> None:
        source = source or self._sessions.open(endpoint)
        self._detach()
        self._source = source
        self._expected, self._elsewhere = 0, frozenset()
        self._history = History()
        self._past_requested = -float("inf")
        self._frame = self._blank(LinkStage.ATTACHED, endpoint)

    def _detach(self) -> None:
        source, self._source = self._source, None
        if source is not None:
            source.close()


def _has_news(last: Snapshot | None, snapshot: Snapshot) -> bool:
    """Return whether a snapshot has samples that the previous one did not have."""
    return last is None or (last.run, last.tick) != (snapshot.run, snapshot.tick)


def _with_newest_values(last: Snapshot | None, snapshot: Snapshot) -> Snapshot:
    """Return a snapshot without new samples with the newest values of the one before it."""
    if last is None or _has_news(last, snapshot):
        return snapshot
    channels = {
        name: replace(view, last=last.channels[name].last) if name in last.channels else view
        for name, view in snapshot.channels.items()
    }
    return replace(snapshot, channels=channels)


def _interval(before: Frame, snapshot: Snapshot) -> float:
    """Return the time between two snapshots [s of wall time], smoothed over about 20."""
    if before.snapshot is None or before.snapshot.run != snapshot.run:
        return 0.0
    latest = snapshot.wall_time - before.snapshot.wall_time
    return before.interval + 0.05 * (latest - before.interval) if before.interval else latest


def _speed(before: Frame, snapshot: Snapshot) -> float:
    """Return device seconds per wall second, smoothed over about 20 snapshots.

    Both times are the run's own: snapshots may wait in a queue and arrive in bursts.
    """
    previous = before.snapshot
    if previous is None or previous.run != snapshot.run:
        return before.speed
    wall = snapshot.wall_time - previous.wall_time
    if not 0 < wall < QUIET:
        return before.speed
    latest = (snapshot.device_time - previous.device_time) / wall
    return before.speed + 0.05 * (latest - before.speed) if latest > 0 else before.speed
