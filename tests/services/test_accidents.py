"""Runs that end badly: killed at any moment, out of disk, interrupted twice; nothing is lost."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from rig.bench.session import Bench
from rig.cli.main import app
from rig.model.parse import InputError
from rig.model.trips import RecordingFailed
from rig.runs.files import scratch_folder
from rig.runs.journal import TAIL_BLOCKS, BlockRow, JournalTail, read_tail, tail_of
from rig.runs.listing.index import indexed_runs
from rig.runs.recorder import Recorder
from rig.runs.recover import FINALISED, recover
from rig.runs.runstate import read_events
from rig.runs.store import load_run
from tests.full_disk import largest_file
from tests.services.children import RIG, acknowledged, assert_all_there, finish, measured, start
from tests.services.fake_driver import FakeDriver, samples
from tests.variants import every_second


@pytest.mark.parametrize("block", [1, 17, 45])
def test_killed_while_recording_every_acknowledged_sample_is_recovered(
    tmp_path: Path, block: int
) -> None:
    run = tmp_path / "run"
    code, _ = finish(run, "kill at block", block)
    assert code == -signal.SIGKILL
    (summary,) = indexed_runs(tmp_path)
    assert summary.state == "interrupted"
    with pytest.raises(InputError, match=r"interrupted, .*bramah recover"):
        load_run(run)
    report = recover(run)
    assert report.state == "interrupted"
    assert_all_there(run)
    assert not list(run.glob("journal*"))
    if block == 45:
        assert [r.name for r in load_run(run).records] == ["s_r1"]
        first, second = load_run(run, partial=True).records
        assert (first.samples, second.samples) == (300, 140)
        assert (report.records, report.partial) == (2, 1)
    else:
        with pytest.raises(InputError, match="before any record was complete"):
            load_run(run)
    assert recover(run).message == FINALISED


def test_a_finalised_run_on_a_disk_for_reading_only_has_nothing_to_recover(
    interrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recover(interrupted)

    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("rig.runs.runstate.replace_text", refused)
    monkeypatch.setattr(Path, "unlink", refused)
    assert recover(interrupted).message == FINALISED


@pytest.mark.parametrize("place", every_second(range(10)))
def test_killed_while_the_archive_is_written_the_run_is_finished_by_recover(
    tmp_path: Path, place: int
) -> None:
    run = tmp_path / "run"
    code, _ = finish(run, "kill in archive", place)
    assert code == -signal.SIGKILL
    report = recover(run)
    assert report.state == "done"
    assert [(r.name, r.samples) for r in load_run(run).records] == [("s_r1", 300), ("s_r2", 300)]
    assert_all_there(run)
    left = {p.name for p in run.iterdir()}
    assert left == {"events.jsonl", "records.h5", "run.yaml", "state"}


@pytest.mark.parametrize("place", range(8))
def test_killed_while_the_folder_is_made_it_is_an_empty_run_or_none(
    tmp_path: Path, place: int
) -> None:
    run = tmp_path / "run"
    code, _ = finish(run, "kill at start", place)
    assert code == -signal.SIGKILL
    if place < 2:
        assert indexed_runs(tmp_path) == []
        with pytest.raises(InputError, match="not a run folder"):
            recover(run)
    else:
        report = recover(run)
        assert (report.state, report.records) == ("interrupted", 0)
        assert not (run / "owner.json").exists()
        assert [s.state for s in indexed_runs(tmp_path)] == ["interrupted"]
        with pytest.raises(InputError):
            load_run(run)


def test_killed_at_a_random_moment_from_outside_nothing_is_lost(tmp_path: Path) -> None:
    run = tmp_path / "run"
    child = start(run, "serve", 100_000)
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        if run.with_suffix(".ack").exists() and acknowledged(run) > 200:
            break
        time.sleep(0.01)
    with pytest.raises(InputError, match=f"being written by process {child.pid}"):
        recover(run)
    with pytest.raises(InputError, match=f"still being recorded .process {child.pid}"):
        load_run(run)
    child.kill()
    child.communicate(timeout=30)
    recover(run)
    assert acknowledged(run) > 200
    assert_all_there(run)


@pytest.fixture
def interrupted(tmp_path: Path) -> Path:
    """A run killed in its second record, with everything still in the write-ahead log."""
    run = tmp_path / "run"
    finish(run, "kill at block", 45)
    return run


def found_as_measured(run: Path) -> int:
    """Check the samples that were found; return how many of the 450 were not."""
    found = measured(run)
    known = samples(RIG, np.arange(len(found)))[:, RIG.recorded.index("piston_1")]
    there = np.isfinite(found)
    np.testing.assert_array_equal(found[there], known[there])
    return 450 - int(there.sum())


def test_a_torn_end_of_the_log_costs_the_blocks_on_it_and_says_how_many(interrupted: Path) -> None:
    log = interrupted / "journal.sqlite-wal"
    raw = log.read_bytes()
    log.write_bytes(raw[: len(raw) - 20_000])
    report = recover(interrupted)
    lost = found_as_measured(interrupted)
    assert 0 < lost <= 200  # what stands on five pages
    assert report.missing == lost
    assert report.damaged is not None
    assert (report.damaged.parent / f"{report.damaged.name}-tail").exists()


def test_a_last_write_cut_off_by_a_full_disk_is_no_damage(interrupted: Path) -> None:
    log = interrupted / "journal.sqlite-wal"
    log.write_bytes(log.read_bytes() + bytes(1000))  # a part of a page
    done = CliRunner().invoke(app, ["recover", str(interrupted)], standalone_mode=False)
    assert done.exception is None
    assert "the journal ends early: its last write is cut off" in done.stdout
    assert "read from it: 450 samples; no loss is known" in done.stdout
    assert found_as_measured(interrupted) == 0


@pytest.mark.parametrize("kept", [0, 3, 500, 5000])
def test_a_torn_tail_costs_the_newest_blocks_only(interrupted: Path, kept: int) -> None:
    tail = interrupted / "journal.sqlite-tail"
    raw = tail.read_bytes()
    tail.write_bytes(raw[:kept])
    report = recover(interrupted)
    each = 12 + int.from_bytes(raw[4:8], "little")
    newest = 45 % TAIL_BLOCKS
    assert found_as_measured(interrupted) == 10 * (newest - kept // each)
    assert report.damaged is not None
    assert f"tail has {kept} bytes, not 65536; up to 310 samples (0.310 s)" in report.message
    assert load_run(interrupted).records[0].samples == 300


@pytest.mark.parametrize(
    ("state", "what"), [("gone", "is missing"), ("zeros", "is filled with zeros")]
)
def test_a_tail_without_the_newest_blocks_is_damage(
    interrupted: Path, state: str, what: str
) -> None:
    tail = interrupted / "journal.sqlite-tail"
    if state == "gone":
        tail.unlink()
    else:
        tail.write_bytes(bytes(tail.stat().st_size))
    done = CliRunner().invoke(app, ["recover", str(interrupted)], standalone_mode=False)
    assert f"journal.sqlite-tail {what}; up to 310 samples (0.310 s)" in done.stdout
    assert "its journal was damaged" in str(done.exception)
    assert (interrupted / "journal.damaged.sqlite").exists()
    assert found_as_measured(interrupted) == 10 * (45 % TAIL_BLOCKS)


def test_a_tail_whose_newer_half_is_zeros_is_damage(interrupted: Path) -> None:
    tail = interrupted / "journal.sqlite-tail"
    raw = tail.read_bytes()
    tail.write_bytes(raw[:5000] + bytes(len(raw) - 5000))
    assert "tail is filled with zeros" in recover(interrupted).message


def test_a_zeroed_tail_is_damage_where_nothing_else_was_written_yet(tmp_path: Path) -> None:
    run = killed_after(5, tmp_path)
    tail = run / "journal.sqlite-tail"
    tail.write_bytes(bytes(tail.stat().st_size))
    with pytest.raises(RecordingFailed, match="lacks the first blocks of the last stream"):
        recover(run)
    assert (run / "journal.sqlite").exists()


def test_a_run_killed_before_its_first_block_is_not_damaged(tmp_path: Path) -> None:
    report = recover(killed_after(0, tmp_path))
    assert (report.damaged, report.samples) == (None, 0)


@pytest.mark.parametrize("blocks", [1, 31, 32, 33, 63, 64, 65, 100])
def test_a_run_killed_at_any_block_is_not_damaged(tmp_path: Path, blocks: int) -> None:
    report = recover(killed_after(blocks, tmp_path))
    assert (report.damaged, report.outside) == (None, 10 * blocks)


def killed_after(blocks: int, folder: Path) -> Path:
    """A run whose process died after so many blocks."""
    original, copy = folder / "run", folder / "copy"
    with Bench(RIG, FakeDriver(RIG), Recorder(original, RIG), signals=False) as bench:
        for _ in range(blocks):
            bench.exchange()
        shutil.copytree(original, copy)
        (copy / "owner.json").unlink()
    return copy


def test_a_damaged_block_of_the_tail_is_lost_alone_and_counted(interrupted: Path) -> None:
    tail = interrupted / "journal.sqlite-tail"
    raw = bytearray(tail.read_bytes())
    raw[400] ^= 1
    tail.write_bytes(raw)
    report = recover(interrupted)
    assert found_as_measured(interrupted) == 10
    assert report.missing == 10
    assert "journal.sqlite-tail are missing" in report.message


@given(st.lists(st.tuples(st.integers(0, 20_000), st.integers(0, 255)), max_size=30), st.data())
def test_whatever_happens_to_a_tail_a_row_read_from_it_was_written(
    changes: list[tuple[int, int]], data: st.DataObject
) -> None:
    rng = np.random.default_rng(len(changes))
    written = [
        BlockRow(k, 1, k, 10 * k, 10, None if k % 2 else 0.5, 7, rng.bytes(720), rng.bytes(k % 3))
        for k in range(1, data.draw(st.integers(1, 30)))
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "journal.sqlite"
        tail = JournalTail(tail_of(path))
        for row in written:
            if row.id % 17 == 0:
                tail.clear()
            assert tail.add(row)
        tail.close()
        cleared = len(written) // 17 * 17
        assert read_tail(path, after=cleared - 1) == written[max(0, cleared - 1) :]
        raw = bytearray(tail_of(path).read_bytes())
        for at, value in changes:
            raw[at] = value
        tail_of(path).write_bytes(raw)
        assert set(read_tail(path, after=0)) <= set(written)


def test_a_damaged_block_is_found_by_its_checksum_and_becomes_lost_samples(
    interrupted: Path,
) -> None:
    with sqlite3.connect(interrupted / "journal.sqlite") as db:
        (blob,) = db.execute("SELECT data FROM block WHERE tick = 100").fetchone()
        spoiled = bytes([blob[0] ^ 1]) + blob[1:]
        db.execute("UPDATE block SET data = ? WHERE tick = 100", (spoiled,))
    db.close()
    report = recover(interrupted)
    assert (report.damaged_blocks, report.lost_samples) == (1, 10)
    record = load_run(interrupted).records[0]
    assert np.flatnonzero(np.isnan(record.channels["piston_1"])).tolist() == list(range(90, 100))
    assert record.attributes["lost_samples"] == 10
    assert (interrupted / "journal.damaged.sqlite").exists()


def test_a_missing_state_and_a_torn_event_do_not_stop_the_recovery(interrupted: Path) -> None:
    (interrupted / "state").unlink()
    events = interrupted / "events.jsonl"
    events.write_bytes(events.read_bytes()[:-5])
    assert recover(interrupted).state == "interrupted"
    found = [e["event"] for e in read_events(interrupted)]
    assert found[-1] == "recovered"
    assert found[:3] == ["start", "stream begins", "record begins"]


def test_a_run_copied_from_another_computer_is_recovered_by_force_only(interrupted: Path) -> None:
    owner = interrupted / "owner.json"
    owner.write_text('{"pid": 1, "started": "1", "host": "bench-pc"}')
    with pytest.raises(InputError, match="on computer 'bench-pc'"):
        recover(interrupted)
    assert recover(interrupted, force=True).records == 2


def test_a_journal_that_is_none_is_refused(interrupted: Path) -> None:
    for name in ("journal.sqlite-wal", "journal.sqlite-shm", "journal.sqlite-tail"):
        (interrupted / name).unlink()
    (interrupted / "journal.sqlite").write_bytes(b"rubbish" * 1000)
    with pytest.raises(RecordingFailed, match="not a readable journal"):
        recover(interrupted)
    assert (interrupted / "journal.sqlite").read_bytes() == b"rubbish" * 1000


@pytest.mark.parametrize("limit", [600_000, 650_000])
def test_a_journal_that_cannot_grow_zeroes_the_outputs_and_what_it_took_is_readable(
    tmp_path: Path, limit: int
) -> None:
    run = tmp_path / "run"
    code, said = finish(run, "file limit", limit)
    assert code == 1
    assert "is the disk full?" in said.strip().splitlines()[-1]
    assert "Traceback" not in said
    device = run.with_suffix(".device").read_text().split()
    assert device[-3:] == ["zero", "stop", "close"]
    assert (run / "state").read_text() == "aborted\n"
    assert_all_there(run)
    assert len(measured(run)) > limit / 5000


def test_a_disk_without_room_for_the_archive_either_is_recovered_when_there_is(
    tmp_path: Path,
) -> None:
    run = tmp_path / "run"
    code, said = finish(run, "disk full", 600_000)
    assert code == 1
    assert "Traceback" not in said
    assert run.with_suffix(".device").read_text().split()[-3:] == ["zero", "stop", "close"]
    assert (run / "state").read_text() == "aborted\n"
    with pytest.raises(InputError, match=r"aborted, .*bramah recover"):
        load_run(run)
    report = recover(run)
    assert report.state == "aborted"
    assert report.samples >= 100
    assert_all_there(run)


@pytest.mark.parametrize("size", [33_000, 50_000, 70_000])
def test_a_disk_that_takes_the_journal_but_not_the_archive_keeps_the_journal(
    tmp_path: Path, size: int
) -> None:
    run = tmp_path / "run"
    finish(run, "kill at block", 45)
    with largest_file(size), pytest.raises(RecordingFailed, match=r"records.h5: .*too large"):
        recover(run)
    assert (run / "journal.sqlite").exists()
    assert not (run / "records.h5.tmp").exists()
    recover(run)
    assert_all_there(run)


def test_a_run_folder_deleted_or_moved_stops_the_run_and_says_what_is_left(tmp_path: Path) -> None:
    run, moved = tmp_path / "run", tmp_path / "moved"
    driver = FakeDriver(RIG)
    said = (
        r"run: this run folder was deleted or moved .* its \d+ samples are lost if it was deleted"
    )

    def move_it_during_the_run() -> None:
        with Bench(RIG, driver, Recorder(run, RIG), signals=False) as bench:
            bench.run_for(1.0)
            run.rename(moved)
            bench.run_for(10.0)

    with pytest.raises(RecordingFailed, match=said):
        move_it_during_the_run()
    assert driver.calls[-3:] == ["zero", "stop", "close"]
    assert not run.exists()
    (moved / "owner.json").unlink()  # as if this process had ended
    recover(moved)
    assert len(measured(moved)) > 1000


def test_a_killed_process_leaves_its_temporary_folder_to_the_next_one_to_remove(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = (
        "import time; from rig.runs.files import scratch_folder; hold = scratch_folder(); "
        "print(hold.__enter__(), flush=True); time.sleep(600)"
    )
    variables = {**os.environ, "TMPDIR": str(tmp_path)}
    line = [sys.executable, "-c", code]
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with subprocess.Popen(line, env=variables, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        left = Path(child.stdout.readline().strip())
        os.utime(left, (0, 0))
        with scratch_folder() as own:
            assert sorted(tmp_path.iterdir()) == sorted((left, own))
        child.kill()
    with scratch_folder() as own:
        assert list(tmp_path.iterdir()) == [own]
    assert not list(tmp_path.iterdir())


def test_ctrl_c_twice_still_zeroes_and_finishes_the_run(tmp_path: Path) -> None:
    run = tmp_path / "run"
    code, said = finish(run, "ctrl-c twice", 40)
    assert code == 130
    assert "Traceback" not in said
    device = run.with_suffix(".device").read_text().split()
    assert device[-5:] == ["zero", "zero", "zero", "stop", "close"]
    assert (run / "state").read_text() == "aborted\n"
    assert [r.samples for r in load_run(run, partial=True).records] == [300, 100]
    assert_all_there(run)


def test_sigterm_is_a_stop(tmp_path: Path) -> None:
    run = tmp_path / "run"
    child = start(run, "serve", 100_000)
    while child.poll() is None and not (
        run.with_suffix(".ack").exists() and acknowledged(run) > 100
    ):
        time.sleep(0.01)
    child.terminate()
    _, said = child.communicate(timeout=60)
    assert child.returncode == 130, said
    assert run.with_suffix(".device").read_text().split()[-3:] == ["zero", "stop", "close"]
    assert read_events(run)[-1]["message"] == "stopped by SIGTERM"
    assert_all_there(run)
