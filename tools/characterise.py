"""What a vehicle, an assembly or the paper's seven robots can do; or which shape to dock for a task.

.venv/bin/python tools/characterise.py modcube bluerov2_heavy --out runs/capability
.venv/bin/python tools/characterise.py --assembly 2x2x1 --module modcube
.venv/bin/python tools/characterise.py --table1 --out runs/table1
.venv/bin/python tools/characterise.py --choose 4 --task task.toml
"""

from __future__ import annotations

import argparse
import io
import tomllib
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from functools import partial
from pathlib import Path
from typing import Any

from command_line import Parser, refuse, run_tool

import characterise_blas  # noqa: F401
import characterise_table as table
import numpy as np
from argument_types import CELLS, cells_in, check_results, folder_for_results, positive, whole
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from firmware_py.description.fleet import load_fleet
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import AXES, Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import described, groups_of
from firmware_py.prepare.capability.layout import UNITS, Layout, of_modules, of_rows, of_vehicle
from firmware_py.prepare.capability.summary import DIRECTIONS, Capability, characterise
from hil.workers import processes

DATA = Path(__file__).with_name("data")
ENDINGS = ("json", "csv", "png", "html")
MODULE_PRICE_USD = 800.0
"""The paper's price of one module."""
NOT_PRINTED = ("assumption", f"max_inscribed_ellipsoid_volume[{table.TABLE_NORMALISATION}]")
"""Metrics left out of the printed table: a note states the first, another row shows the second."""
WIDTH = 170
"""Characters per line of a table that does not go to a terminal."""
MODULE = "modcube"
"""Vehicle of every module of an assembly, unless --module names another."""
LARGEST_BOX = 64
"""Largest number of modules in an assembly."""
LEAST_DIRECTIONS, MOST_DIRECTIONS = 121, 100_000
"""Limits of --directions: harmonics of degree ten have 121 coefficients."""
LEAST_SIZE, MOST_SIZE = 1e-6, 1e6
"""Permitted force, N, and torque, N m: the power curves overflow far beyond any thruster."""


def main() -> int:
    """Runs the tool; returns its exit status."""
    given = arguments()
    try:
        with folder_for_results(given.out):
            run(given)
    except DescriptionError as error:
        return refuse("characterise", error)
    return 0


def arguments() -> argparse.Namespace:
    """Parses and checks the command line."""
    assert __doc__ is not None
    parser = Parser(description=__doc__)
    parser.add_argument("vehicle", nargs="*", help="vehicle names or .toml files")
    parser.add_argument(
        "--assembly", metavar="SHAPE", help="AxBxC modules, cells such as '0,0,0 1,0,0', or a fleet file"
    )
    parser.add_argument(
        "--module", metavar="VEHICLE", help=f"vehicle of every module of an assembly given as AxBxC or as cells; {MODULE} by default"
    )
    parser.add_argument("--table1", action="store_true", help="characterise the paper's seven robots and compare them with Table I")
    parser.add_argument("--choose", type=whole(1), metavar="N", help="rank all shapes of N modules, 1 to 5")
    parser.add_argument("--task", type=Path, metavar="FILE", help="task file for --choose")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for CSV, JSON, figure (PNG) and report (HTML)")
    parser.add_argument("--directions", type=whole(1), default=DIRECTIONS, help="number of directions over the sphere, 121 or more")
    parser.add_argument(
        "--force", type=positive, default=1.0, metavar="N", help="force for which the power space in the force frame is computed, N"
    )
    parser.add_argument(
        "--torque", type=positive, default=1.0, metavar="NM", help="torque for which the power space in the torque frame is computed, N m"
    )
    parser.add_argument("--jobs", type=whole(1), default=2, help="number of parallel processes")
    given = parser.parse_args()
    if sum([bool(given.vehicle), given.assembly is not None, given.table1, given.choose is not None]) != 1:
        parser.error("give one of: vehicles, --assembly SHAPE, --table1, --choose N --task FILE")
    if given.module is not None and (given.assembly is None or given.assembly.endswith(".toml")):
        parser.error("--module tells of what an --assembly of AxBxC or of cells is made; give one with it")
    if (given.choose is None) != (given.task is None):
        parser.error("--choose N and --task FILE go together")
    idle = [f"--{name}" for name in ("directions", "force", "torque", "jobs") if getattr(given, name) != parser.get_default(name)]
    if given.choose is not None and idle:
        parser.error(f"--choose takes no {', '.join(idle)}; leave out what does nothing")
    if not LEAST_DIRECTIONS <= given.directions <= MOST_DIRECTIONS:
        parser.error(f"--directions {given.directions}: permitted: {LEAST_DIRECTIONS} to {MOST_DIRECTIONS}")
    for option, size in (("--force", given.force), ("--torque", given.torque)):
        if not LEAST_SIZE <= size <= MOST_SIZE:
            parser.error(f"{option} {size:g}: permitted: {LEAST_SIZE:g} to {MOST_SIZE:g}")
    return given


def run(given: argparse.Namespace) -> None:
    """Runs the requested characterisation. Raises DescriptionError."""
    if given.out:
        stem = "choice" if given.choose is not None else "table1" if given.table1 else "capability"
        key = "rank_by" if given.choose is not None else "vehicles"
        check_results(given.out, key, *(f"{stem}.{ending}" for ending in ENDINGS))
    settings = {"count": given.directions, "sizes": {"force": given.force, "torque": given.torque}}
    if given.choose is not None:
        from characterise_choose import choose

        choose(given.choose, given.task, given.out, _console(), _console(error=True))
    elif given.table1:
        _table1(settings, given.jobs, given.out)
    else:
        layouts = [of_vehicle(load_vehicle(name)) for name in given.vehicle]
        layouts += _assemblies(given.assembly, load_vehicle(given.module or MODULE)) if given.assembly is not None else []
        found = _all(_by_name(layouts), settings, given.jobs)
        _print(found)
        if given.out:
            _write(given.out, "capability", found, table.rows_of(found), {name: name for name in found})


def _console(error: bool = False) -> Console:
    console = Console(stderr=error)
    return console if console.is_terminal else Console(stderr=error, width=WIDTH)


def _assemblies(shape: str, module: Vehicle) -> list[Layout]:
    """Layouts named by --assembly. Raises DescriptionError."""
    if shape.endswith(".toml"):
        return _fleet(Path(shape))
    cells = _cells(shape)
    return [of_modules(cells, [0] * len(cells), [module] * len(cells), name=f"{module.name} {shape}")]


def _by_name(layouts: Sequence[Layout]) -> dict[str, Layout]:
    """Layouts by name, the columns of the table. Raises DescriptionError where two have the same name."""
    names = [layout.name for layout in layouts]
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        raise DescriptionError(f"{names.count(twice[0])} vehicles have the name {twice[0]!r}; give each file another `name`")
    return dict(zip(names, layouts, strict=True))


def _fleet(path: Path) -> list[Layout]:
    fleet = load_fleet(path)
    vehicles = {m.vehicle: load_vehicle(m.vehicle) for m in fleet.module}
    groups = groups_of(fleet)
    return [of_modules(*described(fleet, members, vehicles), fleet.pitch_m, f"{path.stem} body {members[0]}") for members in groups]


def _cells(shape: str) -> list[tuple[int, int, int]]:
    """Parses cells from `2x2x1` or `0,0,0 1,0,0`."""
    try:
        if "," in shape:
            found = cells_in(shape)
        else:
            a, b, c = (int(edge) for edge in shape.split("x"))
            fits = min(a, b, c) >= 1 and a * b * c <= LARGEST_BOX
            found = [(x, y, z) for x in range(a) for y in range(b) for z in range(c)] if fits else []
    except ValueError:
        found = []
    if not 1 <= len(found) <= LARGEST_BOX:
        what = f"needs AxBxC, cells such as '0,0,0 1,0,0', each number from {CELLS.low:g} to {CELLS.high:g}, or a fleet file (.toml)"
        raise DescriptionError(f"--assembly {shape!r}: {what}; {LARGEST_BOX} modules at most")
    return found


def _all(layouts: dict[str, Layout], settings: dict[str, Any], jobs: int) -> dict[str, Capability]:
    """Characterises every layout, with progress; in `jobs` processes where there are several layouts."""
    work: Callable[..., Capability] = partial(characterise, **settings)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = _console(error=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        mark = bar.add_task("characterise", total=len(layouts))
        found: dict[str, Capability] = {}

        def done(name: str, result: Capability) -> None:
            found[name] = result
            bar.update(mark, advance=1, description=name)
            if not console.is_terminal and len(layouts) > 1:
                console.print(f"{len(found)}/{len(layouts)} {name}", highlight=False)

        if min(jobs, len(layouts)) == 1:
            for name, layout in layouts.items():
                done(name, work(layout, progress=partial(_describe, bar, mark, name)))
        else:
            with processes(min(jobs, len(layouts)))() as pool:
                largest_first = sorted(layouts, key=lambda n: -layouts[n].count)
                waiting = {pool.submit(work, layouts[name]): name for name in largest_first}
                for future in as_completed(waiting):
                    done(waiting[future], future.result())
    return {name: found[name] for name in layouts}


def _describe(bar: Progress, mark: Any, name: str, text: str) -> None:
    bar.update(mark, description=f"{name}: {text}")


def _print(found: dict[str, Capability]) -> None:
    """Prints the table, one column per vehicle."""
    console = _console()
    shown = Table(title="What the body can do", title_justify="left")
    shown.add_column("figure")
    for name in found:
        shown.add_column(name, justify="right")
    rows = [row for row in table.rows_of(found) if row.metric not in NOT_PRINTED]
    for row in rows:
        if row.space == "-":
            shown.add_row(row.label, *(table.text(row.cells[name]) for name in found))
    for k, axis in enumerate(AXES):
        unit = UNITS["force"] if k < 3 else UNITS["torque"]
        shown.add_row(f"{axis}, most + / -, {unit}", *(f"{c.axes[k, 0]:.4g} / {c.axes[k, 1]:.4g}" for c in found.values()))
    sizes = {frame: next(iter(found.values())).power[frame].size for frame in UNITS}
    for frame, unit in UNITS.items():
        for space, title in (("power", f"power of {sizes[frame]:g} {unit} in any direction"), ("wrench", f"reachable {frame}s, {unit}")):
            shown.add_section()
            shown.add_row(f"[bold]{title}[/]")
            for row in rows:
                if (row.space, row.frame) == (space, frame):
                    shown.add_row(f"  {row.label}", *(table.text(row.cells[name]) for name in found))
    console.print(shown)
    for name, result in found.items():
        for note in result.notes:
            console.print(f"{name}: {note}", highlight=False, markup=False)


def _write(
    out: Path,
    stem: str,
    found: dict[str, Capability],
    rows: Sequence[table.Row],
    titles: dict[str, str],
    html: str = "",
) -> None:
    """Writes CSV, JSON, PNG and HTML into `out`."""
    from characterise_draw import draw  # matplotlib takes a second to import
    from characterise_report import write_report

    try:
        out.mkdir(parents=True, exist_ok=True)
        table.write_csv(out / f"{stem}.csv", rows, list(found))
        table.write_json(out / f"{stem}.json", found)
        shown = {name: found[name] for name in titles}
        draw(out / f"{stem}.png", shown, titles)
        write_report(out / f"{stem}.html", shown, titles, html)
    except OSError as error:
        raise DescriptionError(f"{error.filename}: cannot be written: {error.strerror}") from None
    for ending in ENDINGS:
        print(out / f"{stem}.{ending}")


def _table1(settings: dict[str, Any], jobs: int, out: Path | None) -> None:
    """Prints the paper's seven robots, and beside them those from the authors' own files and from the paper's text."""
    from characterise_table1 import build_rows, show

    robots = tomllib.loads((DATA / "robots.toml").read_text(encoding="utf-8"))
    raw = tomllib.loads((DATA / "published_layouts.toml").read_text(encoding="utf-8"))
    layouts = {robot["column"]: _robot(robot, raw) for robot in (*robots["robot"], *robots["beside"])}
    found = _all(layouts, settings, jobs)
    paper = table.read_paper(DATA / "table1.csv")
    rows = build_rows(found, robots, MODULE_PRICE_USD)
    console = _console()
    show(console, rows, paper, robots, found)
    if out:
        titles = {robot["column"]: f"{robot['letter']}: {robot['title']}" for robot in robots["robot"]}
        record = Console(record=True, width=WIDTH, file=io.StringIO())
        show(record, rows, paper, robots, found)
        page = record.export_html(inline_styles=True, code_format="<pre>{code}</pre>")
        _write(out, "table1", found, rows, titles, page)


def _robot(robot: dict[str, Any], raw: dict[str, Any]) -> Layout:
    vehicle = load_vehicle(robot["vehicle"])
    if "rows" in robot:
        source = raw[robot["rows"]]
        return of_rows(robot["title"], np.array(source["thrusters"]), source["f_min"], source["f_max"], vehicle)
    cells = robot["cells"]
    return of_modules(cells, [0] * len(cells), [vehicle] * len(cells), name=robot["title"])


if __name__ == "__main__":
    run_tool(main)
