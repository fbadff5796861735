"""Ends of links: a free port, received messages, and a ground side without a thread."""

import socket
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from types import SimpleNamespace
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from firmware_py.app.ground_station import GroundSide
from firmware_py.core.types import Request
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.link import Links
from tests.unit.ground_world import Robot, fleet_of

PATIENCE_S = 5.0


def free_port() -> int:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def received(links: Links, count: int) -> list[Any]:
    """Waits for `count` messages, at most `PATIENCE_S`; returns those received."""
    got: list[Any] = []
    end = time.monotonic() + PATIENCE_S
    while len(got) < count and time.monotonic() < end:
        got += links.receive()
    return got


def heartbeat(system: int = 255) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=190)
    return bytes(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mav))


def firmware_of(modules: int = 1, bodies: Sequence[Any] = ()) -> Any:
    """The part of the firmware that a ground side uses."""
    return SimpleNamespace(pipeline=SimpleNamespace(bodies=list(bodies)), fleet=fleet_of(modules), parameters=Parameters())


def side_on(*links: str, modules: int = 1) -> GroundSide:
    """A ground side without a thread; the test calls `pump`."""
    return GroundSide(GroundConfig(links=links), firmware_of(modules, Robot(modules).bodies), ThreadPoolExecutor(1))


def pump(side: GroundSide, robot: Robot, ticks: int = 1) -> list[Request]:
    """Runs for `ticks`; returns the requests made meanwhile."""
    asked = []
    for _ in range(ticks):
        requests = side.requests()
        side.observe([], [], *robot.step(requests))
        side.pump()
        asked += requests
    return asked + side.requests()
