"""A simulated bench as a child process, for the demo and the figures."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rig.cli.errors import WorkError

_START = "from rig.cli.main import run; run()"
_END_SECONDS = 10.0


@contextmanager
def simulated_bench(
    rig: str,
    *,
    seed: int,
    truth: Path | None = None,
    real_time: bool = False,
    scenario: Path | str | None = None,
) -> Iterator[str]:
    """Start `bramah sim` on a free port, yield its endpoint, end it; raises WorkError if it fails.

    The child also ends by itself when this process is gone.
    """
    words = ["sim", "--rig", rig, "--port", "0", "--seed", str(seed), "--parent", str(os.getpid())]
    words += [] if truth is None else ["--truth", str(truth)]
    words += ["--real-time"] if real_time else []
    words += [] if scenario is None else ["--scenario", str(scenario)]
    with subprocess.Popen(
        [sys.executable, "-c", _START, *words],
        stdout=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        # A Ctrl-C at the terminal is for us; the bench must live until its outputs are zeroed.
        start_new_session=True,
    ) as child:
        assert child.stdout is not None
        try:
            endpoint = child.stdout.readline().strip()
            if not endpoint:
                child.wait(_END_SECONDS)
                raise WorkError("the simulated bench did not start; its reason stands above")
            yield endpoint
        finally:
            child.terminate()
            try:
                child.wait(_END_SECONDS)
            except subprocess.TimeoutExpired:
                child.kill()
