"""Somebody brings a MAT file of an electric machine: columns by their names, or a part of them."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from rig.model.parse import InputError
from rig.runs.exchange.importer import import_records
from rig.runs.store import load_run

N = 500
HEAD = "rig: emps\nrecords:\n"
COLUMNS = """columns:
  time: {column: t}
  position_1: {column: qm, unit: mm}
  drive_1: {column: vir}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    t = np.arange(N)[:, None] * 1e-3
    data = {"t": t, "qm": 1e3 * np.sin(t), "vir": np.cos(t), "gtau": np.array([[35.15]])}
    savemat(tmp_path / "data.mat", data)
    return tmp_path


def bring(folder: Path, entry: str) -> Path:
    (folder / "m.yaml").write_text(HEAD + f"  - {{file: data.mat, {entry}}}\n" + COLUMNS)
    return import_records(folder / "m.yaml", folder / "run").path


def test_vectors_become_the_channels_of_an_electric_rig(folder: Path) -> None:
    run = load_run(bring(folder, "step: all"))
    (record,) = run.records
    assert run.rig.electric
    assert set(record.channels) == {"position_1", "drive_1"}
    np.testing.assert_allclose(record.channels["position_1"], np.sin(np.arange(N) * 1e-3))
    with h5py.File(folder / "run" / "records.h5") as file:
        units = [file["all_r1"][name].attrs["units"] for name in ("position_1", "drive_1")]
    assert units == ["m", "V"]


def test_a_part_of_a_file_is_a_record_of_its_own(folder: Path) -> None:
    (record,) = load_run(bring(folder, "step: rest, begin: 0.2 s, end: 450 ms")).records
    assert record.samples == 250
    assert record.start == pytest.approx(0.2)
    np.testing.assert_allclose(record.channels["drive_1"][0], np.cos(0.2))


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("step: s, begin: 2 s", "has 0.5 s of samples; the record asks for 2 s to the end"),
        ("step: s, end: 0.7 s", "the record asks for 0 s to 0.7 s"),
        ("step: s, begin: 0.3 s, end: 0.2 s", "end 0.2 s is not after begin 0.3 s"),
        ("step: s, begin: 1", "has no unit"),
    ],
)
def test_a_part_that_is_not_there_is_refused(folder: Path, entry: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        bring(folder, entry)
    assert not (folder / "run").exists()


def test_a_hydraulic_channel_is_no_channel_of_this_rig(folder: Path) -> None:
    text = HEAD + "  - {file: data.mat, step: s}\n" + COLUMNS + "  piston_1: {column: qm}\n"
    (folder / "m.yaml").write_text(text)
    with pytest.raises(InputError, match="expected one of: time, position_1, drive_1"):
        import_records(folder / "m.yaml", folder / "run")
