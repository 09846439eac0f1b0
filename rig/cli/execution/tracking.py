"""`bramah run --track`: a separate process that estimates b and the flow gains during the run.

The acquisition only writes blocks to a non-blocking socket (zmq, about 20 us per block), and reads
the estimates from it. A tracker that is slow, hangs or dies does not affect the run: blocks that
do not fit into the tracker's queue are lost samples for the tracker alone.
"""

from __future__ import annotations

import logging
import math
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from multiprocessing import get_context, parent_process
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import zmq
from numpy.typing import NDArray

from analysis.identify.streams.online import Tracker
from analysis.simulation.model import Estimate, estimate_json
from analysis.workers.pool import environment
from drivers.base import SampleBlock
from rig.cli.text.output import Say, write_json
from rig.model.parse import InputError
from rig.model.records import RecordHead
from rig.model.rig import Rig
from rig.model.units import with_interval
from rig.runs.files import scratch_folder
from rig.runs.recorder import RecordMeta
from rig.runs.runstate import EventLog
from rig.runs.store import TRACKED

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

RECENT_SECONDS = 5.0  # [s] of samples kept from before a record is announced
QUEUE_LENGTH = 30_000  # messages in the tracker's queue: five minutes of blocks, 40 MB
REPORT_EVERY = 2.0  # [s] of wall time between two reports of the estimates
FINISH_SECONDS = 20.0  # [s] allowed for the tracker to finish after the run
NICE = 5  # priority of the tracker's process below that of the acquisition


class Follower:
    """Feeds a tracker with the samples of every record; gaps between blocks become NaN."""

    def __init__(self, rig: Rig, tracker: Tracker) -> None:
        self._tracker = tracker
        self._names = rig.recorded
        self._recent_samples = round(RECENT_SECONDS * rig.sample_rate)
        self._recent: deque[tuple[int, Array]] = deque()
        self._next_tick: int | None = None  # first tick of the current record not yet fed
        self._record_end: int | None = None  # end of the current record, exclusive, if known

    def block(self, tick: int, data: Array) -> bool:
        """Add a block (n, channels) that begins at `tick`; return whether the estimates changed."""
        self._recent.append((tick, data))
        newest = tick + len(data)
        while self._recent[0][0] + len(self._recent[0][1]) < newest - self._recent_samples:
            self._recent.popleft()
        return self._next_tick is not None and self._feed(newest)

    def begins(self, head: RecordHead, start: int, ticks: int | None = None) -> None:
        """Begin a record at tick `start`; feed its samples that have arrived already.

        Give the length `ticks` if it is fixed in advance, because blocks may reach beyond the end.
        """
        self._tracker.begin(head)
        self._next_tick, self._record_end = start, None if ticks is None else start + ticks
        if self._recent:
            tick, data = self._recent[-1]
            self._feed(tick + len(data))

    def ends(self, start: int, ticks: int, complete: bool) -> None:
        """End the current record after `ticks` samples; discard it if it is not complete."""
        if self._next_tick is None:
            return
        self._record_end = start + ticks
        if complete and self._next_tick <= self._record_end:
            self._feed(self._record_end)
            self._tracker.end()
        else:
            self._tracker.discard()
        self._next_tick = None

    def _feed(self, last: int) -> bool:
        """Feed the samples from the next tick up to `last` (exclusive); NaN for missing ones."""
        first = self._next_tick
        last = last if self._record_end is None else min(last, self._record_end)
        if first is None or last <= first:
            return False
        part = np.full((last - first, len(self._names)), np.nan)
        for tick, data in self._recent:
            low, high = max(first, tick), min(last, tick + len(data))
            if low < high:
                part[low - first : high - first] = data[low - tick : high - tick]
        self._next_tick = last
        return self._tracker.feed({name: part[:, k] for k, name in enumerate(self._names)})


def summary(parameters: Mapping[str, Mapping[str, Any]]) -> str:
    """Return bulk modulus and flow gains in one line, '?' for values not yet known."""
    parts = []
    for name, estimate in parameters.items():
        value, (low, high) = estimate["value"], estimate["ci95"]
        scale, unit = (1e-6, " MPa") if name == "b" else (1e7, "")
        text = "?" if value is None else f"{scale * value:.4g}"
        if value is not None and low is not None and high is not None:
            half = 0.5 * scale * (high - low)
            text = with_interval(scale * value, half).replace(" ± ", "±")
        parts.append(f"{name} {text}{unit}")
    return "  ".join(parts)


class Tracking:
    """The tracker as the run uses it: an observer of the bench, and a context manager.

    Enter it before the bench and leave it after, so that no run waits with its outputs on. The
    protocol's conditions read its estimates (`protocols.engine.run_inputs.Estimates`). `memory`:
    forgetting time constant [s], infinite for none.
    """

    def __init__(self, rig: Rig, out: Path, say: Say, memory: float = math.inf) -> None:
        self.parameters: dict[str, Any] = {}
        # By family: rms of the prediction error of new rows, and of their right side.
        self.residuals: dict[str, list[float]] = {}
        self.worst_handover = 0.0
        self._rig, self._out, self._say, self._memory = rig, out, say, memory
        self._history: list[dict[str, Any]] = []
        self._notes: list[Callable[[dict[str, Any]], None]] = []
        self._shows: list[Callable[[str], None]] = []
        self._dropped = 0
        self._failure = ""  # why the tracker stopped, as it said itself
        self._next_report = -math.inf

    def subscribe(
        self, note: Callable[[dict[str, Any]], None], show: Callable[[str], None]
    ) -> None:
        """Add functions called with the estimates: at each record's end, and in between."""
        self._notes.append(note)
        self._shows.append(show)

    def __enter__(self) -> Self:
        self._scratch = ExitStack()  # the folder is accessible to this user only
        endpoint = f"ipc://{self._scratch.enter_context(scratch_folder())}/track"
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PAIR)
        self._socket.set(zmq.SNDHWM, QUEUE_LENGTH)
        self._socket.set(zmq.LINGER, 0)
        # This end connects, so that it queues messages sent before the tracker is ready.
        self._socket.connect(endpoint)
        self._process = get_context("spawn").Process(
            target=track_run, args=(self._rig, self._memory, endpoint), daemon=True
        )
        with environment():
            self._process.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None or issubclass(kind, Exception):
                self._finish()
        finally:
            self._socket.close()
            self._context.term()
            self._process.join(1.0)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()
            self._process.close()
            self._scratch.close()

    def values(self) -> Mapping[str, float]:
        """Return each finite estimate [SI] and its relative standard deviation, as NAME.rsd."""
        values: dict[str, float] = {}
        for name, estimate in self.parameters.items():
            value, std = estimate["value"], estimate["std"]
            if value is None:
                continue
            values[name] = float(value)
            if std is not None and value:
                values[f"{name}.rsd"] = abs(float(std) / float(value))
        return {name: value for name, value in values.items() if math.isfinite(value)}

    def complete(self, record: str) -> bool:
        """Return whether the estimates include a record; True if the tracker has ended."""
        included = any(entry["record"] == record for entry in self._history)
        return included or not self._process.is_alive()

    def _finish(self) -> None:
        """Wait for the last estimates and write all estimates into the run folder."""
        written = len(self._history)
        self._notes, self._shows = [], []  # the bench is closed, so waiting is safe
        self._send("stop")
        missing = self._await_last()
        if missing:
            kept = f"the last ones before are in {TRACKED}" if self.parameters else f"no {TRACKED}"
            missing = (
                f"the tracker {missing}: estimates are missing ({kept}), the records are whole"
            )
            log.warning("%s", missing)
        if self.parameters:
            self._say(f"tracked: {summary(self.parameters)}")
        if not self._out.is_dir():
            return
        events = EventLog(self._out)
        if self.parameters:
            memory = self._memory if math.isfinite(self._memory) else None
            data = {"memory_s": memory, "parameters": self.parameters, "records": self._history}
            write_json(self._out / TRACKED, data)
            for entry in self._history[written:]:  # the delayed messages of a slow tracker
                events.append("tracked", None, entry)
        if missing:
            events.append("not tracked", None, {"message": missing})
        events.close()

    def _await_last(self) -> str:
        """Wait for the tracker's last message; return '' or why it does not come."""
        deadline = time.monotonic() + FINISH_SECONDS
        while not self._failure:
            alive = self._process.is_alive()  # asked first: what it sent before its end is read
            answered = bool(self._socket.poll(100))
            if answered and self._receive():
                break
            if not answered and not alive:
                code = self._process.exitcode or 0
                return f"ended with signal {-code}" if code < 0 else f"ended with exit code {code}"
            if time.monotonic() > deadline:
                return f"did not {'finish' if answered else 'answer'} in {FINISH_SECONDS:g} s"
        return self._failure

    # Called by the bench

    def block(self, block: SampleBlock) -> None:
        """Send a block to the tracker and read its answers; never waits."""
        started = time.perf_counter()
        self._send("block", block.tick, block.data)
        self._receive()
        self.worst_handover = max(self.worst_handover, time.perf_counter() - started)

    def record_begins(self, meta: RecordMeta, start: int, ticks: int | None) -> None:
        """Announce a record."""
        head = RecordHead(
            meta.name, meta.step, meta.locked, meta.repeat, self._rig.sample_rate, 0,
            tuple(self._rig.recorded), start / self._rig.sample_rate, meta.period, meta.lines,
        )  # fmt: skip
        self._send("begin", head, start, ticks)

    def record_ends(self, meta: RecordMeta, start: int, ticks: int, state: str) -> None:
        """Announce the end of a record."""
        self._send("end", meta.name, start, ticks, state == "complete")

    def _send(self, *message: object) -> None:
        try:
            self._socket.send_pyobj(message, zmq.NOBLOCK)
        except zmq.Again:
            self._dropped += 1
            if self._dropped == 1:
                log.warning(
                    "the tracker is too slow and loses samples; the run's record is complete"
                )

    def _receive(self) -> bool:
        """Read the tracker's messages; return whether the last one is among them."""
        while True:
            try:
                reply: Any = self._socket.recv_json(zmq.NOBLOCK)
            except zmq.Again:
                return False
            if reply["kind"] == "failed":
                self._failure = f"stopped ({reply['message']})"
                log.warning("the tracker %s", self._failure)
                return True
            self.parameters = reply["parameters"] or self.parameters
            self.residuals = reply["residuals"]
            if reply["kind"] == "last":
                return True
            if reply["kind"] == "record":
                entry = {key: reply[key] for key in ("record", "rows", "parameters")}
                self._history.append(entry)
                if not entry["rows"]:
                    self._say(
                        f"record {entry['record']!r} changes no estimate: it is too short for the "
                        "filters, or its samples are not usable"
                    )
                for note in self._notes:
                    note(entry)
            elif time.monotonic() >= self._next_report:
                self._next_report = time.monotonic() + REPORT_EVERY
                line = summary(self.parameters)
                self._say(f"           {line}")
                for show in self._shows:
                    show(line.split("  ")[0])


# In the tracker's process


def track_run(rig: Rig, memory: float, endpoint: str) -> None:
    """Process messages until one ends it, or until the run's process has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run sends a message instead
    os.nice(NICE)  # the acquisition has priority
    context = zmq.Context()
    socket = context.socket(zmq.PAIR)
    socket.set(zmq.RCVHWM, QUEUE_LENGTH)
    socket.set(zmq.LINGER, 2000)
    socket.bind(endpoint)
    try:
        _serve(rig, Tracker(rig, memory=memory), socket)
    except InputError as error:
        socket.send_json({"kind": "failed", "message": str(error)})
    finally:
        socket.close()
        context.term()


def _serve(rig: Rig, tracker: Tracker, socket: zmq.Socket[bytes]) -> None:
    follower, parent = Follower(rig, tracker), parent_process()
    while True:
        if not socket.poll(1000):
            if parent is not None and not parent.is_alive():
                return
            continue
        kind, *fields = socket.recv_pyobj()
        if kind == "block":
            if follower.block(*fields):
                _reply(socket, "now", tracker)
        elif kind == "begin":
            follower.begins(*fields)
        elif kind == "end":
            name, start, ticks, complete = fields
            follower.ends(start, ticks, complete)
            if complete:
                _reply(socket, "record", tracker, record=name, rows=tracker.record_rows)
        else:
            _reply(socket, "last", tracker)
            return


def _reply(socket: zmq.Socket[bytes], kind: str, tracker: Tracker, **fields: str | int) -> None:
    estimates: dict[str, Estimate] = tracker.estimates()
    parameters = {name: estimate_json(e) for name, e in estimates.items()}
    if all(e["value"] is None for e in parameters.values()):
        parameters = {}
    residuals = {
        family: [residual.rms, residual.size] for family, residual in tracker.residuals().items()
    }
    message = {"kind": kind, "parameters": parameters, "residuals": residuals, **fields}
    try:
        socket.send_json(message, zmq.NOBLOCK)
    except zmq.Again:
        log.debug("the run does not read the estimates; they are dropped")
