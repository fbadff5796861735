"""Table of fail-safes: the figure watched, the modes in which it counts, and its text; limits, delays and actions are parameters.

The first row is the gravest. `Failsafes` keeps the timers of each row; the supervisor acts on what it reports.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from enum import IntEnum
from operator import attrgetter
from typing import NamedTuple

from firmware_py.core.health import NEVER_S, Health
from firmware_py.core.names import name_modules
from firmware_py.core.transitions import MODE_TABLE, Need
from firmware_py.core.types import Mode
from firmware_py.description.failsafe_parameters import Failsafes as FailsafeParameters


class Level(IntEnum):
    """Action of a fail-safe, mildest first; the supervisor falls back to the best variant that is possible."""

    NONE = 0
    WARN = 1
    HOLD = 2
    """Hold the position; without a position, hold depth and attitude; without a depth, surface."""
    DEPTH = 3
    """Hold depth and attitude."""
    SURFACE = 4
    DISARM = 5


ANY = frozenset(Mode)
"""All modes, for faults of the vehicle itself: such a row counts in every mode, and while disarmed too."""
PLACED = frozenset(row.mode for row in MODE_TABLE if Need.POSITION in row.needs)
"""Modes that hold or follow a position."""
MOVING = PLACED - {Mode.POSHOLD}
UPRIGHT = frozenset(row.mode for row in MODE_TABLE if Need.ATTITUDE in row.needs) | {Mode.SURFACE}
"""Modes that hold or follow an attitude; SURFACE does so once one is known."""
FREE = PLACED - {Mode.DOCK}
"""Position modes in which nothing but the water should push the body."""
TRUSTING = frozenset({Mode.ALT_HOLD, Mode.STABILIZE})
"""Modes that hold depth or attitude by the estimate for a pilot: if it contradicts the tags, he is told, and keeps control."""
PILOTED = frozenset(row.mode for row in MODE_TABLE if row.by_pilot)
UNSTOPPED = PILOTED | {Mode.SURFACE}
"""Modes that may be entered whatever fail-safe is on, and in which a body does not stop for others: a pilot's, and the way up."""

PERMITTED = {
    Level.NONE: ANY,
    Level.WARN: ANY,
    Level.HOLD: UNSTOPPED | {Mode.POSHOLD, Mode.MOTOR_DETECT},
    Level.DEPTH: UNSTOPPED,
    Level.SURFACE: UNSTOPPED,
    Level.DISARM: frozenset[Mode](),
}
"""Modes that may be entered while the cause of a fail-safe of that level lasts. Below DISARM a pilot may always take over."""


class Row(NamedTuple):
    """One fail-safe. Its parameters are `name`_limit (none for a yes/no figure), _delay_s, _action and _latched."""

    name: str
    words: str
    """The cause, for people: the text of its end, and the beginning of every other."""
    figure: str
    """Name of the field of Health to watch. Without a limit parameter any value above zero is bad; True counts as 1."""
    detail: str = ""
    """Follows `words` while the cause lasts; `{}` takes the value. At its end the value would only tell that all is well again."""
    below: bool = False
    """Whether values below the limit, not above it, are bad."""
    modes: frozenset[Mode] = ANY
    forced_modes: frozenset[Mode] = frozenset()
    """Further modes, in which it counts only if a fail-safe and not a person chose them."""
    warned_modes: frozenset[Mode] = frozenset()
    """Further modes, in which it only warns, whatever its action."""
    of_modules: Callable[[Health], Mapping[int, float]] = lambda health: {}
    """The same figure of each module by fleet index. In a body of several those beyond the limit follow in brackets."""
    who: Callable[[Health], str] = lambda health: ""
    """Other words that follow in brackets."""


def told(table: str) -> Callable[[Health], Mapping[int, float]]:
    """For `Row.of_modules`: what each module last reported, by the name of a table of ModuleReports."""
    return lambda health: getattr(health.reports, table)


def age_s(*tables: str) -> Callable[[Health], Mapping[int, float]]:
    """For `Row.of_modules`: the age of each module's last report, s; of several tables of times that of the oldest."""
    return lambda health: health.reports.ages_s(health.time_ns, *tables)


LASTS = " for {:.1f} s"
TABLE = (
    Row("leak", "water in a cabin", "leak", of_modules=told("leak")),
    Row("bus_silent", "bus silent", "bus_silent_s", LASTS),
    Row("foreign_sync", "somebody else sends SYNC", "foreign_sync"),
    Row("foreign_command", "somebody else commands modules", "foreign_command"),
    Row("battery_critical", "battery critical", "voltage_share", ": {:.0%} of its voltage", below=True, of_modules=told("voltage_share")),
    Row("cabin_hot", "cabin hot", "cabin_c", ": {:.0f} degC", of_modules=told("cabin_c")),
    Row("cabin_pressure", "cabin pressure off", "cabin_change_pa", " by {:.0f} Pa", of_modules=told("cabin_change_pa")),
    Row("axis_lost", "the thrusters left cannot make every wrench", "lost_axes"),
    Row("attitude_lost", "attitude not held", "attitude_off_deg", ": {:.0f} deg off", modes=UPRIGHT),
    Row("place_lost", "place not held", "place_off_m", ": {:.1f} m off", modes=PLACED),
    Row("depth_unknown", "depth unknown", "depth_unknown_s", LASTS, modes=PLACED | {Mode.ALT_HOLD}),
    Row("tag_gone", "no tag", "tag_age_s", LASTS, modes=PLACED, forced_modes=frozenset({Mode.ALT_HOLD})),
    Row("partner_lost", "a docked partner is lost", "partner_lost", who=attrgetter("open_joint_words")),
    Row("estimator", "sensors and model disagree", "nis_ratio", ": {:.1f} of the expected", modes=PLACED, warned_modes=TRUSTING),
    Row("rejected", "tags refused", "rejected_share", ": {:.0%} of them", modes=PLACED, warned_modes=TRUSTING),
    Row("tag_lost", "no tag", "tag_age_s", LASTS, modes=PLACED),
    Row("pushed", "pushed out of sight", "unseen_push_m_s", " as by a current of {:.1f} m/s", modes=FREE),
    Row("tag_late", "no tag", "tag_age_s", LASTS, modes=MOVING),
    Row("depth_lost", "no pressure", "depth_age_s", LASTS),
    Row("imu_lost", "no IMU", "imu_age_s", LASTS),
    Row("sensor_lost", "a module of several has no IMU or no pressure", "sensor_age_s", LASTS, of_modules=age_s("imu_ns", "pressure_ns")),
    Row("module_silent", "a module is silent", "silent_s", LASTS, of_modules=age_s("hears_ns")),
    Row(
        "module_late", "a module answers too late, or for another tick", "any_late",
        of_modules=lambda health: dict.fromkeys(health.late, True),
    ),
    Row("estop_box_silent", "e-stop box silent", "estop_box_age_s", LASTS),
    Row("ticks_missed", "ticks missed", "missed_percent", ": {:.0f}% of them"),
    Row("fence", "outside the fence", "outside_m", " by {:.2f} m", modes=MOVING, forced_modes=frozenset({Mode.ALT_HOLD})),
    Row("collision", "another body is in the way", "collision_s", ", {:.1f} s to brake", below=True, modes=FREE, warned_modes=UNSTOPPED),
    Row("ground_lost", "ground station silent", "ground_age_s", LASTS, modes=ANY - {Mode.AUTO, Mode.SURFACE}),
    Row("pilot_lost", "pilot silent", "pilot_age_s", LASTS, modes=PILOTED),
    Row("thruster_lost", "a thruster is out", "thruster_lost"),
    Row("cabin_unknown", "no reading of a cabin", "cabin_age_s", LASTS, of_modules=age_s("cabin_ns")),
    Row("battery_unknown", "no reading of a battery", "battery_age_s", LASTS, of_modules=age_s("battery_ns")),
    Row("battery_low", "battery low", "voltage_share", ": {:.0%} of its voltage", below=True, of_modules=told("voltage_share")),
)  # fmt: skip
get_figures = attrgetter(*(row.figure for row in TABLE))
"""Returns the figure of every row, from the health of a tick."""


class Alarm(NamedTuple):
    """Report of a fail-safe that has just begun, spread to another module, recurred or ended."""

    name: str
    words: str
    level: Level
    begins: bool
    again: bool = False
    """Whether its cause came back before it had ended, in no other module than before."""


class Watch:
    """One row with its timers."""

    def __init__(self, row: Row, parameters: FailsafeParameters) -> None:
        self.row = row
        self._since_ns: int | None = None
        self._gone_ns: int | None = None
        self._told_ns: int | None = None
        """`_since_ns` at the last report. A cause that went and came back has a new `_since_ns`, and is reported again."""
        self.active, self.level = False, Level.NONE
        self.acts_as = Level.NONE
        """Its action in the present mode, kept up while it is active or its cause lasts."""
        self.began = ""
        """Its text when it was last told."""
        self._bad_ns: dict[int, int] = {}
        """By fleet index: since when the cause has been in a module."""
        self._named: set[int] = set()
        """Modules with the cause that its texts have named since it began."""
        self.retune(parameters)

    def retune(self, parameters: FailsafeParameters) -> None:
        """Applies new limits and keeps the timers. A changed action is reported, and so carried out, again."""
        name, before = self.row.name, self.level
        self.limit: float = getattr(parameters, f"{name}_limit", 0.0)
        self.level = Level(getattr(parameters, f"{name}_action"))
        self.latched = bool(getattr(parameters, f"{name}_latched"))
        self._told_ns = self._told_ns if self.level == before else None
        self.acts_as = self.level if self.level != before else self.acts_as
        self.active = self.active and self.level != Level.NONE  # NONE is not watched; it begins afresh when watched again
        self._delay_ns = round(getattr(parameters, f"{name}_delay_s") * 1e9)
        self._clear_ns = round(parameters.clear_s * 1e9)

    def take_over(self, before: Sequence[Watch]) -> None:
        """Inherits from the watches of the same row in the bodies before: active if any was, with the age of the oldest cause."""
        on = [watch for watch in before if watch.active]
        self.active, self.began = bool(on), next((watch.began for watch in on), "")
        self.acts_as = max((watch.acts_as for watch in on), default=self.level)
        self._named = set().union(*(watch._named for watch in on))
        self._since_ns = min((watch._since_ns for watch in before if watch._since_ns is not None), default=None)
        self._told_ns = self._since_ns if on and all(watch._told_ns == watch._since_ns for watch in on) else None

    def beyond(self, health: Health) -> bool:
        """Whether the figure is beyond its limit now, in any mode."""
        return self.is_bad(getattr(health, self.row.figure))

    def is_bad(self, value: float) -> bool:
        """Whether a value of the figure is beyond its limit. A NaN is not."""
        return bool(value < self.limit if self.row.below else value > self.limit)

    def counts(self, mode: Mode, forced: bool, armed: bool) -> bool:
        """Whether the row is watched in this mode and state."""
        if self.level == Level.NONE:
            return False
        if not armed:
            return self.row.modes == ANY
        return mode in self.row.modes or mode in self.row.warned_modes or (forced and mode in self.row.forced_modes)

    def enter(self, mode: Mode) -> None:
        """Sets its action in `mode`. Where it only warned before and now acts, its delay counts anew."""
        level = min(self.level, Level.WARN) if mode in self.row.warned_modes else self.level
        if level > self.acts_as:
            self._since_ns = None
        self.acts_as = level

    def words(self, health: Health) -> str:
        """Returns its text with the present value."""
        value = getattr(health, self.row.figure)
        who = self.row.who(health) if health.reports.is_of_several else ""
        if bad := self._bad_modules(health):
            who = name_modules(bad)
        detail = "" if value >= NEVER_S else self.row.detail.format(value)
        return f"{self.row.words}{detail}{who and f' ({who})'}"

    def _bad_modules(self, health: Health) -> list[int]:
        """Returns, in a body of several, the fleet indices of the modules whose own figure is beyond the limit now."""
        if not health.reports.is_of_several:
            return []
        return sorted(module for module, value in self.row.of_modules(health).items() if self.is_bad(value))

    def tell(self, health: Health) -> str:
        """Returns its text, and remembers it and the modules that it names."""
        self.began = self.words(health)
        self._named.update(self._bad_modules(health))
        return self.began

    def spreads(self, health: Health, cause: bool) -> bool:
        """Whether the cause has been for the delay in a module that no text has named since it began. Runs before `step`."""
        now = health.time_ns
        self._bad_ns = {module: self._bad_ns.get(module, now) for module in self._bad_modules(health)} if cause else {}
        if not self.active:
            self._named.clear()
        return self.active and any(now - at >= self._delay_ns for module, at in self._bad_ns.items() if module not in self._named)

    def ending(self, health: Health, mode: Mode, armed: bool) -> str:
        """Returns its text when it ends: what has cleared; or that the cause lasts but no longer counts in this mode or while disarmed."""
        if not self.beyond(health):
            return self.row.words
        return f"{self.words(health)}, which does not count {f'in {mode.name}' if armed else 'while disarmed'}"

    def reason(self, health: Health) -> str:
        """Returns what is wrong, for people; the text from when it began if its cause is gone."""
        return self.words(health) if self.beyond(health) else self.began

    def step(self, now: int, cause: bool, armed: bool) -> bool:
        """Advances the timers; returns whether it began or ended in this tick, or its cause came back for as long as the delay."""
        if cause:
            self._gone_ns = None
            if self._since_ns is None:
                self._since_ns = now
        else:
            self._since_ns = None
            if self._gone_ns is None:
                self._gone_ns = now
        if self._since_ns is not None and now - self._since_ns >= self._delay_ns:
            told, self._told_ns, self.active = self._told_ns == self._since_ns, self._since_ns, True
            return not told
        before = self.active
        if self._gone_ns is not None and now - self._gone_ns >= self._clear_ns and not (self.latched and armed):
            self.active = False
        return self.active != before


class Failsafes:
    """All fail-safes of one body."""

    def __init__(self, parameters: FailsafeParameters) -> None:
        self._all = [Watch(row, parameters) for row in TABLE]

    def retune(self, parameters: FailsafeParameters) -> None:
        """Applies new limits and actions. Active fail-safes stay active, except where the action is NONE now."""
        for watch in self._all:
            watch.retune(parameters)

    def take_over(self, before: Sequence[Failsafes]) -> None:
        """Inherits from the fail-safes of the bodies that this one is made of, or was part of."""
        for i, watch in enumerate(self._all):
            watch.take_over([other._all[i] for other in before])

    def step(self, health: Health, mode: Mode, forced: bool, armed: bool) -> list[Alarm]:
        """Returns the fail-safes that begin, recur or end in this tick, gravest row first.

        Args:
            forced: whether a fail-safe and not a person chose `mode`.
        """
        alarms = []
        for watch, value in zip(self._all, get_figures(health), strict=True):
            cause = watch.is_bad(value) and watch.counts(mode, forced, armed)
            if not cause and not watch.active and watch._since_ns is None:
                continue
            was_active = watch.active
            watch.enter(mode)
            spreads = watch.spreads(health, cause)
            if watch.step(health.time_ns, cause, armed) or spreads:
                again = was_active and watch.active and not spreads
                words = watch.tell(health) if watch.active else watch.ending(health, mode, armed)
                alarms.append(Alarm(watch.row.name, words, watch.acts_as, watch.active, again))
        return alarms

    @property
    def level(self) -> Level:
        """Strongest action of all active fail-safes."""
        return max((watch.acts_as for watch in self._all if watch.active), default=Level.NONE)

    def is_on(self, name: str) -> bool:
        """Whether the row of that name is active."""
        return any(watch.active for watch in self._all if watch.row.name == name)

    def active(self, health: Health) -> list[str]:
        """Returns the active fail-safes above a warning, in words."""
        return [watch.reason(health) for watch in self._all if watch.active and watch.acts_as > Level.WARN]

    def reasons_against(self, mode: Mode, health: Health, but: Container[str] = ()) -> list[str]:
        """Returns the reasons against entering `mode` now, in words; empty when it may be entered. Rows named in `but` are ignored."""
        return [
            watch.reason(health)
            for watch in self._all
            if mode not in PERMITTED[watch.level]
            and (watch.beyond(health) or (watch.active and watch.latched))
            and mode in watch.row.modes
            and watch.row.name not in but
        ]
