"""Generated right-hand sides, compiled and cached on disk for later processes.

A folder per source, named by the hash of the source, of the versions of Python, numba, llvmlite and
numpy and of the processor. It holds the source, numba's own files and `checksums.json`, written
last. A folder is used only if every file matches its checksum and the source is the requested one;
otherwise it is deleted and written anew. The source executed is always the one in memory.
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
    """Return the hash of a source and of everything that its compiled code depends on."""
    versions = [platform.python_version(), *(f"{name} {version(name)}" for name in _LIBRARIES)]
    machine = [platform.machine(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()]
    text = "\n".join((*versions, *machine, source))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@functools.lru_cache(maxsize=256)
def stored(source: str) -> Any | None:
    """Return the compiled `rates` of a source if the disk has it undamaged, else None."""
    folder = cache_folder() / "rates" / key_of(source)
    if not folder.is_dir():
        return None
    if not _is_intact(folder, source):
        log.warning("%s: compiled code is damaged; it is deleted and compiled again", folder)
        shutil.rmtree(folder, ignore_errors=True)
        return None
    try:
        return _run(source, folder / _SOURCE)
    except Exception as error:  # numba raises exceptions of any class for files that it cannot read
        log.warning("%s: compiled code cannot be loaded (%s); it is compiled again", folder, error)
        shutil.rmtree(folder, ignore_errors=True)
        return None


@functools.lru_cache(maxsize=256)
def compiled_now(source: str, subject: str) -> Any:
    """Compile a source and cache it on disk; logs `subject` and the time it took."""
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
            # If another process was first, its folder is used and this one deleted.
            building.replace(root / key_of(source))
    except OSError as error:
        log.debug("%s is not kept: %s", building, error)
    finally:
        shutil.rmtree(building, ignore_errors=True)
    log.warning("compiled in %.1f s", time.perf_counter() - began)
    return compiled


def _run(source: str, path: Path) -> Any:
    """Execute a source as the file at `path`; numba compiles it, or loads it from that folder.

    Its files are in that folder whatever NUMBA_CACHE_DIR states, so that their checksums hold.
    """
    # numba finds the module of the code that it loads by this name.
    module = ModuleType(f"bramah_rates_{key_of(source)}")
    sys.modules[module.__name__] = module
    stated, config.CACHE_DIR = config.CACHE_DIR, ""
    try:
        exec(compile(source, str(path), "exec"), module.__dict__)
    finally:
        config.CACHE_DIR = stated
    return module.rates


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file() and p.name != _CHECKSUMS)


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _is_intact(folder: Path, source: str) -> bool:
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
