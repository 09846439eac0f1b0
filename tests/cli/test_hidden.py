"""What a simulated bench hides stays with it: neither the wire nor the run folder tells of it."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

import pytest
import yaml

from hil_sim.effects import CLASSES
from hil_sim.scenario.random_draw import draw
from rig.runs.rigs import load_rig
from tests.cli.bench import SHORT, bramah, simulated
from tests.cli.recording_proxy import tapped

RIG = "shinshu-2dof"
WORDS = [kind.effect_name() for kind in CLASSES] + ["scenario", "drawn", "effect"]


def two_effects_seed() -> int:
    """A seed that hides two effects which leave the short protocol its limits."""
    rig = load_rig(RIG)
    loud = {"internal_leakage", "coulomb_friction", "spool_lag", "spool_offset", "valve_deadband"}
    return next(s for s in range(500) if len({e.name for e in draw(rig, s).effects} & loud) == 2)


def values_of(data: Any) -> Iterator[float]:
    if isinstance(data, dict):
        for value in data.values():
            yield from values_of(value)
    elif isinstance(data, list):
        for value in data:
            yield from values_of(value)
    elif isinstance(data, float) and data != 0.0:
        yield data


def traces_of(hidden: dict[str, Any], data: bytes) -> list[str]:
    """Return names and values of a scenario that stand in bytes, in any usual form."""
    text = data.decode("latin-1").lower()
    found = [word for word in WORDS if word in text or word.replace("_", "-") in text]
    for effect in hidden["effects"]:
        for value in values_of({k: v for k, v in effect.items() if k in DRAWN[effect["name"]]}):
            forms = [struct.pack(f"{order}{kind}", value) for order in "<>" for kind in "fd"]
            forms += [f"{value:.{digits}g}".encode() for digits in (5, 6, 17)]
            found += [f"{effect['name']}: {value!r}" for form in forms if form in data]
    return found


DRAWN = {kind.effect_name(): set(kind.sizes) for kind in CLASSES}


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Two runs on benches of one seed, one of which hides two effects, and all that was sent."""
    folder = tmp_path_factory.mktemp("night")
    protocol, seed, out = folder / "short.yaml", two_effects_seed(), {}
    protocol.write_text(SHORT)
    for name, more in (("hiding", ("--scenario", "random")), ("plain", ())):
        truth = folder / f"{name}.json"
        with (
            simulated("--seed", seed, "--truth", truth, *more) as (endpoint, _),
            tapped(endpoint) as (here, tap),
        ):
            run = folder / name
            done = bramah("run", protocol, "--rig", RIG, "--out", run, "--endpoint", here)
            assert done.returncode == 0, done.stderr
        out[name] = {
            "truth": json.loads(truth.read_text()), "run": run, "wire": tap.everything,
            "said": done.stdout + done.stderr,
        }  # fmt: skip
    return out


def test_the_truth_file_tells_on_the_simulators_side(night: dict[str, Any]) -> None:
    hidden = night["hiding"]["truth"]["scenario"]
    assert len(hidden["effects"]) == 2
    assert night["plain"]["truth"]["scenario"]["effects"] == []
    # The same seed, drawn here: what the process hid is what its seed says.
    drawn = draw(load_rig(RIG), two_effects_seed()).model_dump(mode="json")
    assert hidden["effects"] == drawn["effects"]


def test_no_byte_on_the_wire_tells_of_it(night: dict[str, Any]) -> None:
    hidden, wire = night["hiding"]["truth"]["scenario"], night["hiding"]["wire"]
    assert len(wire) > 100_000
    assert traces_of(hidden, wire) == []
    # The search finds what is there: a leak would not have passed.
    effect = hidden["effects"][0]
    key = next(iter(DRAWN[effect["name"]]))
    assert traces_of(hidden, wire + struct.pack(">f", effect[key]))
    assert traces_of(hidden, wire + effect["name"].encode())


def test_no_file_of_the_run_folder_tells_of_it(night: dict[str, Any]) -> None:
    hidden, run = night["hiding"]["truth"]["scenario"], night["hiding"]["run"]
    files = [path for path in run.rglob("*") if path.is_file()]
    assert {"run.yaml", "records.h5", "events.jsonl", "state"} <= {path.name for path in files}
    for path in files:
        told = traces_of(hidden, path.read_bytes())
        assert told == [], path
    assert traces_of(hidden, night["hiding"]["said"].encode()) == []


def test_what_a_run_says_of_itself_is_the_same_whether_its_bench_hides_something(
    night: dict[str, Any],
) -> None:
    both = [
        yaml.safe_load((night[name]["run"] / "run.yaml").read_text())
        for name in ("hiding", "plain")
    ]
    assert both[0].keys() == both[1].keys()
    for header in both:
        del header["rig"]["wire"]["port"]
        assert f"--out {night['hiding']['run'].parent}" in header["provenance"].pop("command")
    assert {key for key in both[0] if both[0][key] != both[1][key]} == {"created"}
