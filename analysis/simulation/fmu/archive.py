"""A mock-up unit as a file: description, C sources, libraries for Linux and Windows, in one zip."""

from __future__ import annotations

import hashlib
import importlib.util
import itertools
import logging
import re
import subprocess
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Final

from analysis.simulation.fmu.description import build_description, description_2, description_3
from analysis.simulation.fmu.kernel_source import UntranslatableKernelError
from analysis.simulation.fmu.model_header import model_header
from analysis.simulation.fmu.variables import unit_variables
from analysis.simulation.model import Model
from rig.model.parse import InputError

logger = logging.getLogger(__name__)

VERSIONS: Final = (2, 3)
COMPILER: Final = "ziglang"  # the package that brings a C compiler for every target
SECONDS: Final = 900.0  # [s] for one library; the first one compiles the target's C library as well
_FIXED_DATE: Final = (1980, 1, 1, 0, 0, 0)  # so that the same model makes the same file


@dataclass(frozen=True)
class Target:
    """A machine that a unit runs on: the compiler's name, file ending, folder in either version."""

    name: str
    ending: str
    folders: tuple[str, str]


# With the C library of 2012 the library loads on any Linux since.
LINUX: Final = Target("x86_64-linux-gnu.2.17", "so", ("linux64", "x86_64-linux"))
WINDOWS: Final = Target("x86_64-windows-gnu", "dll", ("win64", "x86_64-windows"))
TARGETS = (LINUX, WINDOWS)


class CompilationError(Exception):
    """A library could not be compiled; names the target and holds the compiler's output."""


def compiler_missing() -> bool:
    """Return whether the package of the C compiler is not installed."""
    return importlib.util.find_spec(COMPILER) is None


def write_fmus(
    model: Model,
    folder: Path,
    name: str,
    about: str,
    targets: Sequence[Target] = TARGETS,
    progress: Callable[[str], None] = logger.info,
) -> list[Path]:
    """Write NAME-fmi2.fmu and NAME-fmi3.fmu of an identified model; return the files.

    Each holds a library for every target and the C sources; no Python is needed where it runs.
    `about` states in a line what the model was identified from; `progress` is called with a line
    before each library is compiled. Raises InputError where a parameter is not identified or a term
    has no translation into C, CompilationError where the compiler fails.
    """
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
    identifier = identifier if identifier[:1].isalpha() else f"m_{identifier}"
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    steps = itertools.count(1)

    def announce(version: int, target: Target) -> None:
        total = len(VERSIONS) * len(targets)
        progress(f"compiling {next(steps)} of {total}: FMI {version} for {target.name}")

    for version in VERSIONS:
        content = _content(model, identifier, about, version, targets, announce)
        files.append(folder / f"{name}-fmi{version}.fmu")
        with zipfile.ZipFile(files[-1], "w") as archive:
            for path, data in content.items():
                entry = zipfile.ZipInfo(path, _FIXED_DATE)
                archive.writestr(entry, data, zipfile.ZIP_DEFLATED)
    return files


def _content(
    model: Model,
    identifier: str,
    about: str,
    version: int,
    targets: Sequence[Target],
    announce: Callable[[int, Target], None],
) -> dict[str, bytes]:
    """Return the unit's files by their paths in the archive."""
    variables = unit_variables(model)
    try:
        header = model_header(model, variables, "")
    except UntranslatableKernelError as error:
        raise InputError(f"the model cannot be exported as C: {error}") from error
    digest = hashlib.sha256(f"{version} {identifier} {header}".encode()).digest()
    token = f"{{{uuid.UUID(bytes=digest[:16])}}}"
    folder = resources.files("analysis.simulation.fmu") / "c"
    names = (f"fmi{version}.c", "bench_model.c", "variables.h")
    sources = {name: (folder / name).read_text(encoding="utf-8") for name in names}
    sources["model.h"] = model_header(model, variables, token)
    describe = description_2 if version == 2 else description_3
    step = 1.0 / model.rig.sample_rate
    text = describe(identifier, about, token, step, variables)  # may name a file not in UTF-8
    content = {"modelDescription.xml": text.encode("utf-8", "backslashreplace")}
    content |= {f"sources/{file}": text.encode() for file, text in sources.items()}
    if version == 3:
        content["sources/buildDescription.xml"] = build_description(identifier).encode()
    for target in targets:
        announce(version, target)
        platform = target.folders[VERSIONS.index(version)]
        library = _compiled(sources, f"fmi{version}.c", target.name)
        content[f"binaries/{platform}/{identifier}.{target.ending}"] = library
    return content


def _compiled(sources: dict[str, str], main: str, target: str) -> bytes:
    """Return the shared library of the sources for a target."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in sources.items():
            Path(folder, name).write_text(text, encoding="utf-8")
        command = [
            sys.executable, "-m", COMPILER, "cc", "-std=c99", "-O2", "-shared", "-fPIC", "-s",
            "-fvisibility=hidden", "-target", target, "-o", "library", main, "-lm",
        ]  # fmt: skip
        try:
            compilation = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, timeout=SECONDS, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise CompilationError(f"no library for {target} after {SECONDS:g} s") from error
        library = Path(folder, "library")
        if compilation.returncode or not library.is_file():
            raise CompilationError(f"no library for {target}: {compilation.stderr.strip()[-2000:]}")
        return library.read_bytes()
