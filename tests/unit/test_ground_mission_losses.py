"""Missions over links that lose, repeat and reorder, from two stations at once: the stored mission is always one station's, and whole."""

from random import Random
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.unit.ground_missions import item
from tests.unit.ground_world import Client, World

SEEDS = range(20)
LOSS, REPEAT, LATEST_TICKS = 0.15, 0.15, 10
RESEND_TICKS = 150


class UploadingStation:
    """A station that uploads its mission by the protocol: it answers requests, and retransmits its last message while nothing arrives."""

    def __init__(self, world: World, client: Client, items: list[tuple[float, ...]], random: Random) -> None:
        self._world, self._client, self._random = world, client, random
        self.items = items
        self.result: int | None = None
        self._read = 0
        self._on_the_way: list[tuple[int, Any]] = []
        self._last: tuple[Any, ...] = ("MISSION_COUNT", 1, 1, len(items), 0)
        self._sent_tick = -RESEND_TICKS

    def step(self) -> None:
        """Runs one tick: queues the robot's messages, delivers what is due in either direction, and retransmits after a timeout."""
        tick = self._world.robot.tick
        told, self._read = self._client.inbox[self._read :], len(self._client.inbox)
        for message in told:
            if message.get_type() in ("MISSION_REQUEST_INT", "MISSION_REQUEST", "MISSION_ACK"):
                self._lay_out(message, tick)
        for what in self._due(tick):
            if isinstance(what, bytes):
                self._client.send_raw(what)
            elif self.result is None:
                self._hear(what, tick)
        if self.result is None and tick - self._sent_tick >= RESEND_TICKS:
            self._say(tick)

    def _hear(self, message: Any, tick: int) -> None:
        if message.get_type() == "MISSION_ACK":
            self.result = message.type
        elif message.seq < len(self.items):
            self._last = ("MISSION_ITEM_INT", *self.items[message.seq], 0)
            self._say(tick)

    def _say(self, tick: int) -> None:
        self._sent_tick = tick
        self._lay_out(self._client.pack(*self._last), tick)

    def _lay_out(self, what: Any, tick: int) -> None:
        """Queues a message for delivery: lost, once or twice, each time after a random delay."""
        for _ in range(1 + (self._random.random() < REPEAT)):
            if self._random.random() >= LOSS:
                self._on_the_way.append((tick + self._random.randint(0, LATEST_TICKS), what))

    def _due(self, tick: int) -> list[Any]:
        due = [what for at, what in self._on_the_way if at <= tick]
        self._on_the_way = [(at, what) for at, what in self._on_the_way if at > tick]
        return due


@pytest.mark.parametrize("seed", SEEDS)
def test_mission_that_is_kept_is_a_whole_one_and_who_hears_that_his_is_taken_brought_it(seed: int) -> None:
    random, world = Random(seed), World()
    places = [[(302084010 + 100 * n + i, 1201614010, -0.4) for i in range(random.randint(1, 8))] for n in range(2)]
    stations = [
        UploadingStation(world, world.client(255 - n), [item(i, place) for i, place in enumerate(each)], random)
        for n, each in enumerate(places)
    ]
    kept: list[tuple[int, ...]] = []
    for _ in range(2000):
        for station in stations:
            station.step()
        world.run(1)
        now = tuple(item.x for item in world.station.services[1].flight.items)
        if now and (not kept or now != kept[-1]):
            kept.append(now)
        if all(station.result is not None for station in stations):
            break
    whole = [tuple(x for x, _, _ in each) for each in places]
    assert kept and all(each in whole for each in kept)
    for station, mission in zip(stations, whole, strict=True):
        assert station.result != mavlink.MAV_MISSION_ACCEPTED or mission in kept
        assert station.result is not None or mission in kept[:-1], "only who was taken, and then replaced, is not told any more"
