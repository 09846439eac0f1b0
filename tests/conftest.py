"""No test reads or writes what the person's own benches left behind."""

from __future__ import annotations

import gc
import os
import signal

# As the command line does: threads of a linear solver wait busily for cores that others use.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Generator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from rig.bench.latch import STATE_VARIABLE
from rig.runs.files import CACHE_VARIABLE
from tests import forked
from tests.warm_up import compile_all

TESTS = Path(__file__).parent
# Folders whose tests wait for processes; the last files of the last one are short.
WAITING = ("tui", "cli", "drivers", "queue", "services")
# Equations compiled by one test serve the next, and those of the next day.
CACHE = TESTS.parent / ".equations_cache"

# A shell that starts the tests in the background has SIGINT ignored; programs that they start and
# stop by Ctrl-C would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# No test depends on how fast the machine is: an example may take what it takes.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")


def pytest_configure(config: pytest.Config) -> None:
    """Compile for all workers before the first starts, and import what their processes need."""
    if config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        compile_all(CACHE)
        forked.begin()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let workers mix files that wait for other processes with those that compute, to the end.

    A worker takes the next file when it has done one.
    """
    if not hasattr(config, "workerinput"):
        return
    files = dict.fromkeys(item.path for item in items)
    folder = {path: path.relative_to(TESTS).parts[0] for path in files}
    computing = [path for path in files if folder[path] not in WAITING]
    waiting = [path for name in WAITING for path in files if folder[path] == name]
    place = {
        path: (k + 0.5) / len(kind) for kind in (computing, waiting) for k, path in enumerate(kind)
    }
    items.sort(key=lambda item: place[item.path])


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Leave imported objects, which stay, out of all later garbage collections."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _state_folder(tmp_path_factory: pytest.TempPathFactory):
    """A state folder for what runs in fixtures that several tests share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(STATE_VARIABLE, str(tmp_path_factory.mktemp("state")))
        patch.setenv(CACHE_VARIABLE, str(CACHE))
        yield


@pytest.fixture(autouse=True)
def state(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A state folder of the test's own: its processes inherit it."""
    folder = tmp_path_factory.mktemp("state")
    monkeypatch.setenv(STATE_VARIABLE, str(folder))
    return folder
