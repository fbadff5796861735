"""The task of a scenario, and the steps of a docking task, as tables of its file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_py.description.schema import DescriptionError, quantity
from firmware_py.description.vehicle import FACE_NAMES


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """One step of a docking task; begins after the previous step, or together with it (`also`)."""

    do: str = quantity(
        choices=("dock", "undock", "move", "moebius_start", "moebius", "wait"),
        help="dock: the named faces; undock: the two modules, by whatever faces; move: the body of `module` to position_m, as it is "
        "turned; moebius_start: to the start of the strip; moebius: along the strip",
    )
    module: int = quantity(2, low=1, high=29, help="number of the active module")
    face: str = quantity("-x", choices=FACE_NAMES, help="face of the active module")
    target_module: int = quantity(1, low=1, high=29, help="number of the target module")
    target_face: str = quantity("+x", choices=FACE_NAMES, help="face of the target module")
    quarter_turns: int = quantity(
        0, low=0, high=3, help="quarter turns of the active module about the target face's normal, from the seat that turns it least"
    )
    both_approach: bool = quantity(False, help="whether both bodies move towards each other, as in the paper")
    position_m: np.ndarray = quantity([0, 0, 0], unit="m", low=-100, high=100, shape=(3,), help="move: target position, world")
    duration_s: float = quantity(10.0, unit="s", low=0, high=3600, help="duration of a step that is no dock or undock")
    also: bool = quantity(False, help="whether the step begins together with the previous one")

    def __post_init__(self) -> None:
        if self.do in ("dock", "undock") and self.module == self.target_module:
            raise DescriptionError(f"module and target_module are both {self.module}; a {self.do} is of two modules", "target_module")

    @property
    def modules(self) -> tuple[int, ...]:
        """Numbers of the modules involved: the active one, then the target of a dock or undock."""
        if self.do in ("dock", "undock"):
            return (self.module, self.target_module)
        return () if self.do == "wait" else (self.module,)


MODES = ("MANUAL", "STABILIZE", "ALT_HOLD", "POSHOLD", "AUTO", "GUIDED", "SURFACE", "MOTOR_DETECT")
"""Modes that an operator can select for a single body."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Task:
    """The task of the robot."""

    kind: str = quantity(
        choices=("hover", "spiral", "moebius", "lissajous", "waypoints", "dock", "force", "mode"),
        help="hover: hold the position; spiral: climb on a cylinder; moebius: along the rim of a Moebius strip; "
        "lissajous: centre + amplitude sin(frequency u), u from 0 to 2 pi turns; waypoints: along those in `file`; "
        "dock: the [[step]]s; force: a stick with the robot on a load cell; mode: stay in `mode`",
    )
    mode: str = quantity("POSHOLD", choices=MODES, help="mode: the mode to stay in")
    pilot_until_s: float = quantity(1e6, unit="s", low=0, high=1e6, help="mode: time of the run until which sticks and set-points stream")
    ground_until_s: float = quantity(
        0.0, unit="s", low=0, high=1e6, help="mode, dock: time of the run until which a ground station is heard; 0: never"
    )
    settle_s: float = quantity(15.0, unit="s", low=0, high=600, help="time that the robot holds its start before the task begins")
    duration_s: float = quantity(unit="s", low=0.1, high=7200, help="duration of the task itself, from rest to rest")
    radius_m: float = quantity(0.30, unit="m", low=0.01, high=100, help="spiral: radius; moebius: radius of the centre circle")
    climb_m: float = quantity(0.40, unit="m", low=-100, high=100, help="spiral: height gained")
    turns: float = quantity(2.0, low=0.01, high=1000, help="spiral: turns, clockwise seen from above; moebius: laps; lissajous: cycles")
    half_width_m: float = quantity(0.30, unit="m", low=0, high=100, help="moebius: half-width of the strip")
    stick: float = quantity(0.6, low=0, high=1, help="force: largest stick deflection")
    amplitude_m: np.ndarray = quantity([1, 1, 0], unit="m", low=0, high=100, shape=(3,), help="lissajous: amplitude along each axis")
    frequency: np.ndarray = quantity([1, 2, 1], low=0, high=100, shape=(3,), help="lissajous: frequency along each axis")
    yaw_turns: float = quantity(0.0, low=-100, high=100, help="lissajous: whole turns of yaw per turn of u")
    roll_turns: float = quantity(0.0, low=-100, high=100, help="lissajous: whole turns of roll per turn of u")
    file: str = quantity("", help="waypoints: CSV or TOML file (prepare/waypoints.py), beside the scenario's file; once read: its path")
    file_text: str = ""
    """Text of `file`, read with the scenario, which can then be flown without the file."""
    centre_m: np.ndarray = quantity(
        [0, 0, 0],
        unit="m",
        low=-1000,
        high=1000,
        shape=(3,),
        help="hover: position; spiral: bottom of its axis; moebius and lissajous: centre",
    )

    @property
    def begin_ns(self) -> int:
        """Start of the task, since the start of the run."""
        return round(self.settle_s * 1e9)

    @property
    def duration_ns(self) -> int:
        """Duration of the task."""
        return round(self.duration_s * 1e9)

    @property
    def end_ns(self) -> int:
        """End of the task and of the run."""
        return self.begin_ns + self.duration_ns
