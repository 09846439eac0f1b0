"""`bramah monitor --plain`: lines that a screen reader can read."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.registry import wire_at
from rig.bench.latch import BenchState
from rig.bench.screens.sockets import Publisher
from rig.runs.rigs import load_rig
from rig.tui.following.link import Link, LocalSessions
from rig.tui.plain import Reader
from tests.tui.glass import Clock, Machine, Recorded, endpoint
from tests.tui.recorded import Bench, followed, past, run, snapshot, tripped

HERE = endpoint()
ROOT = Path(__file__).parents[2]


class Listener:
    """Someone who listens to the lines while time passes."""

    def __init__(self, machine: Machine) -> None:
        self.heard: list[str] = []
        self.clock = Clock()
        self.link = Link(machine, self.clock)
        self.reader = Reader(self.heard.append)

    def listen(self, seconds: float) -> list[str]:
        del self.heard[:]
        for _ in range(round(seconds / 0.1)):
            before = None
            while before is not self.link.frame:
                before = self.link.frame
                self.link.step(0.0)
            self.reader.read(self.link.frame, self.clock())
            self.clock.now += 0.1
        return [line for line in self.heard if not line.startswith("  ")]


def test_one_line_a_second_says_the_state_first() -> None:
    record = Recorded(map(followed, run(Bench(), 4.0)))
    listener = Listener(Machine({HERE: record}))
    assert listener.listen(0.1)[0].startswith("EXCITING: 4.0 s, step1 excite, repeat 1 of 4")
    assert any("attached to run" in line for line in listener.heard)
    for k in range(81, 121):
        record.waiting.append(followed(snapshot(Bench(), k)))
        listener.listen(0.1)
    record.waiting.append(followed(snapshot(Bench(), 121)))
    (line,) = listener.listen(0.4)
    assert "0:33 left" in line
    assert "nearest limit piston_1 −37.4 of −39 mm (2%)" in line
    lines = listener.listen(3.0)
    assert all(line.startswith("NO DATA: ") for line in lines[1:])
    assert 2 <= len(lines) <= 4


def test_a_trip_is_said_at_once_and_then_it_is_silent() -> None:
    record = Recorded(map(followed, run(Bench(), 4.0)))
    listener = Listener(Machine({HERE: record}))
    listener.listen(0.2)
    record.waiting.append(tripped(replace(followed(snapshot(Bench(), 81)))))
    (line,) = listener.listen(0.2)
    assert line.startswith("TRIPPED: ")
    assert any("TRIP  limit 'pressure'" in said for said in listener.heard)
    assert listener.listen(30.0) == []


def test_a_line_is_printed_once_though_the_runs_own_log_has_it_too(tmp_path: Path) -> None:
    bench = Bench(run=str(tmp_path))
    message = snapshot(bench, 80).message
    phases = [("settle", 2000, "filling the lines"), ("excite", 3000, message)]
    lines = [{"event": "phase", "tick": tick, "step": "step1", "phase": phase, "message": said}
             for phase, tick, said in phases]  # fmt: skip
    (tmp_path / "events.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    record = Recorded([snapshot(bench, 80)])
    listener = Listener(Machine({HERE: record}))
    record.lately = past(bench, 4.0)
    listener.listen(0.5)
    for text in (f"step1 excite  {message}", "step1 settle  filling the lines"):
        assert len([said for said in listener.heard if text in said]) == 1
    assert [line.text.split()[1] for line in listener.link.frame.event_lines] == [
        "settle", "excite", "to",
    ]  # fmt: skip


def test_without_a_run_it_says_so_once() -> None:
    assert Listener(Machine()).listen(20.0) == ["NO RUN: waiting for a run"]


def test_several_runs_are_named() -> None:
    machine = Machine({HERE: Recorded(), endpoint("press", 9): Recorded()})
    said = " ".join(Listener(machine).listen(1.0))
    assert "name one with --rig, or its bench with --endpoint: shinshu-2dof (process 4711)" in said


def test_of_several_benches_of_a_rig_that_at_the_endpoint_is_watched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = load_rig("shinshu-2dof")
    here, other = (wire_at(f"modbus-tcp://127.0.0.1:{port}", rig.wire) for port in (5001, 5002))
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as short:
        monkeypatch.setenv("XDG_RUNTIME_DIR", short)
        publisher = Publisher(rig.name)
        state = BenchState(here)
        state.prepare()
        state.take(None)
        try:
            assert [s.pid for s in LocalSessions(rig.name).find()] == [os.getpid()]
            assert [s.pid for s in LocalSessions(rig.name, here).find()] == [os.getpid()]
            assert LocalSessions(rig.name, other).find() == []
        finally:
            state.release()
            publisher.close()


@pytest.fixture
def folder() -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as found:
        yield found


def test_as_a_process_it_ends_with_an_interrupt(folder: str) -> None:
    environment = {**os.environ, "XDG_RUNTIME_DIR": folder}
    words = [sys.executable, "-c", "from rig.cli.main import run; run()", "monitor", "--plain"]
    # A shell starts what it runs in the background with SIGINT ignored, and children inherit that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        words, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    signal.signal(signal.SIGINT, before)
    assert process.stdout is not None
    assert process.stdout.readline() == "NO RUN: waiting for a run\n"
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors


def test_a_screen_without_a_terminal_is_refused_and_uses_no_processor() -> None:
    """A cron job's standard input has ended: a screen that reads it would read for ever."""
    ended = subprocess.run(
        [sys.executable, "-c", "from rig.cli.main import run; run()", "monitor"],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, cwd=ROOT, check=False,
    )  # fmt: skip
    assert ended.returncode == 2
    assert "needs a terminal" in ended.stderr
    assert "--plain" in ended.stderr
