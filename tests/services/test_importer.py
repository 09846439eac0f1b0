"""Somebody brings records from another bench: they enter as a run, or are refused by the cell."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from rig.model.parse import InputError, shipped_files
from rig.model.trips import RecordingFailed
from rig.runs.archive import write_run
from rig.runs.exchange.importer import import_records
from rig.runs.listing.index import indexed_runs
from rig.runs.rigs import load_rig
from rig.runs.store import load_run
from tests.full_disk import largest_file
from tests.services.fake_driver import samples

RIG = load_rig("shinshu-2dof")
NAMES = RIG.channels
DATA = samples(RIG, np.arange(50))[:, : len(NAMES)]
DATA[:, [NAMES.index("spool_1"), NAMES.index("spool_2")]] = 0.1 * np.sin(np.arange(50))[:, None]
HEAD = "rig: shinshu-2dof\nsample_rate: 1 kHz\n"
ONE = HEAD + "records:\n  - {file: a.csv, step: s, locked: [1], repeat: 1}\n"


def csv(names=NAMES, data=DATA, delimiter=",") -> str:
    rows = [delimiter.join(repr(float(v)) for v in row) for row in data]
    return "\n".join([delimiter.join(names), *rows]) + "\n"


def bring(folder: Path, manifest: str, **files: str):
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)
    (folder / "manifest.yaml").write_text(manifest)
    return import_records(folder / "manifest.yaml", folder / "run")


def test_the_documented_manifest_becomes_a_run_like_any_other(tmp_path: Path) -> None:
    bar = DATA.copy()
    column = NAMES.index("cap_pressure_1")
    bar[:, column] /= 1e5
    renamed = ["fSpoolPosition" if n == "spool_1" else n for n in NAMES]
    renamed[column] = "fPa"
    manifest = (
        HEAD
        + """records:
  - {file: step1_r1.csv, step: step1, locked: [1], repeat: 1}
  - {file: both_r1.csv,  step: both,  locked: [],  repeat: 1}
columns:
  spool_1: {column: fSpoolPosition, unit: V, scale: 1.0, offset: 0.0}
  cap_pressure_1: {column: fPa, unit: bar}
"""
    )
    text = csv(renamed, bar)
    report = bring(tmp_path, manifest, step1_r1__csv=text, both_r1__csv=text)
    assert (report.records, report.samples, report.warnings) == (2, 100, ())
    run = load_run(tmp_path / "run")
    assert (run.rig, run.state) == (RIG, "done")
    assert [(r.step, r.locked, r.repeat) for r in run.records] == [
        ("step1", (1,), 1),
        ("both", (), 1),
    ]
    for index, name in enumerate(NAMES):
        np.testing.assert_allclose(run.records[0].channels[name], DATA[:, index], rtol=1e-14)
    (summary,) = indexed_runs(tmp_path / "run")
    assert (summary.state, summary.records) == ("done", 2)
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == [
        "events.jsonl", "records.h5", "run.yaml", "state",
    ]  # fmt: skip


def test_scale_and_offset_apply_to_the_raw_number_and_the_unit_to_their_result(
    tmp_path: Path,
) -> None:
    raw = DATA.copy()
    column = NAMES.index("piston_1")
    raw[:, column] = (raw[:, column] * 1e3 + 37.5) / 0.5  # mm from the retracted end, half steps
    temperature = NAMES.index("oil_temperature")
    raw[:, temperature] = raw[:, temperature] * 9 / 5 + 32
    manifest = (
        ONE
        + "columns:\n  piston_1: {unit: mm, scale: 0.5, offset: -37.5}\n"
        + "  oil_temperature: {unit: degF}\n"
    )
    bring(tmp_path, manifest, a__csv=csv(data=raw))
    (record,) = load_run(tmp_path / "run").records
    np.testing.assert_allclose(record.channels["piston_1"], DATA[:, column], atol=1e-15)
    np.testing.assert_allclose(record.channels["oil_temperature"], DATA[:, temperature], rtol=1e-12)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_the_csv_dialects_of_spreadsheets_are_read(
    tmp_path: Path, delimiter: str, end: str
) -> None:
    text = csv(delimiter=delimiter)
    if delimiter == ";":
        text = text.replace(".", ",")  # the decimal comma of the same spreadsheets
    text = "\n".join(
        delimiter.join(f'"{cell}"' for cell in line.split(delimiter)) for line in text.splitlines()
    )
    (tmp_path / "a.csv").write_bytes(("\ufeff" + text.replace("\n", end) + end + end).encode())
    bring(tmp_path, ONE)
    (record,) = load_run(tmp_path / "run").records
    for index, name in enumerate(NAMES):
        np.testing.assert_array_equal(record.channels[name], DATA[:, index])


@pytest.mark.parametrize("shape", [(50, 1), (1, 50)])
def test_mat_vectors_of_either_orientation_with_a_time_column(
    tmp_path: Path, shape: tuple[int, int]
) -> None:
    content = {name: DATA[:, i].reshape(shape) for i, name in enumerate(NAMES)}
    content["time"] = (2.0 + np.arange(50) / 500).reshape(shape)
    savemat(tmp_path / "a.mat", content)
    manifest = ONE.replace("a.csv", "a.mat").replace("sample_rate: 1 kHz\n", "")
    report = bring(tmp_path, manifest)
    (record,) = load_run(tmp_path / "run").records
    assert (record.sample_rate, record.start) == (500.0, 2.0)
    np.testing.assert_array_equal(record.channels["piston_2"], DATA[:, NAMES.index("piston_2")])
    assert report.warnings == ("sampled at 500 Hz, the rig samples at 1000 Hz",)


def test_a_sensor_of_the_bench_may_be_missing_and_the_report_says_so(tmp_path: Path) -> None:
    report = bring(tmp_path, ONE, a__csv=csv(NAMES[:8], DATA[:, :8]))
    assert len(report.warnings) == 2
    assert report.warnings[0].startswith("supply_pressure: the rig has it, the data does not")
    (record,) = load_run(tmp_path / "run").records
    assert tuple(record.channels) == tuple(sorted(NAMES[:8]))


def replaced(row: int, column: str, cell: str) -> str:
    lines = csv().splitlines()
    cells = lines[row - 1].split(",")
    cells[NAMES.index(column)] = cell
    lines[row - 1] = ",".join(cells)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (replaced(17, "rod_pressure_2", "nan"), "a.csv:17: column 'rod_pressure_2', row 17: "),
        (replaced(17, "spool_1", "-inf"), "a.csv:17: column 'spool_1', row 17: found -inf"),
        (replaced(9, "piston_1", ""), "a.csv:9: column 'piston_1', row 9: the cell is empty"),
        (replaced(51, "piston_1", "1.0.0"), "a.csv:51: column 'piston_1', row 51: found '1.0.0'"),
        (replaced(2, "spool_2", "off"), "a.csv:2: column 'spool_2', row 2: found 'off'"),
        (replaced(30, "spool_2", "1,2"), "a.csv:30: row 30 has 11 cells, the header has 10"),
        ("\n\n" + replaced(5, "spool_2", "x"), "a.csv:7: column 'spool_2', row 7"),
        (csv(NAMES[1:], DATA[:, 1:]), "a.csv: has no column 'spool_1'; found: cap_pressure_1"),
        (csv((*NAMES[:9], "spool_1")), "a.csv:1: column 'spool_1' occurs twice"),
        (csv(data=DATA[:0]), "a.csv: has a header row but no numbers"),
        ("", "a.csv: the file is empty"),
        ("\n \n", "a.csv: the file is empty"),
        ("a\0b", "a.csv: a binary file"),
    ],
)  # fmt: skip
def test_a_bad_cell_is_named_by_file_column_and_row_of_the_editor(
    tmp_path: Path, text: str, said: str
) -> None:
    with pytest.raises(InputError) as error:
        bring(tmp_path, ONE, a__csv=text)
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


@given(
    st.integers(2, 51),
    st.sampled_from(NAMES),
    st.sampled_from(["", "NaN", "inf", "x", "1e", "--1", "1 2", "#REF!"]),
)
@settings(max_examples=40)
def test_any_bad_cell_anywhere_is_found(tmp_path_factory, row: int, column: str, cell: str) -> None:
    folder = tmp_path_factory.mktemp("cell")
    with pytest.raises(InputError, match=rf"a\.csv:{row}: column '{column}', row {row}"):
        bring(folder, ONE, a__csv=replaced(row, column, cell))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: np.where(np.arange(50) == 20, t - 0.0015, t), ":22: column 'time'"),
        (lambda t: np.where(np.arange(50) == 20, t[19], t), ":22: column 'time'"),
        (lambda t: t + 0.001 * (np.arange(50) >= 30), ":32: column 'time', row 32: a step"),
        (lambda t: 2 * t, "steps at 500 Hz, but the manifest's sample_rate is 1000 Hz"),
    ],
)  # fmt: skip
def test_time_that_stands_still_jumps_or_contradicts_is_refused(
    tmp_path: Path, change, said: str
) -> None:
    time = change(np.arange(50) / 1000)
    text = csv((*NAMES, "time"), np.column_stack((DATA, time)))
    manifest = ONE + "columns: {time: {unit: s}}\n"
    with pytest.raises(InputError) as error:
        bring(tmp_path, manifest, a__csv=text)
    assert said in str(error.value)


def test_time_stamps_rounded_to_a_tenth_of_the_step_are_even_enough(tmp_path: Path) -> None:
    time = np.round(np.arange(50) / 1000 + 1.23456, 5)
    text = csv((*NAMES, "ms"), np.column_stack((DATA, time * 1e3)))
    manifest = ONE.replace("sample_rate: 1 kHz\n", "") + "columns: {time: {column: ms, unit: ms}}\n"
    bring(tmp_path, manifest, a__csv=text)
    (record,) = load_run(tmp_path / "run").records
    assert record.sample_rate == pytest.approx(1000, rel=1e-6)


@pytest.mark.parametrize(
    ("manifest", "said"),
    [
        (ONE.replace("step: s", "stop: s"), ":4: records.0.stop: unknown key"),
        (ONE + "extra: 1\n", ":5: extra: unknown key"),
        (ONE.replace("1 kHz", "1 kPa"), ":2: sample_rate: unit 'kPa'"),
        (ONE.replace("1 kHz", "1000"), ":2: sample_rate: 1000 has no unit"),
        (ONE.replace("1 kHz", "-1 kHz"), ":2: sample_rate"),
        (ONE.replace("[1]", "[3]"), ":4: records.0.locked: found [3], expected different joints"),
        (ONE.replace("[1]", "[1, 1]"), ":4: records.0.locked"),
        (ONE.replace("shinshu-2dof", "shinshu"), ":1: rig: "),
        (ONE + "columns:\n  spool_3: {unit: V}\n", ":6: columns.spool_3: no channel of rig"),
        (ONE + "columns:\n  spool_1: {unit: furlong_s}\n", ":6: columns.spool_1.unit: unknown"),
        (ONE + "columns:\n  spool_1: {unit: bar}\n", ":6: columns.spool_1.unit: unit 'bar'"),
        (ONE + "columns:\n  spool_1: {scale: 0}\n", ":6: columns.spool_1: scale is 0"),
        (ONE + "columns:\n  supply_pressure: {column: pS}\n", "has no column 'pS'"),
        (ONE + "  - {file: a.csv, step: s, repeat: 1}\n", ":5: records: step 's' repeat 1 is"),
        (ONE.replace("a.csv", "b.csv"), "b.csv: no such file"),
        (ONE.replace("a.csv", "."), "is a folder"),
        (ONE.replace("step: s", "step: a/b"), "'a/b' cannot name a record"),
        (ONE.replace("sample_rate: 1 kHz\n", ""), "no sample_rate; give one of the two"),
        (HEAD + "records: []\n", ":3: records"),
        (HEAD, "records: is missing here"),
    ],
)  # fmt: skip
def test_a_wrong_manifest_is_refused_by_its_line(tmp_path: Path, manifest: str, said: str) -> None:
    with pytest.raises(InputError) as error:
        bring(tmp_path, manifest, a__csv=csv())
    assert said in str(error.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"spool_1": np.array([1.0, np.nan])}, "column 'spool_1', row 2: found nan"),
        ({"spool_1": np.eye(2)}, "variable 'spool_1' has shape (2, 2)"),
        ({"spool_1": np.array([1j, 2])}, "expected real numbers"),
        ({"spool_1": "text"}, "expected real numbers"),
        ({"spool_1": np.zeros(3)}, "has no column 'piston_1'"),
        ({**{n: np.zeros(5) for n in NAMES}, "piston_1": np.zeros(4)}, "expected the same number"),
        (b"MATLAB 7.3 MAT-file" + bytes(105) + b"\x00\x02IM" + bytes(400), "version 7.3"),
        (b"rubbish" * 50, "MAT file"),
        (b"", "MAT file"),
    ],
)  # fmt: skip
def test_a_mat_file_that_does_not_fit_is_refused(tmp_path: Path, content, said: str) -> None:
    if isinstance(content, bytes):
        (tmp_path / "a.mat").write_bytes(content)
    else:
        savemat(tmp_path / "a.mat", content)
    with pytest.raises(InputError) as error:
        bring(tmp_path, ONE.replace("a.csv", "a.mat"))
    assert said in str(error.value)


SWEEP = np.arange(4000) / 1000.0
WAVE = np.sin(2 * np.pi * 1.3 * SWEEP) + 0.3 * np.sin(2 * np.pi * 4.1 * SWEEP + 1.0)


def moving(**changed: np.ndarray) -> np.ndarray:
    """Records (4000, channels) of a bench in motion, some channels replaced."""
    size = {"spool": 0.5, "piston": 0.01, "cap_pressure": 1e6, "rod_pressure": 1e6}
    mean = {"cap_pressure": 4e6, "rod_pressure": 4e6, "supply_pressure": 7e6}
    columns = []
    for k, name in enumerate(NAMES):
        kind = name.rsplit("_", 1)[0] if name[-1].isdigit() else name
        wave = np.roll(WAVE, 37 * k)
        made = mean.get(kind, 40.0 if kind == "oil_temperature" else 0.0) + wave * size.get(
            kind, 1e-3 * mean.get(kind, 1.0)
        )
        columns.append(changed.get(name, made))
    return np.column_stack(columns)


@pytest.mark.parametrize("delay", [0.003, 0.0025, -0.0041])
def test_a_delay_of_a_column_is_taken_out_and_every_column_kept_as_long(
    tmp_path: Path, delay: float
) -> None:
    def motion(t: np.ndarray) -> np.ndarray:
        return 0.01 * np.sin(2 * np.pi * 3.0 * t)

    data = moving(piston_1=motion(SWEEP - delay), piston_2=motion(SWEEP))
    manifest = ONE.replace("locked: [1], ", "") + f"columns: {{piston_1: {{delay: {delay} s}}}}\n"
    report = bring(tmp_path, manifest, a__csv=csv(data=data))
    assert report.warnings == ()
    (record,) = load_run(tmp_path / "run").records
    # The two pistons moved alike, and do so again; what one of them lacks is in neither.
    np.testing.assert_allclose(record.channels["piston_1"], record.channels["piston_2"], atol=2e-8)
    cut = int(np.ceil(abs(delay) * 1000.0 - 1e-9))
    assert record.samples == len(SWEEP) - cut
    first = cut if delay < 0 else 0
    assert record.start == pytest.approx(first / 1000.0)
    np.testing.assert_array_equal(
        record.channels["piston_2"], motion(SWEEP)[first : first + record.samples]
    )


def test_begin_and_end_count_from_the_files_first_sample_with_a_delay_too(tmp_path: Path) -> None:
    records = "records:\n  - {file: a.csv, step: s, begin: 1 s, end: 2 s}\n"
    delayed = f"{HEAD}{records}columns: {{spool_1: {{delay: 2 ms}}}}\n"
    data = moving()
    bring(tmp_path, delayed, a__csv=csv(data=data))
    (record,) = load_run(tmp_path / "run").records
    np.testing.assert_array_equal(record.channels["piston_1"], data[1000:2000, 1])
    np.testing.assert_array_equal(record.channels["spool_1"], data[1002:2002, 0])
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(InputError, match=r"a\.csv: has 3\.998 s of samples; .* 1 s to 4 s"):
        bring(other, delayed.replace("end: 2 s", "end: 4 s"), a__csv=csv(data=data))
    assert not (other / "run").exists()


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ("time: {column: t, delay: 1 ms}", "columns.time.delay: time has no delay"),
        ("spool_1: {delay: 1 mm}", "columns.spool_1.delay: unit 'mm'"),
        ("spool_1: {delay: 5 s}", "'spool_1' with a delay of 5 s leaves none"),
    ],
)
def test_a_delay_that_makes_no_sense_is_refused(tmp_path: Path, columns: str, said: str) -> None:
    with pytest.raises(InputError) as caught:
        bring(tmp_path, f"{ONE}columns:\n  {columns}\n", a__csv=csv(data=moving()))
    assert said in str(caught.value)


PRESSURE = 4e6 + 1e6 * WAVE


@pytest.mark.parametrize(
    ("channel", "values", "said"),
    [
        ("cap_pressure_2", np.full(4000, 3.1e6), "every sample is 3.1e+06 Pa; is the sensor"),
        ("cap_pressure_2", np.minimum(PRESSURE, 4.8e6), "its top; is the sensor or its converter"),
        ("cap_pressure_2", np.maximum(PRESSURE, 3.1e6), "its bottom; is the sensor"),
        ("cap_pressure_2", 3 * PRESSURE, "to an end of the range -100000 to 1e+07 of the rig's"),
        ("supply_pressure", np.full(4000, 7e6), "every sample is 7e+06 Pa"),
        ("piston_2", 5e-5 * WAVE, "moves by 0.00013 m, 0.16 % of the range of the rig's"),
        ("cap_pressure_2", np.round(np.minimum(PRESSURE, 4.8e6) / 200) * 200, "its top"),
        (
            "cap_pressure_2",
            np.where((np.arange(4000) < 900) | (np.arange(4000) > 1500), PRESSURE, PRESSURE[900]),
            "samples 900 to 1500 are all",
        ),
    ],
)
def test_a_dead_stuck_or_clipped_sensor_is_noticed_with_a_sentence(
    tmp_path: Path, channel: str, values: np.ndarray, said: str
) -> None:
    report = bring(tmp_path, ONE, a__csv=csv(data=moving(**{channel: values})))
    (warning,) = report.warnings
    assert warning.startswith(f"a.csv, {channel}: ")
    assert said in warning
    assert load_run(tmp_path / "run").records[0].samples == 4000


@pytest.mark.parametrize(
    "values",
    [
        PRESSURE,
        np.round(PRESSURE / 200) * 200,  # a converter of 14 bits
        np.round(PRESSURE / 20e3) * 20e3,  # so coarse that every peak is flat
        PRESSURE + np.random.default_rng(1).normal(0, 5e3, 4000),
        4e6 + 1e6 * np.sin(2 * np.pi * 0.25 * SWEEP),  # one slow peak
    ],
)
def test_a_healthy_sensor_is_not_spoken_of(tmp_path: Path, values: np.ndarray) -> None:
    report = bring(tmp_path, ONE, a__csv=csv(data=moving(cap_pressure_2=values)))
    assert report.warnings == ()


@pytest.mark.parametrize("fill", [1.0, 1e20, -1e300])
def test_a_fill_value_of_a_logger_is_a_lost_sample(tmp_path: Path, fill: float) -> None:
    """A filter would spread it over the samples about it."""
    data = np.tile(DATA, (4, 1))
    data[70, NAMES.index("piston_2")] = fill
    report = bring(tmp_path, ONE, a__csv=csv(data=data))
    assert any("taken as lost" in warning for warning in report.warnings)
    (record,) = load_run(tmp_path / "run").records
    piston = record.channels["piston_2"]
    assert np.flatnonzero(np.isnan(piston)).tolist() == [70]
    assert not np.isnan(record.channels["piston_1"]).any()


@pytest.mark.parametrize("factor", [1e5, 1e-5])
def test_a_channel_in_another_unit_is_kept_and_spoken_of(tmp_path: Path, factor: float) -> None:
    report = bring(tmp_path, ONE, a__csv=csv(data=moving(cap_pressure_2=factor * PRESSURE)))
    assert any("is the unit another" in warning for warning in report.warnings)
    (record,) = load_run(tmp_path / "run").records
    assert not np.isnan(record.channels["cap_pressure_2"]).any()


def test_channels_of_a_locked_joint_may_stand_still(tmp_path: Path) -> None:
    still = np.zeros(4000)
    data = moving(spool_1=still, piston_1=still, oil_temperature=np.full(4000, 40.0))
    assert bring(tmp_path, ONE, a__csv=csv(data=data)).warnings == ()


@pytest.mark.parametrize(
    ("channel", "values", "said"),
    [
        ("cap_pressure_1", 1e3 * PRESSURE, "to an end of the range -100000 to 1e+07"),
        ("rod_pressure_1", 1e-5 * PRESSURE, "stays below 53 Pa, .* is the unit another"),
        ("cap_pressure_1", np.full(4000, 3e6), "every sample is 3e+06 Pa; is the sensor"),
        ("piston_1", 20 + WAVE, "to an end of the range -0.04 to 0.04"),
        ("oil_temperature", np.full(4000, 312.0), "goes from 312 to 312 degC, to an end of"),
    ],
)
def test_what_a_locked_joint_or_the_oil_can_never_be_is_spoken_of(
    tmp_path: Path, channel: str, values: np.ndarray, said: str
) -> None:
    report = bring(tmp_path, ONE, a__csv=csv(data=moving(**{channel: values})))
    (warning,) = report.warnings
    assert re.search(said.replace("+", r"\+"), warning), warning


def test_a_column_whose_sensor_the_rig_does_not_describe_is_imported(tmp_path: Path) -> None:
    text = shipped_files("rig", "shipped")["shinshu-2dof"].read_text()
    without = [line for line in text.splitlines() if not line.startswith("  supply_pressure: {")]
    (tmp_path / "own.yaml").write_text("\n".join(without))
    manifest = ONE.replace("shinshu-2dof", "own.yaml")
    assert bring(tmp_path, manifest, a__csv=csv(data=moving())).warnings == ()
    assert "supply_pressure" in load_run(tmp_path / "run").records[0].channels


def test_one_column_for_two_channels_is_spoken_of(tmp_path: Path) -> None:
    manifest = f"{ONE}columns:\n  rod_pressure_2: {{column: cap_pressure_2}}\n"
    report = bring(tmp_path, manifest, a__csv=csv(data=moving()))
    assert report.warnings == (
        "column 'cap_pressure_2' is taken for cap_pressure_2 and rod_pressure_2",
    )


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("locked: [1], lines: [1, 3]", "a.csv: lines without a period"),
        (
            "locked: [1], period: 1000, lines: [3, 700]",
            "a.csv: line 700 is 700 Hz, expected below half the rate, 500 Hz",
        ),
        ("locked: [1, 2]", "a.csv: every joint is locked"),
        ("locked: [1], period: 5000", "a.csv: has 4000 samples, less than its period of 5000"),
        ("locked: [1], bandwidth: 600 Hz", "a.csv: bandwidth of 600 Hz, expected below .*500 Hz"),
    ],
)
def test_an_entry_that_its_samples_contradict_is_spoken_of(
    tmp_path: Path, entry: str, said: str
) -> None:
    manifest = ONE.replace("locked: [1]", entry)
    report = bring(tmp_path, manifest, a__csv=csv(data=moving()))
    assert any(re.match(said, warning) for warning in report.warnings)


def test_a_full_disk_is_said_and_leaves_no_half_run(tmp_path: Path) -> None:
    bring(tmp_path, ONE, a__csv=csv())
    before = sorted(path.name for path in tmp_path.iterdir())
    with largest_file(20_000):
        with pytest.raises(RecordingFailed, match=r"again: cannot be written: .*too large"):
            import_records(tmp_path / "manifest.yaml", tmp_path / "again")
        # So is a run that is simulated.
        with pytest.raises(RecordingFailed, match=r"again: cannot be written: .*too large"):
            write_run(tmp_path / "again", load_run(tmp_path / "run"))
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize("file", ["a.csv", "b.csv"])
def test_repeats_with_the_same_samples_are_imported_with_a_message(
    tmp_path: Path, file: str
) -> None:
    """They show sensors without noise; as two steps they do no harm."""
    second = f"  - {{file: {file}, step: s, repeat: 2}}\n  - {{file: {file}, step: t}}\n"
    report = bring(tmp_path, ONE + second, a__csv=csv(), b__csv=csv())
    (message,) = (w for w in report.warnings if "same samples" in w)
    assert message.startswith(f"{file}: s_r2 has the same samples as s_r1")


TWO_STEPS = ONE + "  - {file: a.csv, step: heavy, repeat: 1%s}\n"


def test_records_without_a_stated_load_have_none_where_another_states_one(tmp_path: Path) -> None:
    bring(tmp_path, TWO_STEPS % ", loaded: true", a__csv=csv())
    assert [r.loaded for r in load_run(tmp_path / "run").records] == [False, True]


def test_where_no_load_is_stated_none_is_known(tmp_path: Path) -> None:
    bring(tmp_path, TWO_STEPS % "", a__csv=csv())
    assert [r.loaded for r in load_run(tmp_path / "run").records] == [None, None]


def test_repeats_of_one_step_with_different_loads_are_refused(tmp_path: Path) -> None:
    """They would not have the same motion, which repeats must have."""
    with pytest.raises(InputError) as error:
        bring(tmp_path, ONE + "  - {file: a.csv, step: s, repeat: 2, loaded: true}\n", a__csv=csv())
    assert ":5: records.1.loaded: found true, expected it as in the other" in str(error.value)
    assert not (tmp_path / "run").exists()
