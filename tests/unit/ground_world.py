"""A robot without physics behind a ground station, and a pymavlink client, connected in memory: for tests of
firmware_py.ground.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.core.failsafes import Level
from firmware_py.core.rotations import from_euler
from firmware_py.core.transitions import State
from firmware_py.core.types import (
    Action,
    BodyRecord,
    DockFeedback,
    EscFeedback,
    Estimate,
    Event,
    Inputs,
    Mode,
    ModuleCommand,
    ModuleInputs,
    Outputs,
    Request,
    Setpoint,
    Thrust,
)
from firmware_py.description.fleet import Fleet, Module
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.signing import Signing
from firmware_py.ground.station import GroundStation

PERIOD_NS = 10_000_000
ZERO = np.zeros(3)


def fleet_of(modules: int, altitude_m: float = 0.0) -> Fleet:
    return Fleet(module=tuple(Module(number=n + 1) for n in range(modules)), altitude_m=altitude_m)


class Robot:
    """Answers requests as the supervisor would. It stands still where it is put, and is at once where a plan that it tracks wants it."""

    def __init__(self, modules: int = 1) -> None:
        self.tick = 0
        self.state = [State.DISARMED] * modules
        self.mode = [Mode.POSHOLD] * modules
        self.p_wb = [np.array([0.1 * n, 0.2, 0.5]) for n in range(modules)]
        self.q_wb = [from_euler(0.1, -0.2, 0.3) for _ in range(modules)]
        self.tracked: list[tuple[int, Any] | None] = [None] * modules
        """Tick at which each module began to track, and the trajectory."""
        self.off_plan = np.zeros(3)
        """How far from its place in a plan the robot is held, m."""
        self.nu = np.array([0.05, 0.0, -0.02, 0.01, 0.02, 0.03])
        self.tag_age_ns, self.ready, self.starts, self.may_arm, self.level = 30_000_000, True, 1, True, Level.NONE
        self.refuse: dict[Action, str] = {}
        """Reason for each action that is refused."""
        self.asked: list[Request] = []
        self.events: list[Event] = []
        """Events of the next tick."""
        self.bodies: list[Any] = [SimpleNamespace(index=n, modules=(n,), passive=()) for n in range(modules)]

    def dock(self) -> None:
        """Makes all modules one body from now on."""
        self.bodies = [SimpleNamespace(index=0, modules=tuple(range(len(self.state))), passive=())]

    def step(self, requests: list[Request]) -> tuple[Inputs, Outputs]:
        self.tick += 1
        time_ns = self.tick * PERIOD_NS
        modules = [self._inputs() for _ in self.state]
        events = [*self.events, *(event for request in requests for event in self._take(request))]
        self.events = []
        self._move()
        commands = [ModuleCommand(s == State.ARMED, np.linspace(-1, 1, 8), None) for s in self.state]
        records = [self._record(body.index) for body in self.bodies]
        return Inputs(self.tick, time_ns, modules, requests), Outputs(
            self.tick, time_ns, commands, False, events, records
        )

    def _inputs(self) -> ModuleInputs:
        return ModuleInputs(
            gyro=ZERO, accel=ZERO, pressure_pa=106_000.0, water_temperature_c=12.75,
            docks=[DockFeedback(0, (100.0, 0.0, 0.0), (1, 0, 0))], voltage_v=12.1, current_a=2.5,
            cabin_temperature_c=25.5, cabin_pressure_pa=101_300.0, leak=False, answered=True, heard=True,
            esc=[EscFeedback(2, (900.0, -450.0), (1.5, 0.5), (0, 2)), EscFeedback(4, (0.0, 0.0), (0.0, 0.0), (1, 3))],
        )  # fmt: skip

    def _take(self, request: Request) -> list[Event]:
        self.asked.append(request)
        action, body = request.action, request.body
        if action in self.refuse:
            return [Event(4, f"{action.name} refused: {self.refuse[action]}", body)]
        armed = self.state[body] == State.ARMED
        if action == Action.ARM and self.state[body] == State.DISARMED:
            self.state[body] = State.ARMED
        elif action == Action.DISARM and armed:
            self.state[body] = State.DISARMED
        elif action == Action.ESTOP:
            self.state[body] = State.ESTOP
        elif action == Action.CLEAR_ESTOP:
            self.state[body] = State.DISARMED
        elif action == Action.SET_MODE:
            self.mode[body] = request.argument
        elif action == Action.HOLD:
            self.mode[body] = Mode.POSHOLD
        elif action == Action.TRACK:
            self.mode[body], self.tracked[body] = Mode.AUTO, (self.tick, request.argument)
        return []

    def _move(self) -> None:
        for n, tracked in enumerate(self.tracked):
            if tracked is not None and self.mode[n] == Mode.AUTO:
                began, trajectory = tracked
                self.p_wb[n] = trajectory.sample((self.tick - began) * PERIOD_NS / 1e9).p_wb + self.off_plan

    def _record(self, body: int) -> BodyRecord:
        estimate = Estimate(
            self.p_wb[body], self.q_wb[body], self.nu, ZERO, ZERO, np.full(3, 0.002), np.full(3, 0.004),
            self.tag_age_ns, float("nan"), 0, 0, self.ready, self.starts,
        )  # fmt: skip
        setpoint = Setpoint(self.p_wb[body], self.q_wb[body], ZERO, ZERO, ZERO, ZERO)
        thrust = Thrust(np.zeros(8), np.zeros(6), (1.0, 1.0), 0.75)
        values = {
            "body": body, "state": self.state[body], "estimate": estimate, "setpoint": setpoint, "wrench": np.zeros(6),
            "thrust": thrust, "commanded_n": np.zeros(8), "mode": self.mode[body], "may_arm": self.may_arm, "level": self.level,
        }  # fmt: skip
        return BodyRecord(**{name: values.get(name) for name in BodyRecord._fields})


class Client:
    """A ground station made of pymavlink's own encoder and parser."""

    def __init__(self, world: "World", channel: int, system: int = 255, component: int = 190) -> None:
        self._world, self.channel = world, channel
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self.mav.robust_parsing = True
        self.inbox: list[Any] = []

    def send(self, name: str, *values: Any, **fields: Any) -> None:
        """Sends a message; the arguments are those of pymavlink's class of that name."""
        self.send_raw(self.pack(name, *values, **fields))

    def pack(self, name: str, *values: Any, **fields: Any) -> bytes:
        message = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{name}")](*values, **fields)
        packed = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return packed

    def send_raw(self, data: bytes) -> None:
        self._world.station.take(self.channel, data, self._world.time_ns, trusted=self._world.trusted)

    def command(self, number: int, *parameters: float, target: int = 1, component: int = 1) -> None:
        filled = [*parameters, *[float("nan")] * (7 - len(parameters))]
        self.send("COMMAND_LONG", target, component, number, 0, *filled)

    def heartbeat(self, kind: int = 6) -> None:
        self.send("HEARTBEAT", kind, 8, 0, 0, 4, 3)

    def all(self, name: str) -> list[Any]:
        return [m for m in self.inbox if m.get_type() == name]

    @property
    def texts(self) -> str:
        """All STATUSTEXTs, joined."""
        return "".join(m.text for m in self.all("STATUSTEXT"))

    def last(self, name: str) -> Any:
        found = self.all(name)
        assert found, f"no {name}; there are {sorted({m.get_type() for m in self.inbox})}"
        return found[-1]

    def clear(self) -> None:
        self.inbox.clear()


class World:
    """Robot, station and clients; `run` advances time."""

    def __init__(
        self,
        modules: int = 1,
        config: GroundConfig | None = None,
        signing: Signing | None = None,
        trusted: bool = False,
        altitude_m: float = 0.0,
    ) -> None:
        self.robot = Robot(modules)
        self.config = config or GroundConfig()
        self.parameters = Parameters()
        self.station = GroundStation(self.config, fleet_of(modules, altitude_m), self.parameters, signing)
        self.clients: list[Client] = []
        self.trusted = trusted
        self.run(1)

    @property
    def time_ns(self) -> int:
        return self.robot.tick * PERIOD_NS

    def client(self, system: int = 255, component: int = 190) -> Client:
        client = Client(self, len(self.clients), system, component)
        self.clients.append(client)
        self.station.join(client.channel, self.time_ns)
        self.run(1)
        return client

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            inputs, outputs = self.robot.step(self.station.requests())
            self.station.observe(inputs, outputs, self.robot.bodies)
            for channel, frame in self.station.frames(outputs.time_ns):
                client = self.clients[channel]
                client.inbox += client.mav.parse_buffer(frame) or []

    def run_until(self, done: Callable[[], bool], ticks: int = 500) -> None:
        """Runs until `done`; fails after `ticks`."""
        for _ in range(ticks):
            if done():
                return
            self.run(1)
        raise AssertionError("it did not happen")
