"""What stands on a disk for the page of runs: a run's log and the stored result of a trace.

The numbers are closed formulas of the size that the seed bench shows, as in `tests.tui.recorded`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np


def trace_json() -> dict[str, Any]:
    """Return a trace that names a leak, with what `bramah trace --json` writes of it."""
    time = np.arange(400) / 100.0
    measured = 0.02 * np.sin(2 * np.pi * time)
    before = measured + 0.004 * time / 4.0 * np.sin(2 * np.pi * time + 1.0) + 5e-4 * time
    after = measured + 2e-4 * np.sin(4 * np.pi * time)
    pressure = 3e6 + 1e6 * np.sin(2 * np.pi * time)
    channels = {
        "piston_2": {"unit": "m", "measured": measured, "before": before, "after": after},
        "cap_pressure_2": {
            "unit": "Pa", "measured": pressure, "before": pressure + 2e5 * np.cos(time),
            "after": pressure + 2e4 * np.cos(time),
        },
    }  # fmt: skip
    return {
        "verdict": "explained",
        "sentence": "Internal leakage at joint 2 explains what the model lacked; what is left is "
        "at the noise.",
        "effects": [
            {
                "name": "internal_leakage", "where": "joint 2", "removed_fraction": 0.93,
                "parameters": {
                    "c_internal_2": {
                        "value": 2.03e-12, "unit": "m^3/(s*Pa)", "std": 2e-14,
                        "ci95": [1.99e-12, 2.07e-12],
                    }
                },
                "gates": [{"name": "held out", "ok": True, "detail": "0.93 of it"}],
                "p_value": 1e-4, "rivals": [],
            }
        ],
        "refused": [
            {
                "name": "valve_deadband", "where": "joint 1", "removed_fraction": 0.04,
                "parameters": {}, "p_value": 0.2, "rivals": [],
                "gates": [{"name": "significance", "ok": False, "detail": "p = 0.2"}],
            }
        ],
        "error": {
            "noise_floor": {"torque_2": 1.2, "flow_cap_2": 1.1e-7, "flow_rod_2": 1.0e-7},
            "before": {"torque_2": 1.3, "flow_cap_2": 9.1e-7, "flow_rod_2": 8.0e-7},
            "after": {"torque_2": 1.25, "flow_cap_2": 1.2e-7, "flow_rod_2": 1.1e-7},
        },
        "fit": {
            "before": {"piston_2": 81.2, "cap_pressure_2": 70.4},
            "after": {"piston_2": 98.9, "cap_pressure_2": 96.0},
        },
        "size": {"torque_2": 40.0, "flow_cap_2": 3e-5, "flow_rod_2": 2.5e-5},
        "next_experiment": {"text": "hold joint 2 at 6 MPa for 30 s with its valve closed"},
        "notes": ["one record of four was cut short"],
        "free_run": {
            "record": "step1_r1", "time": time.tolist(),
            "channels": {
                name: {key: value if key == "unit" else value.tolist()
                       for key, value in one.items()}
                for name, one in channels.items()
            },
        },
    }  # fmt: skip


EVENTS = (
    {"event": "start", "tick": None, "t": 0.0, "command": "bramah run lock-and-excite"},
    {"event": "phase", "tick": 40, "t": 0.04, "step": "lock", "phase": "homing",
     "message": "joint 1 to its retracted end"},
    {"event": "record begins", "tick": 6000, "t": 6.0, "record": "step1_r1"},
    {"event": "alarm", "tick": 6400, "t": 6.4, "alarm": "supply pressure",
     "sentence": "The supply pressure is outside its band. supply_pressure: 5.5 MPa"},
    {"event": "controls taken", "tick": 6900, "t": 6.9, "by": "process 77 on bench-pc"},
    {"event": "trip", "tick": 7997, "t": 7.997,
     "message": "safety trip: limit 'pressure', cap_pressure_2 of joint 2 (arm): 9.31 MPa"},
    {"event": "end", "tick": None, "t": 8.1, "state": "tripped", "message": "outputs zeroed"},
)  # fmt: skip


def log_bytes() -> bytes:
    """Return a run's log as the recorder writes it."""
    lines = (json.dumps({"time": "2024-05-17T09:00:00.000+00:00", **one}) for one in EVENTS)
    return ("\n".join(lines) + "\n").encode()


def run_folder(folder: Path) -> Path:
    """Write a log and a trace into a new folder and return it."""
    folder.mkdir(parents=True)
    (folder / "events.jsonl").write_bytes(log_bytes())
    (folder / "trace.json").write_text(json.dumps(trace_json()), encoding="utf-8")
    return folder
