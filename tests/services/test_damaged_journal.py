"""A damaged journal: what can be read is read, what is lost is said, the journal is kept."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.base import OutputLaw
from rig.bench.session import Bench
from rig.cli.main import app
from rig.model.trips import RecordingFailed
from rig.runs.listing.summary import summarise
from rig.runs.recorder import Recorder
from rig.runs.recover import FINALISED, recover
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_events
from rig.runs.store import load_run
from tests.services.fake_driver import FakeDriver, samples
from tests.variants import kept

RIG = load_rig("shinshu-2dof")
BLOCKS = 6000  # enough that most stand in the database and the newest in its log
PAGE = 4096


class Killed(Exception):
    pass


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose process died after 6000 blocks, in its third record."""
    folder = tmp_path_factory.mktemp("killed")
    original = folder / "run"
    recorder = Recorder(original, RIG)
    bench = Bench(RIG, FakeDriver(RIG), recorder, signals=False)
    bench.__enter__()
    bench.apply([OutputLaw(bias=1.0, limit=2.0), OutputLaw()])
    for repeat in (1, 2):
        with bench.record(step="s", repeat=repeat, start_tick=bench.tick, ticks=7_500):
            bench.run_for(7.5)
    bench.record(step="s", repeat=3, start_tick=bench.tick).open()
    bench.run_for((BLOCKS - 1500) / 100)
    copy = folder / "copy"
    shutil.copytree(original, copy)
    (copy / "owner.json").unlink()
    (copy / "journal.sqlite-shm").unlink()
    bench.__exit__(None, None, None)
    return copy


@pytest.fixture
def run(killed: Path, tmp_path: Path) -> Path:
    shutil.copytree(killed, tmp_path / "run")
    return tmp_path / "run"


def damage(path: Path, seed: int) -> str:
    """Damage one of a journal's files in one of the ways that disks do; returns which."""
    rng = np.random.default_rng(seed)
    target = path.with_name(path.name + ("-wal" if rng.random() < 0.3 else ""))
    raw = bytearray(target.read_bytes())
    kind = ("zero", "truncate", "flip", "shift")[seed % 4]
    if kind == "zero":
        for _ in range(rng.integers(1, 40)):
            at = int(rng.integers(0, len(raw) // PAGE)) * PAGE
            raw[at : at + PAGE] = bytes(min(PAGE, len(raw) - at))
    elif kind == "truncate":
        del raw[int(rng.integers(0, len(raw))) :]
    elif kind == "flip":
        for at in rng.integers(0, len(raw), rng.integers(1, 200)):
            raw[at] ^= 1 << int(rng.integers(0, 8))
    else:  # a stretch of it was overwritten by something else
        at, length = int(rng.integers(0, len(raw))), int(rng.integers(1, 1 << 18))
        end = min(at + length, len(raw))
        raw[at:end] = rng.bytes(end - at)
    target.write_bytes(raw)
    return f"{kind} {target.name}"


def measured_by_tick(run: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    with h5py.File(run / "records.h5") as file:
        groups = [file[name] for name in file if name != "between"]
        groups += list(file["between"].values()) if "between" in file else []
        for group in groups:
            values = group["piston_1"][:]
            ticks = int(group.attrs["start_tick"]) + np.arange(len(values))
            yield ticks[np.isfinite(values)], values[np.isfinite(values)]


def assert_only_what_was_measured(run: Path) -> int:
    """Every sample in the archive is the one measured at that tick; returns how many there are."""
    count = 0
    for ticks, values in measured_by_tick(run):
        known = samples(RIG, ticks)[:, RIG.recorded.index("piston_1")]
        np.testing.assert_array_equal(values, known)
        count += len(ticks)
    return count


def test_the_run_undamaged_is_whole(run: Path) -> None:
    report = recover(run)
    assert report.damaged is None
    assert not list(run.glob("journal*"))
    assert assert_only_what_was_measured(run) == BLOCKS * 10


@pytest.mark.parametrize("seed", kept(range(52), range(1, 5)))
def test_whatever_is_damaged_is_said_kept_and_read_as_far_as_it_goes(run: Path, seed: int) -> None:
    path = run / "journal.sqlite"
    what = damage(path, seed)
    kept = path.read_bytes()
    report = recover(run)
    there = assert_only_what_was_measured(run)
    assert there > 0
    if there < BLOCKS * 10 and "truncate journal.sqlite-wal" not in what:
        assert report.damaged is not None, what
        assert "lost" in report.message
    if report.damaged is not None:
        assert report.damaged.read_bytes() == kept
        assert report.damaged.parent == run
        assert f"read from it: {there} samples" in report.message
        assert report.missing <= BLOCKS * 10 - there
    assert not (run / "journal.rebuilt.sqlite").exists()
    assert recover(run).message == FINALISED


def test_zeroed_pages_cost_the_blocks_on_them_and_no_others(run: Path) -> None:
    path = run / "journal.sqlite"
    raw = bytearray(path.read_bytes())
    for page in (100, 101, 300):
        raw[page * PAGE : (page + 1) * PAGE] = bytes(PAGE)
    path.write_bytes(raw)
    report = recover(run)
    there = assert_only_what_was_measured(run)
    assert 0 < BLOCKS * 10 - there <= 3 * 4 * 10
    assert report.missing == BLOCKS * 10 - there
    assert f"lost: {report.missing} samples ({report.missing / 1000:.3f} s)" in report.message
    assert report.damaged_blocks == report.missing // 10
    assert [r.name for r in load_run(run).records] == ["s_r1", "s_r2"]
    assert "damaged" in read_events(run)[-1]["message"]


def test_a_database_without_its_first_page_is_read_all_the_same(run: Path) -> None:
    path = run / "journal.sqlite"
    path.write_bytes(bytes(PAGE) + path.read_bytes()[PAGE:])
    report = recover(run)
    assert assert_only_what_was_measured(run) == BLOCKS * 10
    assert (report.records, report.missing) == (3, 0)


def test_a_record_whose_description_lost_a_key_stands_outside_of_records(run: Path) -> None:
    path = run / "journal.sqlite"
    raw = path.read_bytes()
    assert raw.count(b'"locked"') > 0
    path.write_bytes(raw.replace(b'"locked"', b'"l#cked"'))
    report = recover(run)
    assert "the description of a record cannot be read" in report.message
    assert report.missing == 0
    assert report.damaged is not None
    assert assert_only_what_was_measured(run) == BLOCKS * 10


def test_the_command_ends_with_1_where_a_journal_was_damaged(run: Path) -> None:
    path = run / "journal.sqlite"
    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) // 2])
    done = CliRunner().invoke(app, ["recover", str(run)], standalone_mode=False)
    assert "kept as journal.damaged.sqlite" in done.stdout
    assert "samples are lost" in str(done.exception)


def test_a_journal_of_nothing_but_zeros_is_no_run_of_0_samples(run: Path) -> None:
    for path in run.glob("journal.sqlite*"):
        path.write_bytes(bytes(path.stat().st_size))
    before = (run / "journal.sqlite").stat().st_size
    with pytest.raises(RecordingFailed, match="none of its blocks can be read"):
        recover(run)
    assert (run / "journal.sqlite").stat().st_size == before
    assert (run / "state").exists()
    assert not (run / "records.h5").exists()


def test_a_run_copied_without_its_samples_is_no_run_of_0_samples(run: Path) -> None:
    for path in run.glob("journal.sqlite*"):
        path.unlink()
    before = sorted(path.name for path in run.iterdir())
    with pytest.raises(RecordingFailed, match=r"neither journal\.sqlite nor records\.h5 is here"):
        recover(run)
    assert sorted(path.name for path in run.iterdir()) == before
    listed = summarise(run)
    assert listed.samples == -1
    assert "neither journal.sqlite nor records.h5 is here" in listed.message


def test_blocks_longer_than_a_page_are_read_by_number(tmp_path: Path) -> None:
    run = tmp_path / "long"
    bench = Bench(RIG, FakeDriver(RIG, block_samples=100), Recorder(run, RIG), signals=False)
    with bench:
        bench.run_for(60.0)
        shutil.copytree(run, tmp_path / "copy")
    copy = tmp_path / "copy"
    (copy / "owner.json").unlink()
    path = copy / "journal.sqlite"
    raw = bytearray(path.read_bytes())
    raw[600 * PAGE : 601 * PAGE] = bytes(PAGE)
    path.write_bytes(raw)
    report = recover(copy)
    there = assert_only_what_was_measured(copy)
    assert 50_000 < there < 60_000
    assert report.damaged is not None
