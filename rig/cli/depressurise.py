"""The `depressurise` verb: the pressure let out where the rig can."""

from __future__ import annotations

from rig.cli.device import device_of
from rig.cli.options import EndpointOption, RigOption
from rig.cli.stop import stop


def depressurise(rig: RigOption, endpoint: EndpointOption = None) -> None:
    """Let the pressure out where the rig can; zeroes the outputs first.

    Example: bramah depressurise --rig shinshu-2dof
    """
    from rig.bench import probe as bench
    from rig.cli.errors import WorkError

    stop(rig, endpoint)
    described, driver = device_of(rig, endpoint)
    pressurised = bench.pressurised(bench.probe(driver, described))
    if pressurised:
        raise WorkError(
            f"rig {described.name!r} describes no way to let the pressure out: stop the pump and "
            f"open the relief by hand; still under pressure: {', '.join(pressurised)}"
        )
