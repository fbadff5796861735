"""report.html of a run: one file that opens without a network, with the flight as an animation, figures and plots."""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.description.signals import Columns
from firmware_py.description.vehicle import Vehicle
from hil.checks import Result
from hil.metrics import errors, metric_order, shown, shown_limit, shown_value
from hil.signals import Flight
from hil.time_plot import Window

REPORT_FILE = "report.html"
FRAMES_HZ = 25.0
"""Samples per second of the animation, which interpolates between them."""
CAPTIONS = {
    "overview": "The whole flight: path in the tank, position and attitude error.",
    "position": "Position per axis: reference, truth and estimate, and what they are off by.",
    "attitude": "Attitude error about each body axis.",
    "estimate": "Does the filter know how wrong it is? Its error inside three of its own standard deviations. Titles: the judged part.",
    "thrusters": "Each thruster, by module: what the firmware commanded after its limiter, and the force that the plant's gave.",
    "disturbance": "Unmodelled force and moment by the filter, the force that was asked for, and the water's velocity.",
    "docking": "The dock: relay currents of both faces, the gap between them, the two conditions, and the stages of each try.",
}
TILES = (
    "attitude_rmse_rad",
    "position_max_m",
    "estimate_position_rmse_m",
    "nis_mean",
    "duration_s",
    "real_time_factor",
)
"""Metrics shown beside the headline."""
DOCK_TILES = ("duration_s", "false_declarations", "tries", "jams", "docked_rmse_m", "join_jump_n", "gap_min_m")
"""The same for a run that docks."""
MOST_TILES = 6
NOT_MEASURED = (
    "Everything here was flown in a simulated tank, by the firmware of the vehicle, over the vehicle's CAN frames. "
    "Nothing of it was measured on hardware. Figures of the paper's robot were measured in a real tank."
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """What the report and its animation show besides the flight.

    Attributes:
        title: heading, such as `Spiral`; description: one sentence under it.
        tank: `box` or `cylinder`; tank_m: (2, 3) its lowest and highest corner, world, m.
        modules: vehicle of each module, in fleet order.
        force_limits_n: (2,) reverse and forward limit of each thruster.
        window: the judged part, s since the flight's first tick.
        paper_rmse_mm: the paper's measurement in the same task, or None.
        notes: assumptions and synthetic data; shown at the foot.
    """

    title: str
    description: str = ""
    tank: str = "box"
    tank_m: np.ndarray
    modules: tuple[Vehicle, ...]
    force_limits_n: np.ndarray
    window: Window
    paper_rmse_mm: float | None = None
    notes: tuple[str, ...] = ()


def write_report(folder: Path, result: Result, flight: Flight, scene: Scene, plots: Sequence[Path]) -> Path:
    """Write report.html into `folder`; returns its path. `plots` are PNG files, inlined in their order."""
    parts = {
        "title": html.escape(f"{scene.title}, {result.seed_and_options}"),
        "heading": html.escape(scene.title),
        "description": html.escape(scene.description),
        "flight": html.escape(result.seed_and_options),
        "verdict": "passed" if result.passed else "failed",
        "verdict_text": "All checks passed" if result.passed else "A check failed",
        "headline": _headline(result, scene),
        "tiles": _tiles(result),
        "table": _table(result),
        "told": _told(result),
        "plots": "\n".join(_plot(path) for path in plots),
        "notes": "\n".join(f"<p>{html.escape(note)}</p>" for note in (f"Flown: {result.flown}.", NOT_MEASURED, *scene.notes)),
        "style": _asset("style.css"),
        "viewer": _asset("viewer.js"),
        "data": json.dumps(animation(flight, scene), separators=(",", ":")).replace("<", "\\u003c"),
    }
    page = _asset("page.html")
    for name, text in parts.items():
        page = page.replace(f"<!--{name}-->", text)
    path = folder / REPORT_FILE
    path.write_text(page, encoding="utf-8")
    return path


def animation(flight: Flight, scene: Scene) -> dict[str, Any]:
    """Input of the viewer: the scene, and the flight thinned to `FRAMES_HZ`.

    `p`, `q`, `ref_p` and `ref_q` are of the body that was flown; `modules` are all modules, whichever body they are in. Errors are
    null before the firmware knows its pose.
    """
    time_s = flight.time_s
    period_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    keep = slice(None, None, max(1, round(1.0 / (FRAMES_HZ * period_s))))
    firmware = flight.firmware
    member = flight.truth["member"]
    error_m, angle_rad = (np.where(flight.placed, error, np.nan) for error in errors(flight))
    return {
        "tank": {"kind": scene.tank, "low": _short(scene.tank_m[0], 3), "high": _short(scene.tank_m[1], 3)},
        "window": list(scene.window),
        "paper_mm": scene.paper_rmse_mm,
        "t": _short(time_s[keep], 3),
        "p": _short(flight.p_wb[keep], 5),
        "q": _short(flight.q_wb[keep], 5),
        "ref_p": _short(firmware["setpoint_p_wb"][keep], 5),
        "ref_q": _short(firmware["setpoint_q_wb"][keep], 5),
        "error_mm": _known(1e3 * error_m[keep]),
        "angle_deg": _known(np.degrees(angle_rad[keep])),
        "cuts": _cuts(flight, keep),
        "modules": [
            _module(vehicle, truth, member[:, m], keep)
            for m, (vehicle, truth) in enumerate(zip(scene.modules, flight.modules, strict=True))
        ],
    }


def _module(vehicle: Vehicle, truth: Columns, member: np.ndarray, keep: slice) -> dict[str, Any]:
    """Geometry of a module, its poses, its thruster forces, and when it was in the body that was flown."""
    return {
        "hull": _short(vehicle.hull.size_m, 4),
        "thrusters": {"p": _short(vehicle.positions, 4), "d": _short(vehicle.directions, 4)},
        "member": (member[keep] > 0.0).astype(int).tolist(),
        "p": _short(truth["p_wm"][keep], 5),
        "q": _short(truth["q_wm"][keep], 5),
        "force": _short(truth["force_n"][keep], 2),
    }


def _cuts(flight: Flight, keep: slice) -> list[int]:
    """Frames at which the number of thrusters changes: there the steered body, and its reference, is a different one."""
    thrusters = np.isfinite(flight.firmware["commanded_n"][keep]).sum(axis=1)
    return (1 + np.flatnonzero(np.diff(thrusters))).tolist()


def _short(values: np.ndarray, digits: int) -> Any:
    return np.round(np.asarray(values, dtype=float), digits).tolist()


def _known(values: np.ndarray) -> list[float | None]:
    """The values, with None (null) for those that are not finite, which JSON cannot represent."""
    return [round(value, 3) if math.isfinite(value) else None for value in values.tolist()]


def _asset(name: str) -> str:
    return (resources.files(__name__) / name).read_text(encoding="utf-8")


def _headline(result: Result, scene: Scene) -> str:
    """Metric of the scenario's first check in large type; a position RMSE also as a bar beside the paper's, if the paper flew the task."""
    name = _asked_first(result)
    if name == "docked":
        text = _big(shown_value("outcome", result.metrics["outcome"]), "", shown("outcome").label)  # a task may end with an undock
    else:
        how, value = shown(name), result.metrics.get(name, math.nan)
        number = shown_value(name, value).removesuffix(f" {how.unit}")
        text = _big(number, how.unit if math.isfinite(value) else "", how.label)
    ours_mm = 1e3 * result.metrics.get("position_rmse_m", math.nan)
    if scene.paper_rmse_mm is None or name != "position_rmse_m":
        return text
    widest = max(ours_mm, scene.paper_rmse_mm)
    rows = (("this flight, simulated", ours_mm, "ours"), ("paper, real tank", scene.paper_rmse_mm, "paper"))
    bars = "".join(
        f'<div class="bar"><span class="name">{name}</span>'
        f'<span class="track"><i class="{kind}" style="width:{100 * value / widest:.1f}%"></i></span>'
        f'<span class="value">{value:.2f} mm</span></div>'
        for name, value, kind in rows
    )
    return f'{text}<div class="bars">{bars}</div>'


def _asked_first(result: Result) -> str:
    return result.checks[0].name if result.checks else "position_rmse_m"


def _big(value: str, unit: str, label: str) -> str:
    return f'<p class="big">{html.escape(value)}<span>{html.escape(unit)}</span></p><p class="under">{html.escape(label)}</p>'


def _tiles(result: Result) -> str:
    names = DOCK_TILES if "outcome" in result.metrics else TILES
    known = [name for name in names if math.isfinite(result.metrics.get(name, math.nan)) and name != _asked_first(result)]
    return "\n".join(
        f'<div class="tile"><b>{html.escape(shown_value(name, result.metrics[name]))}</b>'
        f"<span>{html.escape(shown(name).label)}</span></div>"
        for name in known[:MOST_TILES]
    )


def _table(result: Result) -> str:
    checks = {check.name: check for check in result.checks}
    rows = []
    for name in metric_order([*checks, *result.metrics]):
        check = checks.get(name)
        limit, verdict = "", ""
        if check is not None:
            limit = shown_limit(name, check.low, check.high)
            kind = "passed" if check.passed else "failed"
            verdict = f'<span class="badge {kind}">{kind}</span>'
        label = shown(name).label
        value = shown_value(name, result.metrics.get(name, float("nan")))
        cells = (f"<td>{html.escape(label)}</td>", f'<td class="n">{html.escape(value)}</td>')
        rows.append(f'<tr>{"".join(cells)}<td class="n">{html.escape(limit)}</td><td>{verdict}</td></tr>')
    return "\n".join(rows)


def _told(result: Result) -> str:
    """Why no tag was seen, faults that never began and the firmware's warnings, shown under the table; empty if there is none of them."""
    lines = "\n".join(f"<li>{html.escape(line)}</li>" for line in result.warnings)
    lacked = [f"<p>{html.escape(line)}</p>" for line in (result.no_tag_reason, *result.unmet_faults) if line]
    return "\n".join([*lacked, *([f"<h3>Warnings of the firmware</h3>\n<ul>\n{lines}\n</ul>"] if lines else [])])


def _plot(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    caption = html.escape(CAPTIONS.get(path.stem, path.stem))
    image = f'<img alt="{caption}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"
