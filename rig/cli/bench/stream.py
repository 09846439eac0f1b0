"""Figures of large data sets: rows streamed or in memory, two workers or one."""

from __future__ import annotations

import importlib
import resource
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from analysis.identify.streams.out_of_core import identify_folders
from analysis.regression.solve import Accumulator
from analysis.workers.cluster import DaskCluster
from analysis.workers.pool import ONE_THREAD, Processes, environment
from rig.cli.bench.figure import Figure

GROUP = "stream"
COLUMNS = 9  # columns of the two-joint bench's fluid rows
READ_ROWS = 16_384
WRITE_ROWS = 100_000
WARM_SECONDS = 0.3
# Dask's default returns every freed array to the system, which doubles the time (docs/scale.md).
WORKER_ENVIRONMENT = {
    **ONE_THREAD,
    "MALLOC_TRIM_THRESHOLD_": "268435456",
    "MALLOC_MMAP_THRESHOLD_": "33554432",
}
_TRIES = 3  # repetitions, of which the fastest counts


def write_rows(path: Path, rows: int) -> None:
    """Write [X y] (rows, COLUMNS + 1) as plain float64 to a file, block by block."""
    rng = np.random.default_rng(0)
    truth = np.arange(1.0, COLUMNS + 1)
    with path.open("wb") as file:
        for first in range(0, rows, WRITE_ROWS):
            X = rng.standard_normal((min(WRITE_ROWS, rows - first), COLUMNS))
            y = X @ truth + rng.standard_normal(len(X))
            np.column_stack((X, y)).tofile(file)


def streamed(path: str) -> dict[str, Any]:
    """Solve a file of rows block by block: time [s], peak memory of this process [B], solution."""
    started = time.perf_counter()
    total = Accumulator(COLUMNS)
    with Path(path).open("rb") as file:
        while True:
            block = np.fromfile(file, count=READ_ROWS * (COLUMNS + 1))
            if not len(block):
                break
            block = block.reshape(-1, COLUMNS + 1)
            total.fold(block[:, :-1], block[:, -1])
    R = total.triangle
    solution = np.linalg.solve(R[:-1, :-1], R[:-1, -1])
    seconds = time.perf_counter() - started
    return {"seconds": seconds, "peak": peak_memory(), "rows": total.rows, "solution": solution}


def in_memory(path: str) -> dict[str, Any]:
    """Solve a file of rows by numpy's lstsq; the time excludes loading the rows."""
    all_rows = np.fromfile(path).reshape(-1, COLUMNS + 1)
    X, y = np.ascontiguousarray(all_rows[:, :-1]), all_rows[:, -1].copy()
    del all_rows
    started = time.perf_counter()
    solution = np.linalg.lstsq(X, y)[0]
    seconds = time.perf_counter() - started
    return {"seconds": seconds, "peak": peak_memory(), "rows": len(y), "solution": solution}


def peak_memory() -> float:
    """Return the peak memory [B] of this process.

    Linux counts the memory of the process that started this one in `ru_maxrss`, but not in the
    status file.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024.0 * float(line.split()[1])
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def row_figures(folder: Path, rows: int = 10_000_000) -> dict[str, float]:
    """Return memory and time of solving `rows` streamed from a file, and by numpy's lstsq.

    Each is measured in a new process with one BLAS thread, best of three for the stream.
    """
    path = folder / "rows.f64"
    write_rows(path, rows)
    estimates = []
    for function, repeats in ((streamed, _TRIES), (in_memory, 1)):
        with Processes(1) as pool:
            results = list(pool.map(function, [str(path)] * repeats))
            estimates.append(min(results, key=lambda result: float(result["seconds"])))
    path.unlink()
    stream, whole = estimates
    difference = np.abs(stream["solution"] / whole["solution"] - 1.0).max()
    return {
        "rows": float(stream["rows"]),
        "stream_seconds": stream["seconds"],
        "stream_peak_bytes": stream["peak"],
        "lstsq_seconds": whole["seconds"],
        "lstsq_peak_bytes": whole["peak"],
        "ratio": stream["seconds"] / whole["seconds"],
        "difference": float(difference),
    }


def cluster_figures(folders: Sequence[str]) -> list[Figure]:
    """Measure two Dask workers against one in identifying run folders, on this machine.

    Each worker is a process with one thread. The speed-up of two processes in plain arithmetic is
    the machine's limit. Raises ImportError without dask.distributed.
    """
    distributed: Any = importlib.import_module("distributed")
    best: dict[int, float] = {1: np.inf, 2: np.inf}
    busiest = dict(best)  # processor seconds of the busier worker
    values = []
    # No dashboard, loopback only; the workers end with the block.
    for workers in (1, 2) * _TRIES:
        with (
            environment(WORKER_ENVIRONMENT),
            distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address=None,
                silence_logs=50,
            ) as local,
            distributed.Client(local, set_as_default=False) as watcher,
            DaskCluster(local.scheduler_address) as pool,
        ):
            list(pool.map(_warm, [WARM_SECONDS] * 4 * workers))
            before = watcher.run(time.process_time)
            started = time.perf_counter()
            result = identify_folders(folders, pool=pool)
            best[workers] = min(best[workers], time.perf_counter() - started)
            used = [after - before[w] for w, after in watcher.run(time.process_time).items()]
            busiest[workers] = min(busiest[workers], max(used))
            values.append([estimate.value for estimate in result.estimates.values()])
    reference = identify_folders(folders)
    expected = np.array([estimate.value for estimate in reference.estimates.values()])
    difference = float(np.abs(np.array(values) / expected - 1.0).max())
    ratio = busiest[1] / busiest[2]
    return [
        Figure(GROUP, "one Dask worker", best[1], "s"),
        Figure(GROUP, "two Dask workers", best[2], "s"),
        Figure(GROUP, "two workers over one", best[1] / best[2], "x", 1.6, True),
        Figure(GROUP, "two processes over one, bare arithmetic", _spin_speedup(), "x"),
        Figure(GROUP, "one's processor time over the busier of two", ratio, "x"),
        Figure(GROUP, "archive: largest relative difference", difference, "", 1e-10),
    ]


def _spin_speedup() -> float:
    best = {1: np.inf, 2: np.inf}
    for workers in (1, 2) * _TRIES:
        with Processes(workers) as pool:
            list(pool.map(_warm, [WARM_SECONDS] * 4 * workers))
            started = time.perf_counter()
            list(pool.map(_spin, [1_000_000] * 16))
            best[workers] = min(best[workers], time.perf_counter() - started)
    return best[1] / best[2]


def _spin(rounds: int) -> int:
    return sum(k & 3 for k in range(rounds))


def _warm(seconds: float) -> None:
    """Let a worker import this module and stay busy, so that the other workers import it too."""
    time.sleep(seconds)
