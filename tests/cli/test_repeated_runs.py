"""The same run given twice is no further evidence, and a changed sample is no measurement."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from analysis.identify.identify import identify
from analysis.simulation.model import nominal_model, save_model
from analysis.terms import with_effects
from analysis.terms.base import Used
from drivers.base import OutputLaw
from rig.bench.session import Bench
from rig.cli.main import app
from rig.model.parse import InputError
from rig.runs import repeated
from rig.runs.recorder import Recorder
from rig.runs.repeated import refuse_repeated
from rig.runs.rigs import load_rig
from rig.runs.store import load_run
from rig.runs.stream import open_record
from tests.cli.bench import bramah_here
from tests.services.fake_driver import FakeDriver

RIG = load_rig("shinshu-2dof")


def taken(folder: Path, first_tick: int = 0) -> Path:
    """A run of one record."""
    driver = FakeDriver(RIG, first_tick=first_tick)
    with Bench(RIG, driver, Recorder(folder, RIG), signals=False) as bench:
        bench.apply([OutputLaw(bias=1.0, limit=2.0), OutputLaw()])
        bench.exchange()
        with bench.record(step="s"):
            bench.run_for(2.0)
    return folder


@pytest.fixture(scope="module")
def monday(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return taken(tmp_path_factory.mktemp("runs") / "monday")


@pytest.fixture
def copy(monday: Path, tmp_path: Path) -> Path:
    shutil.copytree(monday, tmp_path / "copy")
    return tmp_path / "copy"


def imported_again(run: Path, folder: Path, kind: str) -> Path:
    """A run exported as `kind` of file, and imported again."""
    bramah_here("export", run, "--format", kind, "--out", folder / "files")
    done = bramah_here("import", folder / "files" / "manifest.yaml", "--out", folder / "run")
    assert done.returncode == 0, done.stderr
    return folder / "run"


@pytest.mark.parametrize(
    "line",
    [
        ("identify", "MONDAY", "AGAIN"),
        ("identify", "MONDAY", "AGAIN", "--stream"),
        ("validate", "m.json", "MONDAY", "AGAIN"),
        ("trace", "MONDAY", "--holdout", "AGAIN"),
    ],
)
@pytest.mark.parametrize("how", ["same", "other spelling", "link", "copy", "csv", "mat"])
def test_a_run_given_twice_is_refused_by_name(
    monday: Path, copy: Path, tmp_path: Path, line: tuple[str, ...], how: str
) -> None:
    (tmp_path / "link").symlink_to(monday)
    again = {
        "same": monday,
        "other spelling": monday / ".." / monday.name,
        "link": tmp_path / "link",
        "copy": copy,
    }.get(how) or imported_again(monday, tmp_path / how, how)
    words = [{"MONDAY": str(monday), "AGAIN": str(again)}.get(word, word) for word in line]
    if "m.json" in words:
        words[words.index("m.json")] = str(tmp_path / "m.json")
        save_model(nominal_model(RIG, list(map(Used, with_effects(RIG, ())))), tmp_path / "m.json")
    done = CliRunner().invoke(app, words, standalone_mode=False)
    assert isinstance(done.exception, InputError), done.exception
    assert f"{again}: is the same run as {monday}" in str(done.exception)


def test_runs_of_equal_size_that_differ_are_two(monday: Path, tmp_path: Path) -> None:
    refuse_repeated([monday, taken(tmp_path / "tuesday", 500), tmp_path / "not-here"])


def test_runs_that_begin_alike_are_two(
    monday: Path, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are read in stretches; the last sample of the last one differs."""
    monkeypatch.setattr(repeated, "STRETCH", 700)
    with h5py.File(copy / "records.h5", "a") as file:
        file["s_r1"]["cap_pressure_2"][-1] += 1.0
    refuse_repeated([monday, copy])
    assert load_run(copy).records[0].channels["cap_pressure_2"][-1] > 1.0


def test_a_notebook_that_identifies_from_a_run_and_its_copy_is_told(
    monday: Path, copy: Path
) -> None:
    renamed = load_run(copy)
    renamed = replace(
        renamed, records=tuple(replace(r, name=f"x{r.name}") for r in renamed.records)
    )
    with pytest.raises(InputError, match=rf"^{copy}: is the same run as {monday}.* leave .* out$"):
        identify([load_run(monday), renamed])


def flip_a_sample(run: Path, channel: str) -> None:
    """Change one stored sample as a failing disk does, behind HDF5's back."""
    with h5py.File(run / "records.h5") as file:
        dataset = file["s_r1"][channel]
        offset = dataset.id.get_chunk_info(0).byte_offset
        assert dataset.fletcher32
        before = np.asarray(dataset[:])
    raw = bytearray((run / "records.h5").read_bytes())
    raw[offset + 8 * 123 + 6] ^= 0x10
    (run / "records.h5").write_bytes(raw)
    assert before.shape == (2000,)


def test_a_changed_sample_is_refused_with_its_record_and_channel(copy: Path) -> None:
    assert load_run(copy).records[0].samples == 2000
    flip_a_sample(copy, "cap_pressure_2")
    with pytest.raises(InputError, match=r"record s_r1, channel cap_pressure_2: samples were"):
        load_run(copy)
    with (
        open_record(copy, "s_r1") as reader,
        pytest.raises(InputError, match=r"record s_r1, channel cap_pressure_2"),
    ):
        reader.read(100, 200)
