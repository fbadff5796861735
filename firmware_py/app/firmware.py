"""The firmware of one process without a clock: frames in, frames out. Lockstep and real time both drive it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from firmware_py.app.preparation import job_key, prepare
from firmware_py.bus.codec import Codec, Frame
from firmware_py.bus.mapping import InputCollector, OutputEncoder
from firmware_py.bus.port import PortError, check_kind
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.types import Inputs, Outputs, PartRequest, Request
from firmware_py.description.fleet import Fleet, load_fleet
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError, read_toml
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_fleet, check_fleet
from firmware_py.runtime.worker import InlineWorker, Worker

BusFrame = tuple[int, Frame]
"""Index of the bus, and the frame."""


@dataclass(slots=True)
class Firmware:
    """The parts of one process: collector -> pipeline -> encoder."""

    fleet: Fleet
    parameters: Parameters
    codec: Codec
    collector: InputCollector
    pipeline: Pipeline
    encoder: OutputEncoder
    vehicles: Sequence[Vehicle]
    """By fleet index."""
    worker: Worker

    def sync(self, tick: int, time_ns: int) -> list[BusFrame]:
        """The SYNC frames that start tick `tick` on each bus."""
        self.collector.sync_sent(tick, time_ns)
        return self._sent(self.encoder.sync(tick))

    def discard_received(self) -> None:
        """Discards what was collected, so that the first tick takes only frames after its SYNC, as the log records it."""
        self.collector = InputCollector(self.fleet, self.codec)

    def step(
        self, tick: int, time_ns: int, received: Sequence[BusFrame], requests: Sequence[Request]
    ) -> tuple[Inputs, Outputs, list[BusFrame]]:
        """Steps the fleet with the frames that came since the last tick; returns inputs, outputs and the frames to send."""
        for bus in range(len(self.fleet.buses)):
            self.collector.take(bus, [frame for at, frame in received if at == bus])
        inputs = self.collector.collect(tick, time_ns, requests)
        outputs = self.tick(inputs)
        return inputs, outputs, self.frames(outputs)

    def frames(self, outputs: Outputs) -> list[BusFrame]:
        """The frames to send in a tick. A module's thrusters are commanded only after its first MCU_STATUS."""
        return self._sent(self.encoder.frames(outputs, self.collector.without_status))

    def _sent(self, frames: list[BusFrame]) -> list[BusFrame]:
        self.collector.sent(frames)
        return frames

    def tick(self, inputs: Inputs) -> Outputs:
        """Steps the fleet. Finished results of the worker enter `inputs`; new preparation requests go to the worker."""
        inputs.prepared = self.worker.results()
        outputs = self.pipeline.step(inputs)
        for request in outputs.preparations:
            kind, body = job_key(request, self.pipeline.bodies)
            job = partial(prepare, request, kind, self.pipeline, self.vehicles, self.fleet.pitch_m)
            self.worker.submit(job, (kind, body), first=isinstance(request, PartRequest))
        return outputs


def vehicles_of(fleet: Fleet) -> dict[str, Vehicle]:
    """The vehicles that a fleet names, by name; each file is read once."""
    return {name: load_vehicle(name) for name in dict.fromkeys(m.vehicle for m in fleet.module)}


def read_fleet(path: Path) -> Fleet:
    """The fleet in `path`, checked that its modules can be docked as it says. Raises DescriptionError, which names the file."""
    fleet = load_fleet(path)
    for index, address in enumerate(fleet.buses):
        try:
            check_kind(address)
        except PortError as error:
            raise read_toml(path)[1].error(("buses", index), str(error)) from None
    try:
        check_fleet(fleet, vehicles_of(fleet))
    except DescriptionError as error:
        raise DescriptionError(f"{path}: {error}") from None
    return fleet


def compose(
    fleet: Fleet, parameters: Parameters, vehicles: Mapping[str, Vehicle] | None = None, worker: Worker | None = None
) -> Firmware:
    """The firmware of `fleet`, ready to step; slow work runs inline unless a worker is given.

    Raises:
        DescriptionError: the fleet or a vehicle is wrong.
    """
    codec = Codec.load()
    described = vehicles if vehicles is not None else vehicles_of(fleet)
    bodies = assemble_fleet(fleet, described)
    return Firmware(
        fleet=fleet,
        parameters=parameters,
        codec=codec,
        collector=InputCollector(fleet, codec),
        pipeline=Pipeline(bodies, parameters, fleet.period_ns),
        encoder=OutputEncoder(fleet, codec),
        vehicles=[described[module.vehicle] for module in fleet.module],
        worker=worker if worker is not None else InlineWorker(),
    )
