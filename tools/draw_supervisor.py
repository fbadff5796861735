"""Draws docs/supervisor.md from the supervisor's tables, so that the drawing always matches the code.

    .venv/bin/python tools/draw_supervisor.py            writes docs/supervisor.md
    .venv/bin/python tools/draw_supervisor.py --check    exits 1 when it is not up to date
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from command_line import Parser, run_tool

from firmware_py.core.arming import CHECKS
from firmware_py.core.failsafes import ANY, PERMITTED, TABLE, Level, Row, Watch
from firmware_py.core.supervisor import LADDER
from firmware_py.core.transitions import MODE_TABLE, Guard, State
from firmware_py.core.transitions import TABLE as TRANSITIONS
from firmware_py.core.types import Mode
from firmware_py.description.parameters import Parameters

PAGE = Path(__file__).resolve().parents[1] / "docs" / "supervisor.md"
NEEDS = """\
Attitude comes from tags, or from gravity until the first tag: one second after a start without tags roll and pitch are known, and ten tags
that agree give position and heading. Position comes from tags only. SURFACE without an attitude pushes up along the body's own axis.
The pilot counts as lost once stick input was received and then stopped; if none was ever received, the sticks are neutral, and the first
input that arrives counts. A ground station, too, is lost only once one was heard."""
COUNTING = """\
Most severe first, with the default parameters (`failsafes.NAME_limit`, `_delay_s`, `_action`, `_latched`). "always" is in every mode, and
while disarmed; the others count only while armed. In a mode marked "by a fail-safe" one counts only if a fail-safe and not a person chose
that mode, and where it "only warns" its action does not apply. While a fail-safe with another action than warn is on, the body is not armed
(forced arming skips this). In a body of several modules the text names those behind it: "water in a cabin (module 1)"."""
WATCHED = """\
- `attitude_lost`: the angle to the set-point, RMS over a second, about the axes that the thrusters left can turn. Something holds the body,
  its thrusters or gains do not fit it, or frames come so late that it swings.
- `place_lost`: the distance to the set-point, RMS over a second, along all axes. Something pushes, holds or tows the body harder than its
  thrusters can push, or the tags have jumped. It goes on swimming back by itself; with action 2 it lets go of the place and holds the one
  where it is.
- `module_silent`: no frame of a module comes, or it reports that it obeys no commands (BOOT, TIMEOUT or FAULT in MCU_STATUS).
  While every module of a body reports so, its path waits and its set-point rests where the body is: it does not swim back by itself
  afterwards.
- `module_late`: MCU_STATUS comes, but for `ARM_ANSWER_MS` none has come in its own tick. The robot flies on; what it loses by that is in
  [mcu.md](mcu.md).
- `thruster_lost`: a thruster is left out because its ESC failed, or because it stands still, does not obey, or does not push as it says
  (`faults.*`). It is used again once the body is disarmed, its failed ESC has been well for a second, or the robot is pushed as much
  without it, so that it was not the cause. Thrusters that are left out with their silent module do not count.
- `fence`: it counts only where the body goes by itself. A body that it stops holds its place where it is. In an ALT_HOLD that a fail-safe
  chose it only tells, unless its action is graver than that fail-safe's.
- `collision`: the time that is left before the body must brake, to stop before another body of the same fleet towards which it moves or
  turns, or wants to. Both must have seen tags, and near each other by more than 8 cm/s, 4 cm/s of it by the body's own motion. A body
  without tags keeps others 5 cm farther off for each second, up to 1 m. The two bodies of a dock do not count for each other, nor do the
  two pieces of an undock for three seconds. In DOCK a body waits for others by itself.
- `estop_box_silent`: a box that was heard since the start of the process (HEARTBEAT with NodeState OK or WARNING). With
  `ARM_ESTOP_BOX` 1 a robot whose box was not heard yet is not armed either; forced arming skips this.
- `ground_lost`: the ground station that is watched ([ground-station.md](ground-station.md#connect))."""
AFTERWARDS = """\
A fail-safe forbids other modes only among those in which it is active: while the pilot is silent, AUTO may be chosen.

When a fail-safe is over, the body stays in the mode that it chose until a person selects one; selecting the same one makes it the person's
own. If a person had chosen the mode before, and the fail-safe did not change it, it is that person's choice again. A person who selects
another mode while the cause lasts keeps control until the next fail-safe begins; then the gravest one that is on acts.

In MOTOR_DETECT a body is disarmed instead, whatever the action, if a motor test armed it or it never saw a tag: it may lie on a bench. A
cause that returns before its fail-safe has ended acts again after its delay, and so does one that spreads to a further module of the body,
which is then told of as well. A disarmed or stopped body keeps the mode that a person chose; after a motor test, a dock or a fail-safe's
mode it goes to POSHOLD."""

ALWAYS = frozenset(Mode).intersection(*(modes for level, modes in PERMITTED.items() if level < Level.DISARM))
"""Modes that no fail-safe forbids: with DISARM there is no armed body to select one."""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines] + [""]


def words(name: str) -> str:
    """Readable form of an enum member's name."""
    return name.lower().replace("_", " ")


def diagram() -> list[str]:
    """The state diagram, in Mermaid."""
    arrows: dict[tuple[State, State], list[str]] = {}
    for row in TRANSITIONS:
        if row.state != row.next_state:
            arrows.setdefault((row.state, row.next_state), []).append(words(row.trigger.name))
    lines = [f"    {a.name} --> {b.name}: {', '.join(names)}" for (a, b), names in arrows.items()]
    return ["```mermaid", "stateDiagram-v2", "    [*] --> DISARMED", *lines, "```", ""]


def transitions() -> list[str]:
    """Table of all transitions."""
    rows = [
        (
            row.state.name,
            words(row.trigger.name),
            "" if row.guard == Guard.ALWAYS else words(row.guard.name),
            words(row.effect.name),
            row.next_state.name,
            row.mode.name if row.mode is not None else "",
        )
        for row in TRANSITIONS
    ]
    return table(("state", "trigger", "if", "then", "next state", "mode"), rows)


def modes() -> list[str]:
    """Table of what each mode needs."""
    rows = [
        (row.mode.name, str(int(row.mode)), ", ".join(words(n.name) for n in sorted(row.needs)), "yes" if row.mode in ALWAYS else "")
        for row in MODE_TABLE
    ]
    return [*table(("mode", "number", "needs", "may be selected whatever fail-safe is on"), rows), NEEDS, ""]


def arming() -> list[str]:
    """Table of the arming checks."""
    return table(("check", "forced arming"), [(c.name, "skips it" if c.may_be_skipped else "checks it") for c in CHECKS])


def counts_in(row: Row) -> str:
    """Modes in which a fail-safe is active."""
    if row.modes == ANY:
        return "always"
    if len(row.modes) > len(Mode) // 2:
        return "all but " + ", ".join(sorted(m.name for m in ANY - row.modes))
    forced = [f"{m.name} (by a fail-safe)" for m in sorted(row.forced_modes)]
    warned = [f"{m.name} (only warns)" for m in sorted(row.warned_modes)]
    return ", ".join([*sorted(m.name for m in row.modes), *forced, *warned])


def failsafes() -> list[str]:
    """Table of the fail-safes with their default parameters."""
    parameters = Parameters().failsafes
    rows = []
    for row in TABLE:
        watch = Watch(row, parameters)
        limit = f"{'<' if row.below else '>'} {watch.limit:g}" if hasattr(parameters, f"{row.name}_limit") else "yes"
        delay = f"{getattr(parameters, f'{row.name}_delay_s'):g} s"
        ends = f"cause gone for {parameters.clear_s:g} s{', disarmed' if watch.latched else ''}"
        says = (row.words + row.detail).format(float("nan")).replace("nan", "N")
        rows.append((f"`{row.name}`", says, limit, delay, words(watch.level.name), ends, counts_in(row)))
    return table(("fail-safe", "text", "limit", "delay", "action", "ends by", "active in"), rows)


def permitted() -> list[str]:
    """Table of the modes that may be entered while a cause lasts, and of what each action tries."""
    rows = []
    for level in Level:
        allowed = PERMITTED[level]
        names = "all" if allowed == ANY else ", ".join(sorted(m.name for m in allowed)) or "none"
        steps = ", else ".join(words(t.name.removeprefix("FAILSAFE_")) for t in LADDER.get(level, ()))
        rows.append((str(int(level)), words(level.name), steps, names))
    return table(("number", "action", "does", "modes that may be entered meanwhile"), rows)


def page() -> str:
    """The whole page."""
    lines = [
        "# Supervisor", "",
        "Generated from the tables in `firmware_py/core` by `.venv/bin/python tools/draw_supervisor.py`; do not edit.", "",
        "## States", "", *diagram(), "All transitions; a request without a row is refused with a text.", "", *transitions(),
        "## Modes", "", *modes(), "## Arming checks", "", *arming(),
        "## Fail-safes", "",
        COUNTING, "",
        *failsafes(), WATCHED, "", "### Actions", "", *permitted(), AFTERWARDS,
    ]  # fmt: skip
    return "\n".join(lines).rstrip() + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes or checks the page."""
    parser = Parser(description="draw docs/supervisor.md from the supervisor's tables")
    parser.add_argument("--check", action="store_true", help="only check whether the page is up to date (status 1 if not)")
    if parser.parse_args(arguments).check:
        return 0 if PAGE.exists() and PAGE.read_text(encoding="utf-8") == page() else 1
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    run_tool(main)
