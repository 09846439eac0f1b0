"""The arm drawn from its linkage: links, cylinders, range of motion, reach of the tip.

Absolute angle theta_k = q_1 + ... + q_k, zero hanging straight down. The inner pin of cylinder k
lies at distance a in direction theta_(k-1) - offset_k, the outer one at c in direction theta_k, so
that the angle between them is beta_k = q_k + offset_k (`rig.model.linkage`).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.patches import Arc, Polygon

from analysis.report.plots.style import (
    CARD,
    GREY,
    INK,
    JOINT_COLOURS,
    PALE,
    Array,
    figure,
    note,
    style,
    svg,
)
from analysis.report.settings import REPORT
from rig.model.rig import Rig


@dataclass(frozen=True)
class Pose:
    """Points [m] of the arm at one position: joints and tip (N+1, 2), inner, outer pins (N, 2)."""

    joints: Array
    inner: Array
    outer: Array
    theta: Array


def _direction(theta: float) -> Array:
    return np.array([np.sin(theta), -np.cos(theta)])


def pose(rig: Rig, q: Array) -> Pose:
    """Return the positions of joints, tip and pins at joint angles q (N,) [rad]."""
    theta = np.cumsum(q)
    points, inner, outer = [np.zeros(2)], [], []
    for k, joint in enumerate(rig.joints):
        before = theta[k - 1] if k else 0.0
        inner.append(
            points[-1] + joint.linkage.base_pin * _direction(before - joint.linkage.offset)
        )
        outer.append(points[-1] + joint.linkage.arm_pin * _direction(theta[k]))
        points.append(points[-1] + joint.link_length * _direction(theta[k]))
    return Pose(np.array(points), np.array(inner), np.array(outer), theta)


def angle_range(rig: Rig, joint: int) -> tuple[float, float]:
    """Return the joint angle [rad] at the retracted and the extended end of the stroke."""
    part = rig.joints[joint]
    half = part.cylinder.stroke / 2
    return float(part.linkage.angle(-half)), float(part.linkage.angle(half))


def middle(rig: Rig) -> Array:
    """Return the joint angles (N,) [rad] at mid-stroke."""
    return np.array([float(joint.linkage.angle(0.0)) for joint in rig.joints])


def reach(rig: Rig) -> Array:
    """Return tip positions [m] over the whole stroke of every joint, shape (m, 2)."""
    N = len(rig.joints)
    per_joint = max(2, min(REPORT.reach_grid, int(REPORT.reach_poses ** (1 / N))))
    axes = [
        joint.linkage.angle(np.linspace(-0.5, 0.5, per_joint) * joint.cylinder.stroke)
        for joint in rig.joints
    ]
    return np.array([pose(rig, np.array(q)).joints[-1] for q in itertools.product(*axes)])


def arm(rig: Rig) -> Markup:
    """Draw the arm at mid-stroke, each joint's two ends dashed, and the region of the tip."""
    q = middle(rig)
    with style():
        canvas = figure(4.2, CARD)
        axes = canvas.add_axes((0.02, 0.02, 0.96, 0.96))
        axes.set_aspect("equal")
        axes.axis("off")
        tips = reach(rig)
        _tip_region(axes, rig, tips)
        for k in range(len(rig.joints)):
            for end in angle_range(rig, k):
                dashed = q.copy()
                dashed[k] = end
                points = pose(rig, dashed).joints[k : k + 2]
                axes.plot(*points.T, color=JOINT_COLOURS[k % 5], linewidth=1.0, alpha=0.45,
                          linestyle=(0, (3, 2)))  # fmt: skip
        at = pose(rig, q)
        _ground(axes, max(j.link_length for j in rig.joints))
        _links(axes, rig, at)
        _limits(axes, np.vstack((tips, at.joints, at.inner, at.outer)))
        _scale_bar(axes)
        label = f"Side view of an arm of {len(rig.joints)} joints with its cylinders at mid-stroke"
        return svg(canvas, "rig", label)


def _tip_region(axes: Any, rig: Rig, tips: Array) -> None:
    side = round(len(tips) ** 0.5)
    if len(rig.joints) == 2:
        # The edge of the square of strokes maps to the edge of the region.
        grid = tips.reshape(side, side, 2)
        edge = np.vstack((grid[0], grid[:, -1], grid[-1, ::-1], grid[::-1, 0]))
        axes.add_patch(Polygon(edge, closed=True, facecolor="#eef1f4", edgecolor=PALE, zorder=0.4))
    else:
        axes.plot(*tips.T, ".", color=PALE, markersize=2.0, zorder=0.5)
    low = tips[tips[:, 1].argmin()]
    axes.annotate(
        "reach of the tip", low, (0, -5), textcoords="offset points", ha="center", va="top",
        fontsize=7, color="#6b7280",
    )  # fmt: skip


def _ground(axes: Any, size: float) -> None:
    half = 0.16 * size
    x = np.linspace(-half, half, 7)
    y = 0.05 * size
    axes.plot([-half, half], [y, y], color=INK, linewidth=1.2)
    for start in x[:-1]:
        axes.plot([start, start + 0.05 * size], [y, y + 0.05 * size], color=INK, linewidth=0.6)
    axes.add_patch(
        Polygon([(-0.04 * size, y), (0.04 * size, y), (0, 0)], closed=True, facecolor=PALE,
                edgecolor=INK, linewidth=0.8)
    )  # fmt: skip


def _links(axes: Any, rig: Rig, at: Pose) -> None:
    size = max(j.link_length for j in rig.joints)
    for k, joint in enumerate(rig.joints):
        colour = JOINT_COLOURS[k % 5]
        start, end = at.joints[k], at.joints[k + 1]
        axes.plot(*np.array([start, end]).T, color=colour, linewidth=5.0, solid_capstyle="round",
                  zorder=2)  # fmt: skip
        # Brackets: pins that do not lie on a link are held by a thin line to the joint.
        for pin in (at.inner[k], at.outer[k]):
            axes.plot(*np.array([start, pin]).T, color=GREY, linewidth=1.0, zorder=1.5)
        body = at.inner[k] + 0.62 * (at.outer[k] - at.inner[k])
        axes.plot(*np.array([at.inner[k], body]).T, color=INK, linewidth=4.0, zorder=3,
                  solid_capstyle="butt")  # fmt: skip
        axes.plot(*np.array([body, at.outer[k]]).T, color=INK, linewidth=1.4, zorder=3)
        axes.plot(*np.array([at.inner[k], at.outer[k]]).T, "o", color="white", zorder=4,
                  markeredgecolor=INK, markersize=3.5, markeredgewidth=0.9)  # fmt: skip
        axes.plot(*start, "o", color="white", markeredgecolor=colour, markersize=6, zorder=5,
                  markeredgewidth=1.6)  # fmt: skip
        low, high = sorted(np.degrees(angle_range(rig, k)))
        _arc(axes, rig, at, k, 0.3 * size)
        _name(
            axes, f"link {k + 1}, {joint.link_length * 1e3:.0f} mm\n{low:.0f}° to {high:.0f}°",
            0.3 * start + 0.7 * end, _direction(at.theta[k] + np.pi / 2), colour,
        )  # fmt: skip
        along = at.outer[k] - at.inner[k]
        across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        centre = 0.5 * (at.inner[k] + body)
        side = np.sign(across @ (centre - start)) or 1.0
        _name(axes, f"cylinder {k + 1}", centre, side * across, INK)


def _name(axes: Any, text: str, point: Array, away: Array, colour: str) -> None:
    """Write a label beside a point, on the side that `away` (2,) points to."""
    axes.annotate(
        text.replace("-", "−"), point, tuple(9 * away), textcoords="offset points", fontsize=7.5,
        color=colour, ha="left" if away[0] > 0 else "right", zorder=6,
        va="center" if abs(away[0]) > 0.5 else ("bottom" if away[1] > 0 else "top"),
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8, "alpha": 0.8},
    )  # fmt: skip


def _arc(axes: Any, rig: Rig, at: Pose, k: int, radius: float) -> None:
    before = at.theta[k - 1] if k else 0.0
    low, high = sorted(np.degrees(before + np.array(angle_range(rig, k))) - 90.0)
    arc = Arc(tuple(at.joints[k]), 2 * radius, 2 * radius, theta1=low, theta2=high,
              color=JOINT_COLOURS[k % 5], linewidth=1.0)  # fmt: skip
    axes.add_patch(arc)


def _limits(axes: Any, points: Array) -> None:
    low, high = points.min(axis=0), points.max(axis=0)
    pad = 0.14 * float((high - low).max())
    axes.set_xlim(low[0] - 1.6 * pad, high[0] + 1.2 * pad)
    axes.set_ylim(low[1] - pad, high[1] + pad)


def _scale_bar(axes: Any) -> None:
    x0, x1 = axes.get_xlim()
    y0, y1 = axes.get_ylim()
    target = 0.2 * (x1 - x0)
    length = 10.0 ** np.floor(np.log10(target))
    length = max(m * length for m in (1, 2, 5) if m * length <= target)
    x, y = x0 + 0.03 * (x1 - x0), y0 + 0.03 * (y1 - y0)
    axes.plot([x, x + length], [y, y], color=INK, linewidth=1.2, solid_capstyle="butt")
    note(axes, 0.03, 0.045, f"{length * 1e3:g} mm", ha="left", va="bottom")
