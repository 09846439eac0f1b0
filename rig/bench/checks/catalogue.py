"""Every check in words: quantity, threshold, delay, message and advice.

The table in docs/safety.md is generated from this catalogue.
"""

from __future__ import annotations

from dataclasses import dataclass

from rig.bench.settings import GuardSettings
from rig.model import trips


@dataclass(frozen=True)
class CheckText:
    """One check: `limit` is its name in trips and alarms, `key` its key in the rig file."""

    limit: str
    key: str
    default: str
    delay: str
    acts: str
    sentence: str
    remedy: str


def catalogue(settings: GuardSettings | None = None) -> tuple[CheckText, ...]:
    """Return the checks in the order of the page."""
    s = settings or GuardSettings()
    warn_delay = f"trip: none; warning: {s.warning_delay:g} s"
    lasting = f"{s.window:g} s window, lasting {s.confirm:g} s"
    both, trip, warn = "trip, warning", "trip", "warning"
    return (
        CheckText(
            "pressure", "limits.pressure", "warning at 90 % of the limit", warn_delay, both,
            "A chamber pressure is outside its band.",
            "Lower amplitude or load; check relief valve and sensor.",
        ),
        CheckText(
            "piston", "limits.piston", "warning at 90 % of the limit", warn_delay, both,
            "An excited piston leaves the range it may use.",
            "Lower the amplitude; see whether the piston drifts off its centre.",
        ),
        CheckText(
            "stroke end", "cylinder.stroke", "2 % of the stroke past its end", "none", trip,
            "A piston reads past the end of its stroke.",
            "Check the position sensor: offset, mounting, wiring.",
        ),
        CheckText(
            "lock", "tolerance of the lock", "twice the tolerance; warning at 90 % of that",
            warn_delay, both, "A locked joint moves.",
            "Keep away; look for a leaking valve or cylinder, or a joint that works against it.",
        ),
        CheckText(
            "piston speed", "limits.speed", "warning at 90 % of the limit", "none", both,
            "A piston is faster than allowed, or its signal jumps.",
            "Lower the amplitude; a jump is a loose plug or a swapped channel.",
        ),
        CheckText(
            "pressure rate", "limits.pressure_rate", "warning at 90 % of the limit", "none", both,
            "A pressure rises or falls faster than allowed, or its signal jumps.",
            "Look for an impact at an end stop; a jump is a loose plug or a swapped channel.",
        ),
        CheckText(
            "command", "limits.command", "the limit, one step of the converter more", "none", trip,
            "The device puts out more than the limit.",
            "Do not use this device: it does not keep the bound it was given.",
        ),
        CheckText(
            "spool", "alarms.channels", "none", warn_delay, both,
            "A spool is outside the band that the rig file sets.",
            "See what commands it, and whether the band is right.",
        ),
        CheckText(
            "supply pressure", "limits.supply_pressure",
            f"trip: none; warning outside {100 * s.supply_warning[0]:g} to "
            f"{100 * s.supply_warning[1]:g} % of supply.pressure",
            warn_delay, both, "The supply pressure is outside its band.",
            "Check pump, relief valve and accumulator; a demand above the pump's flow lowers it.",
        ),
        CheckText(
            "oil temperature", "limits.oil_temperature",
            f"trip: none; warning {s.oil_warning:g} times oil.temperature_band off oil.temperature",
            warn_delay, both, "The oil is warmer or colder than the rig file expects.",
            "Warm the oil up, or switch the cooler on; parameters hold at their own temperature.",
        ),
        CheckText(
            trips.FINITE, "", "every sample", "none", trip, "A sample is not a number.",
            "Look at the driver and the device: this is no measurement.",
        ),
        CheckText(
            trips.SATURATED, "sensors.range",
            f"{s.saturated_samples} samples in a row, {s.saturated_samples_vacuum} at the vacuum "
            "end of a pressure sensor",
            "none", trip, "A sensor stands at the end of its range: blind, or its wire is broken.",
            "Check plug and wire; if the value is real, the sensor's range is too small.",
        ),
        CheckText(
            trips.GAP, "", f"trip above {s.max_gap:g} s; any lost sample warns", "none", both,
            "Samples were lost between device and computer.",
            "Check the wire and what else this computer does.",
        ),
        CheckText(
            trips.STALE, "wire.watchdog",
            f"trip at the watchdog's time, warning at {100 * s.stale_warning:g} % of it", "none",
            both, "The newest samples are old.",
            "Check the network and the load of this computer.",
        ),
        CheckText(
            trips.DEVICE, "", "the device's own", "none", trip,
            "The device has zeroed its outputs by itself.",
            "Ask the device why: `bramah probe`; its watchdog may not have heard this computer.",
        ),
        CheckText(
            trips.FROZEN, "checks.frozen_sensor",
            f"one value for {s.frozen_after:g} s while the joint moves", "none", trip,
            "A sensor repeats one value while its joint moves.",
            "Check sensor, plug and converter; the position loop may be blind.",
        ),
        CheckText(
            trips.NOT_FOLLOWING, "checks.spool_not_following",
            f"mean deviation above {100 * s.spool_share:g} % of the movement commanded, or "
            f"{100 * s.spool_constant:g} % of the stroke off",
            lasting, trip, "A spool does not follow its command.",
            "Let the pressure out, then look for a stuck spool, a loose plug or swapped channels.",
        ),
        CheckText(
            trips.EMPTY_CHAMBER, "checks.chamber_without_pressure",
            f"never above {100 * s.empty_chamber:g} % of supply.pressure while excited",
            lasting, trip, "A chamber of a moving joint has no pressure.",
            "Stop the pump, keep away and look for oil: a hose may have burst.",
        ),
        CheckText(
            trips.SUPPLY_LOST, "checks.supply_lost",
            f"below {100 * s.supply_lost:g} % of supply.pressure while excited", lasting, trip,
            "The supply pressure is gone while a joint is excited.",
            "See why the pump stopped; what was measured since is not usable.",
        ),
        CheckText(
            trips.NOTHING_MOVES, "checks.nothing_moves",
            f"spool open by {100 * s.open_spool:g} % of its stroke (mean), piston still to "
            f"{s.still_piston:g} deviations of its noise",
            lasting, warn, "A spool is open and its piston does not move.",
            "Check supply, stop valves, what may block the joint, and the piston's sensor.",
        ),
        CheckText(
            trips.ABOVE_SUPPLY, "checks.pressure_above_supply",
            f"mean above {100 * s.above_supply:g} % of the supply", lasting, warn,
            "A chamber pressure stays above the supply pressure.",
            "Check gain and offset of the sensor, and what load pushes the joint.",
        ),
        CheckText(
            trips.DRIFTS, "checks.drift_at_rest",
            f"faster than {100 * s.drift:g} % of limits.speed at zero command", lasting, warn,
            "A piston moves although its command is zero.",
            "Keep away; look for a valve off its null, a leak, a load that pulls.",
        ),
        CheckText(
            trips.NOISY, "checks.noisy_sensor", f"{s.noise:g} times the noise stated", lasting,
            warn, "A sensor is noisier than the rig file states.",
            "Check shield, earth and plug; correct sensors.*.noise if the value is right.",
        ),
        CheckText(
            trips.SWAPPED, "checks.swapped_pressures",
            f"swing of a closed, locked cylinder {s.swing_factor:g} times off what its other "
            "chamber's says, and another joint's sensor fits",
            f"{s.swing_span:g} s window, lasting {s.confirm:g} s", warn,
            "A pressure sensor seems to be plugged in at another joint's place.",
            "Compare the plugs of both joints' pressure sensors with the rig file.",
        ),
        CheckText(
            trips.SENSOR_DRIFT, "checks.drifting_pressure_sensor",
            f"{100 * s.trend:g} % of supply.pressure in {s.trend_span:g} s that no motion "
            "explains, in one chamber, all other joints locked",
            f"{s.trend_span:g} s window, lasting {s.confirm:g} s", warn,
            "A pressure drifts although the motion repeats.",
            "Check the sensor, its supply voltage and its oil; the force it shows is not real.",
        ),
    )  # fmt: skip


def page(settings: GuardSettings | None = None) -> str:
    """Return the checks as a table in Markdown."""
    head = "| check | key | default | delay | acts | what it says | what to do |"
    lines = [head, "|" + "---|" * 7]
    for c in catalogue(settings):
        key = f"`{c.key}`" if "." in c.key and " " not in c.key else c.key or "–"
        cells = (f"`{c.limit}`", key, c.default, c.delay, c.acts, c.sentence, c.remedy)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
