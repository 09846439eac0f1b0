"""The integrator's bench on a serial line, in a process of its own.

``python -m tests.hil_sim.serial_bench realtime|virtual [parent]`` prints its endpoint.
"""

from __future__ import annotations

import sys

from hil_sim.device.lifetime import ParentProcess
from hil_sim.device.server import SERIAL, serve
from tests.hil_sim.integrator import IntegratorPlant, seed_rig


def main() -> None:
    """Serve the plant, print the endpoint first."""
    parent = ParentProcess(int(sys.argv[2])) if len(sys.argv) > 2 else None
    rig = seed_rig()
    serve(
        rig,
        IntegratorPlant(rig),
        wire=SERIAL,
        realtime=sys.argv[1] == "realtime",
        on_ready=lambda endpoint: print(endpoint, flush=True),  # noqa: T201
        parent=parent,
    )


if __name__ == "__main__":
    main()
