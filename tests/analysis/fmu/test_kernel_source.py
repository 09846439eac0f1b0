"""Kernels in C do what the same kernels do in Python, and what has no translation is refused."""

from __future__ import annotations

import ctypes
import importlib
import math
import pkgutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import analysis.effects
import analysis.terms
from analysis.simulation.fmu.kernel_source import (
    KERNEL_KINDS,
    KernelLibrary,
    UntranslatableKernelError,
)
from analysis.terms.base import CONTRIBUTE, OUT_ROWS, PREPARE, X_ROWS, Kernel, kernel
from tests.drivers.firmware import compiler

N = 2
STATES, PARAMETERS = 8, 128


def every_kernel() -> dict[str, Kernel]:
    """Every kernel of the terms and of the catalogue, by module and name."""
    found: dict[str, Kernel] = {}
    for package in (analysis.terms, analysis.effects):
        for entry in pkgutil.iter_modules(package.__path__):
            module = importlib.import_module(f"{package.__name__}.{entry.name}")
            for name, value in vars(module).items():
                if isinstance(value, Kernel) and value.function.__module__ == module.__name__:
                    found[f"{entry.name}.{name}"] = value
    return found


@pytest.fixture(scope="module")
def in_c(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("kernels")
    library = KernelLibrary()
    exported = []
    for name, each in every_kernel().items():
        function = library.add(each.function, KERNEL_KINDS)
        exported.append(
            f"void {name.replace('.', '_')}(int phase, double *bench, double *x, double *z,"
            " double *par, double *out, double *M, double *dz)"
            f" {{ {function}(phase, bench, x, z, par, out, M, dz); }}"
        )
    tuples = "struct tuple2 { double v[2]; }; struct tuple3 { double v[3]; };"
    text = ["#include <math.h>", f"#define N {N}", tuples, library.source, *exported]
    (folder / "kernels.c").write_text("\n".join(text), encoding="utf-8")
    built = str(folder / "kernels.so")
    subprocess.run([*compiler(), "-std=c99", "-shared", "-fPIC", "-O1", "-fno-sanitize=all",
             str(folder / "kernels.c"), "-o", built, "-lm"], check=True)  # fmt: skip
    return ctypes.CDLL(built)


def state(rng: np.random.Generator) -> list[np.ndarray]:
    """Arguments of a kernel in the range of a bench: bench, x, z, par, out, M, dz."""
    x = np.zeros((X_ROWS, N))
    x[:4] = rng.uniform(-1, 1, (4, N))
    x[4:6] = rng.uniform(-0.2, 0.2, (2, N))
    x[6] = rng.uniform(-1, 1, N)
    x[7:9] = rng.uniform(0, 7e6, (2, N))
    x[9:11] = rng.uniform(1e-4, 1e-3, (2, N))
    par = rng.uniform(0.01, 2.0, PARAMETERS)
    par[0] = rng.integers(0, N)  # most kernels hold their joint there
    bench = np.array([0.3, 7e6, 0.0, 40.0])
    M = rng.uniform(0, 1, (N, N))
    return [bench, x, rng.uniform(-1e-5, 1e-5, STATES), par, np.zeros((OUT_ROWS, N)), M,
            np.zeros(STATES)]  # fmt: skip


@pytest.mark.parametrize("name", every_kernel())
def test_a_kernel_in_c_does_what_it_does_in_python(name: str, in_c: ctypes.CDLL) -> None:
    rng = np.random.default_rng(7)
    plain = every_kernel()[name].function
    for case in range(40):
        phase = (PREPARE, CONTRIBUTE)[case % 2]
        python, c = state(rng), []
        c = [array.copy() for array in python]
        plain(phase, *python)
        pointers = [a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in c]
        getattr(in_c, name.replace(".", "_"))(phase, *pointers)
        for wanted, found in zip(python, c, strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=0.0)


def test_some_kernel_changes_something(in_c: ctypes.CDLL) -> None:
    """The comparison above would pass for functions that do nothing."""
    arguments = state(np.random.default_rng(1))
    pointers = [a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in arguments]
    in_c.hydraulics__orifice(CONTRIBUTE, *pointers)
    assert np.abs(arguments[4]).max() > 0


@kernel
def _whole_division(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    out[0, 0] = par[0] // 2


@kernel
def _sorted(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    out[0, 0] = sorted(par)[0]


@kernel
def _gamma(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    out[0, 0] = math.gamma(par[0])


@pytest.mark.parametrize(
    ("wrong", "says"),
    [(_whole_division, "FloorDiv"), (_sorted, "sorted"), (_gamma, "math.gamma")],
)
def test_what_has_no_translation_is_refused_with_its_place(wrong: Kernel, says: str) -> None:
    with pytest.raises(UntranslatableKernelError, match=f"{wrong.function.__name__}.*{says}"):
        KernelLibrary().add(wrong.function, KERNEL_KINDS)


def test_the_folder_of_c_files_is_part_of_the_package() -> None:
    folder = Path(importlib.import_module("analysis.simulation.fmu").__file__ or "").parent / "c"
    assert {path.name for path in folder.iterdir()} >= {"bench_model.c", "fmi2.c", "fmi3.c"}
