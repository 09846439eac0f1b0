"""The generated right-hand side: the same numbers as term by term, from a cache nobody trusts."""

from __future__ import annotations

import logging
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from analysis.effects.base import Effect
from analysis.simulation import compiled_sources, fused, interpreted
from analysis.simulation import equations as eq
from analysis.simulation.model import Model, model_of
from analysis.simulation.simulate import Compiled, DrivingInput, Effort, State, compiled, simulate
from analysis.terms import base, baseline_of, known
from analysis.terms.base import Coefficient, Kernel, Term, Used, kernel
from analysis.terms.specialise import NotSpecialisable
from rig.model.rig import Rig
from rig.runs.files import CACHE_VARIABLE
from rig.runs.rigs import load_rig
from tests.forked import ROOT, Forked
from tests.variants import kept

RIGS = ("boom-1dof", "shinshu-2dof", "digger-3dof", "electric-2dof")
PLACES = ("bench", "joint 2", "joint 2 cap", "joint 2 piston")


def plausible(rig: Rig, terms: Sequence[Used], seed: int) -> Model:
    """A model of the terms with inertias that are possible and the rest drawn at random."""
    rng = np.random.default_rng(seed)
    values = {
        c.parameter: float(rng.uniform(0.5, 2.0))
        for used in terms
        for c in (*used.term.coefficients(rig), *used.term.parameters(rig))
    }
    values |= dict(rig.nominal)
    return model_of(rig, terms, values)


def at(effect: type[Effect], rig: Rig) -> Used:
    """An effect at the last of `PLACES` that it takes, with a shape from its bounds' midst."""
    for where in reversed(PLACES):
        try:
            term = effect(where)
            shape = tuple(s.middle for s in term.shapes(rig))
            model_of(rig, (Used(term, shape),), {})
            plausible_pack(rig, Used(term, shape))
        except (ValueError, KeyError, IndexError):
            continue
        return Used(term, shape)
    raise AssertionError(f"{effect.name} is at home nowhere")


def plausible_pack(rig: Rig, used: Used) -> np.ndarray:
    values = plausible(rig, (*map(Used, baseline_of(rig)), used), 0).values
    return used.term.pack(rig, values, used.shape)


def effects(rig: Rig) -> list[Used]:
    return [at(term, rig) for term in known().values() if issubclass(term, Effect)]


class Evaluated:
    """One model's right-hand side at random states, under random inputs, locked or not."""

    def __init__(self, rig: Rig, model: Model) -> None:
        self.rig, self.model, self.N = rig, model, len(rig.joints)
        self.packed = [u.term.pack(rig, model.values, u.shape) for u in model.terms]
        self.hidden = [u.term.hidden(rig) for u in model.terms]
        self.geometry = compiled(plausible(rig, [*map(Used, baseline_of(rig))], 0)).geometry
        self.electric = [bool(g != 0.0) for g in self.geometry[:, eq.GAIN]]

    @property
    def source(self) -> str:
        return fused.source_of(self.model.terms, self.packed, self.hidden, self.electric)

    def states(self, seed: int) -> dict[str, Any]:
        rng, N = np.random.default_rng(seed), self.N
        q = rng.normal(0, 0.05, N) + [
            0.0 if drive else float(joint.linkage.angle(0.0))
            for joint, drive in zip(self.rig.joints, self.electric, strict=True)
        ]
        pressures = rng.uniform(-2e5, 8e6, 2 * N)
        y = np.concatenate(
            (q, rng.normal(0, 0.5, N), pressures, rng.normal(0, 1e-5, sum(self.hidden)))
        )
        inputs = rng.normal(0, 0.05, (5, 3 + 4 * N))
        inputs[:, 0], inputs[:, 1] = rng.uniform(6e6, 8e6, 5), rng.uniform(20, 60, 5)
        inputs[:, 2 + N : 2 + 2 * N] += q
        return {
            "t": float(rng.uniform(0, 6e-3)), "y": y, "inputs": inputs, "rate": 1000.0,
            "locked": rng.uniform(size=N) < 0.3,
        }  # fmt: skip

    def by(self, rates: Any, context: np.ndarray, seed: int) -> tuple[int, np.ndarray]:
        now = self.states(seed)
        dy = np.zeros_like(now["y"])
        status = eq.evaluate(
            rates.address, now["t"], now["y"], dy, now["inputs"], now["rate"], now["locked"],
            self.geometry, np.concatenate(self.packed), context,
            np.zeros(interpreted.work_size(self.N)),
        )  # fmt: skip
        return status, dy

    def term_by_term(self, seed: int) -> tuple[int, np.ndarray]:
        context = interpreted.context(self.N, self.model.terms, self.packed, self.hidden)
        return self.by(interpreted.compiled_rates(), context, seed)

    def in_python(self, seed: int) -> tuple[int, np.ndarray]:
        """The generated source as Python runs it, compiled by nobody."""
        text = re.sub(r"@cfunc\(.*\)|@njit\(.*\)", "", self.source)
        names: dict[str, Any] = {}
        exec(text, names)
        now = self.states(seed)
        dy = np.zeros_like(now["y"])
        with np.errstate(all="ignore"):
            status = names["rates"](
                now["t"], now["y"], dy, now["inputs"].ravel(), len(now["inputs"]), now["rate"],
                now["locked"].astype(np.uint8), self.geometry.ravel(),
                np.concatenate(self.packed), None, None,
            )  # fmt: skip
        return status, dy


def assert_alike(one: tuple[int, np.ndarray], other: tuple[int, np.ndarray]) -> None:
    assert one[0] == other[0]
    if one[0] == eq.OK:
        np.testing.assert_allclose(one[1], other[1], rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", RIGS)
def test_every_rigs_own_equations_are_those_of_its_terms(name: str) -> None:
    rig = load_rig(name)
    subject = Evaluated(rig, plausible(rig, [*map(Used, baseline_of(rig))], 3))
    for seed in range(20):
        assert_alike(subject.in_python(seed), subject.term_by_term(seed))


def test_every_effect_can_be_written_out_and_keeps_its_numbers() -> None:
    rig = load_rig("shinshu-2dof")
    for used in effects(rig):
        terms = (*map(Used, baseline_of(rig)), used)
        subject = Evaluated(rig, plausible(rig, terms, 4))
        for seed in range(6):
            assert_alike(subject.in_python(seed), subject.term_by_term(seed))


@settings(max_examples=40)
@given(st.integers(0, 10**6))
@pytest.mark.slow
def test_compiled_with_every_effect_at_once_not_a_bit_differs(seed: int) -> None:
    rig = load_rig("shinshu-2dof")
    terms = (*map(Used, baseline_of(rig)), *effects(rig))
    subject = Evaluated(rig, plausible(rig, terms, 5))
    source = subject.source
    own = compiled_sources.stored(source) or compiled_sources.compiled_now(source, "all effects")
    status, dy = subject.by(own, np.zeros(1, dtype=np.int64), seed)
    expected, by_terms = subject.term_by_term(seed)
    assert status == expected
    if status == eq.OK:
        np.testing.assert_array_equal(dy, by_terms)


def test_the_source_holds_neither_loops_nor_arrays_of_its_own() -> None:
    rig = load_rig("digger-3dof")
    subject = Evaluated(rig, plausible(rig, [*map(Used, baseline_of(rig))], 3))
    assert " for " not in subject.source
    assert "np.zeros" not in subject.source


# A term from outside, as a plug-in would bring it.


@njit(cache=False)
def _twice(x):
    return x + x


@dataclass(frozen=True)
class Brake(Term):
    """Torque against a joint's motion with an early end, a helper and a place in it."""

    name: ClassVar[str] = "test_brake"
    per_joint: ClassVar[bool] = True

    @property
    def kernel(self) -> Kernel:
        return _brake

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        return (Coefficient("brake", "N*m", "mechanical"),)

    def pack(self, rig: Rig, values: Any, shape: Any) -> np.ndarray:
        return np.array([self.joint, values["brake"]])


@kernel
def _brake(phase, bench, x, z, par, out, M, dz):
    if phase != base.CONTRIBUTE:
        return
    i = int(par[0])
    if x[base.QD, i] > 0.0:
        out[base.TORQUE, i] -= _twice(par[1])
        return
    for k in range(x.shape[1]):
        if k > i:
            continue
        out[base.TORQUE, k] += par[1] * math.cos(x[base.THETA, k])


class Odd(Brake):
    """A term whose kernel does what no fixed place exists for."""

    name: ClassVar[str] = "test_odd"

    @property
    def kernel(self) -> Kernel:
        return _odd


@kernel
def _odd(phase, bench, x, z, par, out, M, dz):
    if phase == base.CONTRIBUTE:
        k = 0
        while k < x.shape[1]:
            out[base.TORQUE, k] -= par[1]
            k += 1


def test_a_new_term_is_one_class_wherever_it_stands() -> None:
    rig = load_rig("shinshu-2dof")
    for where in ("joint 1", "joint 2"):
        terms = (*map(Used, baseline_of(rig)), Used(Brake(where)))
        subject = Evaluated(rig, plausible(rig, terms, 6))
        for seed in range(8):
            assert_alike(subject.in_python(seed), subject.term_by_term(seed))


def test_a_kernel_that_cannot_be_written_out_is_simulated_term_by_term(
    caplog: pytest.LogCaptureFixture,
) -> None:
    rig = load_rig("shinshu-2dof")
    model = plausible(rig, (*map(Used, baseline_of(rig)), Used(Odd("joint 1"))), 6)
    subject = Evaluated(rig, model)
    with pytest.raises(NotSpecialisable, match="while"):
        _ = subject.source
    with caplog.at_level(logging.INFO):
        assert not compiled(model, Effort.FIT).fused
    assert "term by term" in caplog.text


# What is kept on disk.


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of the test's own, and a process that remembers nothing."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    forget()
    yield tmp_path
    forget()


def forget() -> None:
    compiled_sources.stored.cache_clear()
    compiled_sources.compiled_now.cache_clear()


def small() -> tuple[Model, DrivingInput, State]:
    rig = load_rig("boom-1dof")
    model = model_of(rig, [*map(Used, baseline_of(rig))], rig.nominal)
    still, one = np.zeros((30, 1)), np.full((30, 1), 0.01)
    drive = DrivingInput(
        1000.0, one, np.full(30, 7e6), np.full(30, 40.0), np.array([False]), still, still, still
    )
    angle = float(rig.joints[0].linkage.angle(0.0))
    return model, drive, State(*(np.array([v]) for v in (angle, 0.0, 3.5e6, 3.5e6)))


def run_small() -> tuple[Compiled, np.ndarray]:
    model, drive, start = small()
    ready = compiled(model)
    return ready, simulate(ready, drive, start).q


def test_the_first_use_says_that_it_compiles_and_the_second_does_not(
    cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first, q = run_small()
    assert first.fused
    assert "compiling the equations of 1 joint" in caplog.text
    assert re.search(r"compiled in \d+\.\d s", caplog.text)
    caplog.clear()
    forget()
    again, same = run_small()
    assert again.fused
    assert again.rates is not first.rates
    assert again.rates.cache_hits == 1  # numba loaded what it compiled before
    assert caplog.text == ""
    np.testing.assert_array_equal(q, same)


@pytest.mark.parametrize(
    ("damage", "victim"),
    kept(
        product(("cut", "changed", "gone"), ("*.nbc", "*.nbi", "rates.py", "checksums.json")),
        (5,),
    ),
)
def test_a_damaged_cache_is_made_again_and_the_numbers_stay(
    cache: Path, caplog: pytest.LogCaptureFixture, victim: str, damage: str
) -> None:
    q = run_small()[1]
    for path in [p for p in cache.rglob(victim) if p.is_file()]:
        whole = path.read_bytes()
        if damage == "gone":
            path.unlink()
        elif damage == "cut":
            path.write_bytes(whole[: len(whole) // 2])
        else:
            middle = len(whole) // 2
            path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    forget()
    caplog.clear()
    ready, same = run_small()
    assert ready.fused
    assert "damaged" in caplog.text
    assert "compiling" in caplog.text
    np.testing.assert_array_equal(q, same)
    forget()
    caplog.clear()
    run_small()
    assert caplog.text == ""  # and what was made again is whole


def test_a_folder_that_numba_is_to_use_for_its_files_harms_no_compiled_code(
    cache: Path, caplog: pytest.LogCaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NUMBA_CACHE_DIR is set: the code stands beside its checksums all the same."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "numba"))
    q = run_small()[1]
    forget()
    caplog.clear()
    np.testing.assert_array_equal(run_small()[1], q)
    assert caplog.text == ""
    assert str(tmp_path / "numba") == numba.config.CACHE_DIR


def test_code_that_belongs_to_another_source_is_never_run(
    cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Another set's folder under this set's name, checksums and all."""
    q = run_small()[1]
    (mine,) = (cache / "rates").iterdir()
    forget()
    rig = load_rig("electric-2dof")
    compiled(plausible(rig, [*map(Used, baseline_of(rig))], 1))
    (other,) = {*(cache / "rates").iterdir()} - {mine}
    name = mine.name
    mine.rename(cache / "aside")
    other.rename(cache / "rates" / name)
    forget()
    caplog.clear()
    np.testing.assert_array_equal(run_small()[1], q)
    assert "damaged" in caplog.text


def test_a_cache_that_cannot_be_written_costs_time_and_no_more(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (cache / "file").write_text("in the way")
    monkeypatch.setenv(CACHE_VARIABLE, str(cache / "file"))
    assert run_small()[0].fused
    assert "cannot be written" in caplog.text


def test_two_processes_that_compile_at_once_leave_one_whole_folder(cache: Path) -> None:
    children = [Forked((), ROOT, __name__, told=True) for _ in range(2)]
    found = [child.communicate(timeout=120)[0].strip() for child in children]
    assert found[0] == found[1] != ""
    assert len([*(cache / "rates").iterdir()]) == 1
    forget()
    assert compiled_sources.stored(_small_source()) is not None


def _small_source() -> str:
    rig = load_rig("boom-1dof")
    model = model_of(rig, [*map(Used, baseline_of(rig))], rig.nominal)
    return Evaluated(rig, model).source


if __name__ == "__main__":
    sys.stdout.write(run_small()[1].tobytes().hex())
