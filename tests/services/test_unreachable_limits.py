"""A limit that no reading can pass protects nothing, and is said before anything moves."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.bench.checks.unreachable import unreachable_limits
from rig.runs.rigs import load_rig
from tests.cli.bench import ROOT, SHORT, bramah_here

SHIPPED = ROOT / "rig" / "shipped" / "shinshu-2dof.yaml"


def changed(folder: Path, old: str, new: str) -> Path:
    """Return the shipped rig file with a text replaced."""
    text = SHIPPED.read_text()
    assert old in text
    (folder / "rig.yaml").write_text(text.replace(old, new))
    return folder / "rig.yaml"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("speed: 0.6 m/s", "speed: 600 m/s", "limit of 600 m/s on its speed, since it reads at"),
        ("pressure_rate: 4 GPa/s", "pressure_rate: 4000 GPa/s", "on its rate, since it reads at"),
        ("range: [-40 mm, 40 mm]", "range: [-30 mm, 30 mm]", "since its sensor ends at 0.03 m"),
    ],
)
def test_each_limit_beyond_what_its_sensor_can_read_is_named(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    sentences = unreachable_limits(load_rig(str(changed(tmp_path, old, new))))
    assert any(words in sentence for sentence in sentences)
    assert {sentence.split(":")[0][-1] for sentence in sentences} == {"1", "2"}


def test_the_shipped_benches_have_no_such_limit() -> None:
    for path in SHIPPED.parent.glob("*.yaml"):
        assert unreachable_limits(load_rig(path.stem)) == []


def test_check_says_so_and_checks_the_rest(tmp_path: Path) -> None:
    protocol = tmp_path / "short.yaml"
    protocol.write_text(SHORT)
    rig = changed(tmp_path, "speed: 0.6 m/s", "speed: 600 m/s")
    done = bramah_here("check", protocol, "--rig", rig, "--nominal")
    assert done.returncode == 0, done.stderr
    assert "WARNING: piston_1: no reading can pass the limit of 600 m/s" in done.stderr
