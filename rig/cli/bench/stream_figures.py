"""Figures of the group `stream` of `bramah bench`: large data sets and running estimates."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np

from analysis.identify.identify import identify
from analysis.identify.result import PLAIN
from analysis.identify.streams.online import Tracker, track
from drivers.base import SampleBlock
from rig.cli.bench.figure import Figure
from rig.cli.bench.speed.figures import bench_run
from rig.cli.bench.stream import GROUP, cluster_figures, row_figures
from rig.cli.execution.tracking import Tracking
from rig.cli.text.output import Say
from rig.model.records import Record
from rig.model.rig import Rig
from rig.runs.archive import write_run
from rig.runs.recorder import RecordMeta
from rig.runs.rigs import load_rig

RIG = "shinshu-2dof"
BLOCK = 10  # samples: 10 ms
RUNS, RECORD_SECONDS = 8, 20.0  # length of the archive: 144 records


def stream_figures(folder: Path, say: Say) -> list[Figure]:
    """Measure streamed rows, an archive on one and two Dask workers, and the tracker's cost."""
    say("stream: 1e7 rows of 9 from a file, and in memory")
    rows = row_figures(folder)
    figures = [
        Figure(GROUP, "rows of 9 columns", rows["rows"]),
        Figure(GROUP, "peak memory, streamed", rows["stream_peak_bytes"] / 1e9, "GB", 1.0),
        Figure(GROUP, "peak memory, numpy's lstsq", rows["lstsq_peak_bytes"] / 1e9, "GB"),
        Figure(GROUP, "streamed from a file", rows["stream_seconds"], "s"),
        Figure(GROUP, "numpy's lstsq, rows in memory", rows["lstsq_seconds"], "s"),
        Figure(GROUP, "streamed over lstsq", rows["ratio"], "x as long", 2.0),
        Figure(GROUP, "largest relative difference", rows["difference"], "", 1e-10),
    ]
    return [*figures, *_cluster(folder, say), *_tracking(folder, say)]


def _cluster(folder: Path, say: Say) -> list[Figure]:
    say("stream: an archive on one and on two Dask workers")
    run = bench_run(load_rig(RIG), repeats=6, seconds=RECORD_SECONDS)
    folders = [str(write_run(folder / f"run-{number}", run)) for number in range(RUNS)]
    records = Figure(GROUP, f"archive: records of {RECORD_SECONDS:g} s", RUNS * len(run.records))
    return [records, *cluster_figures(folders)]


def _tracking(folder: Path, say: Say) -> list[Figure]:
    say("stream: what following costs the acquisition")
    rig = load_rig(RIG)
    run = bench_run(rig, repeats=2)
    tracker = Tracker(run.rig)
    spent = time.process_time()
    for record in run.records:
        track(tracker, record, BLOCK)
    spent = time.process_time() - spent
    blocks = sum(record.samples for record in run.records) / BLOCK
    batch = identify([run], reject_noise=False, estimator=PLAIN).estimates
    difference = max(abs(e.value / batch[n].value - 1.0) for n, e in tracker.estimates().items())
    handed = _handover(rig, run.records[0], folder)
    return [
        Figure(GROUP, "tracker against the batch, largest difference", difference, "", 1e-9),
        Figure(GROUP, "handing a 10 ms block on, mean", 1e3 * float(handed.mean()), "ms", 2.0),
        Figure(GROUP, "handing on, 99 %", 1e3 * float(np.quantile(handed, 0.99)), "ms", 2.0),
        Figure(GROUP, "handing on, worst", 1e3 * float(handed.max()), "ms"),
        Figure(GROUP, "tracker's own work per block (beside)", 1e3 * spent / blocks, "ms"),
    ]


def _handover(rig: Rig, record: Record, folder: Path) -> np.ndarray:
    """Return the time [s] that handing each block of a record to the tracker takes."""
    zeros = np.zeros(record.samples)
    data = np.column_stack([record.channels.get(name, zeros) for name in rig.recorded])
    saturated = np.zeros((BLOCK, len(rig.channels)), dtype=bool)
    meta = RecordMeta(record.step, record.repeat, record.locked, record.period, record.lines)
    spent = []
    with Tracking(rig, folder / "none", lambda _: None, math.inf) as tracking:
        tracking.record_begins(meta, 0, record.samples)
        for tick in range(0, record.samples, BLOCK):
            block = SampleBlock(0, tick, data[tick : tick + BLOCK], saturated, 0, False)
            started = time.perf_counter()
            tracking.block(block)
            spent.append(time.perf_counter() - started)
            time.sleep(0.002)  # blocks arrive at five times real time
        tracking.record_ends(meta, 0, record.samples, "complete")
    return np.array(spent)
