"""Pools: the same results in the same order wherever the work is done, and nothing left behind."""

from __future__ import annotations

import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count, islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.identify.result import PLAIN
from analysis.identify.streams.out_of_core import identify_folders
from analysis.workers.cluster import DaskCluster
from analysis.workers.forked import Forked
from analysis.workers.pool import Pool, Processes, Serial
from rig.model.parse import InputError
from rig.model.records import Run
from rig.runs.archive import write_run
from tests.analysis import small_bench as bench
from tests.analysis.pool_work import about, broken, gone, noise, square
from tests.analysis.test_accumulate import assert_same
from tests.cli.bench import bramah_here
from tests.studies.pool import Kept, performed

END_SECONDS = 20.0


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture(scope="module", params=[Processes, Forked])
def processes(request: pytest.FixtureRequest) -> Iterator[Pool]:
    with request.param(2) as pool:
        yield pool


def test_processes_give_what_this_process_gives(processes: Pool) -> None:
    expected = list(Serial().map(noise, range(20)))
    assert list(processes.map(noise, range(20))) == expected


def test_items_may_be_endless() -> None:
    with Processes(2) as processes:
        for pool in (Serial(), processes):
            assert list(islice(pool.map(square, count()), 5)) == [0, 1, 4, 9, 16]


def test_an_error_comes_back_as_it_was(processes: Pool) -> None:
    for pool in (Serial(), processes):
        with pytest.raises(InputError, match="item 3 cannot be used"):
            list(pool.map(broken, [3, 4]))


def test_processes_are_others_have_one_thread_each_and_end_with_the_block() -> None:
    before = os.environ.get("OPENBLAS_NUM_THREADS")
    with Processes(2) as pool:
        found = list(pool.map(about, range(8)))
    assert os.environ.get("OPENBLAS_NUM_THREADS") == before
    pids = {pid for pid, _ in found}
    assert os.getpid() not in pids
    assert {threads for _, threads in found} == {"1"}
    assert not any(alive(pid) for pid in pids)


def test_a_process_that_dies_ends_the_work_with_a_reason() -> None:
    with Processes(1) as pool, pytest.raises(ChildProcessError, match="a worker process died"):
        list(pool.map(gone, [1]))


def test_copies_of_this_process_share_its_data_and_end_with_the_map() -> None:
    pool, large = Forked(2), np.zeros(1_000_000)
    met = get_context("fork").Barrier(2)

    def work(number: int) -> tuple[int, list[int], float]:
        if number < 2:  # neither process can take both
            met.wait(END_SECONDS)
        large[number] = 1.0
        return os.getpid(), list(pool.map(lambda _: os.getpid(), range(3))), large.sum()

    done = list(pool.map(work, range(4)))
    pids = {pid for pid, _, _ in done}
    assert len(pids) == 2
    assert os.getpid() in pids
    # A map within a map starts no further copies.
    assert all(within == [pid] * 3 for pid, within, _ in done)
    assert large.sum() == sum(pid == os.getpid() for pid, _, _ in done) < 4
    (copy,) = pids - {os.getpid()}
    assert not alive(copy)


def test_what_a_copy_does_not_finish_is_done_here(caplog: pytest.LogCaptureFixture) -> None:
    """Out of memory, the system kills one of the processes."""
    here, taken = os.getpid(), get_context("fork").Event()

    def work(number: int) -> int:
        if os.getpid() != here:
            taken.set()
            os.kill(os.getpid(), signal.SIGKILL)
        assert taken.wait(END_SECONDS)
        return number

    assert list(Forked(2).map(work, range(4))) == [0, 1, 2, 3]
    assert "a process that shared the work died" in caplog.text


def test_other_threads_forbid_copies() -> None:
    """A lock that another thread holds would stay locked in the copy."""
    end = threading.Event()
    other = threading.Thread(target=end.wait)
    other.start()
    assert Forked().workers == 1
    end.set()
    other.join()


@contextmanager
def dask(*words: object) -> Iterator[subprocess.Popen[bytes]]:
    """A `dask` command as docs/scale.md starts it, ended by its own SIGTERM."""
    line = [sys.executable, "-m", "dask", *map(str, words)]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(line, stdin=quiet, stdout=quiet, stderr=quiet) as process:
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(END_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()


def wait_for(what: Path, process: subprocess.Popen[bytes]) -> str:
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        assert process.poll() is None, "dask ended by itself"
        if what.exists() and what.read_text().strip():
            return what.read_text()
        time.sleep(0.05)
    raise AssertionError(f"{what} never came")


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    import json

    file = tmp_path_factory.mktemp("dask") / "scheduler.json"
    place = ("--host", "127.0.0.1", "--port", 0, "--no-dashboard", "--scheduler-file", file)
    with ExitStack() as stack:
        process = stack.enter_context(dask("scheduler", *place))
        wait_for(file, process)
        address = json.loads(file.read_text())["address"]
        limits = ("--no-nanny", "--nthreads", 1, "--no-dashboard", "--host", "127.0.0.1")
        stack.enter_context(dask("worker", address, *limits))
        deadline = time.monotonic() + 60.0
        while True:
            try:
                with DaskCluster(address):
                    break
            except InputError:
                assert time.monotonic() < deadline
                time.sleep(0.1)
        yield address


def test_a_cluster_identifies_what_one_process_does(
    scheduler: str, tmp_path: Path, multisine_run: Run
) -> None:
    runs = [multisine_run, bench.one_sample_shorter(multisine_run)]
    names = ("monday", "tuesday")
    folders = [str(write_run(tmp_path / n, run)) for n, run in zip(names, runs, strict=True)]
    with DaskCluster(scheduler) as pool:
        assert pool.workers == 1
        both = identify(runs, estimator=PLAIN)
        assert_same(identify_folders(folders, pool=pool), both)
        with pytest.raises(InputError, match="item 3 cannot be used"):
            list(pool.map(broken, [3]))
        with pytest.raises(InputError, match="wednesday: no worker of the cluster sees it"):
            identify_folders([str(tmp_path / "wednesday")], pool=pool)


def test_a_study_on_a_cluster_goes_on_when_a_job_fails(scheduler: str, tmp_path: Path) -> None:
    told: list[object] = []
    kept = Kept(tmp_path, lambda job: f"{job}.json", lambda root: root, lambda job, root: root)
    for again in (False, True):
        jobs = performed(
            [4.0, -1.0, 9.0], math.sqrt, scheduler, lambda *words: told.append(words[2:]), kept
        )
        assert [next(jobs), next(jobs)] == [(4.0, 2.0), (9.0, 3.0)]
        with pytest.raises(RuntimeError, match=r"1 of \d jobs failed:\n-1.0: ValueError: "):
            next(jobs)  # an error that no bad input explains is not passed over
        # What was found is not done again; what failed is tried anew.
        assert [job for job, _ in told] == ([-1.0] if again else [4.0, -1.0, 9.0])
        assert isinstance(dict(told)[-1.0], ValueError)
        told.clear()


def test_the_command_line_works_on_a_cluster(
    scheduler: str, tmp_path: Path, multisine_run: Run
) -> None:
    folder = write_run(tmp_path / "monday", multisine_run)
    done = bramah_here("identify", folder, "--cluster", scheduler)
    assert done.returncode == 0, done.stderr
    assert "C_mm_2" in done.stdout


@pytest.mark.slow
def test_runs_that_only_the_workers_see_are_identified_from_elsewhere(
    scheduler: str, tmp_path: Path, multisine_run: Run
) -> None:
    folder = os.path.relpath(
        write_run(tmp_path / "tuesday", multisine_run)
    )  # from the workers' own
    elsewhere = tmp_path / "away" / "from" / "there"
    elsewhere.mkdir(parents=True)
    assert not (elsewhere / folder).exists()
    line = [sys.executable, "-c", "from rig.cli.main import run; run()", "identify", folder]
    done = subprocess.run(
        [*line, "--cluster", scheduler], cwd=elsewhere,
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "C_mm_2" in done.stdout


def test_an_address_where_nobody_answers_is_said() -> None:
    with socket.socket() as taken:  # bound, but not listening
        taken.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(InputError, match=r"no scheduler answers within 0\.3 s"):
            DaskCluster(address, timeout=0.3).__enter__()


def test_an_address_of_another_kind_is_said() -> None:
    with pytest.raises(InputError, match="expected one like tcp://"):
        DaskCluster("here").__enter__()


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"install bramah\[cluster\]"):
        DaskCluster("tcp://127.0.0.1:1").__enter__()
