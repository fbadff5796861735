"""Missions as a client sends them, flown along a plan that jumps from place to place."""

import numpy as np

from firmware_py.core.types import Setpoint
from firmware_py.ground.plan_jobs import Plan, PlanJob
from tests.unit.ground_requests import NAN
from tests.unit.ground_world import Client, World

PLACES = [(302084010, 1201614010, -0.4), (302084020, 1201614000, -0.3), (302084000, 1201614000, -0.5)]


class Path:
    """A trajectory that jumps to each leg's place at its time and stands still in between."""

    def __init__(self, job: PlanJob, arrivals_s: tuple[float, ...]) -> None:
        self.duration_s = arrivals_s[-1]
        self._stops = [(0.0, job.p_wb)]
        for at_s, leg in zip(arrivals_s, job.legs, strict=True):
            self._stops.append((at_s, self._stops[-1][1] if leg.p_wb is None else leg.p_wb))

    def sample(self, t_s: float) -> Setpoint:
        zero = np.zeros(3)
        p_wb = [place for at_s, place in self._stops if at_s <= max(t_s, 0.0)][-1]
        return Setpoint(p_wb, np.array([1.0, 0, 0, 0]), zero, zero, zero, zero)


def plan_of(job: PlanJob, first_arrival_s: float = 10.0) -> Plan:
    """A plan that takes the same time for each leg."""
    arrivals = tuple(first_arrival_s * (i + 1) for i in range(len(job.legs)))
    return Plan(job.serial, Path(job, arrivals), arrivals)


def item(
    sequence: int,
    place: tuple[int, int, float],
    command: int = 16,
    frame: int = 6,
    p: tuple[float, ...] = (0, 0, 0, NAN),
) -> tuple[float, ...]:
    return (1, 1, sequence, frame, command, 0, 1, *p, *place)


def upload(world: World, client: Client, items: list[tuple[float, ...]], kind: int = 0, target: int = 1) -> int:
    """Sends items as they are requested; returns the result in the acknowledgement."""
    client.clear()
    client.send("MISSION_COUNT", target, 1, len(items), kind)
    answered = 0
    for _ in range(400):
        world.run(1)
        if client.all("MISSION_ACK"):
            return int(client.last("MISSION_ACK").type)
        asked = client.all("MISSION_REQUEST_INT")
        if len(asked) > answered:
            client.send("MISSION_ITEM_INT", target, *items[asked[-1].seq][1:], kind)
            answered = len(asked)
    raise AssertionError("no acknowledgement")


def begin(world: World, client: Client, *start: float) -> PlanJob:
    """Arms, and starts the mission by the command `start` or else by mode; returns what is to be planned."""
    client.command(400, 1)
    world.run(3)
    client.command(*(start or (176, 1, 4, 4)))
    world.run(10)
    (job,) = world.station.jobs()
    return job


def go_to(world: World, client: Client) -> PlanJob:
    """Arms, and requests a way to one place; returns what is to be planned."""
    client.command(400, 1)
    world.run(3)
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, -1, 1, 0, 1.0, 302084010, 1201614000, -0.4)
    world.run(10)
    (job,) = world.station.jobs()
    return job


def fly(world: World, client: Client, first_arrival_s: float = 10.0) -> PlanJob:
    """Arms, starts the mission by mode and delivers the plan, which the body then tracks; returns what was planned."""
    job = begin(world, client)
    world.station.planned(0, plan_of(job, first_arrival_s))
    world.run(3)
    return job


def continued(world: World, client: Client) -> list[int]:
    """Continues the mission; returns the items that are planned."""
    client.command(193, 1)
    world.run(10)
    (job,) = world.station.jobs()
    return [leg.sequence for leg in job.legs]
