"""A night as a script has it: `bramah queue` on a simulated bench over a real wire."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.bench import SHORT, bramah, bramah_here, simulated

RIG = "shinshu-2dof"


def test_a_night_on_a_bench_from_add_to_its_page(tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text(SHORT)
    with simulated("--seed", 5) as (endpoint, _):

        def add(*more: object) -> tuple[int, str, str]:
            words = ("queue", "add", "short.yaml", "--rig", RIG, "--endpoint", endpoint, *more)
            done = bramah_here(*words, cwd=tmp_path)
            return done.returncode, done.stdout, done.stderr

        code, said, error = add("--when", "oil_temperature > 5 degC")
        assert code == 0, error
        assert "item 1 short: queued, about 0.5 min" in said
        assert "the twin uses nominal values" in error
        code, _, error = add("--amplitude-scale", 9)
        assert code == 2
        assert "short.yaml:6: step 'step1', joint 2: the command reaches 7.2 V" in error
        for words in (("--if", "done"), ("--after", 7), ("--when", "oil > 3 degC")):
            assert add(*words)[0] == 2
        code, _, error = add("--after", 1, "--if", "C_pp2.rsd < 20 %")
        assert code == 2
        assert "'C_pp2' is no parameter of that item's rig; expected one of: M1 M2" in error
        code, _, error = add("--after", 1, "--if", "C_pp_2.rsd < 20 %", "--", "--repeats", 1)
        assert code == 0, error

        done = bramah("queue", "run", "--page", tmp_path / "night.html", "--json", "-")
        assert done.returncode == 0, done.stderr
        states = [item["state"] for item in json.loads(done.stdout)["ended"]]
        assert states == ["done", "done"]
        # The file changes while the item waits: what counts is the proof when it starts.
        (tmp_path / "short.yaml").write_text(SHORT.replace("0.8 V", "8 V"))
        assert bramah_here("queue", "retry", 2).returncode == 0
        again = bramah("queue", "run")
    assert again.returncode == 1
    shown = bramah_here("queue", "show", 2, "--json", "-")
    found = json.loads(shown.stdout)
    assert found["state"] == "refused"
    assert "limits.command allows 4 V" in found["reason"]
    first = json.loads(bramah_here("queue", "show", 1, "--json", "-").stdout)
    assert first["found"]["parameters"]["C_pp_2"]["value"] == pytest.approx(6.28e-7, rel=0.05)
    page = (tmp_path / "night.html").read_text()
    assert "2 of 2 items completed" in page
    assert "C_pp_2" in page
    runs = json.loads(bramah_here("runs", tmp_path / "runs", "--json", "-").stdout)
    assert [run["state"] for run in runs] == ["done", "done"]
    assert [run["records"] for run in runs] == [2, 1]
    held = (Path(runs[0]["path"]) / "run.yaml").read_text()
    assert "sha256:" in held
    assert "command: bramah run" in held


@pytest.mark.parametrize(
    "times",
    [
        ("--not-after", "2020-01-01T06:00"),
        ("--not-before", "2099-01-02T22:30", "--not-after", "2099-01-02T06:00"),
    ],
)
def test_an_item_that_could_never_start_is_refused_when_it_is_queued(
    tmp_path: Path, times: tuple[str, ...]
) -> None:
    (tmp_path / "short.yaml").write_text(SHORT)
    done = bramah_here("queue", "add", "short.yaml", "--rig", RIG, *times, cwd=tmp_path)
    assert done.returncode == 2
    assert f"--not-after {times[-1]}: is 0" in done.stderr
    assert "cannot start before" in done.stderr


@pytest.mark.parametrize(
    "words", [("queue", "add", "--name"), ("queue", "add", "--operator"), ("run", "--operator")]
)
def test_a_name_of_two_lines_is_refused(words: tuple[str, ...], tmp_path: Path) -> None:
    *verb, option = words
    out = tmp_path / "out"
    given = ("validate", "--rig", RIG, "--out", out, option, "night\n2")
    done = bramah_here(*verb, *given, cwd=tmp_path)
    assert done.returncode == 2
    assert f"{option} 'night\\n2': found a line break or another control character" in done.stderr
    assert not out.exists()
