"""A vehicle behind MAVLink for tune_gains --live: whether its state is unchanged, what its parameters are, how still it hovers."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Protocol, cast

import numpy as np

from firmware_py.description.schema import DescriptionError

SETTLE_S = 3.0
"""Settling time between a change and its evaluation, by the vehicle's clock."""
SILENT_S, ANSWER_S, ATTEMPTS = 5.0, 1.0, 5
"""Time without a heartbeat after which the vehicle is lost; timeout of a parameter's answer, and number of attempts."""
RESTORE_S, PAUSE_S = 60.0, 0.2
"""Timeout for restoring all changed values; pause after a value that was not accepted."""
STATE_ACTIVE, ARMED, ERROR = 4, 0x80, 3
"""MAV_STATE_ACTIVE; MAV_MODE_FLAG_SAFETY_ARMED; MAV_SEVERITY_ERROR: this and graver severities count as trouble."""
ONBOARD_CONTROLLER, INVALID_AUTOPILOT = 18, 8
"""MAV_TYPE and MAV_AUTOPILOT of our heartbeat: not a ground station, since the vehicle would act on the loss of one."""
NETWORK, LAST_PORT = ("udp", "udpin", "udpout", "udpbcast", "tcp", "tcpin"), 65535
"""Kinds of address that end in a port, and the largest port; pymavlink notices some wrong ports only when it sends."""
RIGHT = "an address such as mavlink:udpin:0.0.0.0:14550"
SEEN = ("position_rmse_m", "attitude_rmse_rad")
"""Metrics available from telemetry; the objective's other terms are left out."""


class TroubleError(Exception):
    """The vehicle is no longer in the state in which the tuning began; the message says why."""


class Link(Protocol):
    """The part of pymavlink's connection that is used."""

    mav: Any
    target_system: int

    def recv_match(self, *, blocking: bool, timeout: float | None = None) -> Any:
        """The next message, or None."""
        ...

    def close(self) -> None:
        """Closes the link."""
        ...


def connect(address: str) -> Link:
    """Opens the link to a MAVLink address. Raises DescriptionError."""
    kind, _, place = address.partition(":")
    port = place.rpartition(":")[2]
    if kind in NETWORK and not (port.isascii() and port.isdecimal() and len(port) <= 5 and int(port) <= LAST_PORT):
        raise DescriptionError(f"--live mavlink:{address}: {port!r} is no port, 0 to {LAST_PORT}; it needs {RIGHT}")
    os.environ["MAVLINK20"] = "1"
    from pymavlink import mavutil

    try:
        return cast(Link, mavutil.mavlink_connection(address, dialect="all", source_system=255, source_component=191))
    except (ImportError, OSError, OverflowError, ValueError) as error:
        raise DescriptionError(f"--live mavlink:{address}: {error}; it needs {RIGHT}") from None


class Vehicle:
    """The vehicle at the other end of a link."""

    def __init__(self, link: Link, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep) -> None:
        """Waits for its heartbeat. Raises DescriptionError when none comes. `clock` and `sleep`: s."""
        self.link, self._clock, self._sleep = link, clock, sleep
        self._last_sent_s, self._heard_s = -1e9, clock()
        self._mode: int | None = None
        self._watched = False
        self.seen: list[Any] = []
        """Messages since `seen` was last cleared."""
        with suppress(TroubleError):
            self.wait_for_heartbeat()
        if self._mode is None:
            raise DescriptionError(f"--live: no heartbeat in {SILENT_S:g} s; is the vehicle's link set to this address?")

    def listen(self, timeout_s: float) -> None:
        """Receives messages, waiting at most `timeout_s`. Raises TroubleError on silence, and after `watch(True)` on any trouble."""
        self._receive(timeout_s)
        if self._clock() - self._heard_s > SILENT_S:
            raise TroubleError(f"the vehicle has been silent for {SILENT_S:g} s")

    def _receive(self, timeout_s: float) -> None:
        now = self._clock()
        if now - self._last_sent_s > 1.0:
            self._last_sent_s = now
            self.link.mav.heartbeat_send(ONBOARD_CONTROLLER, INVALID_AUTOPILOT, 0, 0, 4)
        message = self.link.recv_match(blocking=True, timeout=timeout_s)
        while message is not None:
            self._take(message)
            message = self.link.recv_match(blocking=False)

    def wait_for_heartbeat(self) -> None:
        """Receives messages until the next heartbeat. Raises TroubleError."""
        self.seen.clear()
        while not any(m.get_type() == "HEARTBEAT" for m in self.seen):
            self.listen(0.1)

    def watch(self, on: bool) -> None:
        """Turns on or off the reaction to trouble other than silence."""
        self._watched = on

    def _take(self, message: Any) -> None:
        if self.link.target_system not in (0, message.get_srcSystem()):
            return
        self.seen.append(message)
        kind = message.get_type()
        if kind == "STATUSTEXT" and self._watched and (message.severity <= ERROR or message.text.startswith("fail-safe on")):
            raise TroubleError(f"the vehicle says: {message.text}")
        if kind != "HEARTBEAT" or message.get_srcComponent() != 1:
            return
        self._heard_s = self._clock()
        before, self._mode = self._mode, int(message.custom_mode)
        if not self._watched:
            return
        if message.system_status != STATE_ACTIVE or not message.base_mode & ARMED:
            raise TroubleError("the vehicle is stopped, or disarmed")
        if before != self._mode:
            raise TroubleError(f"the vehicle's mode changed from {before:#x} to {self._mode:#x}")

    def get(self, name: str) -> float:
        """The value of a parameter. Raises TroubleError when it does not answer."""
        return self._ask(name, lambda: self.link.mav.param_request_read_send(self.link.target_system, 1, name.encode(), -1))

    def set(self, name: str, value: float) -> None:
        """Sets a parameter. Raises TroubleError when the vehicle keeps another value."""
        kept = self._ask(name, lambda: self.link.mav.param_set_send(self.link.target_system, 1, name.encode(), value, 9))
        if not abs(kept - value) <= 1e-5 * abs(value):  # also when it is NaN
            raise TroubleError(f"parameter {name} was set to {value:g}, but the vehicle keeps {kept:g}")

    def restore(self, values: Mapping[str, float]) -> dict[str, float]:
        """Sets every parameter until the vehicle confirms it, for at most RESTORE_S even if it is silent; returns those not confirmed."""
        left, end = dict(values), self._clock() + RESTORE_S
        while left and self._clock() < end:
            name = next(iter(left))
            value = left.pop(name)
            try:
                self.set(name, value)
            except (TroubleError, OSError):
                left[name] = value  # after the others
                self._sleep(PAUSE_S)
        return {name: value for name, value in values.items() if name in left}

    def _ask(self, name: str, send: Callable[[], None]) -> float:
        for _ in range(ATTEMPTS):
            self.seen.clear()
            send()
            end = self._clock() + ANSWER_S
            while self._clock() < end:
                self._receive(0.05)
                for message in self.seen:
                    if message.get_type() == "PARAM_VALUE" and message.param_id == name:
                        return float(str(np.float32(message.param_value)))
        raise TroubleError(f"parameter {name}: no answer in {ATTEMPTS * ANSWER_S:g} s")

    def measure_hover(self, seconds: float) -> dict[str, float]:
        """Metrics of a hover of `seconds`, after settling: RMS about the mean pose, by the vehicle's own clock and estimate."""
        self.seen.clear()
        began_ms: int | None = None
        poses: dict[str, list[list[float]]] = {"LOCAL_POSITION_NED": [], "ATTITUDE": []}
        while True:
            self.listen(0.1)
            for m in self.seen:
                kind = m.get_type()
                if kind not in poses:
                    continue
                began_ms = m.time_boot_ms if began_ms is None else began_ms
                since_s = 1e-3 * (m.time_boot_ms - began_ms)
                if since_s >= SETTLE_S:
                    poses[kind].append([m.x, m.y, m.z] if kind == "LOCAL_POSITION_NED" else [m.roll, m.pitch, m.yaw])
                if since_s >= SETTLE_S + seconds and all(poses.values()):
                    return dict(zip(SEEN, map(_spread, poses.values()), strict=True))
            self.seen.clear()


def _spread(values: list[list[float]]) -> float:
    """RMS distance from the mean; angles are unwrapped."""
    array = np.unwrap(np.array(values), axis=0)
    return float(np.sqrt(np.mean(np.sum((array - array.mean(axis=0)) ** 2, axis=1))))
