"""A screen attaches to a run, watches it, stops it; the run does not depend on it in any way."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.base import DeviceLost, SampleBlock
from rig.bench.guard import EXCITED, JointRole
from rig.bench.screens.commands import CommandHolder
from rig.bench.screens.snapshot import (
    KEPT,
    PastKeeper,
    PastMinute,
    PlanLine,
    Snapshot,
    decimate,
    from_json,
    past_from,
    to_json,
)
from rig.bench.screens.sockets import AttachError, Attachment, Command, Endpoint, Publisher
from rig.bench.session import Bench
from rig.model.trips import OperatorStop, SafetyTrip
from rig.runs.recorder import Recorder
from rig.runs.store import load_run
from tests.services.children import RIG, acknowledged, assert_all_there, start
from tests.services.fake_driver import FakeDriver


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A runtime folder of our own, short as real ones are; sockets lie in its `bramah`."""
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as short:
        monkeypatch.setenv("XDG_RUNTIME_DIR", short)
        yield Path(short) / "bramah"


def only(found: list[Endpoint]) -> Endpoint:
    assert len(found) == 1
    return found[0]


def wait_for(condition, seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def test_a_screen_sees_the_run_and_its_stop_ends_it_at_zero(folder: Path, tmp_path: Path) -> None:
    driver = FakeDriver(RIG, pace=0.001)
    seen: list[Snapshot] = []
    taken: list[bool] = []

    def screen() -> None:
        attachment = Attachment(only(Attachment.find("shinshu-2dof")))
        while len(seen) < 3:
            snapshot = attachment.receive(20)
            assert snapshot is not None
            seen.append(snapshot)
        taken.append(attachment.send("stop", 20))
        while seen[-1].state == "running":
            seen.append(attachment.receive(20))
        attachment.close()

    publisher = Publisher(RIG.name)
    watcher = threading.Thread(target=screen)
    watcher.start()
    with (  # noqa: PT012
        pytest.raises(OperatorStop, match="from the screen"),
        Bench(RIG, driver, Recorder(tmp_path / "run", RIG), publisher) as bench,
    ):
        bench.status(step="step1", phase="excite", repeat=2, repeats=10, total_s=60.0)
        bench.exchange()
        with bench.record(step="s"):
            bench.run_for(1000.0)
    watcher.join(30)
    assert not watcher.is_alive()
    assert taken == [True]
    assert driver.calls[-2:] == ["stop", "close"]
    first, last = seen[1], seen[-1]
    assert (first.step, first.phase, first.repeat, first.repeats) == ("step1", "excite", 2, 10)
    assert (first.pid, first.rig, first.run) == (os.getpid(), RIG.name, str(tmp_path / "run"))
    cap = first.channels["cap_pressure_1"]
    assert (cap.unit, cap.low, cap.high) == ("Pa", *RIG.joints[0].limits.pressure)
    assert min(cap.minimum) >= 2e6
    assert max(cap.maximum) <= 4e6
    assert (last.state, last.message) == ("aborted", "stopped by operator (from the screen)")
    assert load_run(tmp_path / "run", partial=True).state == "aborted"
    assert list(folder.iterdir()) == []


def test_screens_that_come_go_hang_or_die_leave_the_run_untouched(
    folder: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    child = start(run, "serve", 100_000)
    script = (
        "import sys, time\nfrom rig.bench.screens.sockets import Attachment\n"
        "a = Attachment(Attachment.find()[0])\n"
        "assert a.receive(20) is not None\nprint('seen', flush=True)\ntime.sleep(600)\n"
    )
    wait_for(lambda: Attachment.find() != [])
    screens = [
        subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    for number, screen in zip((signal.SIGKILL, signal.SIGSTOP), screens, strict=True):
        assert screen.stdout is not None
        assert screen.stdout.readline() == "seen\n"
        screen.send_signal(number)
    reached = acknowledged(run)
    wait_for(lambda: acknowledged(run) > reached + 1000)
    operator = Attachment(only(Attachment.find()))
    assert operator.send("stop", 20)
    operator.close()
    _, said = child.communicate(timeout=60)
    for screen in screens:
        screen.kill()
        screen.communicate(timeout=30)
    assert child.returncode == 130, said
    (record,) = load_run(run, partial=True).records
    assert record.samples >= 1000
    assert record.attributes["lost_samples"] == 0
    assert_all_there(run)


def test_snapshots_are_made_only_while_a_screen_is_attached(folder: Path) -> None:
    with closing(Publisher(RIG.name)) as publisher:
        assert not publisher.watched
        for _ in range(2):  # a screen that comes again is seen again
            screens = [Attachment(publisher.endpoint) for _ in range(2)]
            wait_for(lambda: publisher.watched)
            screens[0].close()
            time.sleep(0.1)
            assert publisher.watched
            screens[1].close()
            wait_for(lambda: not publisher.watched)


def test_a_killed_runs_sockets_are_swept_away(folder: Path, tmp_path: Path) -> None:
    child = start(tmp_path / "run", "serve", 100_000)
    wait_for(lambda: Attachment.find("shinshu-2dof") != [])
    endpoint = only(Attachment.find("shinshu-2dof"))
    assert endpoint.pid == child.pid
    assert Attachment.find("another-rig") == []
    child.kill()
    child.communicate(timeout=30)
    assert Attachment.find() == []
    assert list(folder.iterdir()) == []
    attachment = Attachment(endpoint)
    assert attachment.receive(0.05) is None
    assert attachment.send("stop", 0.05) is False
    assert attachment.alive is False
    attachment.close()


def test_a_socket_without_a_listener_is_no_session(folder: Path) -> None:
    """A run that is starting binds before it listens; a reused process number never listens."""
    Attachment.find()
    path = folder / f"new-{os.getpid()}.pub"
    with socket.socket(socket.AF_UNIX) as starting:
        starting.bind(str(path))
        assert Attachment.find() == []
        starting.listen()
        assert [e.rig for e in Attachment.find()] == ["new"]
    assert Attachment.find() == []


def test_only_the_owner_may_enter_the_folder(folder: Path, monkeypatch) -> None:
    folder.mkdir(mode=0o777)
    folder.chmod(0o777)
    publisher = Publisher(RIG.name)
    assert folder.stat().st_mode & 0o777 == 0o700
    publisher.close()
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(AttachError, match="belongs to user"):
        Publisher(RIG.name, folder)
    monkeypatch.undo()
    link = folder.parent / "link"
    link.symlink_to(folder)
    with pytest.raises(AttachError, match="not a folder"):
        Publisher(RIG.name, link)


def test_a_runtime_folder_too_long_for_a_socket_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / ("x" * 100)
    deep.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(deep))
    name = f"test-{os.getpid()}-" + "long" * 50
    publisher = Publisher(name)
    try:
        assert publisher.endpoint.pub.parent == Path(f"/tmp/bramah-{os.getuid()}")
        assert only(Attachment.find(name)).pid == os.getpid()
    finally:
        publisher.close()
    with pytest.raises(AttachError, match="cannot be made"):
        Publisher("r", deep)


def test_rubbish_on_the_command_socket_is_answered_and_does_nothing(folder: Path) -> None:
    publisher = Publisher(RIG.name)
    context = zmq.Context()
    for raw in (b"", b"\xff\x00", b"[]", b'{"command": "format c:"}', b'"stop"', b"{}"):
        asking = context.socket(zmq.REQ)
        asking.setsockopt(zmq.LINGER, 0)
        asking.connect(f"ipc://{publisher.endpoint.cmd}")
        asking.send_multipart([raw, b"more"])
        found: list[Command] = []
        wait_for(lambda a=asking, f=found: f.extend(publisher.commands()) or a.poll(10))
        assert found == []
        assert b'"ok": false' in asking.recv()
        asking.close()
    context.destroy(linger=0)
    publisher.close()
    publisher.close()


def test_asking_without_waiting_for_the_answer_does_not_stall_the_run(folder: Path) -> None:
    publisher = Publisher(RIG.name)
    attachment = Attachment(publisher.endpoint)
    assert attachment.send("stop", 0.0) is False
    attachment.close()
    second = Attachment(publisher.endpoint)
    answers: list[bool] = []
    asker = threading.Thread(target=lambda: answers.append(second.send("stop", 20)))
    asker.start()
    wait_for(lambda: publisher.commands() is None or bool(answers))
    asker.join(30)
    assert answers == [True]
    second.close()
    publisher.close()


@given(
    st.integers(1, 400).flatmap(
        lambda n: st.tuples(st.just(n), st.integers(1, 60), st.integers(0, 2**31))
    )
)
@settings(max_examples=50)
def test_decimation_keeps_every_peak(case: tuple[int, int, int]) -> None:
    n, buckets, seed = case
    samples = np.random.default_rng(seed).normal(size=(n, 3))
    low, high = decimate(samples, buckets)
    assert len(low) == len(high) <= buckets
    np.testing.assert_array_equal(low.min(axis=0), samples.min(axis=0))
    np.testing.assert_array_equal(high.max(axis=0), samples.max(axis=0))


def test_a_snapshot_survives_its_wire_and_rubbish_is_refused() -> None:
    from rig.bench.screens.snapshot import BenchView, Progress, take_snapshot

    view = BenchView("run", "rig", "running", 10, 0.01, 1.0, 0.0, 0, None)
    units = {"spool_1": "V"}
    made = take_snapshot(view, Progress(), np.ones((5, 1)), units, {"spool_1": (None, 2.0)})
    assert from_json(to_json(made)) == made
    assert replace(made, tick=11) != made
    for raw in (b"", b"[]", b"{}", b'{"channels": {"a": {}}}', b"\xff"):
        with pytest.raises(ValueError):  # noqa: PT011
            from_json(raw)


class Wall:
    """A publisher's double: everything published, nothing asked."""

    def __init__(self) -> None:
        self.seen: list[Snapshot] = []
        self.publish = self.seen.append
        self.watched = True
        self.commands = lambda judge: []
        self.close = dict


def test_a_trip_is_shown_at_once_and_the_limits_follow_the_roles() -> None:
    def spoil(block: SampleBlock) -> SampleBlock:
        data = block.data.copy()
        data[:, 2] = 9.5e6 if block.sequence == 1 else data[:, 2]
        return replace(block, data=data)

    wall = Wall()
    driver = FakeDriver(RIG, spoil=spoil)
    with Bench(RIG, driver, None, wall, clock=lambda: 0.0) as bench:
        bench.guard([EXCITED, JointRole(locked_at=-0.02, tolerance=0.02)])
        bench.exchange()
        with pytest.raises(SafetyTrip):
            bench.exchange()
        assert [s.state for s in wall.seen] == ["running", "tripped"]
    last = wall.seen[1]
    assert "9.5 MPa" in str(last.trip)
    assert (last.channels["piston_1"].low, last.channels["piston_1"].high) == RIG.joints[
        0
    ].limits.piston
    assert last.channels["piston_2"].high == pytest.approx(0.0, abs=1e-12)
    assert last.channels["command_1"].high == 4.0
    assert (last.tick, last.device_time) == (20, 0.02)


def test_a_screen_that_attaches_late_gets_the_last_minute_and_the_plan(folder: Path) -> None:
    publisher = Publisher(RIG.name)
    ticking = iter(range(1_000_000))
    driver = FakeDriver(RIG)
    with Bench(RIG, driver, None, publisher, clock=lambda: next(ticking)) as bench:  # type: ignore[arg-type]
        bench.describe([PlanLine("step1", "joint 2 excited", 6.0)])
        measured = bench.run_for(0.5)
        late = Attachment(publisher.endpoint)
        found: list[PastMinute | None] = []
        asker = threading.Thread(target=lambda: found.append(late.past(20)))
        asker.start()
        wait_for(lambda: bench.exchange() is not None and bool(found))
        asker.join(30)
        late.close()
    (past,) = found
    assert past is not None
    assert past.names == tuple(RIG.recorded)
    assert [line.title for line in past.plan] == ["joint 2 excited"]
    assert np.all(np.diff(past.time) > 0)
    inside = past.time <= 0.5 + 1e-9
    np.testing.assert_array_equal(past.low[inside].min(axis=0), measured.min(axis=0))
    np.testing.assert_array_equal(past.high[inside].max(axis=0), measured.max(axis=0))


def test_a_run_remembers_no_more_than_a_minute_of_snapshots() -> None:
    keeper = PastKeeper(["a", "b"])
    for k in range(KEPT + 10):
        keeper.add(float(k), np.full((3, 2), float(k)))
    keeper.add(1e6, np.empty((0, 2)))
    past = past_from(*keeper.answer())
    assert len(past.time) == KEPT
    assert (past.time[0], past.time[-1]) == (10.0, KEPT + 9.0)
    for header, raw in (({}, b""), ({"names": 3, "plan": []}, b""), ({"names": ["a"]}, b"12")):
        with pytest.raises(ValueError):  # noqa: PT011
            past_from(header, raw)


def test_the_controls_are_taken_over_explicitly_and_every_screen_sees_whose_they_are(
    tmp_path: Path,
) -> None:
    holder = CommandHolder()
    one, two = (Command("pause", holder=name) for name in ("one", "two"))
    assert holder.judge(one, lambda _: None) is None
    assert "one is in control" in str(holder.judge(two, lambda _: None))
    assert holder.judge(Command("take", holder="two"), None) is None
    assert holder.held is not None
    assert holder.held.holder == "two"
    assert "two is in control" in str(holder.judge(one, lambda _: None))
    assert holder.judge(Command("stop"), None) is None
    assert holder.judge(Command("release", holder="two"), None) is None
    assert holder.held is None
    assert "the key 'holder' is missing" in str(holder.judge(Command("take"), None))
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    assert holder.judge(Command("take", holder="three", pid=dead.pid), None) is None
    assert holder.held is None, "a screen that is gone gives its controls up"


def test_a_snapshot_says_roles_warning_bands_and_a_lost_device() -> None:
    wall = Wall()
    with (  # noqa: PT012
        pytest.raises(DeviceLost),
        Bench(RIG, FakeDriver(RIG), None, wall, clock=lambda: 0.0) as bench,
    ):
        bench.guard([EXCITED, JointRole(locked_at=-0.02, tolerance=0.02)])
        bench.exchange()
        raise DeviceLost("the device does not answer")
    first, last = wall.seen[0], wall.seen[-1]
    assert first.roles == ["excited", "locked"]
    cap = first.channels["cap_pressure_1"]
    assert cap.warn_high is not None
    assert cap.high is not None
    assert cap.warn_high < cap.high
    assert (first.device, last.device) == ("", "lost")
    assert first.wire == RIG.wire.endpoint
