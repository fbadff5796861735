"""The simulated tag computer, a node of its own on the bus: turns the sightings of cameras into TAG frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence

from firmware_py.bus.codec import Codec, Frame, pack_quaternion
from hil.plant.camera import Camera, Sighting, in_the_world
from hil.plant.spec import SensorSpec
from hil.plant.world import World


class TagCamera:
    """The tag computer, number 31: sends the sightings of its cameras, in the world frame, after its processing delay.

    It knows the poses of its fixed cameras. A carried camera's sighting is placed in the world by way of a sighting of the carrier in a
    picture of the same instant, and inherits its errors; without such a sighting it is dropped.
    """

    def __init__(
        self, codec: Codec, cameras: Sequence[Camera], numbers: Mapping[int, int], spec: SensorSpec, world: World
    ) -> None:
        self._position, self._attitude = codec.message("TAG_POSITION"), codec.message("TAG_ATTITUDE")
        self._cameras, self._world = sorted(cameras, key=lambda c: c.carrier >= 0), world
        self._number_of = {module: number for number, module in numbers.items()}
        self._tags = [{tag.id: tag for tag in vehicle.tag} for vehicle in world.vehicles]
        self._delay_ns = round(1e6 * spec.tag_delay_ms)
        self._waiting: deque[tuple[Sighting, int, int]] = deque()
        self._sync: tuple[int, int] | None = None
        self._counters = dict.fromkeys(self._number_of, 0)
        self._farthest_m = min(axis.factor * axis.raw_high for axis in self._position.field_details[:3])
        self.change: Callable[[Sighting, int], Sighting | None] = lambda sighting, carrier: sighting
        """Fault hook: changes a sighting by a camera on the given module (-1: fixed camera); returns None to lose it."""
        self.watch()

    def watch(self) -> None:
        """Takes the pictures that are due, stamped relative to the last SYNC. Sightings that a frame cannot represent are dropped."""
        for sighting in self._see():
            if self._sync is None or sighting.module not in self._number_of:
                continue
            tick, sync_ns = self._sync
            offset_ns = sighting.capture_ns - sync_ns
            is_near = all(abs(m) <= self._farthest_m for m in sighting.p_wt.tolist())  # else the frame would saturate
            if is_near and 0 <= offset_ns <= 25_500_000:  # range of 8 bits of 0.1 ms
                self._waiting.append((sighting, tick, offset_ns))

    def _see(self) -> list[Sighting]:
        """Returns all sightings of the pictures that are due, world frame, in order of capture."""
        fixed: list[Sighting] = []
        for camera in self._cameras:
            found = camera.watch(self._world)
            if camera.carrier < 0:
                fixed += [seen for s in found if (seen := self.change(s, s.carrier)) is not None]
                continue
            for relative in found:
                own = [s for s in fixed if s.module == relative.carrier and s.capture_ns == relative.capture_ns]
                if own:
                    tag = self._tags[own[0].module][own[0].tag_id]
                    seen = self.change(in_the_world(relative, own[0], tag), relative.carrier)
                    fixed += [] if seen is None else [seen]
        return sorted(fixed, key=lambda s: s.capture_ns)

    def sync(self, tick: int, time_ns: int) -> list[Frame]:
        """Records the time of SYNC and returns the frames of sightings that are due."""
        self._sync = (tick, time_ns)
        frames = []
        while self._waiting and self._waiting[0][0].capture_ns + self._delay_ns <= time_ns:
            sighting, capture_tick, offset_ns = self._waiting.popleft()
            counter = self._counters[sighting.module]
            self._counters[sighting.module] = (counter + 1) & 15
            number = self._number_of[sighting.module]
            frames.append(self._position.encode(number, sighting.p_wt.tolist(), counter))
            values = [
                *pack_quaternion(sighting.q_wt.tolist()),
                sighting.tag_id,
                sighting.quality,
                capture_tick & 0xFF,
                1e-6 * offset_ns,
            ]
            frames.append(self._attitude.encode(number, values, counter))
        return frames
