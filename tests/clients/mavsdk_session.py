"""A MAVSDK program that operates the robot; each step prints a line of JSON. Runs in .venv-clients."""

import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.manual_control import ManualControl
from mavsdk.plugins.mission import Mission, MissionItem, MissionPlan
from mavsdk.plugins.offboard import Offboard, PositionNedYaw
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry

ORIGIN = (30.2084, 120.1614)
METRES_PER_DEGREE = (110855.9, 96284.0)
"""Metres per degree at the origin, by the WGS 84 series, independent of the firmware's own conversion."""
WAYPOINTS = (
    (0.15, 0.10, 0.38), (0.20, -0.10, 0.34), (0.0, -0.20, 0.30), (-0.20, -0.10, 0.36), (-0.15, 0.15, 0.42),
    (0.05, 0.20, 0.38), (0.20, 0.0, 0.32), (0.0, 0.0, 0.38),
)  # fmt: skip


def say(step: str, **values: Any) -> None:
    print(json.dumps({"step": step, "at": round(time.monotonic(), 2), **values}), flush=True)


def wait(what: str, done: Callable[[], Any], seconds: float) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if value := done():
            return value
        time.sleep(0.05)
    raise TimeoutError(what)


def place(x: float, y: float, z: float) -> MissionItem:
    item = MissionItem(
        latitude_deg=ORIGIN[0] + x / METRES_PER_DEGREE[0], longitude_deg=ORIGIN[1] + y / METRES_PER_DEGREE[1],
        relative_altitude_m=-z, speed_m_s=0.15, is_fly_through=True, yaw_deg=0.0,
    )  # fmt: skip
    return item


def fly(url: str) -> None:
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    result = mavsdk.add_any_connection(url)
    system = mavsdk.first_autopilot(20.0)
    assert system is not None, f"no autopilot found: {result}"
    say("connected")
    telemetry, action, param = Telemetry(system), Action(system), Param(system)
    wait("local position", lambda: telemetry.health().is_local_position_ok, 20)
    wait("armable", lambda: telemetry.health().is_armable, 20)
    p = wait("position", lambda: telemetry.position_velocity_ned(), 10).position
    euler = telemetry.attitude_euler()
    say("telemetry", ned=[p.north_m, p.east_m, p.down_m], roll_deg=euler.roll_deg,
        in_air=telemetry.in_air(),
        home=wait("home", lambda: telemetry.home().latitude_deg, 10), health=str(telemetry.health()))  # fmt: skip
    everything = param.get_all_params()
    before = param.get_param_float("POS_BW")
    param.set_param_float("POS_BW", before + 0.1)
    after = param.get_param_float("POS_BW")
    param.set_param_float("POS_BW", before)
    say("parameters", floats=len(everything.float_params), ints=len(everything.int_params), before=before, after=after)
    mission(Mission(system), action, telemetry)
    manual(ManualControl(system), telemetry)
    offboard(Offboard(system), telemetry)
    action.hold()
    action.disarm()
    wait("disarmed", lambda: not telemetry.armed(), 5)
    say("disarmed")
    mavsdk.destroy()


def mission(plugin: Mission, action: Action, telemetry: Telemetry) -> None:
    plugin.upload_mission(MissionPlan([place(*w) for w in WAYPOINTS]))
    down = plugin.download_mission().mission_items
    first = down[0]
    say("mission", up=len(WAYPOINTS), down=len(down), latitude=first.latitude_deg, altitude=first.relative_altitude_m)
    action.arm()
    wait("armed", telemetry.armed, 5)
    say("armed")
    action.hold()
    say("hold", mode=str(wait("hold", lambda: telemetry.flight_mode(), 5)))
    plugin.start_mission()
    seen: list[int] = []

    def done() -> bool:
        progress = plugin.mission_progress()
        if progress is not None and progress.current not in seen:
            seen.append(progress.current)
        return bool(plugin.is_mission_finished())

    wait("first waypoint", lambda: done() or 1 in seen, 60)
    mode = str(telemetry.flight_mode())
    wait("mission to finish", done, 180)
    p = telemetry.position_velocity_ned().position
    say("flown", progress=seen, mode=mode, ned=[p.north_m, p.east_m, p.down_m])


def manual(plugin: ManualControl, telemetry: Telemetry) -> None:
    start = telemetry.position_velocity_ned().position
    for _ in range(10):
        plugin.set_manual_control_input(0.0, 0.0, 0.5, 0.0)
        time.sleep(0.05)
    plugin.start_position_control()
    for _ in range(40):
        plugin.set_manual_control_input(0.4, 0.0, 0.5, 0.0)
        time.sleep(0.05)
    mode = str(telemetry.flight_mode())
    for _ in range(20):
        plugin.set_manual_control_input(0.0, 0.0, 0.5, 0.0)
        time.sleep(0.05)
    p = telemetry.position_velocity_ned().position
    say("manual", mode=mode, moved=[p.north_m - start.north_m, p.east_m - start.east_m, p.down_m - start.down_m])


def offboard(plugin: Offboard, telemetry: Telemetry) -> None:
    target = PositionNedYaw(0.1, -0.1, 0.40, 0.0)
    plugin.set_position_ned(target)
    plugin.start()

    def there() -> bool:
        p = telemetry.position_velocity_ned().position
        return math.dist((p.north_m, p.east_m, p.down_m), (0.1, -0.1, 0.40)) < 0.02

    wait("offboard target", there, 30)
    mode = str(telemetry.flight_mode())
    plugin.stop()
    say("offboard", mode=mode)


if __name__ == "__main__":
    fly(sys.argv[1])
