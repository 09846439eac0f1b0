"""Records of other systems: the bandwidth of their motion narrows the filter of their rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from analysis.regression.rows import default_filtering
from analysis.regression.settings import REGRESSION
from rig.model.records import BANDWIDTH, Record, Run, with_common_bandwidth
from rig.model.rig import Rig
from rig.runs.exchange.importer import import_records, motion_bandwidth
from rig.runs.rigs import load_rig
from rig.runs.store import load_run

RATE = 500.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("shinshu-2dof")


def moved(rig: Rig, *tones: float, seconds: float = 10.0, seed: int = 1) -> dict[str, np.ndarray]:
    """Return every channel of a rig whose first joint moves at some frequencies [Hz]."""
    t = np.arange(round(seconds * RATE)) / RATE
    rng = np.random.default_rng(seed)
    channels = {name: np.full(len(t), 1.0) for name in rig.channels}
    s = sum(1e-2 / (1 + f) * np.sin(2 * np.pi * f * t + f + seed) for f in tones)
    noise = rig.sensors.piston.noise * rng.standard_normal(len(t))
    return {**channels, "piston_1": s + noise, "piston_2": np.zeros(len(t))}


def imported(folder: Path, rig: Rig, record: str, *repeats: dict[str, np.ndarray]) -> list[Record]:
    """Return records after an import, `record` being further keys of each in the manifest."""
    lines = ["rig: shinshu-2dof", f"sample_rate: {RATE} Hz", "records:"]
    for k, channels in enumerate(repeats, start=1):
        table = np.column_stack([channels[name] for name in rig.channels])
        np.savetxt(
            folder / f"{k}.csv", table, "%.9g", ",", header=",".join(rig.channels), comments=""
        )
        lines.append(f"  - {{file: {k}.csv, step: a, locked: [2], repeat: {k}{record}}}")
    manifest = folder / "manifest.yaml"
    manifest.write_text("\n".join(lines))
    import_records(manifest, folder / "run")
    return list(load_run(folder / "run").records)


def cutoff_of(record: Record) -> float:
    """Return the frequency [Hz] at which the filter of a record's rows passes half."""
    rows = default_filtering(record).rows
    assert rows is not None
    response = np.abs(np.fft.rfft(rows.taps[0], 1 << 16))
    return float(np.fft.rfftfreq(1 << 16, 1 / RATE)[np.argmax(response < 0.5)])


def test_slow_motion_has_a_narrow_filter_alike_in_all_records(rig: Rig, tmp_path: Path) -> None:
    """A machine that moves below 1.3 Hz, in the second repeat up to 4 Hz."""
    records = imported(tmp_path, rig, "", moved(rig, 0.3, 1.3), moved(rig, 0.3, 1.3, 4.0, seed=2))
    assert [r.bandwidth for r in records] == pytest.approx([4.0, 4.0], abs=0.2)
    low, wide = REGRESSION.row_cutoff_range[0], REGRESSION.row_cutoff
    half = [cutoff_of(r) for r in records]
    assert half == pytest.approx([1.3 * low] * 2, rel=0.05)  # halfway to where it is closed
    bare = Record("a", "a", (2,), 1, RATE, records[0].channels)
    assert cutoff_of(bare) == pytest.approx(1.3 * wide, rel=0.05)


def test_a_stated_bandwidth_holds_up_to_that_of_the_motion(rig: Rig, tmp_path: Path) -> None:
    """A careful user states more than the motion needs: the rows would hold noise alone there."""
    for stated, used in ((0.9, 0.9), (8.0, 1.3)):
        folder = tmp_path / f"{stated}"
        folder.mkdir()
        (record,) = imported(folder, rig, f", bandwidth: {stated} Hz", moved(rig, 0.3, 1.3))
        assert record.bandwidth == pytest.approx(used, abs=0.2)
        said = (folder / "run" / "events.jsonl").read_text()
        words = f"8 Hz is stated, and the motion is below {record.bandwidth:.2g} Hz"
        assert (words in said) == (stated == 8.0)
        assert ("bandwidth:" in said) == (stated == 8.0)


def test_a_short_record_keeps_the_bandwidth_that_it_states(rig: Rig, tmp_path: Path) -> None:
    """Its spectrum is too coarse to show the bandwidth of its motion."""
    short = moved(rig, 0.3, 1.3, seconds=4.0)
    (record,) = imported(tmp_path, rig, ", bandwidth: 8 Hz", short)
    assert record.bandwidth == 8.0
    assert cutoff_of(record) == pytest.approx(1.3 * 12.0, rel=0.05)


def test_known_lines_need_no_bandwidth(rig: Rig, tmp_path: Path) -> None:
    (record,) = imported(tmp_path, rig, ", period: 5000, lines: [3, 13]", moved(rig, 0.3, 1.3))
    assert record.bandwidth is None


def test_slow_motion_of_many_lines_has_a_narrow_filter_and_a_slow_sine_keeps_harmonics(
    rig: Rig,
) -> None:
    """All but the last, which is filtered by its highest line, excite 0.8 Hz at most."""
    slow = Record("a", "a", (2,), 1, RATE, moved(rig, 0.8), period=10_000, lines=(2, 5, 9, 16))
    assert cutoff_of(slow) == pytest.approx(1.3 * 3.2, rel=0.05)
    sine = replace(slow, lines=(16,))
    assert cutoff_of(sine) == pytest.approx(1.3 * REGRESSION.row_cutoff_range[0], rel=0.05)
    known = replace(slow, period=0, lines=(), attributes={BANDWIDTH: 0.8})
    assert cutoff_of(known) == pytest.approx(1.3 * 2.4, rel=0.05)
    quick = replace(slow, lines=(20, 50, 90, 160))
    assert cutoff_of(quick) == pytest.approx(1.3 * 12.0, rel=0.05)


def test_records_that_are_analysed_together_pass_alike_filters(rig: Rig, tmp_path: Path) -> None:
    """A slow and a quick run; with a record that states nothing, none is narrowed."""
    runs = []
    for name, tone in (("slow", 1.3), ("quick", 7.0)):
        (tmp_path / name).mkdir()
        records = imported(tmp_path / name, rig, "", moved(rig, tone))
        runs.append(Run(rig, tuple(records)))
    common = [r.bandwidth for run in with_common_bandwidth(runs) for r in run.records]
    assert common == pytest.approx([7.0, 7.0], abs=0.2)
    bare = Run(rig, (replace(runs[0].records[0], attributes={}),))
    assert [r.bandwidth for run in with_common_bandwidth([*runs, bare]) for r in run.records] == (
        [None] * 3
    )


@pytest.mark.parametrize("corner", [np.inf, 100.0, 20.0])
@pytest.mark.parametrize("times", [1.0, 30.0])
def test_noise_of_the_sensor_is_no_motion(rig: Rig, times: float, corner: float) -> None:
    """Differentiated, a quiet record's noise, white or filtered, has more power than its motion."""
    channels = moved(rig, 0.3, 1.3)
    white = np.random.default_rng(5).standard_normal(len(channels["piston_1"]))
    pole = np.exp(-2 * np.pi * corner / RATE)
    noise = lfilter([np.sqrt(1 - pole**2)], [1, -pole], white) * rig.sensors.piston.noise
    noisy = {**channels, "piston_1": channels["piston_1"] + times * noise}
    assert motion_bandwidth(rig, (2,), noisy, RATE) == pytest.approx(1.3, abs=0.2)


def test_no_line_of_noise_in_many_records_is_taken_for_motion(rig: Rig) -> None:
    """The widest of all records decides: one line gave a crane rows for 30 times its motion.

    A hidden leak was lost in their noise, and an inertia that the slow motion shows.
    """
    still = moved(rig, 0.4, seconds=30.0)
    channels = (
        {
            **still,
            "piston_1": still["piston_1"] + 300.0 * moved(rig, seconds=30.0, seed=k)["piston_1"],
        }
        for k in range(2, 102)
    )
    widths = [motion_bandwidth(rig, (2,), of_record, RATE) for of_record in channels]
    assert max(w for w in widths if w is not None) == pytest.approx(0.4, abs=0.1)


def test_what_has_no_bandwidth(rig: Rig) -> None:
    """No joint that moves, and records too short to lose rows to a narrow filter."""
    assert motion_bandwidth(rig, (1, 2), moved(rig, 1.0), RATE) is None
    assert motion_bandwidth(rig, (2,), moved(rig, 1.0, seconds=5.0), RATE) is None
    assert motion_bandwidth(rig, (2,), moved(rig, 1.0), RATE) == pytest.approx(1.0, abs=0.2)
