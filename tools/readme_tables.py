"""Writes the tables of README.md and docs/figures.md between their markers, from accept.json and bench.json: no figure is typed by hand.

A marker names a table: `<!-- table: accept -->` (all groups), `<!-- table: accept hover spiral -->` (those groups),
`<!-- table: bench -->`, or `<!-- table: bench WORD -->` (names with WORD in them); `headlines` in their place selects those of
HEADLINES. Each ends at `<!-- end -->`. A table whose file is missing stays as it is, and so does a figure of `accept` while any
group of its table has not been measured.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from command_line import Parser, refuse, run_tool

RowName = tuple[str, str, str]
"""Command, the figure that `the same` refers to, and name: see `rows_by_name`."""
PAGES = (Path("README.md"), Path("docs/figures.md"))
SOURCES = {"accept": Path("accept.json"), "bench": Path("bench.json")}
MARKER = re.compile(r"(<!-- table: (?P<kind>\w+)(?P<words>[^>]*?) -->\n)(?P<old>.*?)(<!-- end -->)", re.DOTALL)
HEADLINE = "headlines"
HEADLINES = {
    "accept": (
        ("hover", "hover, 20 seeds: position RMSE, worst"),
        ("spiral", "spiral, 20 seeds: position RMSE, median"),
        ("spiral", "spiral, 20 seeds: position RMSE, worst"),
        ("spiral", "spiral, 20 seeds: attitude RMSE, worst"),
        ("paper", "paper's controller, same 20 seeds: position RMSE, median (paper's tank: 20.92 mm)"),
        ("determinism", "same seed twice: logs that differ, of three"),
        ("speed", "spiral in lockstep with recorder and real frames, one core"),
        ("mobius-4", "Moebius strip, 4 modules, real sensors, 10 seeds: position RMSE, worst"),
        ("polycube", "random polycubes of 2 to 8 modules, 20: position RMSE, worst"),
        ("dock", "dock, 1000 trials: lower 95 % bound of success"),
        ("near-miss-passes", "near miss, 10,000 passes through real frames: docks declared"),
        ("thrusters", "one thruster dead on the spiral, worst of 8: position RMSE"),
        ("blind", "hover, 5 s without tags, 50 seeds: largest horizontal error, median"),
        ("blind", "the same: 95 %"),
    ),
    "bench": (
        ("", "firmware's whole tick, p50"),
        ("", "firmware's whole tick, p99.9"),
        ("", "pipeline.step, 64 modules docked"),
        ("", "real time at 100 Hz: tick starts late by, worst"),
        ("", "drag table of one module"),
        ("", "allocation, saturated"),
        ("", "plant step (RK4), 64 worlds on two cores"),
    ),
}
"""Group and name of the figures shown in README, by their file; those of bench.json have no groups."""

Entries = Sequence[dict[str, Any]]


def number(value: float | None) -> str:
    """Text with three significant digits, and all those before the point: `3.53`, `26.4`, `0.0411`."""
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 100 or float(value).is_integer() else f"{value:.3g}"


def rows(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *body]
    return "".join(f"| {' | '.join(cell.replace('|', ',') for cell in line)} |\n" for line in lines)


def accept_table(entries: Entries, groups: Sequence[str], old: str) -> str:
    """The figures of these groups, of all or the headlines, with limit, verdict and the command that measures them.

    Args:
        old: the current table; its rows are kept while some of the groups have not been measured.
    """
    body = [
        (
            e["name"], f"{number(e['value'])} {e['unit']}".strip(), e["limit"] and f"{e['limit']} {e['unit']}".strip(),
            e["limit"] and ("passed" if e["passed"] else "**failed**"), f"`{e['command']}`",
        )
        for e in chosen("accept", entries, groups, lambda e: e["group"] in groups)
    ]  # fmt: skip
    new = rows(("figure", "measured", "limit", "result", "command"), body)
    wanted = {group for group, _ in HEADLINES["accept"]} if HEADLINE in groups else set(groups)
    whole = wanted <= {e["group"] for e in entries}
    return new if whole else merged(rows_by_name(old), rows_by_name(new))


def chosen(kind: str, entries: Entries, words: Sequence[str], named: Callable[[dict[str, Any]], bool]) -> Entries:
    """All entries without words, the headlines, or those that are `named` by the words."""
    if HEADLINE in words:
        return [e for wanted in HEADLINES[kind] for e in entries if (e.get("group", ""), e["name"]) == wanted]
    return [e for e in entries if not words or named(e)]


def rows_by_name(table: str) -> dict[RowName, str]:
    """Rows of a table by command, by the figure of that command that `the same` refers to, and by name."""
    found, meant, before = {}, "", ""
    for line in table.splitlines(keepends=True):
        _, name, *_, command, _ = (cell.strip() for cell in line.split("|"))
        if not name.startswith("the same"):
            meant = name
        elif command != before:  # a figure with a command of its own
            meant = ""
        found[command, meant, name] = line
        before = command
    return found


def merged(old: Mapping[RowName, str], new: Mapping[RowName, str]) -> str:
    """Merges new rows into old ones; an additional row goes after the new row that precedes it."""
    names, place, lines = list(old), 0, {**old, **new}
    for name in new:
        if name not in old:
            names.insert(place, name)
        place = names.index(name) + 1
    return "".join(lines[name] for name in names)


def bench_table(entries: Entries, words: Sequence[str], old: str) -> str:
    """The figures of `make bench`, beside its peers."""
    body = [
        (
            e["name"], f"{number(e['value'])} {e['unit']}", e["peer"] or "",
            f"{number(e['peer_value'])} {e['unit']}" if e["peer_value"] is not None else "", number(e["ratio"]),
        )
        for e in chosen("bench", entries, words, lambda e: any(word in e["name"] for word in words))
    ]  # fmt: skip
    return rows(("what", "measured", "compared with", "its figure", "times better"), body)


TABLES = {"accept": accept_table, "bench": bench_table}


def filled(text: str, sources: dict[str, Entries]) -> str:
    """`text` with every table rewritten whose source exists. Raises KeyError for an unknown kind of table."""

    def table(match: re.Match[str]) -> str:
        make = TABLES[match["kind"]]
        if match["kind"] not in sources:
            return match[0]
        return match[1] + make(sources[match["kind"]], match["words"].split(), match["old"]) + match[5]

    return MARKER.sub(table, text)


def read_source(path: Path) -> Entries:
    """Reads the measured figures. Raises ValueError where the file is not in the format that the tools write."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: no JSON: {error}") from None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"{path}: not a list of figures")
    return entries


def main() -> int:
    """Runs the tool; returns its exit status."""
    Parser(description=__doc__).parse_args()
    if missing := [page for page in PAGES if not page.is_file()]:
        print(f"readme: no {missing[0]} in {Path.cwd()}; run this in the root of the project", file=sys.stderr)
        return 2
    try:
        write_tables()
    except KeyError as error:
        print(f"readme: {error} is no kind of table, or no column of its file; there are {', '.join(TABLES)}", file=sys.stderr)
        return 2
    except (ValueError, OSError) as error:
        return refuse("readme", error)
    return 0


def write_tables() -> None:
    """Writes the pages; reports missing sources. Raises KeyError, ValueError and OSError."""
    sources = {kind: read_source(path) for kind, path in SOURCES.items() if path.exists()}
    for kind in set(SOURCES) - set(sources):
        print(f"readme: no {SOURCES[kind]}; its tables stay as they are (make {kind})", file=sys.stderr)
    written = {page: filled(page.read_text(encoding="utf-8"), sources) for page in PAGES}
    for page, text in written.items():
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    run_tool(main)
