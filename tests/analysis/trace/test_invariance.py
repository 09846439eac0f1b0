"""Another description of the same bench leaves verdict, name, place and size as they are.

Runs and records come in another order, the sensors are sampled at another rate, the rig file is
written in other units, the joints change their numbers, a step is added in which nothing moves.
None of it says anything of the machine. The bench is `foreign_bench`, one moving joint.
"""

from __future__ import annotations

import copy
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import rig as rig_package
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.candidates import catalogue
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import regression_data
from analysis.trace.engine import trace
from analysis.trace.result import Trace
from rig.model.parse import InputError, parse_model
from rig.model.records import Record, Run
from rig.model.rig import Rig
from tests.analysis.small_bench import NOISE
from tests.analysis.trace.foreign_bench import Hidden, pair_of_runs
from tests.analysis.trace.test_foreign_bench import rig_angle

LEAK, RUBBING = 2e-12, 80.0  # [m^3/(s Pa)], [N]
HIDDEN = {
    "leak": Hidden(1.0, 1.0, leak=LEAK),
    "rubbing": Hidden(RUBBING, RUBBING, 1e-4),
}
NAME = {
    "leak": ("internal_leakage", "c_internal_{}", LEAK),
    "rubbing": ("coulomb_friction", "Fc{}", RUBBING),
}
SHIPPED = (Path(rig_package.__file__).parent / "shipped" / "shinshu-2dof.yaml").read_text()
RATE = 500.0  # [Hz] of the bench that is described in other ways
# Sampled all at once: a joint that gets another number is then sampled as before.
TEXT = SHIPPED.replace("sample_rate: 1 kHz", "sample_rate: 500 Hz").replace("10 us", "0 us")


def parsed(text: str) -> Rig:
    return parse_model(Rig, text, "bench.yaml")


def noise_at(rate: float) -> float:
    """Return the sensors' noise at a sample rate, for the same noise within any band."""
    return math.sqrt(rate / 1000.0)


def traced(runs: tuple[Run, ...], held_out: Run, **options: Any) -> Trace:
    return trace(runs, [held_out], look_ahead=False, **options)


@pytest.fixture(scope="module", params=["leak", pytest.param("rubbing", marks=pytest.mark.slow)])
def cause(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def runs(cause: str) -> tuple[Run, Run]:
    return pair_of_runs(parsed(TEXT), HIDDEN[cause], noise=noise_at(RATE))


@pytest.fixture(scope="module")
def as_it_is(runs: tuple[Run, Run], cause: str) -> Trace:
    result = traced(runs[:1], runs[1])
    assert_names(result, cause, "joint 2")
    return result


def assert_names(result: Trace, cause: str, where: str) -> None:
    name, parameter, size = NAME[cause]
    assert result.verdict == "explained"
    assert [(e.name, e.where) for e in result.effects] == [(name, where)]
    found = result.effects[0].parameters[parameter.format(where.split()[1])]
    assert found.value == pytest.approx(size, rel=0.03, abs=0.0)


def assert_same(result: Trace, before: Trace, tolerance: float) -> None:
    """Ask for the same verdict, names, sizes, errors and noise, whatever number a joint has.

    A shape that the data hardly determine may also move by a twentieth of its interval.
    """
    assert result.verdict == before.verdict
    assert [e.name for e in result.effects] == [e.name for e in before.effects]
    for one, other in zip(result.effects, before.effects, strict=True):
        for size, wanted in zip(one.parameters.values(), other.parameters.values(), strict=True):
            spread = 0.05 * (wanted.ci95[1] - wanted.ci95[0])
            allowed = max(tolerance * abs(wanted.value), spread if wanted.unit == "m/s" else 0.0)
            assert size.value == pytest.approx(wanted.value, abs=allowed)
    assert sorted(result.after.values()) == pytest.approx(
        sorted(before.after.values()), rel=tolerance, abs=0.0
    )
    noise, wanted_noise = (sorted(f.noise for f in x.floors) for x in (result, before))
    assert noise == pytest.approx(wanted_noise, rel=tolerance, abs=0.0)


def shuffled(run: Run) -> Run:
    """Return the run with its records, their repeats and their channels in another order."""
    rng = np.random.default_rng(5)
    records = []
    for k, i in enumerate(rng.permutation(len(run.records))):
        one = run.records[i]
        names = [list(one.channels)[j] for j in rng.permutation(len(one.channels))]
        channels = {name: one.channels[name] for name in names}
        records.append(replace(one, repeat=k + 1, channels=channels))
    return replace(run, records=tuple(records))


@pytest.mark.slow
def test_records_and_channels_in_another_order(runs: tuple[Run, Run], as_it_is: Trace) -> None:
    train, held_out = map(shuffled, runs)
    assert [r.name for r in train.records] != [r.name for r in runs[0].records]
    result = traced((train,), held_out)
    assert [e.where for e in result.effects] == ["joint 2"]
    assert_same(result, as_it_is, 1e-3)


@pytest.mark.slow
def test_candidates_in_another_order(runs: tuple[Run, Run], as_it_is: Trace) -> None:
    result = traced(runs[:1], runs[1], effects=catalogue(runs[0].rig)[::-1])
    assert [e.where for e in result.effects] == ["joint 2"]
    assert_same(result, as_it_is, 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [1000, 250, 500, 2000])
def test_sensors_sampled_at_another_rate(cause: str, rate: int) -> None:
    """The sensors are those of the shipped rig, one after another, of one noise per root hertz."""
    bench = parsed(SHIPPED.replace("sample_rate: 1 kHz", f"sample_rate: {rate} Hz"))
    train, held_out = pair_of_runs(bench, HIDDEN[cause], noise=noise_at(rate))
    assert len(train.records[0].channels["piston_2"]) == 8 * rate
    assert_names(traced((train,), held_out), cause, "joint 2")


# Units of the shipped file, and what another person writes instead: unit and factor.
OTHER_UNITS = {
    "mm": ("m", 1e-3), "um": ("mm", 1e-3), "m": ("cm", 1e2), "m/s": ("mm/s", 1e3),
    "m^2": ("mm^2", 1e6), "m^3": ("cm^3", 1e6), "MPa": ("bar", 10.0), "kPa": ("bar", 1e-2),
    "GPa/s": ("bar/s", 1e4), "L/min": ("m^3/s", 1e-3 / 60), "Hz": ("kHz", 1e-3), "mV": ("V", 1e-3),
    "V": ("mV", 1e3), "deg": ("rad", math.pi / 180), "kg/m^3": ("g/cm^3", 1e-3),
    "m^3/(s*V*Pa^0.5)": ("L/(min*V*bar^0.5)", 6e4 * math.sqrt(1e5)),
}  # fmt: skip


def otherwise(text: str) -> str:
    """Return a rig file's text with its quantities in `OTHER_UNITS`."""

    def written(found: re.Match[str]) -> str:
        unit, factor = OTHER_UNITS[found[2]]
        return f"{float(found[1]) * factor:.15g} {unit}"

    units = "|".join(re.escape(u) for u in sorted(OTHER_UNITS, key=len, reverse=True))
    return re.sub(rf"(?<![\w.])(-?\d[\d.]*(?:e-?\d+)?) ({units})(?=[\s,}}\]]|$)", written, text)


def test_a_rig_file_in_other_units(runs: tuple[Run, Run], as_it_is: Trace) -> None:
    text = otherwise(TEXT)
    assert "7 MPa" in TEXT
    assert "supply: {pressure: 70 bar," in text
    assert "cap_area: 700 mm^2" in text
    assert not re.search(r"\d (MPa|kPa|um|deg)\b", text)
    other = parsed(text)
    train, held_out = (replace(run, rig=other) for run in runs)
    result = traced((train,), held_out)
    assert [e.where for e in result.effects] == ["joint 2"]
    assert_same(result, as_it_is, 1e-3)


def changed_places(text: str) -> str:
    """Return the rig file of the same machine whose moving joint is the first.

    The standing joint becomes the second, its link along the first's: what it carries then weighs
    at the moving joint alone. The moving joint's angle is counted from where the base's is.
    """
    file = yaml.safe_load(text)
    before = rig_angle(parsed(text))
    boom, arm = (copy.deepcopy(joint) for joint in file["joints"])
    arm["linkage"]["offset"] = f"{-180.0 - math.degrees(before)} deg"
    boom["linkage"]["offset"] = f"{math.degrees(before)} deg"
    guess = {
        "M1": "2 kg*m^2", "M2": "1 kg*m^2", "R12": "0.5 kg*m^2", "W1": "3 kg*m", "W2": "1 kg*m",
    }  # fmt: skip
    nominal = {other_number(name): value for name, value in file["nominal"].items()} | guess
    return yaml.safe_dump(file | {"joints": [arm, boom], "nominal": nominal})


def other_number(name: str) -> str:
    """Return the name of a channel or parameter of joint 1 as that of joint 2, and back."""
    if name == "R12" or not name.endswith(("1", "2")):
        return name
    return name[:-1] + {"1": "2", "2": "1"}[name[-1]]


def in_changed_places(run: Run) -> Run:
    other = parsed(changed_places(TEXT))

    def renamed(one: Record) -> Record:
        channels = {other_number(name): x for name, x in one.channels.items()}
        return replace(one, locked=(2,), channels=channels)

    return replace(run, rig=other, records=tuple(map(renamed, run.records)))


@pytest.mark.slow
def test_joints_in_changed_places(runs: tuple[Run, Run], as_it_is: Trace) -> None:
    train, held_out = map(in_changed_places, runs)
    assert train.rig.joints[0].linkage.angle(0.0) == pytest.approx(
        sum(joint.linkage.angle(0.0) for joint in runs[0].rig.joints)
    )
    result = traced((train,), held_out)
    assert [e.where for e in result.effects] == ["joint 1"]
    assert_same(result, as_it_is, 1e-3)


def at_rest(run: Run, locked: tuple[int, ...]) -> Run:
    """Return the run with a further step of as many repeats in which nothing moves."""
    rng = np.random.default_rng(9)
    still = [
        replace(
            one, name=f"rest_r{one.repeat}", step="rest", locked=locked, lines=(), period=0,
            channels={
                name: np.mean(x) * (not name.startswith(("spool", "piston")))
                + NOISE[name.rstrip("_12")] * rng.standard_normal(len(x))
                for name, x in one.channels.items()
            },
        )
        for one in run.records
    ]  # fmt: skip
    return replace(run, records=(*still, *run.records))


@pytest.mark.slow
def test_a_further_step_in_which_nothing_moves(runs: tuple[Run, Run], as_it_is: Trace) -> None:
    result = traced((at_rest(runs[0], (1, 2)),), runs[1])
    assert [e.where for e in result.effects] == ["joint 2"]
    assert_same(result, as_it_is, 1e-3)


def test_a_joint_said_to_move_that_stands_is_refused(runs: tuple[Run, Run]) -> None:
    """The records hold nothing of it: whose mistake it is, only the user can know."""
    with pytest.raises(InputError, match=r"'rest_r1', channel 'piston_2': joint 2 is not locked"):
        traced((at_rest(runs[0], (1,)),), runs[1])


def test_where_a_joint_stands_by_its_noise_is_no_lever_for_a_weight() -> None:
    """Aligned, both weights pull alike: their difference is a micrometre's, all of it noise."""
    bench = pair_of_runs(parsed(TEXT), HIDDEN["rubbing"], noise=noise_at(RATE))[0]
    moved = in_changed_places(bench)
    terms = [Used(term) for term in baseline_of(moved.rig)]
    data = regression_data(moved.rig, terms, conditioned_records(moved.rig, [moved]))
    assert 3.0 < data.beta["W1"] + data.beta["W2"] < 4.0
    assert max(abs(data.beta["W1"]), abs(data.beta["W2"])) < 4.0
