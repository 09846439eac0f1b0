"""A host in a process of its own that drives a bench's first output until it is ended."""

from __future__ import annotations

import sys

from drivers.base import OFF, OutputLaw
from drivers.registry import make_driver
from rig.model.parts import Wire
from tests.drivers.wires import ROOT
from tests.forked import Forked
from tests.hil_sim.integrator import seed_rig

PATIENCE = 20.0  # [s] the driver's timeout: a loaded machine may take long


def driving_host(kind: str, key: str, place: str, watchdog: float) -> Forked:
    """Start the host on a wire whose setting `key` is `place`; return it once it drives."""
    words = (kind, key, place, watchdog)
    process = Forked(words, ROOT, "tests.drivers.driving_host", told=True)
    assert process.stdout.readline() == "driving\n"
    return process


def main(kind: str, key: str, place: str, watchdog: str) -> None:
    """Drive the first output; write "driving" as long as its voltage is there."""
    settings = {key: place, "timeout": PATIENCE, "watchdog": float(watchdog)}
    driver = make_driver(Wire.model_validate({"kind": kind, **settings}), seed_rig())
    driver.connect()
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    while True:
        if driver.read_block().data[-1, 10] > 0.9:
            sys.stdout.write("driving\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
