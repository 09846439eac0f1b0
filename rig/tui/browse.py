"""Runs, protocols and the queue on the disk, as read for the screen."""

from __future__ import annotations

import re
import sqlite3
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from protocols.files.library import shipped_names
from rig.bench.latch import state_folder
from rig.model.parse import InputError
from rig.queue.items import Item
from rig.queue.store import QueueStore
from rig.runs.listing.index import indexed_runs
from rig.runs.listing.summary import RunSummary
from rig.tui.jobs import VerbJob
from rig.tui.recorded_run import RunLog, RunTrace

TABS: Final = ("protocols", "runs", "queue")
STEPS: Final = re.compile(rb"^steps:", re.MULTILINE)
SHIPPED_JOINTS: Final = 2  # of the rigs that the shipped `lock-and-excite` is for
READ_AT_MOST: Final = 1_000_000  # [bytes] of a file that are read to recognise a protocol


@dataclass(frozen=True)
class BrowserState:
    """Contents of the folder; `trouble` states in one line what cannot be read.

    `log` and `trace` are those of the run opened last; `job` is the newest verb started here, for
    `rig` (of so many `joints`) and `endpoint`.
    """

    folder: Path = Path()
    tab: int = 0
    protocols: tuple[str, ...] = ()
    runs: tuple[RunSummary, ...] = ()
    queue: tuple[Item, ...] = ()
    paused: str = ""
    trouble: str = ""
    reading: bool = False
    job: VerbJob | None = None
    log: RunLog | None = None
    trace: RunTrace | None = None
    rig: str = ""
    joints: int = SHIPPED_JOINTS
    endpoint: str | None = None

    @property
    def name(self) -> str:
        """The tab that is open."""
        return TABS[self.tab]

    @property
    def lines(self) -> int:
        """Number of lines of the open tab."""
        return len((self.protocols, self.runs, self.queue)[self.tab])


def read_disk(previous: BrowserState) -> BrowserState:
    """Read runs, queue and protocols; never raises: `trouble` states what cannot be read."""
    troubles: list[str] = []
    runs: tuple[RunSummary, ...] = ()
    queue: tuple[Item, ...] = ()
    paused = ""
    try:
        runs = tuple(reversed(indexed_runs(previous.folder)))  # the newest on top
    except (InputError, OSError) as error:
        troubles.append(str(error))
    path = state_folder() / "queue.sqlite"
    if path.is_file():
        try:
            with QueueStore(path, create=False) as store:
                queue, paused = tuple(store.items()), store.paused
        except (InputError, OSError, sqlite3.Error) as error:
            troubles.append(str(error))
    return replace(
        previous,
        protocols=(*protocol_files(previous.folder), *shipped_names()),
        runs=runs,
        queue=queue,
        paused=paused,
        trouble="; ".join(troubles),
        reading=False,
    )


def protocol_files(folder: Path) -> tuple[str, ...]:
    """Return the protocol files of a folder: YAML with `steps:` on a line that is not indented."""
    protocols = []
    for path in sorted(folder.glob("*.yaml")):
        with suppress(OSError), path.open("rb") as file:
            if STEPS.search(file.read(READ_AT_MOST)):
                protocols.append(str(path))
    return tuple(protocols)
