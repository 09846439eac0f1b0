"""What a night must not do: real commands on protocols that cannot run, or that never end."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.bench import bramah_here, outputs_are_zero, simulated

RIG = "shinshu-2dof"
HEAD = "version: 2\nname: night\njoints: 2\n"
HUNDRED = ", ".join(f"{1 + k / 100:.2f}" for k in range(100))
SWEEP = f"""{HEAD}parameters: {{a: 1, f: 1}}
steps:
  - sweep: {{a: [{HUNDRED}], f: [{HUNDRED}]}}
    steps:
      - hold: 1 s
"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SWEEP, "night.yaml:6: 10000 steps; expected at most 1000"),
        (
            f"{HEAD}steps:\n  - include: other.yaml\n",
            "other.yaml:5: include: circular: night.yaml -> other.yaml -> night.yaml",
        ),
        (
            "version: 7\nname: night\njoints: 2\nsteps:\n  - hold: 1 s\n",
            "night.yaml:1: version 7 is later than this program reads, which is 2",
        ),
    ],
    ids=["a sweep of 10 000 steps", "files that include each other", "a later version"],
)
def test_what_cannot_run_is_refused_before_a_bench_is_asked_for(
    text: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / "night.yaml").write_text(text)
    (tmp_path / "other.yaml").write_text(f"{HEAD}steps:\n  - include: night.yaml\n")
    night = ("night.yaml", "--rig", RIG)
    nowhere = "modbus-tcp://127.0.0.1:9"
    for command in (
        ("run", *night, "--out", "run", "--endpoint", nowhere),
        ("queue", "add", *night),
    ):
        done = bramah_here(*command, cwd=tmp_path)
        assert done.returncode == 2, command
        assert said in done.stderr.replace(f"{tmp_path}/", "")
        assert "Traceback" not in done.stderr
    assert not (tmp_path / "run").exists()
    assert json.loads(bramah_here("queue", "list", "--json", "-").stdout)["items"] == []


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with simulated() as (address, _):
        yield address


@pytest.mark.parametrize(
    ("step", "said"),
    [
        (
            "wait_until: oil_temperature > 70 degC",
            "oil_temperature > 70 degC did not come within 2 s: oil_temperature N °C",
        ),
        (
            "prompt: Is the cell empty?\n    answers: [yes, no]",
            "'Is the cell empty?' was not answered within 2 s",
        ),
    ],
    ids=["a condition that never comes", "a prompt that nobody answers"],
)
def test_what_never_comes_ends_the_run_with_its_reason_and_a_safe_bench(
    step: str, said: str, endpoint: str, tmp_path: Path
) -> None:
    (tmp_path / "night.yaml").write_text(f"{HEAD}steps:\n  - {step}\n    timeout: 2 s\n")
    done = bramah_here(
        "run", "night.yaml", "--rig", RIG, "--out", "run", "--endpoint", endpoint, cwd=tmp_path
    )
    assert done.returncode == 1
    last = re.sub(r"oil_temperature [\d.]+ °", "oil_temperature N °", done.stderr.splitlines()[-1])
    assert last == f"bramah: {said}"
    assert outputs_are_zero(endpoint)
    (line,) = [
        line for line in bramah_here("runs", tmp_path).stdout.splitlines() if "night" in line
    ]
    assert "aborted" in line
