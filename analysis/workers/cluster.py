"""A Dask cluster as a pool: work runs where the data is, only results are transferred.

The scheduler and its workers are started by the machines' owner (docs/scale.md); this class only
connects. A worker must have this package installed, in this version, and see the folders under the
paths given.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Self, TypeVar

from analysis.workers.pool import Reads, in_order
from rig.model.parse import InputError

T = TypeVar("T")
U = TypeVar("U")

CONNECT_SECONDS = 10.0


class DaskCluster:
    """A pool of the workers behind a Dask scheduler at ``tcp://HOST:PORT``.

    Entering raises InputError where dask.distributed is not installed, where nothing answers at the
    address, or where there is no worker. A cluster lost later raises ConnectionError.
    """

    workers = 0

    def __init__(self, address: str, timeout: float = CONNECT_SECONDS) -> None:
        self.address = address
        self._timeout = timeout
        self._client: Any = None
        self._lost: tuple[type[BaseException], ...] = ()
        self._holders: dict[str, list[str]] = {}  # workers that see a path, by path

    def __enter__(self) -> Self:
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError as error:
            raise InputError(
                f"--cluster {self.address}: dask.distributed is not installed; "
                "install bramah[cluster]"
            ) from error
        if not self.address.startswith(("tcp://", "tls://")):
            raise InputError(f"--cluster {self.address}: expected one like tcp://127.0.0.1:8786")
        try:
            self._client = distributed.Client(
                self.address, timeout=self._timeout, set_as_default=False
            )
        except (OSError, ValueError) as error:  # a name that cannot be looked up is a ValueError
            raise InputError(
                f"--cluster {self.address}: no scheduler answers within {self._timeout:g} s; start "
                "one with `dask scheduler`"
            ) from error
        closed: Any = importlib.import_module("distributed.comm.core").CommClosedError
        self._lost = (distributed.KilledWorker, distributed.CancelledError, closed)
        self.workers = len(self._workers())
        if not self.workers:
            self.__exit__()
            raise InputError(
                f"--cluster {self.address}: the scheduler has no workers; start some with "
                f"`dask worker {self.address}`"
            )
        return self

    def __exit__(self, *_: object) -> None:
        client, self._client = self._client, None
        self._holders = {}
        if client is not None:
            client.close()

    def _workers(self) -> dict[str, Any]:
        # All of them: the default is to list a few.
        workers: dict[str, Any] = self._client.scheduler_info(n_workers=-1)["workers"]
        return workers

    def map(
        self, function: Callable[[T], U], items: Iterable[T], reads: Reads[T] | None = None
    ) -> Iterator[U]:
        """Yield function(item) in the items' order, each run by a worker that sees its path.

        `reads` names the path that an item needs. Raises InputError for a path that no worker sees.
        """
        if self._client is None:
            raise ValueError("use the cluster in a `with` block")

        def submit(item: T) -> Any:
            where = None if reads is None else self._holders_of(reads(item))
            return self._client.submit(function, item, workers=where, pure=False)

        try:
            yield from in_order(submit, items, self.workers)
        except self._lost as error:
            raise ConnectionError(
                f"the cluster at {self.address} lost the work: {error}"
            ) from error

    def _holders_of(self, path: str) -> list[str]:
        """Return the workers that see a path, queried once because busy workers answer late."""
        if path in self._holders:
            return self._holders[path]
        answers = self._client.run(_exists, path)
        holders = [worker for worker, exists in answers.items() if exists]
        if not holders:
            raise InputError(
                f"{path}: no worker of the cluster sees it (of {len(answers)}); give the path "
                "as the workers see it"
            )
        self._holders[path] = holders
        return holders


def _exists(path: str) -> bool:
    return Path(path).exists()
