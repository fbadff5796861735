"""The world of one run: all modules, the water, and their true state. The interface of the plant to all other code.

Only `advance` moves time. Docked modules share a body; `groups` gives the initial grouping.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle
from hil.plant import thrusters as thrusters_module
from hil.plant.bodies import Bodies, Modules, nominal_centre_motion
from hil.plant.build import make_thrusters
from hil.plant.dock_spec import DockSpec, JamRule
from hil.plant.docked import DockedBodies
from hil.plant.docking import Docks, joints_between
from hil.plant.draw import ModuleDraw, draw_module, stream
from hil.plant.integrator import advance
from hil.plant.jets import add_jets
from hil.plant.lattice import Place
from hil.plant.spec import Tank, WorldSpec
from hil.plant.thrusters import Thrusters
from hil.plant.water import Gusts, Water, make_water

STEP_NS = 2_500_000
"""Sub-step of the integration."""


class Start(NamedTuple):
    """Initial pose of a module, at rest."""

    p_wm: np.ndarray
    q_wm: np.ndarray


class Truth(NamedTuple):
    """True state of one module."""

    time_ns: int
    p_wm: np.ndarray
    """(3,) hull centre, world."""
    q_wm: np.ndarray
    """(4,) module to world."""
    v_w: np.ndarray
    """(3,) velocity of the hull centre, world."""
    w_b: np.ndarray
    """(3,) angular rate, module frame."""
    specific_force: np.ndarray
    """(3,) at the hull centre, module frame, m/s^2: what an ideal accelerometer reads."""
    force_n: np.ndarray
    """(t,) force of each thruster."""
    current_w: np.ndarray
    """(3,) velocity of the water."""
    voltage_v: float
    current_a: float


class BodyTruth(NamedTuple):
    """True state of one body."""

    time_ns: int
    modules: tuple[int, ...]
    p_wb: np.ndarray
    """(3,) centre of mass according to the vehicle files: the point that the controller steers."""
    q_wb: np.ndarray
    """(4,) body to world; the body frame has the axes of the lattice."""
    v_w: np.ndarray
    """(3,) velocity of that point, world."""
    w_b: np.ndarray


class Arrays(NamedTuple):
    """A world's own arrays, as `integrator.advance` takes them."""

    bodies: Bodies
    modules: Modules
    thrusters: Thrusters
    water: Water
    gusts: np.ndarray
    """(k, 3) target of the gust in each of the next k ticks."""
    external: np.ndarray
    steps: int
    """Sub-steps of a tick."""
    step_s: float
    stage: np.ndarray
    thrust: np.ndarray
    seen: np.ndarray
    """(m, 16) written by `bodies.observe`."""


class World(DockedBodies):
    """Modules in a tank."""

    def __init__(
        self,
        spec: WorldSpec,
        tank: Tank,
        vehicles: Sequence[Vehicle],
        starts: Sequence[Start],
        seed: int,
        period_ns: int,
        step_ns: int = STEP_NS,
        groups: Sequence[Sequence[int]] | None = None,
        places: Sequence[Place] | None = None,
        dock: DockSpec | None = None,
        jam: JamRule | None = None,
    ) -> None:
        """Creates a world at time 0.

        Args:
            vehicles, starts: one per module; for modules that start docked, the leader's start places the body.
            groups: modules of each body, the leader first; each module alone when left out.
            places: seat of each module in its body, whose frame has its origin at the leader's hull centre.
            dock, jam: parameters of the docking faces and of their jams.
            seed: of every draw; the same seed gives the same world.
            period_ns: the tick, for which `advance` will be called. Raises DescriptionError when step_ns does not divide it.
        """
        if period_ns % step_ns:
            raise DescriptionError(f"plant: the sub-step of {step_ns} ns does not divide the tick of {period_ns} ns")
        self._truths: dict[int, Truth] = {}
        self._escs: dict[int, np.ndarray] = {}
        self.time_ns = 0
        self.vehicles = tuple(vehicles)
        self.spec = spec
        self.seed = seed
        self.period_ns = period_ns
        self._step_ns = step_ns
        self._draws = [draw_module(v, spec, seed, m) for m, v in enumerate(vehicles)]
        self._first = [0, *np.cumsum([len(v.thruster) for v in vehicles]).tolist()]
        self._water = make_water(spec, tank)
        self._gusts = Gusts(spec, stream(seed, "gusts"), 1e-9 * period_ns)
        self._water.flow[0], self._water.flow[1] = self._gusts.mean, self._gusts.start
        self._thrusters = make_thrusters(vehicles, self._draws, spec, step_ns)
        self._seen = np.zeros((len(vehicles), 16))
        self.docks = Docks(vehicles, dock or DockSpec(), jam or JamRule(), seed)
        self.jet_strength = spec.jet_strength
        self._held = set()
        self._thruster_faults: dict[tuple[int, int], tuple[str, float]] = {}
        self.push = np.zeros((len(vehicles), 6))
        """(m, 6) external push on each module: wrench about its hull's centre, module frame, N and N m."""
        alone = [Place(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])) for _ in vehicles]
        self._seat(groups or [(m,) for m in range(len(vehicles))], places or alone)
        for b, members in enumerate(self.bodies):
            self._put(b, members[0], starts[members[0]])
        self.docks.energise(joints_between(self._modules, self.docks.faces.kind))
        self._power_magnets()
        self._step(0)

    def _put(self, body: int, leader: int, start: Start) -> None:
        """Sets the pose of a body from the start of its leader."""
        x, q_wm = self._body_arrays.state[body], rotations.normalise(np.array(start.q_wm, dtype=np.float64))
        x[3:7] = rotations.normalise(rotations.multiply(q_wm, rotations.conjugate(self._modules.quaternion[leader])))
        x[:3] = start.p_wm - rotations.rotate(x[3:7].copy(), self._modules.position[leader].copy())

    def set_command(self, module: int, u: Sequence[float] | np.ndarray) -> None:
        """Sets the commands (t,), -1 to 1, of one module's thrusters, held until the next call."""
        wanted = np.array(u, dtype=np.float64)
        if self._thruster_faults:
            wanted = self._with_thruster_faults(module, wanted)
        arrays = self._thrusters
        thrusters_module.command(arrays.force_curve, arrays.constants, arrays.level, self._first[module], wanted)
        for (m, t), (how, value) in self._thruster_faults.items():
            if m == module and how == "weak":
                self._thrusters.level[self._first[m] + t, 0] *= value

    def break_thruster(self, module: int, thruster: int, how: str, value: float = 0.0) -> None:
        """Makes a thruster faulty from the next command on.

        Args:
            how: dead; weak: `value` is the share of force left, with a slower propeller; reversed; stuck: at the command
                `value`; fake_rpm: `value` is the share of force left, but the ESC reports the speed of a healthy thruster.
        """
        self._thruster_faults[module, thruster] = (how, value)
        share = value if how == "fake_rpm" else 1.0
        self._thrusters.constants[self._first[module] + thruster, 0] = share * self._draws[module].gain[thruster]

    def clear_faults(self, module: int) -> None:
        """Ends all faults of a module: restores thrusters, battery and magnets to their initial parameters and removes the push."""
        self._thruster_faults = {key: broken for key, broken in self._thruster_faults.items() if key[0] != module}
        self._thrusters.constants[self._first[module] : self._first[module + 1], 0] = self._draws[module].gain
        self._thrusters.supply[module, 1] = self.vehicles[module].supply.voltage_v
        self.push[module] = 0.0
        self.docks.unstick_relays(module)

    def _with_thruster_faults(self, module: int, wanted: np.ndarray) -> np.ndarray:
        for (m, t), (how, value) in self._thruster_faults.items():
            if m == module and how in ("dead", "reversed", "stuck"):
                wanted[t] = {"dead": 0.0, "reversed": -wanted[t], "stuck": value}[how]
        return wanted

    def sag(self, module: int, volts: float) -> None:
        """Lowers the open-circuit voltage of a module's battery by `volts`, at most to zero."""
        self._thrusters.supply[module, 1] = max(0.0, self._thrusters.supply[module, 1] - volts)

    def advance(self, duration_ns: int) -> None:
        """Advances the world. Raises DescriptionError when the duration is no multiple of the sub-step."""
        if duration_ns % self._step_ns:
            raise DescriptionError(f"plant: the sub-step of {self._step_ns} ns does not divide {duration_ns} ns")
        self._water.flow[2] = self._gusts.step()
        self._step(duration_ns // self._step_ns)
        self.time_ns += duration_ns
        if len(self.vehicles) > 1 or self.docks.busy:
            self._dock(1e-9 * duration_ns)

    def set_relays(self, module: int, relays: Sequence[int]) -> None:
        """Sets the relay states of a module's six magnets: 0 off, 1 forward, 2 reverse."""
        self.docks.set_relays(module, relays)
        self._power_magnets()

    def _power_magnets(self) -> None:
        idle = np.array([v.supply.idle_w for v in self.vehicles])
        self._thrusters.supply[:, 4] = idle + self.docks.magnet_power_w()

    def _dock(self, elapsed_s: float) -> None:
        state = self._body_arrays.state
        verdict = self.docks.step(self.time_ns, elapsed_s, self._modules, state, self._pull_on)
        for joint in verdict.part:
            self.part(joint)
        for joint in verdict.join:
            if self._modules.body[joint.module] != self._modules.body[joint.other]:
                self.join(joint)

    def _step(self, steps: int) -> None:
        h = 1e-9 * self._step_ns
        self._truths.clear()
        self._escs.clear()
        self._external[:] = 0.0
        if len(self.vehicles) > 1 or any(self.push.ravel().tolist()):
            self._update_external_wrenches()
        faces = self.docks.faces if len(self.bodies) > 1 else None
        arrays = (self._body_arrays, self._modules, faces, self._thrusters, self._water)
        advance(*arrays, self._external, steps, h, self._stage, self._thrust, self._seen)

    def _update_external_wrenches(self) -> None:
        """Computes the wrenches of jets and external pushes on modules and bodies."""
        self._module_wrenches[:] = 0.0
        if len(self.vehicles) > 1 and self.jet_strength > 0.0:
            jet = (self.jet_strength, self.spec.jet_length_m, self.spec.jet_radius_m)
            add_jets(self._thrusters, self._body_arrays, self._modules, *jet, self._module_wrenches)
        for m in sorted(set(self.push.nonzero()[0].tolist())):
            force, moment = (self._modules.turn[m] @ part for part in np.split(self.push[m], 2))
            moment += np.cross(self._modules.position[m], force)
            self._module_wrenches[m] += np.concatenate([force, moment])
        np.add.at(self._external, self._modules.body, self._module_wrenches)

    def batch_key(self) -> tuple[object, ...]:
        """Returns the parameters that all worlds of one batch must share: water, tank, tick and sub-step.

        Raises DescriptionError for more than one module, a faulty thruster, an external push, a clamped body, or a coil that carries
        current: these need Python between the ticks.
        """
        if len(self.vehicles) > 1 or self._thruster_faults:
            raise DescriptionError(
                "plant: a batch is of lone modules that are whole; "
                f"here are {len(self.vehicles)} modules, {len(self._thruster_faults)} faults"
            )
        acts = {"a hand is on it": self.push.any(), "it is clamped": self._body_arrays.clamped.any(), "a coil is on": self.docks.busy}
        if found := [what for what, does in acts.items() if does]:
            raise DescriptionError(f"plant: a batch is of lone modules that nothing but thrusters and water moves; here {', '.join(found)}")
        return (self._water[1:], self.period_ns, self._step_ns)

    def lend_arrays(self, ticks: int) -> Arrays:
        """Lends the arrays of a single-module world to `hil.batch`, which has checked `batch_key` and advances them by `ticks`. Sets the
        clock to the end of these ticks at once, so the truth must not be read before the batch has flown.
        """
        self._truths.clear()
        self._escs.clear()
        self.time_ns += ticks * self.period_ns
        return Arrays(
            self._body_arrays, self._modules, self._thrusters, self._water, self._gusts.steps(ticks), self._external,
            self.period_ns // self._step_ns, 1e-9 * self._step_ns, self._stage, self._thrust, self._seen,
        )  # fmt: skip

    def truth(self, module: int) -> Truth:
        """Returns the true state of one module. Its arrays are copies, cached until the world advances.

        Raises DescriptionError when it has none: the integration has become unstable.
        """
        if module not in self._truths:
            self._truths[module] = self._look_at(module)
        return self._truths[module]

    def _look_at(self, module: int) -> Truth:
        seen = self._seen[module].copy()
        if not math.isfinite(seen @ seen):
            what = f"after {1e-9 * self.time_ns:.3g} s of seed {self.seed} the motion of the modules is beyond all numbers"
            why = f"a force is too stiff for the sub-step of {1e-6 * self._step_ns:g} ms"
            raise DescriptionError(f"plant: {what}: {why}; lower stiffness and damping under [world] or [dock]")
        power = self._thrusters.power[module]
        first, last = self._first[module], self._first[module + 1]
        return Truth(
            self.time_ns, seen[:3], seen[3:7], seen[7:10], seen[10:13], seen[13:16],
            self._thrusters.force[first:last].copy(), self._flow(),
            float(power[0]), float(power[1]),
        )  # fmt: skip

    def seen(self) -> np.ndarray:
        """(m, 16) state of all modules, cheaper than `truth`: position, quaternion, velocity, rate, specific force."""
        return self._seen.copy()

    def body_truth(self, body: int) -> BodyTruth:
        """Returns the true state of one body, by its index in `bodies`."""
        modules = self.bodies[body]
        x = self._body_arrays.state[body]
        seen = np.empty(6)
        nominal_centre_motion(x, self._centres[body], seen)
        return BodyTruth(self.time_ns, modules, seen[:3], x[3:7].copy(), seen[3:], x[10:13].copy())

    def esc(self, module: int) -> np.ndarray:
        """(t, 2) speed (1/min) and current (A) of each thruster of a module; cached until the world advances."""
        if module not in self._escs:
            first, last = self._first[module], self._first[module + 1]
            self._escs[module] = np.empty((last - first, 2))
            thrusters_module.feedback(self._thrusters, first, self._escs[module])
        return self._escs[module]

    def draw(self, module: int) -> ModuleDraw:
        """Returns the parameters of a module drawn for this seed."""
        return self._draws[module]

    def kinetic_energy(self) -> np.ndarray:
        """(b,) kinetic energy of each body with its added mass, in still water, J."""
        arrays = self._body_arrays
        return np.array([0.5 * x[7:] @ (arrays.rigid[b] + arrays.added[b]) @ x[7:] for b, x in enumerate(arrays.state)])

    def set_motion(self, body: int, v_w: np.ndarray, w_b: np.ndarray) -> None:
        """Sets the velocity (3,) of O, world, and the angular rate (3,), body frame, of a body."""
        x = self._body_arrays.state[body]
        x[7:10], x[10:13] = rotations.rotate_back(x[3:7].copy(), np.array(v_w, dtype=np.float64)), w_b
        self._step(0)
