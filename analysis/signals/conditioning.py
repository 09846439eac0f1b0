"""Records to signals: aligned, filtered, differentiated, with the linkage's geometry.

Glossary: n samples, N joints. `u` spool [V] (electric: drive), `s` piston [m] (electric: q), `q`
joint angle [rad], `theta` absolute angle q_1 + ... + q_k, `G` = ds/dq [m], `p_cap p_rod` chamber
pressures [Pa gauge], `V_cap V_rod` chamber volumes [m^3], `p_s p_tank` supply and return pressure
[Pa gauge]. A trailing d is d/dt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.signals.filters import Smoother, align, channel_filter, path_cutoff, row_filter
from analysis.signals.locks import held_positions, motion_bands, within_band
from analysis.signals.settings import SIGNALS
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.parts import converter_step
from rig.model.records import Record, bridged
from rig.model.rig import Rig

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Signals:
    """Filtered signals of one record; arrays (n, N) per joint or (n,) for the bench, in SI.

    `excited` (N,) marks the joints whose rows may be used; `valid` (n, N) is false where a sensor
    of the joint was clipped within the filter's reach or the filter runs over the record's edge.
    `lost` (n, N) is true where a sample within that reach never arrived: it was interpolated, and
    no row may use it. `bands` (N,) [Hz] are those in which the joints move, 0 for one that stands
    still (see `analysis.signals.locks.motion_bands`). `weight` (n, N), if given, weights each
    joint's torque balance (see `without_rests`). `loaded` states whether the last link carries a
    load that it does not carry in other records; None: not known. `path_cutoffs` (N,) [Hz], if
    given, are those of `analysis.signals.filters.path_cutoff`.
    """

    rate: float
    t: Array
    u: Array
    s: Array
    sd: Array
    q: Array
    qd: Array
    qdd: Array
    theta: Array
    G: Array
    p_cap: Array
    p_rod: Array
    pd_cap: Array
    pd_rod: Array
    V_cap: Array
    V_rod: Array
    p_s: Array
    p_tank: Array
    temperature: Array
    excited: Mask
    valid: Mask
    lost: Mask
    bands: Array
    weight: Array | None = None
    loaded: bool | None = None
    path_cutoffs: Array | None = None

    def path(self, joint: int) -> Array:
        """Return the path s (n,) of a joint (0-based) along which its friction reverses."""
        s = self.s[:, joint]
        if self.path_cutoffs is None or not np.isfinite(self.path_cutoffs[joint]):
            return s
        return row_filter(self.rate, float(self.path_cutoffs[joint])).apply(s)

    def slow_speed(self, joint: int) -> Array:
        """Return the speed s' (n,) of a joint below `SIGNALS.direction_cutoff`."""
        return row_filter(self.rate, SIGNALS.direction_cutoff).apply(self.sd[:, joint])

    def direction(self, joint: int) -> Array:
        """Return the sign (n,) of `slow_speed`.

        The mean of |v + noise| exceeds |v|, that of (v + noise) times this sign does not.
        """
        return np.asarray(np.sign(self.slow_speed(joint)))

    @property
    def joints(self) -> int:
        """N."""
        return int(self.s.shape[1])

    @property
    def moving(self) -> Mask:
        """The joints (N,) whose motion is the measured one; the others stand still."""
        return self.bands > 0.0

    @property
    def excited_joints(self) -> list[int]:
        """The joints, 0-based, whose rows may be used."""
        return np.flatnonzero(self.excited).tolist()


def without_rests(signals: Signals, joints: Sequence[int], full_weight: float = 1.0) -> Signals:
    """Return signals that weight the torque balances of `joints` by 0 while they are at rest.

    At rest, dry friction balances whatever holds the joint, up to its breakaway value, so that no
    law of the speed applies. A balance that holds at every sample also holds when weighted, so both
    of its sides are weighted before filtering: by 0 at rest, by 1 from `full_weight` times the
    record's rms speed on, smoothly between. A steeper weight shifts high-frequency noise of the
    acceleration into the filter's band.
    """
    weight = np.ones_like(signals.sd)
    for i in joints:
        speed = np.abs(signals.sd[:, i])
        full = full_weight * float(np.sqrt(np.mean(speed**2)))
        x = np.minimum(speed / max(full, 1e-300), 1.0)
        weight[:, i] = x * x * (3.0 - 2.0 * x)
    return replace(signals, weight=weight)


def aligned_channels(rig: Rig, record: Record) -> dict[str, Array]:
    """Return the record's measured channels moved to the tick's instant, each (n,).

    Channel k of the multiplexer is sampled k `skew` after the tick, and a sensor's reading is
    `delay` late: x(t) = measured(t + delay - k skew). Lost samples (NaN) are bridged by a straight
    line first; `lost_samples` states where.
    """
    return {
        name: align(bridged(np.asarray(record.channels[name], dtype=np.float64)), shift)
        for name, shift in _shifts(rig, record.sample_rate).items()
        if name in record.channels
    }


def sampled_channels(rig: Rig, rate: float, channels: Mapping[str, Array]) -> dict[str, Array]:
    """Return channels at the tick's instant, each (n,), as multiplexer and sensors sample them.

    The inverse of `aligned_channels`, at a sample rate [Hz].
    """
    shifts = _shifts(rig, rate)
    return {name: align(x, -shifts[name]) for name, x in channels.items()}


def _shifts(rig: Rig, rate: float) -> dict[str, float]:
    """Return by how many samples each channel lags the instant of the tick."""
    return {
        name: (rig.sensors.of(ch.kind_of(name)[0]).delay - k * rig.sensors.skew) * rate
        for k, name in enumerate(rig.channels)
    }


def align_reach(rig: Rig, rate: float) -> int:
    """Return how many samples on either side an aligned sample depends on."""
    shifts = [abs(shift) for shift in _shifts(rig, rate).values()]
    return SIGNALS.align_half_width + int(np.floor(max(shifts, default=0.0) + 0.5))


def lost_samples(rig: Rig, record: Record) -> Mask:
    """Return where (n, N) a joint's sample, or one of the bench's, never arrived (NaN)."""
    masks = {n: np.isnan(record.channels[n]) for n in rig.channels if n in record.channels}
    return _by_joint(rig, record, masks)


def is_used(rig: Rig, record: Record, name: str) -> bool:
    """Return whether rows need a channel: of a locked joint, only its position."""
    kind, joint = ch.kind_of(name)
    return joint not in record.locked or kind == rig.position_kind


def _by_joint(rig: Rig, record: Record, masks: Mapping[str, Mask]) -> Mask:
    """Return where (n, N) a joint's mask (n,), or one of the bench's, holds on a used channel."""
    out = np.zeros((record.samples, len(rig.joints)), dtype=bool)
    for name, mask in masks.items():
        joint = ch.kind_of(name)[1]
        if is_used(rig, record, name) and mask.any():
            out[:, slice(None) if joint is None else slice(joint - 1, joint)] |= mask[:, None]
    return out


def condition(
    rig: Rig,
    record: Record,
    smoother: Smoother | None = None,
    bands: Array | None = None,
    held: Array | None = None,
) -> Signals:
    """Turn a record into signals through one zero-phase filter (default `channel_filter`).

    `bands` (N,) [Hz] is what `analysis.signals.locks.motion_bands` decided for all repeats of the
    record's step; without it the record counts as the only repeat. `held` (N,) [m] replaces
    `held_positions`, for a record that is a part of a longer one. Lost samples (NaN) are marked in
    `Signals.lost`. Raises InputError naming record and channel where one is missing or not finite.
    """
    smoother = smoother or channel_filter(record.sample_rate)
    joints = range(1, len(rig.joints) + 1)
    excited = np.array([i not in record.locked for i in joints])
    _refuse_missing(rig, record, excited)
    channels = aligned_channels(rig, record)
    n = record.samples

    bands = motion_bands(rig, [record]) if bands is None else bands
    moving = bands > 0.0
    for i, band in zip(joints, map(float, bands), strict=True):
        name = ch.channel(rig.position_kind, i)
        if name in channels:
            channels[name] = within_band(channels[name], record.sample_rate, band)

    def filtered(kind: str, highest: int) -> Sequence[Array]:
        """Return the joints' channels of one kind and their derivatives, (n, N) each."""
        fill = np.zeros(n)
        rows = np.array([channels.get(ch.channel(kind, i), fill) for i in joints])
        return smoother.derivatives(rows.T, highest)

    def bench(name: str, constant: float) -> Array:
        return smoother.apply(channels[name]) if name in channels else np.full(n, constant)

    supply, oil = (0.0, 0.0) if rig.electric else (rig.supply.pressure, rig.oil.temperature)
    held = held_positions(rig, [record]) if held is None else held
    s, sd, sdd = filtered(rig.position_kind, 2)
    # A joint that does not move stands at `held`.
    s[:, ~moving], sd[:, ~moving], sdd[:, ~moving] = held[~moving], 0.0, 0.0
    (p_cap, pd_cap), (p_rod, pd_rod) = filtered(ch.CAP, 1), filtered(ch.ROD, 1)
    q, qd, qdd, G, theta, V_cap, V_rod = _geometry(rig, s, sd, sdd, moving)
    return Signals(
        rate=record.sample_rate,
        t=record.time,
        u=filtered(rig.drive_kind, 0)[0],
        s=s, sd=sd, q=q, qd=qd, qdd=qdd, theta=theta, G=G,
        p_cap=p_cap, p_rod=p_rod, pd_cap=pd_cap, pd_rod=pd_rod, V_cap=V_cap, V_rod=V_rod,
        p_s=bench(ch.SUPPLY, supply),
        p_tank=np.zeros(n),
        temperature=bench(ch.TEMPERATURE, oil),
        excited=excited,
        valid=_valid(rig, record, smoother.reach),
        lost=_widened(
            lost_samples(rig, record), smoother.reach + align_reach(rig, record.sample_rate)
        ),
        bands=bands,
        loaded=record.loaded,
        path_cutoffs=_path_cutoffs(rig, record.sample_rate, channels, sd),
    )  # fmt: skip


def _path_cutoffs(rig: Rig, rate: float, channels: Mapping[str, Array], sd: Array) -> Array:
    """Return `path_cutoff` (N,) [Hz] of joints of speeds (n, N), infinite for one at rest."""
    measured = [channels.get(ch.channel(rig.position_kind, i + 1)) for i in range(sd.shape[1])]
    return np.array([
        np.inf if s is None or not sd[:, i].any() else path_cutoff(s, sd[:, i], rate)
        for i, s in enumerate(measured)
    ])  # fmt: skip


def of_other_geometry(rig: Rig, signals: Signals, other: Rig) -> Signals:
    """Return the signals of `rig` for another rig's linkages and cylinders.

    Piston positions and pressures are measured and unchanged; q, its rates, G and the volumes are
    recomputed, with s'' = G q'' + (dG/dq) q'^2 of the linkages that the signals were made with.
    """
    s = signals.s
    slope = np.column_stack([j.geometry(s[:, i])[2] for i, j in enumerate(rig.joints)])
    sdd = signals.G * signals.qdd + slope * signals.qd**2
    q, qd, qdd, G, theta, V_cap, V_rod = _geometry(other, s, signals.sd, sdd, signals.moving)
    return replace(
        signals, q=q, qd=qd, qdd=qdd, G=G, theta=theta, V_cap=V_cap, V_rod=V_rod
    )  # fmt: skip


def clipped_samples(rig: Rig, record: Record) -> dict[str, Mask]:
    """Return the clipped samples (n,) of each channel that reaches an end of its sensor's range."""
    clipped = {}
    for name in rig.channels:
        if name in record.channels:
            sensor = rig.sensors.of(ch.kind_of(name)[0])
            low, high = sensor.range
            step = converter_step(sensor)
            x = np.asarray(record.channels[name])
            low, high = low + 0.5 * step, high - 0.5 * step
            if x.min() > low and x.max() < high:  # nearly always; not with a lost sample
                continue
            mask = (x <= low) | (x >= high)
            if mask.any():
                clipped[name] = mask
    return clipped


def _refuse_missing(rig: Rig, record: Record, excited: Mask) -> None:
    for i, moves in enumerate(excited, start=1):
        for kind in rig.joint_kinds if moves else (rig.position_kind,):
            name = ch.channel(kind, i)
            if name not in record.channels:
                raise InputError(
                    f"record {record.name!r} has no channel {name!r}, needed because joint {i} is "
                    f"{'excited' if moves else 'locked'}; it has: {' '.join(record.channels)}"
                )
            values = record.channels[name]
            if np.isinf(values).any():
                row = int(np.flatnonzero(np.isinf(values))[0])
                raise InputError(
                    f"record {record.name!r}, channel {name!r}: sample {row} is not a finite "
                    "number; cut the record there or repair the file"
                )


def _geometry(
    rig: Rig, s: Array, sd: Array, sdd: Array, moving: Mask
) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
    """Return q, dq/dt, d2q/dt2, G, absolute angles and chamber volumes (cap, rod), each (n, N).

    q' = s'/G, q'' = (s'' - (dG/dq) q'^2)/G.
    """
    q, G, slope = np.empty_like(s), np.empty_like(s), np.empty_like(s)
    for i, joint in enumerate(rig.joints):
        q[:, i], G[:, i], slope[:, i] = joint.geometry(s[:, i] if moving[i] else s[:1, i])
    qd = sd / G
    theta = rig.base_angle + np.cumsum(q.T, axis=0).T
    volumes = [rig.chamber_volumes(i, s[:, i]) for i in range(len(rig.joints))]
    V_cap, V_rod = (np.array(side).T for side in zip(*volumes, strict=True))
    return q, qd, (sdd - slope * qd**2) / G, G, theta, V_cap, V_rod


def _valid(rig: Rig, record: Record, reach: int) -> Mask:
    clipped = clipped_samples(rig, record)
    clipped.pop(ch.TEMPERATURE, None)
    invalid = _widened(_by_joint(rig, record, clipped), reach)
    invalid[:reach] = invalid[record.samples - reach :] = True
    return np.asarray(~invalid)


def _widened(mask: Mask, reach: int) -> Mask:
    """Return where (n, N) a mask is true anywhere within `reach` samples."""
    if not mask.any():
        return mask
    window = np.ones(2 * reach + 1)
    count = np.apply_along_axis(np.convolve, 0, mask.astype(np.float64), window)
    return np.asarray(count[reach : reach + len(mask)] > 0.5)
