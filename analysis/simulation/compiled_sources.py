"""Generated right-hand sides, compiled, and kept on disk for the next process.

A folder per source, named by the hash of the source, of the versions of Python, numba, llvmlite and
numpy and of the processor. In it stand the source, numba's own files and `checksums.json`, written
last. A folder counts only if every file has its checksum and the source is the one asked for;
anything else is deleted and made again. The source that runs is the one in memory in any case.
"""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import platform
import shutil
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import llvmlite.binding as llvm  # type: ignore[import-untyped]
from numba import config

from rig.runs.files import cache_folder

log = logging.getLogger(__name__)

_SOURCE, _CHECKSUMS = "rates.py", "checksums.json"
_LIBRARIES: Final = ("numba", "llvmlite", "numpy")


def key_of(source: str) -> str:
    """Return the hash of a source and of what compiles it."""
    versions = [platform.python_version(), *(f"{name} {version(name)}" for name in _LIBRARIES)]
    machine = [platform.machine(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()]
    whole = "\n".join((*versions, *machine, str(config.CACHE_DIR), source))
    return hashlib.sha256(whole.encode()).hexdigest()[:32]


@functools.lru_cache(maxsize=256)
def stored(source: str) -> Any | None:
    """Return the compiled `rates` of a source if the disk has it unharmed, else None."""
    folder = cache_folder() / "rates" / key_of(source)
    if not folder.is_dir():
        return None
    if not _unharmed(folder, source):
        log.warning("%s: compiled code is damaged; it is deleted and made again", folder)
        shutil.rmtree(folder, ignore_errors=True)
        return None
    try:
        return _run(source, folder / _SOURCE)
    except Exception as error:  # numba raises what it likes over files that it cannot read
        log.warning("%s: compiled code cannot be loaded (%s); it is made again", folder, error)
        shutil.rmtree(folder, ignore_errors=True)
        return None


@functools.lru_cache(maxsize=256)
def compiled_now(source: str, subject: str) -> Any:
    """Compile a source and keep it on disk; says that it does, for `subject`, and how long."""
    log.warning("compiling the equations of %s (once on this computer) ...", subject)
    began = time.perf_counter()
    root = cache_folder() / "rates"
    try:
        root.mkdir(parents=True, exist_ok=True, mode=0o700)
        building = Path(tempfile.mkdtemp(prefix="making-", dir=root))
    except OSError as error:
        log.warning("%s cannot be written (%s): compiled for this process only", root, error)
        building = Path(tempfile.mkdtemp(prefix="bramah-rates-"))
    try:
        (building / _SOURCE).write_text(source, encoding="utf-8")
        compiled = _run(source, building / _SOURCE)
        sums = {str(p.relative_to(building)): _checksum(p) for p in _files(building)}
        (building / _CHECKSUMS).write_text(json.dumps(sums), encoding="utf-8")
        if building.parent == root:
            # Where another process was first, its folder stays and this one goes.
            building.replace(root / key_of(source))
    except OSError as error:
        log.debug("%s is not kept: %s", building, error)
    finally:
        shutil.rmtree(building, ignore_errors=True)
    log.warning("compiled in %.1f s", time.perf_counter() - began)
    return compiled


def _run(source: str, path: Path) -> Any:
    """Execute a source as the file at `path`; numba compiles it, or loads it from beside it."""
    # By its name numba finds the module again whose code it loads.
    module = ModuleType(f"bramah_rates_{key_of(source)}")
    sys.modules[module.__name__] = module
    exec(compile(source, str(path), "exec"), module.__dict__)
    return module.rates


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file() and p.name != _CHECKSUMS)


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _unharmed(folder: Path, source: str) -> bool:
    try:
        expected = json.loads((folder / _CHECKSUMS).read_text(encoding="utf-8"))
        checksums = {str(p.relative_to(folder)): _checksum(p) for p in _files(folder)}
        return bool(
            checksums == expected
            and len(checksums) > 1
            and (folder / _SOURCE).read_text(encoding="utf-8") == source
        )
    except (OSError, ValueError):
        return False
