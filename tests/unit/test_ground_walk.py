"""End-to-end smoke test: HEARTBEAT and ATTITUDE reach a real MAVLink client over loopback."""

import os
from contextlib import closing
from typing import Any

import pytest

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil

from firmware_py.app.ground_station import GroundSide
from firmware_py.ground.config import GroundConfig
from tests.unit.ground_sides import firmware_of, free_port
from tests.unit.ground_world import Robot

DEADLINE_ROUNDS = 2000


@pytest.mark.parametrize(("ours", "theirs"), [("udpout", "udpin"), ("udpin", "udpout"), ("tcpin", "tcp")])
def test_client_sees_heartbeat_and_attitude(ours: str, theirs: str) -> None:
    port = free_port()
    if theirs == "udpin":
        client = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", dialect="all")
        side = GroundSide(GroundConfig(links=(f"{ours}:127.0.0.1:{port}",)), firmware_of())
    else:
        side = GroundSide(GroundConfig(links=(f"{ours}:127.0.0.1:{port}",)), firmware_of())
        client = mavutil.mavlink_connection(f"{theirs}:127.0.0.1:{port}", dialect="all")
    robot = Robot()
    seen: dict[str, Any] = {}
    with closing(client), closing(side.links):
        for _ in range(DEADLINE_ROUNDS):
            if theirs != "udpin" and "HEARTBEAT" not in seen:
                client.mav.heartbeat_send(6, 8, 0, 0, 4)
            inputs, outputs = robot.step(side.requests())
            side.observe([], [], inputs, outputs)
            side.pump()
            while (message := client.recv_match(blocking=False)) is not None:
                seen[message.get_type()] = message
            if "HEARTBEAT" in seen and "ATTITUDE" in seen:
                break
    assert (seen["HEARTBEAT"].type, seen["HEARTBEAT"].autopilot) == (12, 0)
    assert (seen["HEARTBEAT"].get_srcSystem(), seen["HEARTBEAT"].get_srcComponent()) == (1, 1)
    attitude = seen["ATTITUDE"]
    assert [attitude.roll, attitude.pitch, attitude.yaw] == pytest.approx([0.1, -0.2, 0.3], abs=1e-6)
    assert attitude.yawspeed == pytest.approx(0.03)
