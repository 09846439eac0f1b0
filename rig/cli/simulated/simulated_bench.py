"""A simulated bench as a child process, and the file of its true parameters (`sim --truth`)."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from analysis.workers.pool import environment
from rig.bench.latch import STATE_VARIABLE
from rig.cli.errors import BAD_INPUT, WorkError
from rig.cli.text.output import write_json
from rig.model.parse import InputError
from rig.queue.processes import BRAMAH
from rig.runs.files import scratch_folder

_END_SECONDS = 10.0

SCENARIO: Final = "scenario"  # key beside the parameters' names


@contextmanager
def simulated_bench(
    rig: str,
    *,
    seed: int,
    truth: Path | None = None,
    real_time: bool = False,
    scenario: Path | str | None = None,
    wire: str = "modbus-tcp",
) -> Iterator[str]:
    """Start `bramah sim` on a wire and a free port, yield its endpoint, end it.

    Raises InputError where the child ended because of bad input, WorkError where it did not start
    for another reason. The child also ends by itself when this process ends.
    """
    words = ["sim", "--rig", rig, "--port", "0", "--seed", str(seed), "--parent", str(os.getpid())]
    words += ["--wire", wire]
    words += [] if truth is None else ["--truth", str(truth)]
    words += ["--real-time"] if real_time else []
    words += [] if scenario is None else ["--scenario", str(scenario)]
    with (
        scratch_folder() as folder,
        # A trip latched by an earlier simulated bench on the same port must not block this one.
        environment({STATE_VARIABLE: str(folder)}),
        subprocess.Popen(
            [*BRAMAH, *words],
            stdout=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
            text=True,
            # Ctrl-C must not reach the bench, which has to run until its outputs are zeroed.
            start_new_session=True,
        ) as child,
    ):
        assert child.stdout is not None
        try:
            endpoint = child.stdout.readline().strip()
            if not endpoint:
                error = InputError if child.wait(_END_SECONDS) == BAD_INPUT else WorkError
                raise error("the simulated bench did not start; its error message is above")
            yield endpoint
        finally:
            child.terminate()
            try:
                child.wait(_END_SECONDS)
            except subprocess.TimeoutExpired:
                child.kill()


def write_truth(path: Path | None, parameters: Mapping[str, float], scenario: Any) -> None:
    """Write true parameters [SI] by name and, under `scenario`, the hidden effects."""
    write_json(path, {**parameters, SCENARIO: scenario})


def read_truth(path: Path) -> dict[str, float]:
    """Read the parameters that `bramah sim --truth` wrote; raises InputError for other files."""
    try:
        truth = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): float(value) for name, value in truth.items() if name != SCENARIO}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path} cannot be read as true parameters ({error}); expected the JSON file that "
            "`bramah sim --truth` writes"
        ) from error
