"""Imports foreign records, described by a manifest, into a run folder."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rig.model import channels as ch
from rig.model.numerics.spectra import noise_power, power_spectrum
from rig.model.parse import InputError
from rig.model.records import BANDWIDTH, bridged, channels_digest, common_bandwidth
from rig.model.rig import Rig
from rig.runs import archive, store
from rig.runs.exchange.columns import read_table
from rig.runs.exchange.dead_sensors import silent_sensors
from rig.runs.exchange.manifest import (
    TIME,
    Manifest,
    ManifestRecord,
    channels_of,
    check_against_rig,
    load_manifest,
)
from rig.runs.exchange.settings import EXCHANGE
from rig.runs.rigs import load_rig
from rig.runs.runstate import DONE, EventLog, write_state

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImportReport:
    """The imported run and warnings for the user."""

    path: Path
    records: int
    samples: int
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Source:
    """A manifest with the data needed to read its files."""

    path: Path
    manifest: Manifest
    rig: Rig
    maps: Mapping[str, tuple[float, float]]

    def column(self, channel: str) -> str:
        """Return the column name of a channel in the files."""
        entry = self.manifest.columns.get(channel)
        return channel if entry is None or entry.column is None else entry.column


@dataclass(frozen=True)
class _Imported:
    entry: ManifestRecord
    sample_rate: float
    start: float
    channels: dict[str, Array]


def import_records(manifest_path: str | Path, out: str | Path) -> ImportReport:
    """Import every record of a manifest into a new run folder.

    Raises InputError naming file, column and row, before anything is written; RecordingFailed if
    the run cannot be written.
    """
    path, folder = Path(manifest_path), Path(out)
    store.refuse_occupied(folder)
    manifest, lines = load_manifest(path)
    try:
        rig = load_rig(manifest.rig, relative_to=path.parent)
    except InputError as error:
        raise InputError(f"{path}:{lines.get(('rig',), 1)}: rig: {error}") from error
    source = _Source(path, manifest, rig, check_against_rig(manifest, lines, path, rig))
    records = [_read(source, entry) for entry in manifest.records]
    warnings = _warnings(source, records)
    records = _with_bandwidth(rig, [_without_outliers(rig, r) for r in records])
    warnings += _narrowed(manifest, records)
    _write(source, records, folder, warnings)
    samples = sum(len(next(iter(r.channels.values()))) for r in records)
    return ImportReport(folder, len(records), samples, warnings)


def _read(source: _Source, entry: ManifestRecord) -> _Imported:
    file = source.path.parent / entry.file
    required, optional = channels_of(source.rig)
    # A channel that the manifest maps is required, even if it is optional otherwise.
    needed = [n for n in (*required, *optional) if n in required or n in source.manifest.columns]
    timed = source.manifest.sample_rate is None or TIME in source.manifest.columns
    known = (*required, *optional, TIME)
    if timed:
        needed.append(TIME)
    columns = _read_columns(source, file, known, needed)
    by_channel = {}
    for name, raw in columns.items():
        scale, offset = source.maps.get(name, (1.0, 0.0))
        by_channel[name] = raw * scale + offset if (scale, offset) != (1.0, 0.0) else raw
    rate, start = _time_base(source, file, by_channel.pop(TIME, None))
    samples = len(next(iter(by_channel.values())))
    delays = {n: c.delay * rate for n, c in source.manifest.columns.items() if n in by_channel}
    first, last = _common(file, rate, samples, delays)
    for name, delay in delays.items():
        by_channel[name] = _advanced(by_channel[name], delay, first, last)
    part = _record_slice(entry, file, rate, first, last)
    channels = {n: by_channel[n][part] for n in known if n in by_channel}
    return _Imported(entry, rate, start + part.start / rate, channels)


def _without_outliers(rig: Rig, imported: _Imported) -> _Imported:
    """Return a record whose few samples beyond the range of their sensor are lost (NaN).

    A logger's fill value would go through the filters into the samples about it. Where many are
    beyond, the range or the unit is another than the data's, and they are kept.
    """
    channels = dict(imported.channels)
    for name in filter(channels.__contains__, rig.channels):
        x, (low, high) = channels[name], rig.sensors.of(ch.kind_of(name)[0]).range
        margin = EXCHANGE.end_share * (high - low)
        outside = (x < low - margin) | (x > high + margin)
        if 0 < np.count_nonzero(outside) <= EXCHANGE.outlier_share * len(x):
            channels[name] = np.where(outside, np.nan, x)
    return replace(imported, channels=channels)


def _with_bandwidth(rig: Rig, records: list[_Imported]) -> list[_Imported]:
    """Return records with their bandwidths, except those that state lines.

    It is the `common_bandwidth` of those that do not state it, and for another one that of its
    motion where it states more.
    """
    measured = [
        motion_bandwidth(rig, r.entry.locked, r.channels, r.sample_rate)
        if not r.entry.lines
        else None
        for r in records
    ]
    unstated = [
        width
        for width, r in zip(measured, records, strict=True)
        if not r.entry.lines and r.entry.bandwidth is None
    ]
    common = common_bandwidth(unstated)

    def of(record: _Imported, width: float | None) -> float | None:
        stated = record.entry.bandwidth
        if stated is None:
            return None if record.entry.lines else common
        return stated if width is None else min(stated, width)

    return [
        replace(r, entry=r.entry.model_copy(update={BANDWIDTH: of(r, width)}))
        for r, width in zip(records, measured, strict=True)
    ]


def _narrowed(manifest: Manifest, records: list[_Imported]) -> tuple[str, ...]:
    """Say where records state a bandwidth that their motion does not reach."""
    pairs = [
        (entry.bandwidth, r.entry.bandwidth)
        for entry, r in zip(manifest.records, records, strict=True)
        if entry.bandwidth is not None and r.entry.bandwidth is not None
    ]
    if not pairs:
        return ()
    stated, used = (max(widths) for widths in zip(*pairs, strict=True))
    if used > EXCHANGE.narrowed * stated:
        return ()
    return (
        f"bandwidth: {stated:g} Hz is stated, and the motion is below {used:.2g} Hz: rows are "
        "filtered for that, since wider ones hold more noise",
    )


def motion_bandwidth(
    rig: Rig, locked: tuple[int, ...], channels: Mapping[str, Array], rate: float
) -> float | None:
    """Return the frequency [Hz] below which `EXCHANGE.velocity_share` of each velocity's power is.

    `channels` are positions (n,) and others by name, `rate` [Hz]. None where no joint moves, and
    for a record shorter than `EXCHANGE.bandwidth_seconds`, which needs all its rows.
    """
    free = [i for i in range(1, len(rig.joints) + 1) if i not in locked]
    positions = [bridged(channels[ch.channel(rig.position_kind, i)]) for i in free]
    moving = [x for x in positions if np.ptp(x) > 0.0]
    if not moving or len(moving[0]) < EXCHANGE.bandwidth_seconds * rate:
        return None
    return max(_bandwidth(x, rate) for x in moving)


def _bandwidth(position: Array, rate: float) -> float:
    """Return the bandwidth [Hz] of a position (n,); lines that noise may cause do not count.

    The power of noise is exponentially distributed about its mean: of N lines, N exp(-x) are
    expected above x times the mean.
    """
    f, power = power_spectrum(position, rate)
    noise = noise_power(f, power, EXCHANGE.highest_bandwidth)
    inside = f <= EXCHANGE.highest_bandwidth
    least = noise * math.log(np.count_nonzero(inside) / EXCHANGE.noise_lines)
    seen = np.where(power > least, power, 0.0)[inside]
    if not seen.any():
        return EXCHANGE.highest_bandwidth
    velocity = np.cumsum(seen * f[inside] ** 2)
    return float(f[inside][np.searchsorted(velocity, EXCHANGE.velocity_share * velocity[-1])])


def _common(
    file: Path, rate: float, samples: int, delays: Mapping[str, float]
) -> tuple[int, int]:  # fmt: skip
    """Return the samples [first, last) common to all columns without their delays [samples]."""
    first = math.ceil(-min((0.0, *delays.values())) - EXCHANGE.delay_tolerance)
    last = samples - math.ceil(max((0.0, *delays.values())) - EXCHANGE.delay_tolerance)
    if last - first < 2:
        name = max(delays, key=lambda n: abs(delays[n]))
        raise InputError(
            f"{file}: has {samples / rate:g} s of samples; column of {name!r} with a delay of "
            f"{delays[name] / rate:g} s leaves none that all columns have"
        )
    return first, last


def _advanced(values: Array, delay: float, first: int, last: int) -> Array:
    """Return a column (n,) advanced by its delay [samples]; 0 outside [first, last)."""
    samples = round(delay)
    out = np.zeros_like(values)
    if abs(delay - samples) < EXCHANGE.delay_tolerance:
        out[first:last] = values[first + samples : last + samples]
        return out
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415 - loads slowly

    spline = make_interp_spline(np.arange(len(values)), values, k=3)
    out[first:last] = spline(np.arange(first, last) + delay)
    return out


def _record_slice(entry: ManifestRecord, file: Path, rate: float, first: int, last: int) -> slice:
    """Return the samples between the entry's `begin` and `end`; raises InputError if none are.

    Both count from the file's first sample; [first, last) are the samples common to all columns.
    """
    begin = max(first, round(entry.begin * rate))
    end = last if entry.end is None else round(entry.end * rate)
    if begin >= last - 1 or end > last:
        stated = f"{entry.begin:g} s to {'the end' if entry.end is None else f'{entry.end:g} s'}"
        has = f"{last / rate:g} s of samples" + ("" if not first else f" from {first / rate:g} s")
        raise InputError(f"{file}: has {has}; the record asks for {stated}")
    return slice(begin, end)


def _read_columns(
    source: _Source, file: Path, channels: tuple[str, ...], needed: list[str]
) -> dict[str, Array]:
    """Return a file's columns (n,) by channel; raises InputError if a needed one is missing."""
    names = {channel: source.column(channel) for channel in channels}
    columns = list(dict.fromkeys(names.values()))
    try:
        table = read_table(file, columns, [names[channel] for channel in needed])
    except InputError as error:
        no_time = f"has no column {names[TIME]!r}"
        if source.manifest.sample_rate is not None or no_time not in str(error):
            raise
        raise InputError(
            f"{file}: {no_time}, and the manifest {source.path} gives no sample_rate; give one of "
            "the two"
        ) from error
    return {channel: table[name] for channel, name in names.items() if name in table}


def _time_base(source: _Source, file: Path, time: Array | None) -> tuple[float, float]:
    """Return (sample rate [Hz], time of the first sample [s]); refuses uneven time."""
    stated = source.manifest.sample_rate
    if time is None:
        return float(stated or 0.0), 0.0
    column = source.column(TIME)
    first_row = 1 if file.suffix.lower() == ".mat" else 2  # the row of the first sample
    if len(time) < 2:
        raise InputError(f"{file}: column {column!r} has one row only; expected a time series")
    steps = np.diff(time)
    decreasing = np.flatnonzero(steps <= 0)
    if len(decreasing):
        row = int(decreasing[0]) + 1
        raise InputError(
            f"{file}:{row + first_row}: column {column!r}, row {row + first_row}: time goes from "
            f"{time[row - 1]:.9g} to {time[row]:.9g} s; expected it to increase"
        )
    step = float(np.median(steps))
    uneven = np.flatnonzero(np.abs(steps - step) > EXCHANGE.step_deviation * step)
    if len(uneven):
        row = int(uneven[0]) + 1
        raise InputError(
            f"{file}:{row + first_row}: column {column!r}, row {row + first_row}: a step of "
            f"{steps[row - 1]:.6g} s among steps of {step:.6g} s; expected even sampling"
        )
    mean = float((time[-1] - time[0]) / (len(time) - 1))
    rate = float(f"{1.0 / mean:.6g}")  # rounded time stamps are not more accurate
    if stated is not None and abs(rate - stated) > 1e-3 * stated:
        raise InputError(
            f"{file}: column {column!r} steps at {rate:.6g} Hz, but the manifest's sample_rate is "
            f"{stated:.6g} Hz"
        )
    return stated or rate, float(time[0])


def _warnings(source: _Source, records: list[_Imported]) -> tuple[str, ...]:
    warnings = []
    rig = source.rig
    for name in rig.channels:
        lacking = [r.entry.file for r in records if name not in r.channels]
        if lacking:
            where = "" if len(lacking) == len(records) else f" in {len(lacking)} file(s)"
            warnings.append(f"{name}: the rig has it, the data does not{where}; imported without")
    channels_of_column: dict[str, list[str]] = {}
    for name in dict.fromkeys(name for r in records for name in r.channels):
        channels_of_column.setdefault(source.column(name), []).append(name)
    for column, names in channels_of_column.items():
        if len(names) > 1:
            warnings.append(f"column {column!r} is taken for {' and '.join(names)}")
    warnings += _repeated_samples(records)
    for rate in sorted({r.sample_rate for r in records}):
        if abs(rate - rig.sample_rate) > 1e-6 * rig.sample_rate:
            warnings.append(f"sampled at {rate:g} Hz, the rig samples at {rig.sample_rate:g} Hz")
    for r in records:
        warnings += _warnings_of_entry(rig, r)
        silent = silent_sensors(rig, r.entry.locked, r.channels)
        warnings += [f"{r.entry.file}, {sentence}" for sentence in silent]
    lengths: dict[str, set[int]] = {}
    for r in records:
        lengths.setdefault(r.entry.step, set()).add(len(next(iter(r.channels.values()))))
    for step, sizes in lengths.items():
        if len(sizes) > 1:
            few, many = min(sizes), max(sizes)
            warnings.append(f"step {step!r}: its repeats have {few} to {many} samples")
    return tuple(warnings)


def _repeated_samples(records: list[_Imported]) -> list[str]:
    """Say which repeats of a step hold the samples of another one."""
    known: dict[tuple[str, str], str] = {}
    out = []
    for record in records:
        name = record.entry.meta().name
        of_step = record.entry.step, channels_digest(record.channels)
        first = known.setdefault(of_step, name)
        if first != name:
            out.append(
                f"{record.entry.file}: {name} has the same samples as {first}, which adds no "
                "information and shows sensors without noise"
            )
    return out


def _warnings_of_entry(rig: Rig, r: _Imported) -> list[str]:
    """Say what a record's entry states that its samples contradict, or that leaves it no use."""
    file, samples = r.entry.file, len(next(iter(r.channels.values())))
    out = []
    if len(r.entry.locked) == len(rig.joints):
        out.append(f"{file}: every joint is locked; a record is of use where one moves")
    if r.entry.period > samples:
        out.append(f"{file}: has {samples} samples, less than its period of {r.entry.period}")
    if r.entry.bandwidth is not None and r.entry.bandwidth >= 0.5 * r.sample_rate:
        width, half = r.entry.bandwidth, 0.5 * r.sample_rate
        out.append(f"{file}: bandwidth of {width:g} Hz, expected below half the rate, {half:g} Hz")
    if r.entry.lines and not r.entry.period:
        out.append(f"{file}: lines without a period are multiples of nothing; state period as well")
    elif r.entry.lines and 2 * max(r.entry.lines) >= r.entry.period:
        line = max(r.entry.lines)
        stated = f"line {line} is {line * r.sample_rate / r.entry.period:g} Hz"
        out.append(f"{file}: {stated}, expected below half the rate, {0.5 * r.sample_rate:g} Hz")
    return out


def _write(
    source: _Source, records: list[_Imported], folder: Path, warnings: tuple[str, ...]
) -> None:
    about = f"imported from {source.path.name}"
    with store.whole_run(folder, source.rig, about) as fresh, closing(EventLog(fresh)) as events:
        events.append("import", None, {"manifest": str(source.path), "warnings": warnings})
        _write_archive(source, records, fresh)
        for r in records:
            events.append("record complete", None, {"record": r.entry.meta().name})
        write_state(fresh, DONE)
        events.append("end", None, {"state": DONE, "message": "", "records": len(records)})


def _write_archive(source: _Source, records: list[_Imported], folder: Path) -> None:
    with archive.create(folder / store.ARCHIVE, source.rig.name) as file:
        for order, r in enumerate(records):
            meta = r.entry.meta()
            about = archive.record_attributes(meta.as_dict(), r.sample_rate, r.start, complete=True)
            more = {
                "stream": order,
                "start_tick": 0,
                "lost_samples": 0,
                "late_blocks": 0,
                "jitter_max_s": 0.0,
                "saturated_samples": 0,
                "file": r.entry.file,
            }
            attributes = {**meta.attributes, **about, **more}
            archive.write_group(file, meta.name, r.channels, attributes, source.rig.unit_of)
