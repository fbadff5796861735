"""The bench: firmware and plant on one bus in lockstep, one process and one thread. It owns time and flies a scenario."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from firmware_py.app.configuration import configuration_of
from firmware_py.app.firmware import BusFrame, Firmware, compose
from firmware_py.app.lockstep import PATIENCE_LOOKS, Lockstep, drain, send
from firmware_py.app.observers import Observer, recording
from firmware_py.app.realtime import LISTEN_NS, OTHER_SYNC
from firmware_py.bus.port import Port, PortError, open_port
from firmware_py.core.types import Outputs
from firmware_py.description.fleet import Fleet, Module
from firmware_py.description.parameters import Parameters
from firmware_py.runtime.disk import writing_to
from firmware_py.runtime.interrupts import interrupts_deferred
from firmware_py.runtime.realtime import quiet_garbage
from firmware_py.runtime.recorder import Recorder
from hil import DEFAULT_BUS, USUAL_RATE_HZ
from hil.dock_script import DockScript
from hil.faults import Faults
from hil.force_script import ForceScript
from hil.mode_script import ModeScript
from hil.nodes import Nodes, make_nodes
from hil.orders import Orders
from hil.plant.world import World
from hil.scenario import Scenario, make_world
from hil.script import Script
from hil.starts import pitch_of
from hil.truth_log import TruthRecorder

LOOK_S = 0.005
"""Polling period while listening to a bus: SYNC comes at 50 Hz at least."""
SCRIPTS: dict[str, Callable[[Scenario, Fleet], Orders]] = {"dock": DockScript, "force": ForceScript, "mode": ModeScript}
"""Orders by kind of task; the remaining kinds, which are trajectories, use Script."""
WorldWatch = Callable[[int, World], None]
"""Called in each tick with its number and the world."""


@dataclass(slots=True)
class Bench:
    """Firmware and plant on one bus, ready to fly."""

    firmware: Firmware
    nodes: Nodes
    script: Orders
    firmware_port: Port
    plant_port: Port
    faults: Faults
    patience_looks: int = PATIENCE_LOOKS
    """Number of polls of a socket after which a frame counts as lost by the bus."""
    is_dead: bool = False
    """Whether the firmware's process is killed. Its replacement is already composed."""

    @quiet_garbage()
    def fly(
        self, observers: Sequence[Observer] = (), progress: Callable[[float], None] | None = None, watch: WorldWatch | None = None
    ) -> float:
        """Flies to the end of the script; returns the wall time that took, s. Calls `watch` once the plant has done its half of a tick.

        Raises DescriptionError if another node answers as one of the simulated modules.
        """
        lockstep, fleet = Lockstep(self.firmware, [self.firmware_port], observers, self.patience_looks), self.firmware.fleet
        sent: list[BusFrame] = []
        outputs: Outputs | None = None
        began = time.perf_counter()
        for tick in range(1, self.script.ticks + 1):
            time_ns = tick * fleet.period_ns
            if self.faults.process_killed(time_ns):
                self._step_plant(tick, sent, watch)
                lockstep, outputs, sent = self._without_firmware(observers), None, []
                continue
            self.is_dead = False
            sent += lockstep.start_tick(tick, time_ns)
            answers = self._step_plant(tick, sent, watch)
            outputs, sent = lockstep.finish_tick(tick, time_ns, self.script.requests(time_ns, outputs), answers)
            if self.script.is_over(time_ns):
                break
            if progress is not None and tick % fleet.rate_hz == 0:
                progress(time_ns * 1e-9)
        return time.perf_counter() - began

    def listen(self) -> None:
        """Listens before the first SYNC, as the vehicle's process does; not on a virtual bus, which reaches no other process.

        Raises PortError if another node sends SYNC: a robot on the bus already has a leader.
        """
        if self.plant_port.address.startswith("virtual:"):
            return
        sync = self.firmware.codec.message("SYNC").id_of(0)
        began = time.perf_counter()
        while time.perf_counter() - began < 1e-9 * LISTEN_NS:
            if any(frame.id == sync for frame in self.plant_port.receive()):
                raise PortError(OTHER_SYNC)
            time.sleep(LOOK_S)

    def _step_plant(self, tick: int, sent: Sequence[BusFrame], watch: WorldWatch | None) -> list[BusFrame]:
        """The plant's half of a tick: takes the sent frames, advances by a period and answers; returns the answers."""
        heard = [frame for _, frame in drain([self.plant_port], sent, self.patience_looks)]
        if tick <= self.firmware.fleet.rate_hz:  # later, this bench was there first
            self.nodes.refuse_others(heard, self.plant_port.address)
        answers = send([self.plant_port], [(0, frame) for frame in self.nodes.step(heard)])
        if watch is not None:
            watch(tick, self.nodes.world)
        return answers

    def _without_firmware(self, observers: Sequence[Observer]) -> Lockstep:
        """Completes a tick in which the firmware's process is dead; returns the lockstep of the firmware that will replace it."""
        self.firmware_port.receive()
        if not self.is_dead:
            self.is_dead, self.firmware = True, compose(self.firmware.fleet, self.firmware.parameters)
        return Lockstep(self.firmware, [self.firmware_port], observers, self.patience_looks)


def fleet_of(scenario: Scenario, bus: str = DEFAULT_BUS, rate_hz: int = USUAL_RATE_HZ) -> Fleet:
    """The fleet that a scenario's modules make up, all on one bus. Paths and bodies depend on neither bus nor rate."""
    modules = tuple(
        Module(number=m.number, vehicle=m.vehicle, body=m.body, cell=m.cell, rotation=m.rotation) for m in scenario.module
    )
    return Fleet(module=modules, buses=(bus,), rate_hz=rate_hz, pitch_m=pitch_of(scenario))


def script_of(scenario: Scenario, fleet: Fleet) -> Orders:
    """The script that gives the orders in a scenario."""
    return SCRIPTS.get(scenario.task.kind, Script)(scenario, fleet)


def open_bench(
    stack: ExitStack, scenario: Scenario, seed: int, parameters: Parameters, bus: str = DEFAULT_BUS, rate_hz: int = USUAL_RATE_HZ
) -> Bench:
    """A bench whose two ports are closed with `stack`. Raises DescriptionError and PortError."""
    fleet = fleet_of(scenario, bus, rate_hz)
    firmware = compose(fleet, parameters)
    world = make_world(scenario, seed, fleet.period_ns)
    nodes = make_nodes(world, firmware.codec, scenario)
    faults = nodes.faults = Faults(nodes, scenario.fault)
    ports = [stack.enter_context(open_port(bus)) for _ in range(2)]
    return Bench(firmware, nodes, script_of(scenario, fleet), ports[0], ports[1], faults)


def fly_scenario(
    scenario: Scenario,
    seed: int,
    parameters: Parameters,
    out: Path,
    bus: str = DEFAULT_BUS,
    rate_hz: int = USUAL_RATE_HZ,
    progress: Callable[[float], None] | None = None,
    before_logs: Callable[[], None] | None = None,
) -> float:
    """Flies `scenario` and leaves the logs in `out`; returns the wall time of the flight, s. Raises OSError if the disk is full.

    `before_logs` is called once nothing can be refused any more; until then the logs of an earlier flight are untouched. From then on
    Ctrl-C takes effect at the end of a tick, so that the logs are complete up to it.
    """
    with writing_to(out), ExitStack() as stack:
        bench = open_bench(stack, scenario, seed, parameters, bus, rate_hz)
        bench.listen()
        check = stack.enter_context(interrupts_deferred())
        if before_logs is not None:
            before_logs()
        recorder = Recorder(out, configuration_of(bench.firmware, scenario=scenario.name, seed=seed, rate_hz=rate_hz))
        stack.callback(recorder.close)
        thrusters = tuple(len(v.thruster) for v in bench.nodes.world.vehicles)
        truth = stack.enter_context(TruthRecorder(out, thrusters))
        wall_s = bench.fly([recording(recorder, rate_hz), lambda *_: check()], progress, truth.record_world)
        recorder.close()
        recorder.check()
        return wall_s
