"""A night's queue: what starts when, how each item ends, and what a person may change."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bench.latch import BenchState, note_stop
from rig.model.parameters import parameter_names
from rig.model.parse import InputError
from rig.queue.items import channel_condition, check_wanted, parse_time, result_condition
from rig.queue.processes import reason_in
from rig.queue.store import QueueStore
from rig.runs.rigs import load_rig
from rig.runs.store import load_run
from tests.queue.nights import LONG, Night, reset, until
from tests.variants import kept

RIG = load_rig("shinshu-2dof")


@pytest.fixture
def night(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Night:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    return Night(tmp_path)


def test_a_night_ends_with_each_item_in_a_named_state_and_a_reason(night: Night) -> None:
    for mode in ("done", "fail", "refuse", "unready", "odd", "done"):
        night.add(mode)
    report = night.run()
    assert (report.code, report.reason) == (1, "nothing more to start")
    assert night.states() == ["done", "failed", "refused", "refused", "failed", "done"]
    assert night.item(2).reason == "the protocol could not be done"
    assert night.item(3).reason == "step 'step1', joint 2: the piston reaches 80 mm"
    assert night.item(4).reason == "the protocol was changed since: refused"
    assert night.item(5).reason.startswith("ended with 77")
    assert [r.name for r in load_run(night.item(6).run).records] == ["s_r1", "s_r2"]
    # What a failed item recorded is complete, and it keeps its place.
    assert len(load_run(night.item(2).run).records) == 2
    with QueueStore(night.path) as store:
        assert [item.id for item in store.items()] == [1, 2, 3, 4, 5, 6]
    assert [night.starts(k) for k in range(1, 7)] == [1, 1, 0, 0, 1, 1]
    assert night.item(1).results["parameters"]["b"]["value"] == 2.0
    assert night.run().ended == ()


def test_a_name_of_two_lines_is_not_queued(night: Night) -> None:
    with pytest.raises(InputError, match="expected a name of one line"):
        night.add("done\nagain")
    assert night.states() == []


def test_the_reason_of_a_verb_is_all_that_it_said_last() -> None:
    log = "bramah: an earlier word\nprogress\nbramah: sheet.yaml:3: a\nbramah: sheet.yaml:9: b\n"
    assert reason_in(log + "the last line of another\n") == "sheet.yaml:3: a; sheet.yaml:9: b"
    assert (
        reason_in("\033[1;37;41mbramah: outputs not confirmed\033[0m\n") == "outputs not confirmed"
    )
    assert reason_in("nothing was said\n") == ""


def test_higher_priorities_start_first_and_a_moved_item_takes_its_place(night: Night) -> None:
    for priority in (0, 0, 5, 0):
        night.add("done", priority)
    with QueueStore(night.path) as store:
        store.move(4, before=1)
        assert [item.id for item in store.items()] == [3, 4, 1, 2]
        store.move(3, priority=0, last=True)
        assert [item.id for item in store.items()] == [4, 1, 2, 3]
        store.move(2)
        assert [item.id for item in store.items()] == [2, 4, 1, 3]
        store.cancel(4, "me")
        with pytest.raises(InputError, match="item 4 is cancelled; only a queued item"):
            store.move(4)
        with pytest.raises(InputError, match="item 4 is cancelled already"):
            store.cancel(4, "me")
        with pytest.raises(InputError, match=r"no item 9; the queue has items 1 to 4"):
            store.item(9)
    report = night.run()
    assert [item.id for item in report.ended] == [2, 1, 3]
    assert night.item(4).reason == "cancelled by me"


def test_what_depends_on_an_earlier_result_starts_or_is_skipped(night: Night) -> None:
    first = night.add("fail")
    on_failure = night.add("done", after=first, wanted="failed")
    either = night.add("done", after=first, wanted="ended")
    never = night.add("done", after=first)
    chained = night.add("done", after=never)
    exact = night.add("done", after=on_failure, wanted="b.rsd < 0.1 %")
    coarse = night.add("done", after=on_failure, wanted="b.rsd > 0.1 %")
    unknown = night.add("done", after=on_failure, wanted="M1 > 2")
    night.run()
    states = dict(enumerate(night.states(), start=1))
    assert states[on_failure] == states[either] == states[exact] == "done"
    assert states[never] == states[chained] == states[coarse] == states[unknown] == "skipped"
    assert night.item(never).reason == "item 1 is failed; wanted: done"
    assert night.item(chained).reason == "item 4 is skipped; wanted: done"
    assert night.item(coarse).reason == "b.rsd of item 2 is 0.0005; wanted: b.rsd > 0.1 %"
    assert "M1 was not identified" in night.item(unknown).reason


def test_an_item_waits_for_its_time_and_expires_after_it(night: Night) -> None:
    now = datetime.now(UTC)
    soon = (now + timedelta(seconds=2)).isoformat()
    waits = night.add("done", priority=9, not_before=soon)
    late = night.add("done", not_after=(now - timedelta(seconds=1)).isoformat())
    at_once = night.add("done")
    report = night.run()
    assert [item.id for item in report.ended] == [late, at_once, waits]
    assert night.item(waits).started >= soon[:23]
    assert night.item(late).state == "expired"
    assert any("not before" in line for line in night.said)


def test_an_item_waits_for_the_bench_and_a_condition_that_never_comes_ends(
    night: Night, monkeypatch: pytest.MonkeyPatch
) -> None:
    oil = night.folder / "oil"
    oil.write_text("20 20 20 45")
    monkeypatch.setenv("TEST_OIL", str(oil))
    end = (datetime.now(UTC) + timedelta(seconds=4)).isoformat()
    warm = night.add("done", when="oil_temperature > 40 degC")
    hot = night.add("done", when="oil_temperature > 400 degC", not_after=end)
    night.run()
    assert night.states() == ["done", "expired"]
    assert night.starts(hot) == 0
    assert "waited for oil_temperature > 400 degC" in night.item(hot).reason
    assert f"item {warm} done: waits for oil_temperature > 40 degC; it is 20" in night.said


def test_a_trip_stops_the_queue_and_what_waits_stays_queued_until_it_is_cleared(
    night: Night,
) -> None:
    night.add("trip-20")
    night.add("done")
    report = night.run()
    assert report.code == 3
    assert "cap_pressure_1" in report.reason
    assert night.states() == ["tripped", "queued"]
    # Nobody has looked at the bench: the next night's runner starts nothing and loses no item.
    again = night.run()
    assert again.code == 3
    assert night.states() == ["tripped", "queued"]
    assert "not started" in night.item(2).reason
    assert night.starts(2) == 0
    reset()
    assert night.run().code == 0
    assert night.item(2).run.endswith("run2")


def test_a_notification_of_an_item_that_found_the_bench_tripped_has_it_queued(
    night: Night,
) -> None:
    notes = night.folder / "notes"
    night.add("trip-20")
    night.add("done")
    night.run()
    assert night.run("sh", "-c", f"cat >> {notes}").code == 3
    first = json.loads(notes.read_text().splitlines()[0])
    assert (first["event"], first["item"]["id"], first["item"]["state"]) == ("trip", 2, "queued")
    assert first["counts"] == {"tripped": 1, "queued": 1}


def test_a_lost_device_is_one_item_s_bad_luck_twice_in_a_row_it_is_the_bench(
    night: Night,
) -> None:
    for mode in ("lost-20", "done", "lost-20", "lost-20", "done"):
        night.add(mode)
    report = night.run()
    # The outputs of a device that does not answer cannot be confirmed: that stops the queue.
    assert report.code == 4
    assert night.states()[0] == "device lost"
    assert "outputs not confirmed at zero" in night.item(1).reason
    assert night.states()[1:] == ["queued"] * 4


def test_an_item_waits_for_a_bench_that_another_process_uses(night: Night) -> None:
    """A manual session that somebody forgot costs no item of the night."""
    night.add("done")
    night.add("done")
    state = BenchState(load_rig("shinshu-2dof").wire)
    state.prepare()
    state.occupy()
    state.take(None)

    def say(line: str) -> None:
        if "waits for the bench" in line:
            state.release()
        Night.say(night, line)

    night.say = say  # type: ignore[method-assign]
    assert night.run().code == 0
    assert night.states() == ["done", "done"]
    assert night.starts(1) == 1
    assert any(f"is in use by process {os.getpid()} of" in line for line in night.said)


def test_a_killed_item_is_made_safe_recovered_and_not_started_again(night: Night) -> None:
    night.add("die-20")
    night.add("die-early")
    night.add("done")
    night.run()
    assert night.states() == ["interrupted", "interrupted", "done"]
    reason = night.item(1).reason
    assert "killed by signal 9; outputs confirmed at zero; recovered: " in reason
    assert len(load_run(night.item(1).run, partial=True).records) == 1
    assert [night.starts(k) for k in (1, 2, 3)] == [1, 0, 1]
    night.run()
    assert night.starts(1) == 1


def test_pause_lets_the_present_item_end_and_nothing_more_start(night: Night) -> None:
    night.add("endless")
    night.add("done")
    child = night.process()
    until(lambda: night.starts(1) == 1, "the first item runs")
    with QueueStore(night.path) as store:
        store.pause("me")
        store.cancel(1, "me")
    assert child.wait(LONG) == 1
    assert night.states() == ["cancelled", "queued"]
    assert night.item(1).reason.startswith("cancelled by a person; stopped by SIGTERM")
    run = Path(night.item(1).run)
    assert (run / "state").read_text() == "aborted\n"
    told = run.with_suffix(".device").read_text().split()
    assert told[-3:] == ["zero", "stop", "close"]
    assert night.run().reason.startswith("paused: paused by me at ")
    with QueueStore(night.path) as store:
        store.resume("me")
    night.run()
    assert night.states() == ["cancelled", "done"]


@pytest.mark.parametrize(
    ("number", "reason"),
    [(2, "stopped by operator (Ctrl-C)"), (1, "stopped because the terminal closed")],
)
def test_a_signal_at_the_runner_ends_the_item_safely(
    night: Night, number: int, reason: str
) -> None:
    night.add("endless")
    night.add("done")
    child = night.process()
    until(lambda: night.starts(1) == 1, "the item runs")
    child.send_signal(number)
    assert child.wait(LONG) == 130
    assert night.states() == ["stopped", "queued"]
    assert night.item(1).reason == f"{reason}; stopped by SIGTERM"
    assert Path(night.item(1).run).with_suffix(".device").read_text().split()[-3] == "zero"


def test_a_stop_of_the_running_item_keeps_the_next_one_from_the_bench(night: Night) -> None:
    """As after `bramah stop`, which signals the run, or the space bar on the screen."""
    night.add("endless")
    night.add("done")
    child = night.process()
    until(lambda: night.starts(1) == 1, "the item runs")
    process = night.item(1).pid
    assert process is not None
    os.kill(process, signal.SIGTERM)
    assert child.wait(LONG) == 130
    assert night.states() == ["stopped", "queued"]
    assert night.starts(2) == 0


@pytest.mark.parametrize("stop", ["stopped", "all-stopped"])
def test_a_bench_that_is_stopped_during_a_check_is_not_driven(night: Night, stop: str) -> None:
    night.add(stop)
    night.add("done")
    report = night.run()
    assert report.code == 130
    assert "`bramah stop` of " in report.reason
    assert night.states() == ["queued", "queued"]
    assert night.starts(1) == night.starts(2) == 0


def test_a_stop_of_another_bench_ends_no_night(night: Night) -> None:
    night.add("done")
    note_stop("modbus-tcp://127.0.0.1:9")
    assert night.run().code == 0


def test_a_retried_item_keeps_its_place_and_its_first_run(night: Night) -> None:
    night.add("fail")
    night.add("done")
    night.run()
    with QueueStore(night.path) as store:
        with pytest.raises(InputError, match="is already the run folder of item 1"):
            store.add(store.item(1).job, 0, {})
        store.retry(1, "me")
        assert [item.id for item in store.items()] == [1, 2]
    night.run()
    assert night.item(1).run.endswith("run1-2")
    assert night.item(1).attempt == 2
    assert night.starts(1) == 2
    assert (night.folder / "run1" / "records.h5").exists()


def test_one_runner_at_a_time_and_a_dead_one_holds_nothing(night: Night) -> None:
    night.add("endless")
    child = night.process()
    until(lambda: night.starts(1) == 1, "the item runs")
    with pytest.raises(InputError, match=f"process {child.pid} runs this queue already"):
        night.run()
    with QueueStore(night.path) as store:
        store.cancel(1, "me")
    child.wait(LONG)
    (night.folder / "queue.sqlite.d" / "runner.lock").write_text("4194000\n")
    night.run()
    assert "the previous runner, process 4194000, was killed" in night.said


@pytest.mark.parametrize(
    ("command", "logged"),
    kept(
        [
            (("sh", "-c", "cat >> {}"), ""),
            (("sleep", "600"), "took longer"),
            (("false",), "ended with 1"),
            (("/no/such/program",), "was not delivered"),
            (("sh", "-c", "exec <&-; exit 3"), "ended with 3"),
        ],
        (0, 1),
    ),
)
def test_a_notification_is_delivered_or_costs_the_night_nothing(
    night: Night, caplog: pytest.LogCaptureFixture, command: tuple[str, ...], logged: str
) -> None:
    notes = night.folder / "notes"
    night.add("fail")
    night.add("trip-20")
    assert night.run(*(word.format(notes) for word in command)).code == 3
    assert night.states() == ["failed", "tripped"]
    assert logged in caplog.text
    if logged:
        return
    found = [json.loads(line) for line in notes.read_text().splitlines()]
    assert [note["event"] for note in found] == ["failure", "trip", "end"]
    assert found[0]["item"]["state"] == "failed"
    assert found[0]["reason"] == "the protocol could not be done"
    assert found[2]["counts"] == {"failed": 1, "tripped": 1}


@pytest.mark.parametrize(
    "text", ["oil_temperature > 40", "oil_temperature > 40 bar", "oil > 40 degC", "b.rsd < 1 %", ""]
)
def test_a_condition_of_no_channel_or_unit_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--when"):
        channel_condition(text)


@pytest.mark.parametrize("text", ["> 300 degC", ">= 101 degC", "< 0 degC", "> 100 degC"])
def test_a_condition_that_no_reading_of_the_bench_can_meet_is_refused(text: str) -> None:
    ranges = {name: RIG.range_of(name) for name in RIG.channels}
    with pytest.raises(InputError, match="expected a bound within the sensor's range, 0 to 100"):
        channel_condition(f"oil_temperature {text}", ranges)
    assert channel_condition("oil_temperature > 99 degC", ranges).bound == pytest.approx(99.0)


@pytest.mark.parametrize("text", ["finished", "b.rsd", "b < 2 m", "M1 > x", "b.rsd < 1 mm"])
def test_a_wanted_result_that_none_can_be_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--if"):
        check_wanted(text, parameter_names(2))


def test_a_parameter_that_is_misspelt_is_refused_with_those_that_there_are() -> None:
    check_wanted("C_pp_1.rsd < 5 %", parameter_names(2))
    for text in ("B.rsd < 0.5 %", "B < 5 %"):
        with pytest.raises(InputError, match=r"'B' is no parameter .* one of: M1 M2 R12 .* b"):
            check_wanted(text, parameter_names(2))
    with pytest.raises(InputError, match=r"compared in SI, .* b\.rsd, may have %"):
        check_wanted("b < 5 %", parameter_names(2))


@given(st.floats(-300, 300), st.sampled_from(["<", "<=", ">", ">="]))
def test_a_channel_condition_compares_in_si(bound: float, sign: str) -> None:
    condition = channel_condition(f"oil_temperature {sign} {bound!r} degC")
    for value in (bound - 1.0, bound + 1.0):
        assert condition.holds(value) == eval(f"{value!r} {sign} {bound!r}")
    assert not condition.holds(float("nan"))
    assert result_condition(f"b.rsd {sign} {bound!r} %").bound == pytest.approx(bound / 100)


@given(st.integers(0, 23), st.integers(0, 59))
def test_a_time_of_day_is_the_next_one(hour: int, minute: int) -> None:
    now = datetime.now(UTC)
    found = parse_time(f"{hour:02d}:{minute:02d}", now, "--not-before")
    assert timedelta(minutes=-1) <= found - now <= timedelta(hours=25)
    local = found.astimezone()
    assert (local.hour, local.minute) == (hour, minute)


def test_a_file_that_is_no_queue_is_refused_and_kept(tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("no database " * 100)
    before = text.read_bytes()
    with pytest.raises(InputError, match="not a usable queue"):
        QueueStore(text)
    assert text.read_bytes() == before
    other = tmp_path / "other.sqlite"
    db = sqlite3.connect(other)
    db.execute("CREATE TABLE mine (x)")
    db.close()
    with pytest.raises(InputError, match="a database of another program"):
        QueueStore(other)
    with pytest.raises(InputError, match="no such queue"):
        QueueStore(tmp_path / "none.sqlite", create=False)
    later = tmp_path / "later.sqlite"
    QueueStore(later).__exit__(None, None, None)
    db = sqlite3.connect(later)
    db.execute("PRAGMA user_version=7")
    db.close()
    with pytest.raises(InputError, match="a queue of schema version 7"):
        QueueStore(later)
