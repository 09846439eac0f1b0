"""Files that verbs write: what cannot be written is refused before anything is computed."""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
from pathlib import Path

import pytest

from rig.runs.archive import write_run
from tests.analysis import small_bench as bench
from tests.cli.bench import bramah, bramah_here, words
from tests.variants import kept

RUN = Path("runs", "monday")
RIG = ("--rig", "shinshu-2dof")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run, and a file where a person thinks a folder is."""
    folder = tmp_path_factory.mktemp("lab")
    run = bench.experiment(
        bench.shinshu(), bench.default_excitations(1), repeats=2, seed=1, seconds=5.0
    )
    write_run(folder / RUN, run)
    (folder / "results").write_text("a file of last year", encoding="utf-8")
    return folder


# Folders of runs that do not exist: a verb that looked at them first would name those.
VERBS = [
    (("identify", "runs/none"), ("--json", "--model", "--report")),
    (("trace", "runs/none", "--holdout", "runs/other"), ("--json", "--model", "--report")),
    (("validate", "none.json", "runs/none"), ("--json",)),
    (("plan", "--rig", "none"), ("--json", "--out", "--validation")),
    (("design", "none", "--rig", "none", "--out", "b.yaml"), ("--json",)),
    (("design", "none", "--rig", "none"), ("--out",)),
    (("check", "none", "--rig", "none"), ("--json",)),
    (("loop", "--rig", "none", "--out", "new", "--unattended"), ("--json", "--report")),
    (("sim", "--rig", "none"), ("--truth",)),
    (("schema",), ("--out",)),
    (("runs", "none"), ("--json",)),
    (("conformance", "none", "--rig", "none"), ("--json",)),
    (("bench", "--only", "none"), ("--json", "--docs")),
    (("queue", "run"), ("--json", "--page")),
    (("queue", "page"), ("--out",)),
    (("queue", "list"), ("--json",)),
]


@pytest.mark.parametrize(
    ("line", "option"), [(line, option) for line, options in VERBS for option in options]
)
def test_a_file_that_cannot_be_written_is_refused_before_the_work(
    lab: Path, line: tuple[str, ...], option: str
) -> None:
    done = bramah_here(*line, option, "results/night/x.out", cwd=lab)
    assert done.returncode == 2, done.stderr
    assert f"{option} results/night/x.out: {lab / 'results'} is no folder" in done.stderr


def test_a_demo_without_a_place_for_its_folder_is_refused(lab: Path) -> None:
    done = bramah_here("demo", "--out", "results/demo", cwd=lab)
    assert done.returncode == 2
    assert f"{lab / 'results'} is no folder; name another folder" in done.stderr


def test_a_new_folder_named_for_every_result_is_made(lab: Path) -> None:
    files = ("new/deep/p.json", "new/models/m.json", "new/reports/r.html")
    options = zip(("--json", "--model", "--report"), files, strict=True)
    line = [word for pair in options for word in pair]
    done = bramah_here("identify", RUN, *line, cwd=lab)
    assert done.returncode == 0, done.stderr
    assert all((lab / name).stat().st_size > 0 for name in files)


def test_two_results_are_not_written_over_each_other(lab: Path) -> None:
    done = bramah_here("identify", RUN, "--json", "m.json", "--model", "m.json", cwd=lab)
    assert done.returncode == 2
    assert "--json writes that file as well" in done.stderr


@pytest.mark.parametrize("name", ["records.h5", "run.yaml", "events.jsonl"])
def test_no_result_is_written_over_what_a_run_has_recorded(lab: Path, name: str) -> None:
    before = (lab / RUN / "records.h5").read_bytes()
    done = bramah_here("identify", RUN, "--json", RUN / name, cwd=lab)
    assert done.returncode == 2
    assert f"{RUN / name}: is part of the run {RUN}" in done.stderr
    assert (lab / RUN / "records.h5").read_bytes() == before


def test_a_folder_and_a_device_are_no_files_to_write(lab: Path) -> None:
    for place, said in (("runs", "is a folder"), ("/dev/null", "is no regular file")):
        done = bramah_here("identify", RUN, "--report", place, cwd=lab)
        assert done.returncode == 2
        assert f"--report {place}: {said}" in done.stderr


def test_a_truth_file_that_is_missing_is_refused_before_the_work(lab: Path) -> None:
    done = bramah_here("identify", "runs/none", "--truth", "truth.json", cwd=lab)
    assert done.returncode == 2
    assert "truth.json cannot be read as true parameters" in done.stderr


def test_a_run_is_refused_a_folder_below_a_file_before_its_check(lab: Path) -> None:
    done = bramah_here("run", "validate", *RIG, "--out", "results/tuesday", cwd=lab)
    assert done.returncode == 2
    assert f"results/tuesday: {lab / 'results'} is no folder" in done.stderr
    assert "checking" not in done.stderr


def test_a_disk_that_is_full_at_the_end_leaves_the_result_on_the_screen(lab: Path) -> None:
    line = words("identify", RUN, "--model", "full/m.json")
    # Python would keep bytecode that the limit cut off, and every later import of it would fail.
    variables = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        line, cwd=lab, capture_output=True, text=True, timeout=120, check=False, env=variables,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)),
    )  # fmt: skip
    assert done.returncode == 1
    assert "full/m.json" in done.stderr
    assert "W1" in done.stdout
    assert "condition number" in done.stdout


def test_a_full_device_behind_standard_output_is_named(lab: Path) -> None:
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        done = subprocess.run(
            words("schema"), cwd=lab, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 1
    assert done.stderr == "bramah: No space left on device (standard output: /dev/full)\n"


def test_results_for_a_closed_standard_output_are_no_error(lab: Path) -> None:
    line = ["sh", "-c", 'exec "$@" >&-', "sh", *words("schema")]
    done = subprocess.run(line, cwd=lab, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("kind", kept(["parquet", "fmu"], (0,)))
def test_a_file_name_that_is_not_utf_8_is_a_name(lab: Path, kind: str) -> None:
    new = os.fsdecode(b"new/\xff")
    line = ("identify", RUN, "--report", f"{new}.html", "--model", f"{new}.json")
    assert bramah(*line, cwd=lab).returncode == 0
    assert rb"\udcff.html" in (lab / f"{new}.html").read_bytes()  # the command, as shown
    out = ("--model", f"{new}.json", "--out", f"{new}.{kind}")
    done = bramah_here("export", RUN, "--format", kind, *out, cwd=lab)
    assert done.returncode == 0, done.stderr


def test_output_piped_into_head_is_no_error(lab: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        words("runs", "runs"),
        cwd=lab,
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_terminal_that_lacks_a_character_shows_its_code(lab: Path) -> None:
    variables = {**os.environ, "PYTHONIOENCODING": "latin-1"}
    folder = lab / "2 Ω"
    folder.mkdir()
    shutil.copytree(lab / RUN, folder / "µ – Ω")
    done = subprocess.run(
        words("runs", folder), capture_output=True, encoding="latin-1", env=variables, check=False
    )
    assert done.returncode == 0, done.stderr
    assert r"µ \u2013 \u03a9" in done.stdout


def test_results_are_json_alone_where_standard_error_is_closed(lab: Path) -> None:
    line = words("runs", "runs", "--json", "-", "--rebuild")
    done = subprocess.run(
        ["sh", "-c", 'exec "$@" 2>&-', "sh", *line], cwd=lab, stdout=subprocess.PIPE, check=False
    )
    assert done.returncode == 0
    assert [run["path"] for run in json.loads(done.stdout)] == [str(RUN)]


@pytest.fixture(autouse=True)
def _clean(lab: Path):  # type: ignore[no-untyped-def]
    yield
    shutil.rmtree(lab / "new", ignore_errors=True)
    assert not list(lab.rglob("*.tmp"))
