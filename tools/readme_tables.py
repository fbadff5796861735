"""Writes README.md's tables between their markers, out of accept.json and bench.json: no figure is typed by hand.

A marker names a table: `<!-- table: accept -->` (all groups), `<!-- table: accept hover spiral -->` (those groups),
`<!-- table: bench -->`, or `<!-- table: bench WORD -->` (names with WORD in them). Each ends at `<!-- end -->`. A table whose
file is missing stays as it is, and so does a figure of `accept` while any group of its table has not been measured.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from command_line import Parser, in_words, run_tool

README = Path("README.md")
SOURCES = {"accept": Path("accept.json"), "bench": Path("bench.json")}
MARKER = re.compile(r"(<!-- table: (?P<kind>\w+)(?P<words>[^>]*?) -->\n)(?P<old>.*?)(<!-- end -->)", re.DOTALL)

Entries = Sequence[dict[str, Any]]


def number(value: float | None) -> str:
    """Three figures that mean something: `3.53`, `26.4`, `0.0411`."""
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 100 or float(value).is_integer() else f"{value:.3g}"


def rows(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *body]
    return "".join(f"| {' | '.join(cell.replace('|', ',') for cell in line)} |\n" for line in lines)


def accept_table(entries: Entries, groups: Sequence[str], old: str) -> str:
    """The figures of these groups, or of all, with limit, verdict and the command that measures them.

    Args:
        old: the table as it stands; its rows stay where some groups were measured and others were not.
    """
    body = [
        (
            e["name"], f"{number(e['value'])} {e['unit']}".strip(), e["limit"] and f"{e['limit']} {e['unit']}".strip(),
            e["limit"] and ("passed" if e["passed"] else "**failed**"), f"`{e['command']}`",
        )
        for e in entries if not groups or e["group"] in groups
    ]  # fmt: skip
    new = rows(("figure", "measured", "limit", "result", "command"), body)
    whole = set(groups) <= {e["group"] for e in entries}
    return new if whole else "".join((rows_by_name(old) | rows_by_name(new)).values())


def rows_by_name(table: str) -> dict[tuple[str, str, str], str]:
    """The lines of a table by their command, by what `the same` means among the figures of that command, and by name."""
    found, meant, before = {}, "", ""
    for line in table.splitlines(keepends=True):
        _, name, *_, command, _ = (cell.strip() for cell in line.split("|"))
        if not name.startswith("the same"):
            meant = name
        elif command != before:  # a figure that has a command of its own
            meant = ""
        found[command, meant, name] = line
        before = command
    return found


def bench_table(entries: Entries, words: Sequence[str], old: str) -> str:
    """What `make bench` measured, beside its peers."""
    body = [
        (
            e["name"], f"{number(e['value'])} {e['unit']}", e["peer"] or "",
            f"{number(e['peer_value'])} {e['unit']}" if e["peer_value"] is not None else "", number(e["ratio"]),
        )
        for e in entries if not words or any(word in e["name"] for word in words)
    ]  # fmt: skip
    return rows(("what", "measured", "beside", "its figure", "times better"), body)


TABLES = {"accept": accept_table, "bench": bench_table}


def filled(text: str, sources: dict[str, Entries]) -> str:
    """`text` with every table written anew whose source is there. Raises KeyError for a table of no known kind."""

    def table(match: re.Match[str]) -> str:
        make = TABLES[match["kind"]]
        if match["kind"] not in sources:
            return match[0]
        return match[1] + make(sources[match["kind"]], match["words"].split(), match["old"]) + match[5]

    return MARKER.sub(table, text)


def read_source(path: Path) -> Entries:
    """What was measured. Raises ValueError where the file is not as the tools write it."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: no JSON: {error}") from None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"{path}: not a list of figures")
    return entries


def main() -> int:
    """The command line."""
    Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    if not README.is_file():
        print(f"readme: no {README} in {Path.cwd()}; run this in the root of the project", file=sys.stderr)
        return 2
    try:
        write_tables()
    except KeyError as error:
        print(f"readme: {error} is no table of {README}, or no column of its file; there are {', '.join(TABLES)}", file=sys.stderr)
        return 2
    except (ValueError, OSError) as error:
        print(f"readme: {in_words(error)}", file=sys.stderr)
        return 2
    return 0


def write_tables() -> None:
    """Writes README.md; says what is missing. Raises KeyError, ValueError and OSError."""
    sources = {kind: read_source(path) for kind, path in SOURCES.items() if path.exists()}
    for kind in set(SOURCES) - set(sources):
        print(f"readme: no {SOURCES[kind]}; its tables stay as they are (make {kind})", file=sys.stderr)
    README.write_text(filled(README.read_text(encoding="utf-8"), sources), encoding="utf-8")


if __name__ == "__main__":
    run_tool(main)
