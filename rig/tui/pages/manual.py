"""Manual: one joint moved while a key is held, joints locked and unlocked."""

from __future__ import annotations

from rig.tui.drawing.rows import Row, block, hstack, row, wrapped
from rig.tui.drawing.styles import ASK, DIM, STRONG, WARN_TEXT
from rig.tui.look import PlotView
from rig.tui.pages.parts import bench_bars, joint_box, joints_in

MANUAL = "manual"  # the kind of session that accepts jogs


def manual_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the manual actions possible now, and the joints."""
    snapshot = view.newest.snapshot
    if snapshot is None or view.newest.over:
        lines = [
            row((" Nothing is held by hand.", STRONG)),
            row((" Enter starts a manual session: it takes the device; no protocol may run.", "")),
            row((" d lets the pressure out, where the rig can.", "")),
        ]
        return block(lines, width, height)
    if snapshot.kind != MANUAL:
        text = (
            f" Refused while a protocol runs ({snapshot.run or snapshot.step}): wait for its end."
        )
        return block(wrapped(text, width, WARN_TEXT), width, height)
    joints = list(joints_in(snapshot.channels))
    joint = joints[min(max(view.look.joint, 1), len(joints)) - 1] if joints else 1
    keys = f"hold ↑ to extend joint {joint}, ↓ to retract: it stops when you let go"
    head = [
        *wrapped(snapshot.message, width, STRONG),
        *([] if view.in_command else wrapped("t takes the controls first", width, WARN_TEXT)),
        *wrapped(keys, width, ASK),
        *wrapped("← → joint   l lock   u unlock   x end the session", width, DIM),
    ]
    bars = bench_bars(view, width)
    room = max(height - len(head) - len(bars), 0)
    others = [joint, *(other for other in joints if other != joint)][: max(width // 38, 1)]
    each = (width - len(others) + 1) // len(others)
    boxes = [(joint_box(view, number, each, room), each) for number in sorted(others)]
    return [*head, *hstack(boxes, room), *bars]
