"""A proof on the twin is kept while nothing changes, and made anew when anything does."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest

from protocols.files.library import read_protocol
from protocols.files.plan import Overrides, Plan, resolve
from rig.cli.execution import protocol_run
from rig.cli.execution.protocol_run import ProtocolJob, run_protocol
from rig.cli.proof import proofs
from rig.cli.proof.proofs import PlanProof, proved
from rig.cli.proof.twin_choice import TwinSource
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs.files import CACHE_VARIABLE, cache_folder
from rig.runs.rigs import load_rig
from tests.cli.bench import ROOT, SHORT, bramah_here

RIG = "shinshu-2dof"


@pytest.fixture
def rig() -> Rig:
    return load_rig(RIG)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own, with the equations that earlier tests compiled."""
    rates = cache_folder() / "rates"
    own = tmp_path / "cache"
    own.mkdir()
    if rates.is_dir():
        (own / "rates").symlink_to(rates)
    monkeypatch.setenv(CACHE_VARIABLE, str(own))
    return own / "proofs"


def short(rig: Rig, text: str = SHORT, **changes: object) -> Plan:
    return resolve(read_protocol(text, "short.yaml"), rig, Overrides(**changes))  # type: ignore[arg-type]


def same(one: PlanProof, other: PlanProof) -> bool:
    """Whether two proofs say the same, wherever they come from."""
    plain = [json.loads(json.dumps(proof.as_dict())) for proof in (one, other)]
    return plain[0] == plain[1]


def test_what_did_not_change_is_not_proved_again(rig: Rig, cache: Path) -> None:
    first = proved(short(rig), rig)
    again = proved(short(rig), rig)
    assert (first.reused, again.reused) == (False, True)
    assert same(first, again)
    assert [path.stem for path in cache.iterdir()] == [first.key]


def test_a_proof_without_predicted_errors_is_completed_when_they_are_wanted(rig: Rig) -> None:
    proved(short(rig), rig)
    full = proved(short(rig), rig, predict=True)
    assert not full.reused
    assert "std. error %" in full.text
    assert same(full, proved(short(rig), rig, predict=True))
    assert proved(short(rig), rig).reused  # the fuller one serves both


def limited(rig: Rig, joint: int, **limits: object) -> Rig:
    """The rig with other limits of one joint."""
    joints = list(rig.joints)
    own = joints[joint - 1]
    changed = own.limits.model_copy(update=limits)
    joints[joint - 1] = own.model_copy(update={"limits": changed})
    return rig.model_copy(update={"joints": tuple(joints)})


def test_another_limit_model_protocol_or_amplitude_is_proved_anew(rig: Rig) -> None:
    proved(short(rig), rig)
    tighter = limited(rig, 2, pressure=(0.0, 6.9e6))
    assert not proved(short(tighter), tighter).reused
    softer = rig.model_copy(update={"nominal": {**rig.nominal, "b": 0.9 * rig.nominal["b"]}})
    assert not proved(short(softer), softer).reused
    assert not proved(short(rig, amplitude_scale=0.9), rig).reused
    longer = SHORT.replace("duration: 2 s", "duration: 3 s")
    assert not proved(short(rig, longer), rig).reused
    elsewhere = rig.model_copy(update={"wire": rig.wire.model_copy(update={"port": 1502})})
    assert proved(short(elsewhere), elsewhere).reused  # on the twin the wire moves nothing


def test_another_program_or_library_proves_anew(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def key() -> str:
        proofs._source_digest.cache_clear()
        return proofs.proof_key(short(rig), rig, TwinSource())

    before = key()
    with monkeypatch.context() as patch:
        newer = SimpleNamespace(version=lambda name: f"{metadata.version(name)}.1")
        patch.setattr(proofs, "metadata", newer)
        assert key() != before
    copy = tmp_path / "source"
    for package in ("analysis", "protocols", "rig"):
        shutil.copytree(ROOT / package, copy / package, ignore=shutil.ignore_patterns("*.pyc"))
    monkeypatch.setattr(proofs, "_ROOT", copy)
    assert key() == before
    for changed in ("analysis/simulation/twin.py", "protocols/engine/centring.py"):
        text = (copy / changed).read_text()
        (copy / changed).write_text(text + "# changed\n")
        assert key() != before
        (copy / changed).write_text(text)
    assert key() == before


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda _: "",
        lambda _: "[]",
        lambda _: "null",
        lambda text: text.replace('"predicted"', '"predicated"', 1),
        lambda text: text.replace('"key": "', '"key": "0'),
        lambda text: text.replace('"steps": [', '"steps": [3, ', 1),
    ],
)
def test_a_damaged_proof_is_made_anew_and_kept_whole(
    rig: Rig, cache: Path, damage: Callable[[str], str]
) -> None:
    first = proved(short(rig), rig)
    (path,) = cache.iterdir()
    whole = path.read_text()
    path.write_text(damage(whole))
    again = proved(short(rig), rig)
    assert not again.reused
    assert same(first, again)
    assert path.read_text() == whole
    path.write_bytes(b"\xff\xfe" + whole.encode())
    assert not proved(short(rig), rig).reused


def test_a_cache_that_cannot_be_written_costs_time_only(rig: Rig, cache: Path) -> None:
    cache.write_text("a file where the folder should be")
    assert proved(short(rig), rig).report.ok
    assert not proved(short(rig), rig).reused


WIDE = SHORT.replace("0.8 V", "2.2 V")


def test_the_amplitude_that_a_refusal_names_passes_and_one_hundredth_more_does_not(
    rig: Rig,
) -> None:
    report = proved(short(rig, WIDE), rig).report
    assert not report.ok
    with pytest.raises(InputError) as caught:
        report.require()
    message = str(caught.value)
    assert "step1, joint 2: piston" in message
    assert re.search(r"about \d+ s into the run", message)
    named = re.search(r"; (0\.\d+) times this amplitude would pass", message)
    assert named is not None
    scale = float(named[1])
    assert 0.1 < scale < 1.0
    assert proved(short(rig, WIDE, amplitude_scale=scale), rig).report.ok
    assert not proved(short(rig, WIDE, amplitude_scale=scale + 0.01), rig).report.ok


def test_a_piston_that_cannot_be_centred_is_refused_with_an_amplitude_that_can(rig: Rig) -> None:
    wider = SHORT.replace("0.8 V", "3.2 V")
    words = r"^short.yaml:6: step1: on the twin joint 2 cannot be centred"
    with pytest.raises(InputError, match=words) as caught:
        proved(short(rig, wider), rig)
    named = re.search(r"; (0\.\d+) times this amplitude would pass", str(caught.value))
    assert named is not None
    assert str(caught.value).endswith("; the twin uses nominal values")
    assert proved(short(rig, wider, amplitude_scale=float(named[1])), rig).report.ok


def test_a_step_that_no_amplitude_saves_says_so(rig: Rig) -> None:
    pressed = limited(rig, 2, pressure=(5.0e6, 6.9e6))  # the chambers rest at half the supply
    report = proved(short(pressed), pressed).report
    assert "no smaller amplitude was found to pass" in report.refused[0]


def test_check_says_that_nothing_changed_and_so_does_a_run_folder(tmp_path: Path) -> None:
    file = tmp_path / "short.yaml"
    file.write_text(SHORT)
    first = bramah_here("check", file, "--rig", RIG)
    again = bramah_here("check", file, "--rig", RIG)
    assert (first.returncode, again.returncode) == (0, 0), first.stderr + again.stderr
    assert "the kept proof stands" not in first.stdout
    assert again.stdout.strip() == (
        first.stdout.strip() + "\n\nnothing has changed since the last proof; it is shown again"
    )


def test_a_disk_that_will_not_hold_the_run_refuses_it_before_anything_moves(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = short(rig)
    needed = protocol_run.needed_bytes(plan, rig)
    recorded = 8.0 * len(rig.recorded) * rig.sample_rate * plan.seconds
    assert needed >= 2.0 * recorded  # the journal and the archive written from it
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(
        shutil, "disk_usage", lambda _: usage._replace(free=int(needed + protocol_run.SPARE) - 1)
    )
    job = ProtocolJob(str(tmp_path / "short.yaml"), RIG, tmp_path / "deep" / "run")
    (tmp_path / "short.yaml").write_text(SHORT)
    said: list[str] = []
    with pytest.raises(InputError, match=r"run: the run needs up to \d+ MB .*the disk has \d+ MB"):
        run_protocol(job, said.append)
    assert not (tmp_path / "deep").exists()
    assert not any("running" in line for line in said)
    monkeypatch.setattr(
        shutil, "disk_usage", lambda _: usage._replace(free=int(needed + protocol_run.SPARE) + 1)
    )
    protocol_run.require_space(plan, rig, tmp_path / "deep" / "run")
