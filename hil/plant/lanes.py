"""SIMD integration of eight single-module worlds side by side, for `hil.batch`: every operation runs on all eight lanes at once.

One array holds all numbers of the eight worlds, a row of eight per quantity: the compiler vectorises a loop over lanes only where it
knows the distance between rows. The formulas are those of bodies.py, drag.py and thrusters.py, in the same order, so the results are
bit-identical to those of `World.advance`.
"""

from __future__ import annotations

import math

from numba import njit, types

from hil.plant import drag
from hil.plant.bodies import BODIES, MODULES, NEAR_M, add_walls, respond, touches, turning, weigh
from hil.plant.thrusters import THRUSTERS, idle_of, voltage_of
from hil.plant.vectors import (
    F1,
    F2,
    F3,
    F8,
    I8,
    callee,
    compiled,
    cross,
    matrix_of,
    minus,
    plus,
    times,
    turn,
    turn_back,
)  # fmt: skip
from hil.plant.water import WATER, room

pasted = njit(inline="always")
"""Inlining by numba itself. Inlining by LLVM (`vectors.inlined`) comes too late here: by then the information that an index is not
negative is lost."""
LANES = 8
CHANNELS = 8
"""Thruster channels of each module; channels that a vehicle does not use produce no force."""

STATE, TRIAL, RATES, STAGES = 0, 13, 26, 39
"""Rows: state; trial state of a stage; derivative there; derivatives of the four stages. 13 each."""
RIGID = STAGES + 4 * 13
ADDED, INVERSE = RIGID + 36, RIGID + 72
"""Mass matrices, row by row."""
WEIGHT = INVERSE + 36
"""Fields of `Bodies`: weight 8, hull 4."""
SIZE = WEIGHT + 12
"""Fields of `Modules`: size 3, drag 5, linear 6, quadratic 6, sides 3; then half the hull's diagonal 1."""
WRENCH = SIZE + 24
"""Force and moment about O, body frame: thrusters alone 6, total 6."""
FLOW = WRENCH + 12
"""`Water.flow` 9; velocity and acceleration of the water at a stage 6."""
SUPPLY = FLOW + 15
"""Fields of `Thrusters`: supply 5, power 2."""
ROOM = SUPPLY + 7
"""Distance to the nearest of walls, bottom and surface, less half the hull's diagonal."""
COLUMN = ROOM + 1
"""From here on fields of `Thrusters`: CHANNELS rows for every number of a field; working memory last."""
FORCE_CURVE = COLUMN + 6 * CHANNELS
POWER_CURVE = FORCE_CURVE + 10 * CHANNELS
GAIN = POWER_CURVE + 10 * CHANNELS
DEADBAND = GAIN + CHANNELS
DECAY = GAIN + 3 * CHANNELS
TARGET = DECAY + 3 * CHANNELS
NOW = TARGET + CHANNELS
FORCE = NOW + CHANNELS
MEMORY = FORCE + CHANNELS
ROWS = MEMORY + CHANNELS


@pasted
def _three(w, row, m):
    return (w[row * LANES + m], w[(row + 1) * LANES + m], w[(row + 2) * LANES + m])


@pasted
def _four(w, row, m):
    return (w[row * LANES + m], w[(row + 1) * LANES + m], w[(row + 2) * LANES + m], w[(row + 3) * LANES + m])


@pasted
def _five(w, row, m):
    a, b, c, d = _four(w, row, m)
    return (a, b, c, d, w[(row + 4) * LANES + m])


@pasted
def _six(w, row, m):
    (a, b, c), (d, e, f) = _three(w, row, m), _three(w, row + 3, m)
    return (a, b, c, d, e, f)


@pasted
def _block(w, row, m):
    return (_three(w, row, m), _three(w, row + 6, m), _three(w, row + 12, m))


@pasted
def _mass(w, row, m):
    return (_block(w, row, m), _block(w, row + 3, m), _block(w, row + 18, m), _block(w, row + 21, m))


@pasted
def _put(w, row, m, a):
    w[row * LANES + m], w[(row + 1) * LANES + m], w[(row + 2) * LANES + m] = a


@pasted
def _polynomial(w, row, j, x):
    """Lane version of `thrusters.polynomial`; j: index of thruster and lane."""
    total = x * (w[(row + 4 * CHANNELS) * LANES + j] + 0.0)
    total = x * (w[(row + 3 * CHANNELS) * LANES + j] + total)
    total = x * (w[(row + 2 * CHANNELS) * LANES + j] + total)
    total = x * (w[(row + CHANNELS) * LANES + j] + total)
    return x * (w[row * LANES + j] + total)


@pasted
def _curve(w, row, j, x, is_forward):
    """Value of the forward or reverse curve of a thruster; computes both, since lanes cannot branch."""
    forward, reverse = _polynomial(w, row, j, x), _polynomial(w, row + 5 * CHANNELS, j, x)
    return forward if is_forward else reverse


@pasted
def _sum(w, first, m):
    """Sum over the thrusters."""
    a, b, c, d = _four(w, first, m)
    e, f, g, h = _four(w, first + 4, m)
    return a + b + c + d + e + f + g + h


@pasted
def _reached(w, j, halves):
    """Lagged force of thruster and lane j, `halves` half sub-steps ahead."""
    target, now = w[TARGET * LANES + j], w[NOW * LANES + j]
    return target + (now - target) * w[(DECAY + halves * CHANNELS) * LANES + j]


@callee
def _command(w, n):
    """Lane version of `thrusters.command`; reads the commands from the rows MEMORY."""
    for j in range(CHANNELS * n):
        given = w[MEMORY * LANES + j]
        force = _curve(w, FORCE_CURVE, j, min(1.0, abs(given)), given > 0.0)
        force = 0.0 if force < w[DEADBAND * LANES + j] else force
        w[TARGET * LANES + j] = force if given > 0.0 else -force


@pasted
def _load_supplies(w, n, halves):
    """Lane version of `thrusters.load_supplies`."""
    for j in range(CHANNELS * n):
        f = _reached(w, j, halves)
        w[MEMORY * LANES + j] = _curve(w, POWER_CURVE, j, abs(f), f > 0.0)
    for m in range(n):
        v0, open_v, resistance, limit_a, electronics = _five(w, SUPPLY, m)
        idle_a, conductance = idle_of(open_v, resistance, limit_a, electronics), _sum(w, MEMORY, m) / v0**3
        v = voltage_of(open_v, resistance, limit_a, idle_a, conductance)
        w[(SUPPLY + 5) * LANES + m] = v
        w[(SUPPLY + 6) * LANES + m] = idle_a + conductance * v * v


@pasted
def _column(w, row, m):
    """Three numbers of one thruster."""
    return (w[row * LANES + m], w[(row + CHANNELS) * LANES + m], w[(row + 2 * CHANNELS) * LANES + m])


@pasted
def _add(w, t, m, scale, f, moment):
    """Adds force and moment of thruster t, whose lagged force is in the rows MEMORY; scale: voltage over the curve's voltage."""
    force = w[(GAIN + t) * LANES + m] * scale * scale * w[(MEMORY + t) * LANES + m]
    w[(FORCE + t) * LANES + m] = force
    f = plus(f, times(force, _column(w, COLUMN + t, m)))
    return f, plus(moment, times(force, _column(w, COLUMN + 3 * CHANNELS + t, m)))


@pasted
def _push(w, n, halves):
    """Lane version of `thrusters.forces_after` and `integrator.wrenches`; unrolled, since an inner loop would prevent vectorisation."""
    for j in range(CHANNELS * n):
        w[MEMORY * LANES + j] = _reached(w, j, halves)
    for m in range(n):
        scale = w[(SUPPLY + 5) * LANES + m] / w[SUPPLY * LANES + m]
        f, moment = _add(w, 0, m, scale, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        f, moment = _add(w, 1, m, scale, f, moment)
        f, moment = _add(w, 2, m, scale, f, moment)
        f, moment = _add(w, 3, m, scale, f, moment)
        f, moment = _add(w, 4, m, scale, f, moment)
        f, moment = _add(w, 5, m, scale, f, moment)
        f, moment = _add(w, 6, m, scale, f, moment)
        f, moment = _add(w, 7, m, scale, f, moment)
        _put(w, WRENCH, m, f)
        _put(w, WRENCH + 3, m, moment)


@callee
def _settle(w, n):
    """Lane version of `thrusters.settle`."""
    for j in range(CHANNELS * n):
        w[NOW * LANES + j] = _reached(w, j, 2)


@callee
def _flow(w, n, water, keep):
    """Lane version of `water.flow_at`; keep: fraction of the difference from the target that remains by then."""
    rate = 1.0 / water.smoothing_s
    for m in range(n):
        mean, gust, target = _three(w, FLOW, m), _three(w, FLOW + 3, m), _three(w, FLOW + 6, m)
        gap = times(keep, minus(gust, target))
        _put(w, FLOW + 9, m, plus(mean, plus(target, gap)))
        _put(w, FLOW + 12, m, times(-rate, gap))


@callee
def _along(w, n, h):
    """Lane version of `integrator.along`."""
    for j in range(13 * n):
        w[TRIAL * LANES + j] = w[STATE * LANES + j] + h * w[RATES * LANES + j]


@callee
def _load(w, n, water):
    """Lane version of `bodies.load` without the walls; writes the distance to them into ROOM."""
    half_rho = 0.5 * water.density
    for m in range(n):
        at, q, v, rate = _three(w, TRIAL, m), _four(w, TRIAL + 3, m), _three(w, TRIAL + 7, m), _three(w, TRIAL + 10, m)
        r, flow, flow_rate = matrix_of(q[0], q[1], q[2], q[3]), _three(w, FLOW + 9, m), _three(w, FLOW + 12, m)
        weight, lift, displaced = w[WEIGHT * LANES + m], w[(WEIGHT + 1) * LANES + m], w[(WEIGHT + 8) * LANES + m]
        weight_at, lift_at, displaced_at = _three(w, WEIGHT + 2, m), _three(w, WEIGHT + 5, m), _three(w, WEIGHT + 9, m)
        f, moment = weigh(weight, weight_at, lift, lift_at, displaced, displaced_at, r, flow_rate)
        f, moment = plus(_three(w, WRENCH, m), f), plus(_three(w, WRENCH + 3, m), moment)
        slip, size, (face, edge) = minus(v, turn_back(r, flow)), _three(w, SIZE, m), (w[(SIZE + 3) * LANES + m], w[(SIZE + 4) * LANES + m])
        factor = half_rho * drag.translation(size[0], size[1], size[2], face, edge, slip[0], slip[1], slip[2])
        sides, c, linear, quadratic = _three(w, SIZE + 20, m), _three(w, SIZE + 5, m), _six(w, SIZE + 8, m), _six(w, SIZE + 14, m)
        dragged = drag.box(size, sides, c, linear, quadratic, half_rho, factor, (0.0, 0.0, 0.0), slip, rate)
        _put(w, WRENCH + 6, m, plus(f, dragged[0]))
        _put(w, WRENCH + 9, m, plus(moment, dragged[1]))
        w[ROOM * LANES + m] = room(water, at) - w[(SIZE + 23) * LANES + m]


@callee
def _meet_walls(w, n, bodies, modules, water):
    """Adds the wall forces of the few lanes that are near a wall; `bodies` is working memory."""
    for m in range(n):
        if w[ROOM * LANES + m] <= NEAR_M:
            for i in range(13):
                bodies.state[m, i] = w[(TRIAL + i) * LANES + m]
            if touches(modules, m, water, bodies.state):
                for i in range(6):
                    bodies.wrench[m, i] = w[(WRENCH + 6 + i) * LANES + m]
                add_walls(bodies, modules, m, water, bodies.state)
                for i in range(6):
                    w[(WRENCH + 6 + i) * LANES + m] = bodies.wrench[m, i]


@callee
def _accelerate(w, n):
    """Lane version of `bodies.accelerate`."""
    for m in range(n):
        q, v, rate = _four(w, TRIAL + 3, m), _three(w, TRIAL + 7, m), _three(w, TRIAL + 10, m)
        flow, flow_rate, f, moment = _three(w, FLOW + 9, m), _three(w, FLOW + 12, m), _three(w, WRENCH + 6, m), _three(w, WRENCH + 9, m)
        r = matrix_of(q[0], q[1], q[2], q[3])
        a, alpha = respond(_mass(w, RIGID, m), _mass(w, ADDED, m), _mass(w, INVERSE, m), r, v, rate, flow, flow_rate, f, moment)
        spin = turning(q, rate)
        w[(RATES + 3) * LANES + m] = spin[0]
        _put(w, RATES, m, turn(r, v))
        _put(w, RATES + 4, m, (spin[1], spin[2], spin[3]))
        _put(w, RATES + 7, m, a)
        _put(w, RATES + 10, m, alpha)


@callee
def _close_step(w, n, h):
    """Lane version of `integrator.close_step`."""
    for j in range(13 * n):
        inner = w[(STAGES + 13) * LANES + j] + w[(STAGES + 26) * LANES + j]
        w[STATE * LANES + j] += h / 6.0 * (w[STAGES * LANES + j] + 2.0 * inner + w[(STAGES + 39) * LANES + j])
    for m in range(n):
        a, b, c, d = _four(w, STATE + 3, m)
        norm = math.sqrt(a**2 + b**2 + c**2 + d**2)
        w[(STATE + 3) * LANES + m] = a / norm
        _put(w, STATE + 4, m, (b / norm, c / norm, d / norm))


@callee
def _observe(w, gravity, out, k):
    """Lane version of `bodies.observe`; writes tick k of out (worlds, ticks, 16)."""
    for m in range(out.shape[0]):
        q, v, rate = _four(w, STATE + 3, m), _three(w, STATE + 7, m), _three(w, STATE + 10, m)
        r = matrix_of(q[0], q[1], q[2], q[3])
        felt = minus(plus(_three(w, RATES + 7, m), cross(rate, v)), times(gravity, r[2]))
        velocity = turn(r, v)
        for i in range(7):
            out[m, k, i] = w[i * LANES + m]
        for i in range(3):
            out[m, k, 7 + i], out[m, k, 10 + i], out[m, k, 13 + i] = velocity[i], rate[i], felt[i]


@callee
def _look(w, n, bodies, modules, water, since_s, ahead_s):
    """Writes the derivative at the state extrapolated by `ahead_s` with the previous derivative, in the water `since_s` into the tick."""
    _flow(w, n, water, math.exp(-since_s / water.smoothing_s))
    _along(w, n, ahead_s)
    _load(w, n, water)
    _meet_walls(w, n, bodies, modules, water)
    _accelerate(w, n)


@compiled(types.void(F1, I8, BODIES, MODULES, WATER, F3, F3, I8, F8, F3), nogil=True)
def fly_lanes(w, n, bodies, modules, water, gusts, commands, steps, h, out):
    """Integrates all worlds over all ticks; arguments as in `integrator.advance`.

    Args:
        w: filled by `gather`. n: LANES, passed as an argument because the compiler would unroll loops over a constant.
        bodies: working memory. gusts: (n, k, 3). commands: (n, k, t). out: (worlds, k, 16) written.
    """
    for k in range(commands.shape[1]):
        for m in range(n):
            _put(w, FLOW + 6, m, (gusts[m, k, 0], gusts[m, k, 1], gusts[m, k, 2]))
            for t in range(commands.shape[2]):
                w[(MEMORY + t) * LANES + m] = commands[m, k, t]
        _command(w, n)
        for s in range(steps):
            _load_supplies(w, n, 1)
            for stage in range(4):
                share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                if stage == 0:
                    _push(w, n, 0)
                elif stage == 1:
                    _push(w, n, 1)
                elif stage == 3:
                    _push(w, n, 2)
                _look(w, n, bodies, modules, water, (s + share) * h, share * h)
                for j in range(13 * n):
                    w[(STAGES + 13 * stage) * LANES + j] = w[RATES * LANES + j]
            _close_step(w, n, h)
            _settle(w, n)
        _load_supplies(w, n, 0)
        _push(w, n, 0)
        _look(w, n, bodies, modules, water, steps * h, 0.0)
        for m in range(n):
            _put(w, FLOW + 3, m, minus(_three(w, FLOW + 9, m), _three(w, FLOW, m)))
        _observe(w, water.gravity, out, k)


@compiled(types.void(F1, I8, BODIES, MODULES, THRUSTERS, WATER))
def gather(w, m, bodies, modules, thrusters, water):
    """Copies a single-module world into lane m of w, (ROWS * LANES,)."""
    lane, masses = w[m:], (bodies.rigid, bodies.added, bodies.inverse)
    for i in range(13):
        lane[(STATE + i) * LANES] = bodies.state[0, i]
    for k in range(3):
        for i in range(36):
            lane[(RIGID + 36 * k + i) * LANES] = masses[k][0, i // 6, i % 6]
    reach = 0.0
    for i in range(3):
        lane[(SIZE + i) * LANES], lane[(SIZE + 20 + i) * LANES] = modules.size[0, i], modules.sides[0, i]
        reach += 0.25 * modules.size[0, i] ** 2
        for k in range(3):
            lane[(FLOW + 3 * k + i) * LANES] = water.flow[k, i]
    lane[(SIZE + 23) * LANES] = math.sqrt(reach)
    for first, rows in (
        (WEIGHT, bodies.weight), (WEIGHT + 8, bodies.hull), (SIZE + 3, modules.drag), (SIZE + 8, modules.linear),
        (SIZE + 14, modules.quadratic), (SUPPLY, thrusters.supply), (SUPPLY + 5, thrusters.power),
    ):  # fmt: skip
        for i in range(rows.shape[1]):
            lane[(first + i) * LANES] = rows[0, i]
    for t in range(thrusters.force.shape[0]):
        for first, rows in ((COLUMN, thrusters.column), (GAIN, thrusters.constants), (DECAY, thrusters.decay), (TARGET, thrusters.level)):
            for i in range(rows.shape[1]):
                lane[(first + i * CHANNELS + t) * LANES] = rows[t, i]
        for i in range(10):
            lane[(FORCE_CURVE + i * CHANNELS + t) * LANES] = thrusters.force_curve[t, i // 5, i % 5]
            lane[(POWER_CURVE + i * CHANNELS + t) * LANES] = thrusters.power_curve[t, i // 5, i % 5]


@compiled(types.void(F1, I8, BODIES, THRUSTERS, WATER, F3, F2, F2))
def scatter(w, m, bodies, thrusters, water, stage, seen, last):
    """Copies the results of lane m back into its world.

    last: (k, 16) observations of that world after each tick. `stage`, `seen`: fields of `plant.world.Arrays`.
    """
    lane = w[m:]
    for i in range(13):
        bodies.state[0, i], stage[5, 0, i] = lane[(STATE + i) * LANES], lane[(RATES + i) * LANES]
    for i in range(16):
        seen[0, i] = last[last.shape[0] - 1, i]
    for i in range(3):
        water.flow[1, i], water.flow[2, i] = lane[(FLOW + 3 + i) * LANES], lane[(FLOW + 6 + i) * LANES]
    for i in range(2):
        thrusters.power[0, i] = lane[(SUPPLY + 5 + i) * LANES]
    for t in range(thrusters.force.shape[0]):
        thrusters.level[t, 0], thrusters.level[t, 1] = lane[(TARGET + t) * LANES], lane[(NOW + t) * LANES]
        thrusters.force[t] = lane[(FORCE + t) * LANES]
