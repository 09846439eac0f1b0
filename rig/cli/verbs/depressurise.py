"""The `depressurise` verb: pressures released, if the rig describes how."""

from __future__ import annotations

from rig.cli.execution.device import device_of
from rig.cli.options import EndpointOption, RigOption
from rig.cli.verbs.stop import stop


def depressurise(rig: RigOption, endpoint: EndpointOption = None) -> None:
    """Zero the outputs, then release the pressures, if the rig file describes how.

    Example: bramah depressurise --rig shinshu-2dof
    """
    from rig.bench import probe as bench
    from rig.cli.errors import WorkError

    stop(rig, endpoint)
    described, driver = device_of(rig, endpoint)
    pressurised = bench.pressurised(bench.probe(driver, described))
    if pressurised:
        raise WorkError(
            f"rig {described.name!r} describes no way to release the pressure: stop the pump and "
            f"open the relief valve by hand; still under pressure: {', '.join(pressurised)}"
        )
