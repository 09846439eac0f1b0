"""The `depressurise` verb: pressures released, if the rig describes how."""

from __future__ import annotations

from rig.cli.execution.device import device_of, only_bench, pressure_text
from rig.cli.options import EndpointOption, KnownRigOption
from rig.cli.verbs.stop import NOT_IN_USE, stop


def depressurise(rig: KnownRigOption = None, endpoint: EndpointOption = None) -> None:
    """Zero the outputs, then release the pressures, if the rig file describes how.

    Example: bramah depressurise --rig shinshu-2dof
    """
    from rig.bench import probe as bench
    from rig.bench.latch import rigs_to_stop
    from rig.cli.errors import WorkError

    driven = rigs_to_stop()  # before their runs are ended
    stop(rig, endpoint)
    if rig is None:
        rig = str(only_bench(driven, NOT_IN_USE, "in use"))
    described, driver = device_of(rig, endpoint)
    if left := pressure_text(bench.probe(driver, described)):
        raise WorkError(
            f"rig {described.name!r} describes no way to release the pressure: stop the pump and "
            f"open the relief valve by hand; {left}"
        )
