"""README.md and the pages of docs/: the files and functions they name exist, and a tool writes their tables of figures."""

import ast
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
FIGURES = (ROOT / "docs" / "figures.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", ROOT / "can_dbc" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FOLDERS = "firmware_py|hil|tests|tools|can_dbc"
PLACES = sorted({
    place for page in PAGES for place in re.findall(rf"`((?:{FOLDERS})/[^` :*]+?)(?::(\w+))?`", page.read_text(encoding="utf-8"))
})  # fmt: skip


def tool(name: str) -> ModuleType:
    """Imports a script of tools/ as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("path", "name"), PLACES, ids=[":".join(place).rstrip(":") for place in PLACES])
def test_file_and_function_that_a_page_names_exist(path: str, name: str) -> None:
    assert (ROOT / path).exists()
    if name:
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_pictures_of_a_page_lead_to_files(page: Path) -> None:
    for target, section in re.findall(r"\]\(([^)#]+)(?:#([^)]+))?\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        assert (page.parent / target).exists(), target
        if section:
            headings = re.findall(r"^#+ (.+)$", (page.parent / target).read_text(encoding="utf-8"), re.MULTILINE)
            assert section in [heading.lower().replace(" ", "-") for heading in headings]


def test_figures_stand_on_their_page_and_readme_has_few_of_them() -> None:
    assert "](docs/figures.md)" in README
    assert len(re.findall(r"^\|.*\| (?:passed|\*\*failed\*\*) \|", README, re.MULTILINE)) <= 15


def test_picture_stands_on_the_first_screen() -> None:
    assert "![" in "\n".join(README.splitlines()[:12])


def test_make_targets_of_the_readme_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(re.findall(r"(?:^|`)make ([a-z-]+)", README, re.MULTILINE)) <= targets


def test_tables_of_figures_come_from_the_measurements() -> None:
    readme_tables = tool("readme_tables")
    accept = [
        {"name": "spiral: RMSE", "value": 3.5265, "unit": "mm", "limit": "<= 5", "passed": True, "command": "x",
         "group": "spiral"},
        {"name": "spiral: largest", "value": 9.0, "unit": "mm", "limit": "", "passed": True, "command": "x", "group": "spiral"},
        {"name": "hover: RMSE", "value": 7.0, "unit": "mm", "limit": "<= 5", "passed": False, "command": "y",
         "group": "hover"},
    ]  # fmt: skip
    text = "<!-- table: accept spiral -->\nold\n<!-- end -->\n\n<!-- table: bench -->\nkept\n<!-- end -->\n"
    filled = readme_tables.filled(text, {"accept": accept})
    assert "| spiral: RMSE | 3.53 mm | <= 5 mm | passed | `x` |" in filled
    assert "| spiral: largest | 9 mm |  |  | `x` |" in filled
    assert "hover" not in filled
    assert "old" not in filled
    assert "kept" in filled
    assert readme_tables.filled(filled, {"accept": accept}) == filled
    everything = readme_tables.filled(text.replace("accept spiral", "accept"), {"accept": accept})
    assert "| 7 mm | <= 5 mm | **failed** |" in everything


def test_figure_that_was_not_measured_stays_as_it_is_while_others_of_its_table_are_written() -> None:
    readme_tables = tool("readme_tables")

    def entry(group: str, name: str, value: float) -> dict[str, object]:
        command = "fly blind" if group == "blind" else "fly"
        return {"name": name, "value": value, "unit": "mm", "limit": "", "passed": True, "command": command, "group": group}

    hover, spiral = (((group, f"{group}: RMSE"), (group, "the same: worst")) for group in ("hover", "spiral"))
    blind = ("blind", "the same without tags")
    text = "<!-- table: accept hover spiral blind -->\n<!-- end -->\n"
    first = readme_tables.filled(text, {"accept": [entry(*figure, 1.0 + n) for n, figure in enumerate((*hover, *spiral, blind))]})
    assert re.findall(r"(\d) mm", first) == ["1", "2", "3", "4", "5"]
    again = readme_tables.filled(first, {"accept": [entry(*figure, 8.0) for figure in (*spiral, blind)]})
    assert re.findall(r"(\d) mm", again) == ["1", "2", "8", "8", "8"]
    alone = readme_tables.filled(first, {"accept": [entry(*blind, 9.0)]})
    assert re.findall(r"(\d) mm", alone) == ["1", "2", "3", "4", "9"], "whatever row it follows"
    more = [entry(*hover[0], 6.0), entry("hover", "the same: median", 7.0), entry(*hover[1], 8.0)]
    twice = readme_tables.filled(readme_tables.filled(first, {"accept": more}), {"accept": more})
    assert re.findall(r"(\d) mm", twice) == ["6", "7", "8", "3", "4", "5"], "a new figure stands beside its own, and once"
    assert [line for line in again.splitlines() if "hover: RMSE" in line] == [line for line in first.splitlines() if "hover: RMSE" in line]


@pytest.mark.parametrize("page", [README, FIGURES], ids=["README", "figures"])
def test_every_table_of_figures_is_of_a_known_kind_and_filled(page: str) -> None:
    readme_tables = tool("readme_tables")
    found = list(readme_tables.MARKER.finditer(page))
    assert len(found) == page.count("<!-- table:") == page.count("<!-- end -->")
    for match in found:
        assert match["kind"] in readme_tables.TABLES
        assert match[0].count("\n|") > 2, f"empty table: {match[1].strip()}"


def test_headlines_of_the_readme_are_rows_of_the_page_of_figures() -> None:
    readme_tables = tool("readme_tables")
    for match in readme_tables.MARKER.finditer(README):
        assert match["words"].split() == ["headlines"]
        lines = match["old"].splitlines()[2:]
        assert [line.split(" | ")[0].removeprefix("| ") for line in lines] == [name for _, name in readme_tables.HEADLINES[match["kind"]]]
        assert [line for line in lines if line not in FIGURES.splitlines()] == []


def test_headlines_and_groups_of_the_pages_are_those_that_are_measured() -> None:
    readme_tables, groups = tool("readme_tables"), {group.name: group for group in tool("accept").GROUPS}
    for group, name in readme_tables.HEADLINES["accept"]:
        assert name in [figure.name for figure in groups[group].figures]
    named = [word for match in readme_tables.MARKER.finditer(FIGURES) if match["kind"] == "accept" for word in match["words"].split()]
    assert set(named) <= set(groups)


def test_headlines_come_in_their_order_and_stay_while_they_are_not_measured() -> None:
    readme_tables = tool("readme_tables")
    figures = [{"group": group, "name": name} for group, name in readme_tables.HEADLINES["accept"]]
    figures.insert(0, {"group": "hover", "name": "hover, 20 seeds: share that passed its checks"})
    made = [{"value": 1.0 + n, "unit": "", "limit": "", "passed": True, "command": f["group"]} | f for n, f in enumerate(figures)]
    text = readme_tables.filled("<!-- table: accept headlines -->\n<!-- end -->\n", {"accept": made[::-1]})
    assert re.findall(r"\| (\d+) \|", text) == [str(n) for n in range(2, len(made) + 1)]
    again = [entry | {"value": 99.0} for entry in made if entry["group"] == "blind"]
    assert readme_tables.filled(text, {"accept": again}) == re.sub(r"\| 1[45] \|", "| 99 |", text)
    timed = {"value": 5.0, "unit": "us", "peer": "", "peer_value": None, "ratio": None}
    bench = [timed | {"name": name} for name in ("allocation, saturated", "x")]
    table = readme_tables.filled("<!-- table: bench headlines -->\n<!-- end -->\n", {"bench": bench})
    assert table.count("5 us") == 1 and "| allocation, saturated | 5 us |" in table


TOOLS = sorted((ROOT / "tools").glob("*.py"))


@pytest.mark.parametrize("path", [*PAGES, *TOOLS], ids=lambda path: str(path.relative_to(ROOT)))
def test_shown_command_of_a_tool_starts_with_the_python_that_has_its_packages(path: Path) -> None:
    """In the pages and in the tools' usage; the tables of figures are exempt, as a note above them says once which python they use."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        text = ast.get_docstring(ast.parse(text)) or ""
    lines = [line for line in text.splitlines() if not line.startswith("|")]
    assert [line for line in lines if re.search(r"(?:^ *|`)(?:python tools/\w+\.py|(?:tools/)?\w+\.py(?: |$))", line)] == []


@pytest.mark.parametrize("path", TOOLS, ids=lambda path: path.name)
def test_tool_that_cannot_be_executed_does_not_look_as_if_it_could(path: Path) -> None:
    assert path.read_text(encoding="utf-8").startswith("#!") == bool(path.stat().st_mode & 0o100)
