"""The twin has the last identified model: what nominal values pass, the machine may not."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from analysis.simulation.model import Estimate, Model, load_model, nominal_model, save_model
from analysis.simulation.model_draws import model_draws, unusable
from analysis.terms import with_effects
from analysis.terms.base import Used
from protocols.files.library import read_protocol
from protocols.files.plan import Plan, resolve
from rig.cli.proof.proofs import PlanProof, proved
from rig.cli.proof.twin_choice import last_model_path, save_identified, source_text, twin_source
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs.rigs import load_rig
from rig.runs.store import create_run
from tests.cli.bench import SHORT, bramah, simulated

RIG = "shinshu-2dof"
# 27 mm and 3 mm of centring to either side on nominal values; 36 mm are allowed.
WIDE = SHORT.replace("name: short", "name: wide").replace("amplitude: 0.8 V", "amplitude: 2 V")
GAINS = [f"C_{signs}_{joint}" for signs in ("pp", "pm", "mp", "mm") for joint in (1, 2)]


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(RIG)


@pytest.fixture(scope="module")
def fast_machine(tmp_path_factory: pytest.TempPathFactory, rig: Rig) -> Path:
    """A run on a machine whose valves pass 30 % more than the rig file says."""
    folder = tmp_path_factory.mktemp("fast")
    text = ", ".join(f"{name}: {1.3 * rig.nominal[name]} m^3/(s*V*Pa^0.5)" for name in GAINS)
    (folder / "fast.yaml").write_text(f"parameters: {{{text}}}\n")
    with simulated("--scenario", folder / "fast.yaml", "--seed", 3) as (endpoint, _):
        done = bramah(
            "run", "lock-and-excite-multisine", "--rig", RIG, "--endpoint", endpoint, "--nominal",
            "--amplitude-scale", 0.6, "--repeats", 2, "--out", folder / "run",
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "run"


@pytest.mark.slow
def test_a_protocol_that_nominal_values_pass_is_refused_once_the_machine_is_identified(
    fast_machine: Path, tmp_path: Path
) -> None:
    protocol = tmp_path / "wide.yaml"
    protocol.write_text(WIDE)
    checked = ("check", protocol, "--rig", RIG)
    before = bramah(*checked)
    assert before.returncode == 0, before.stderr
    assert "the twin uses the nominal values of the rig file" in before.stdout
    queued = bramah("queue", "add", protocol, "--rig", RIG, "--out", tmp_path / "queued")
    assert queued.returncode == 0, queued.stderr

    model = tmp_path / "model.json"
    identified = bramah("identify", fast_machine, "--model", model)
    assert identified.returncode == 0, identified.stderr
    assert f"check and run of rig shinshu-2dof now use {model}" in identified.stderr

    refused = bramah(*checked, "--json", tmp_path / "check.json")
    assert refused.returncode == 2
    assert "step1, joint 2: piston -" in refused.stderr
    assert f"on the twin (model {model})" in refused.stderr
    assert "about 0 s into the run" in refused.stderr
    assert f"the last identified model {model} (" in refused.stdout
    document = json.loads((tmp_path / "check.json").read_text())
    assert document["model"]["file"] == str(model)
    scale = document["scales"]["step1"]
    assert f"{scale:g} times this amplitude would pass" in refused.stderr
    assert bramah(*checked, "--amplitude-scale", scale).returncode == 0
    assert bramah(*checked, "--amplitude-scale", scale + 0.02).returncode == 2
    assert bramah(*checked, "--nominal").returncode == 0

    run = bramah("run", protocol, "--rig", RIG, "--out", tmp_path / "run")
    assert run.returncode == 2
    assert "would pass" in run.stderr
    assert not (tmp_path / "run").exists()
    # What was queued before is proved again when it is started, on what is known by then.
    bramah("queue", "run")
    shown = json.loads(bramah("queue", "show", 1, "--json", "-").stdout)
    assert shown["state"] == "refused"
    assert f"model {model}" in shown["reason"]


@pytest.mark.slow
def test_a_run_keeps_which_model_it_was_proved_on(tmp_path: Path, rig: Rig) -> None:
    known = identified(rig, 1.0)
    save_identified(known, tmp_path / "model.json", str)
    (tmp_path / "short.yaml").write_text(SHORT)
    with simulated("--seed", 4) as (endpoint, _):
        done = bramah(
            "run", "short.yaml", "--rig", RIG, "--endpoint", endpoint, "--repeats", 1,
            "--out", "run", cwd=tmp_path,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "the twin uses the last identified model" in done.stderr
    proof = json.loads((tmp_path / "run" / "proof.json").read_text())
    source = twin_source(rig)
    assert proof["model"] == source.as_dict()
    assert proof["model"]["sha256"] == source.sha256 != ""


def plan(rig: Rig, text: str = SHORT) -> Plan:
    return resolve(read_protocol(text, "short.yaml"), rig)


def identified(rig: Rig, gain: float, std: float = 1e-3) -> Model:
    """A model of the rig with other flow gains, each parameter known to `std` of itself."""
    model = nominal_model(rig, tuple(Used(term) for term in with_effects(rig, ())))
    return known(model, {name: gain * rig.nominal[name] for name in GAINS}, std)


def known(model: Model, values: dict[str, float], std: float) -> Model:
    """The model with other values and with independent errors of `std`, relative."""
    parameters = {}
    for name, p in model.parameters.items():
        value = values.get(name, p.value)
        error = std * abs(value)
        parameters[name] = Estimate(value, p.unit, error, (value - 2 * error, value + 2 * error))
    covariance = np.diag([p.std**2 for p in parameters.values()])
    return replace(model, parameters=parameters, covariance=covariance)


def edges(proof: PlanProof, quantity: str) -> tuple[float, float, float]:
    """Low, high and the upper spread of a predicted quantity."""
    (line,) = [p for p in proof.report.steps[0].predictions if p.quantity == quantity]
    return line.low, line.high, line.spread[1]


def test_another_model_is_another_proof_and_the_same_one_is_kept(rig: Rig, tmp_path: Path) -> None:
    nominal = proved(plan(rig), rig, source=twin_source(rig, nominal=True))
    save_identified(identified(rig, 1.2), tmp_path / "a.json", str)
    first = proved(plan(rig), rig)
    assert not first.reused
    assert proved(plan(rig), rig).reused
    assert edges(first, "piston speed")[1] > 1.1 * edges(nominal, "piston speed")[1]
    save_identified(identified(rig, 1.1), tmp_path / "b.json", str)
    second = proved(plan(rig), rig)
    assert not second.reused
    assert edges(second, "piston speed")[1] < edges(first, "piston speed")[1]
    stated = proved(plan(rig), rig, source=twin_source(rig, tmp_path / "a.json"))
    assert edges(stated, "piston speed") == edges(first, "piston speed")


def test_limits_are_judged_at_the_edge_of_the_models_intervals(rig: Rig, tmp_path: Path) -> None:
    """Speed is proportional to the gain: 2 sigma of common gain are 2 sigma of speed."""
    sure, unsure = identified(rig, 1.0, 1e-9), identified(rig, 1.0, 1e-9)
    std = 0.05
    scale = np.array([std * p.value if n in GAINS else 0.0 for n, p in unsure.parameters.items()])
    parameters = {
        name: replace(p, std=s, ci95=(p.value - 2 * s, p.value + 2 * s))
        for (name, p), s in zip(unsure.parameters.items(), scale, strict=True)
    }
    unsure = replace(unsure, parameters=parameters, covariance=np.outer(scale, scale))
    save_model(sure, tmp_path / "sure.json")
    save_model(unsure, tmp_path / "unsure.json")
    low, high, none = edges(
        proved(plan(rig), rig, source=twin_source(rig, tmp_path / "sure.json")), "piston speed"
    )
    assert none < 1e-6
    wide = proved(plan(rig), rig, source=twin_source(rig, tmp_path / "unsure.json"))
    lowest, highest, spread = edges(wide, "piston speed")
    assert highest == pytest.approx((1 + 2 * std) * high, rel=0.02)
    assert lowest == pytest.approx((1 + 2 * std) * low, rel=0.02)
    assert spread == pytest.approx(2 * std * high, rel=0.1)


def test_the_effects_of_the_model_are_in_the_twin(rig: Rig, tmp_path: Path) -> None:
    terms = tuple(Used(term) for term in with_effects(rig, ("coulomb_friction",)))
    rubbing = rig.model_copy(update={"nominal": {**rig.nominal, "Fc1": 10.0, "Fc2": 600.0}})
    model = replace(nominal_model(rubbing, terms), rig=rig)
    save_model(known(model, {}, 1e-3), tmp_path / "rubs.json")
    save_model(identified(rig, 1.0), tmp_path / "plain.json")
    plain, rubs = (
        edges(proved(plan(rig), rig, source=twin_source(rig, tmp_path / name)), "cap_pressure")
        for name in ("plain.json", "rubs.json")
    )
    # The piston moves both ways against 600 N: its chambers' swing grows by about 600 N / A.
    assert (rubs[1] - rubs[0]) - (plain[1] - plain[0]) > 0.5 * 600.0 / 7e-4


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: known(m, {}, 0.4), "is known to +- 80 % only, expected 50 % or less"),
        (lambda m: known(m, {"b": float("nan")}, 1e-3), "it does not determine b"),
        (lambda m: known(m, {"C_pp_2": -1e-7}, 1e-3), "its C_pp_2 is -1e-07"),
        (lambda m: known(m, {"M2": -1.3}, 1e-3), "its M2 is -1.3 kg"),
        (
            lambda m: known(m, {"C_mm_1": 6e-8}, 1e-3),
            "it has C_mm_1 0.1 times the nominal value of the rig file, expected within a factor "
            "of 4: is a channel in another unit",
        ),
        (lambda m: known(m, {}, float("nan")), "it has no intervals for M1"),
        (
            lambda m: replace(
                m,
                rig=m.rig.model_copy(
                    update={
                        "joints": (
                            m.rig.joints[0],
                            m.rig.joints[1].model_copy(update={"link_length": 0.6}),
                        )
                    }
                ),
            ),
            "it was identified on another rig: joints.2.link_length",
        ),
    ],
)
def test_a_model_worse_than_nominal_values_is_left_with_a_warning(  # type: ignore[no-untyped-def]
    rig: Rig, tmp_path: Path, spoil, words: str
) -> None:
    bad = spoil(identified(rig, 1.2))
    assert words in unusable(bad, rig)
    kept = last_model_path(RIG)
    kept.parent.mkdir(parents=True)
    save_model(bad, kept)
    proof = proved(plan(rig), rig)
    assert words in proof.twin_text
    assert proof.twin_text.startswith("WARNING")
    nominal = proved(plan(rig), rig, source=twin_source(rig, nominal=True))
    assert edges(proof, "piston") == edges(nominal, "piston")
    assert words in proved(plan(rig), rig).twin_text  # also from the cache
    with pytest.raises(InputError, match="cannot be the twin of rig 'shinshu-2dof'"):
        proved(plan(rig), rig, source=twin_source(rig, kept))


def test_a_model_that_cannot_serve_does_not_replace_the_one_before(
    rig: Rig, tmp_path: Path
) -> None:
    said: list[str] = []
    save_identified(identified(rig, 1.1), tmp_path / "good.json", said.append)
    save_identified(identified(rig, 1.2, 0.4), tmp_path / "vague.json", said.append)
    assert "now use" in said[0]
    assert "vague.json is not used by check and run" in said[1]
    assert twin_source(rig).shown == str(tmp_path / "good.json")
    assert (
        load_model(tmp_path / "vague.json").values["C_pp_1"] > 0
    )  # the file is there all the same


def test_a_model_of_a_simulated_bench_is_called_so(rig: Rig, tmp_path: Path) -> None:
    """Nobody proves a machine on what a simulator was found to be without reading it."""
    model = identified(rig, 1.0)
    for virtual_time in (True, False):
        run = create_run(tmp_path / f"run-{virtual_time}", rig, virtual_time=virtual_time)
        taken = replace(model, provenance={**model.provenance, "runs": [str(run)]})
        save_identified(taken, tmp_path / "model.json", str)
        source = twin_source(rig)
        assert source.simulated == virtual_time
        assert ("of a SIMULATED bench" in source_text(source)) == virtual_time


def test_the_age_of_a_model_is_stated(rig: Rig, tmp_path: Path) -> None:
    save_identified(identified(rig, 1.1), tmp_path / "model.json", str)
    later = datetime.now(UTC) + timedelta(days=40)
    assert "(40 days old" in source_text(twin_source(rig), later)
    save_model(identified(rig, 1.1), tmp_path / "undated.json")  # of an earlier version
    os.utime(tmp_path / "undated.json", (later.timestamp() - 7300,) * 2)
    assert "(2 h old" in source_text(twin_source(rig, tmp_path / "undated.json"), later)


def test_a_damaged_model_is_named_and_both_options_at_once_refused(
    rig: Rig, tmp_path: Path
) -> None:
    kept = last_model_path(RIG)
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"\xff{")
    assert str(kept) in proved(plan(rig), rig).warning
    with pytest.raises(InputError, match="exclude each other"):
        twin_source(rig, kept, nominal=True)
    with pytest.raises(InputError, match="cannot read the model file"):
        twin_source(rig, tmp_path / "none.json")


def test_the_draws_have_the_covariance_of_the_model(rig: Rig) -> None:
    """For quantities of the parameters' few widest directions the draws' variance is exact."""
    model = identified(rig, 1.0, 1e-9)
    rng = np.random.default_rng(1)
    k = len(model.parameters)
    values = np.array([p.value for p in model.parameters.values()])
    root = 0.01 * values[:, None] * rng.normal(size=(k, 8))  # eight directions, eight draws
    covariance = root @ root.T
    std = np.sqrt(np.diag(covariance))
    parameters = {
        name: replace(p, std=s, ci95=(p.value - 2 * s, p.value + 2 * s))
        for (name, p), s in zip(model.parameters.items(), std, strict=True)
    }
    model = replace(model, parameters=parameters, covariance=covariance)
    drawn = model_draws(model, 8, np.random.default_rng(7))
    moved = np.array([[p.value for p in draw.parameters.values()] for draw in drawn]) - values
    for gradient in rng.normal(size=(5, k)) / values:
        expected = gradient @ covariance @ gradient
        assert np.mean((moved @ gradient) ** 2) == pytest.approx(expected, rel=1e-6)
