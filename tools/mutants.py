"""Mutation tests of safety-critical code: changes one thing at a time in limiter, supervisor, tables and fail-safes, and runs their tests.

    .venv/bin/python tools/mutants.py [MODULE ...] [--jobs N] [--list]

Prints killed and survived per module, names each survivor with its line, and exits 1 when there is one. A mutant exists only in a forked
process: no file is touched. Everything slow to import is imported before the fork.
"""

from __future__ import annotations

import ast
import copy
import importlib.abc
import importlib.machinery
import importlib.util
import itertools
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from command_line import Parser, run_tool

from argument_types import whole

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 60
"""A mutant that needs more time of the processor is killed."""
SUPERVISOR = tuple(f"tests/unit/test_supervisor{part}.py" for part in ("", "_failsafes", "_bodies"))
TARGETS: dict[str, tuple[str, ...]] = {
    "firmware_py.core.transitions": ("tests/unit/test_transitions.py", *SUPERVISOR),
    "firmware_py.core.supervisor": SUPERVISOR,
    "firmware_py.core.arming": ("tests/unit/test_arming.py",),
    "firmware_py.core.failsafes": ("tests/unit/test_failsafes.py",),
    "firmware_py.core.collision": ("tests/unit/test_collision.py",),
    "firmware_py.core.command_watch": ("tests/unit/test_command_watch.py",),
    "firmware_py.core.limiter": ("tests/unit/test_limiter.py",),
    "firmware_py.core.motor_test": ("tests/unit/test_motor_test.py",),
    "firmware_py.description.parameter_rules": ("tests/unit/test_arming.py", "tests/unit/test_live_parameters.py"),
}
"""Tests of each module, which must kill its mutants."""
QUICKLY = (
    "-x", "-q", "-mnot slow", "--assert=plain", "--tb=no", "-pno:cacheprovider", "-pno:unraisableexception", "-pno:threadexception",
)  # fmt: skip
"""pytest's options: only whether a test fails matters; a flight in plain Python would take minutes."""
HEAVY = (
    "numba", "numpy", "pytest", "scipy.spatial.transform", "firmware_py.core.drag_lookup", "firmware_py.core.rotations",
    "firmware_py.core.thruster", "firmware_py.core.missing_thrust", "firmware_py.core.body", "firmware_py.prepare.assembly",
)  # fmt: skip
"""Modules imported before the fork. None of them imports a target."""

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
}  # fmt: skip
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
}  # fmt: skip
CELLS = {"G": "ALWAYS", "F": "NOTHING", "Need": "DEPTH"}
"""Short names in the tables: a cell is replaced by this member, so that losing a row's guard or effect is tested too."""
STATES = {"D": "A", "A": "E", "E": "D"}


class Mutant(NamedTuple):
    """One change to a module."""

    line: int
    what: str
    tree: ast.Module


def mutants(source: str) -> Iterator[Mutant]:
    """All mutants of a module's source, in breadth-first order of its syntax tree."""
    tree = ast.parse(source)
    skipped = {id(node) for node in _annotations(tree)}
    for index, node in enumerate(ast.walk(tree)):
        if id(node) in skipped:
            continue
        for number in range(len(_changes(node))):
            other = copy.deepcopy(tree)
            words, change = _changes(next(itertools.islice(ast.walk(other), index, None)))[number]
            change()
            yield Mutant(getattr(node, "lineno", 0), f"{words}: {ast.unparse(node).splitlines()[0][:70]}", ast.fix_missing_locations(other))


def _annotations(tree: ast.Module) -> Iterator[ast.AST]:
    """Nodes whose change has no effect at run time: annotations, compiler options of a function, zip's check, and bare string constants."""
    for node in ast.walk(tree):
        roots: list[ast.AST | None] = []
        if isinstance(node, (ast.AnnAssign, ast.arg)):
            roots.append(node.annotation)
        elif isinstance(node, ast.FunctionDef):
            roots += [node.returns, *(each for each in node.decorator_list if isinstance(each, ast.Call))]
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            roots.append(node)
        elif isinstance(node, ast.keyword) and node.arg == "strict":
            roots.append(node.value)
        for root in roots:
            if root is not None:
                yield from ast.walk(root)


def _changes(node: ast.AST) -> list[tuple[str, Callable[[], object]]]:
    """Possible changes at a node: a name, and the function that makes the change in place."""
    found: list[tuple[str, Callable[[], object]]] = []
    if isinstance(node, ast.Compare):
        for i, op in enumerate(node.ops):
            for new in COMPARISONS[type(op)]:
                found.append((f"{type(op).__name__} -> {new.__name__}", lambda i=i, new=new: node.ops.__setitem__(i, new())))
    elif isinstance(node, ast.BoolOp):
        new_op = ast.Or if isinstance(node.op, ast.And) else ast.And
        found.append((f"-> {new_op.__name__}", lambda: setattr(node, "op", new_op())))
    elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        op_type = OPERATORS[type(node.op)]
        found.append((f"-> {op_type.__name__}", lambda: setattr(node, "op", op_type())))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub | ast.Invert):
        found.append(("sign or not gone", lambda: _become(node, node.operand)))
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        found.append(("flipped", lambda: setattr(node, "value", not node.value)))
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        found.append(("one more", lambda: setattr(node, "value", node.value + 1)))  # type: ignore[operator]
    elif isinstance(node, ast.If | ast.IfExp):
        found.append(("condition turned", lambda: setattr(node, "test", ast.UnaryOp(ast.Not(), node.test))))
    elif isinstance(node, ast.Tuple | ast.List) and len(node.elts) > 1 and all(isinstance(e, ast.Call) for e in node.elts):
        for i in range(len(node.elts)):
            found.append((f"row {i + 1} gone", lambda i=i: node.elts.__delitem__(i)))
    elif isinstance(node, ast.Call):
        found += _cells(node)
    elif isinstance(node, ast.FunctionDef):
        found += _statements(node)
    return found


def _cells(call: ast.Call) -> list[tuple[str, Callable[[], object]]]:
    """Changes to the cells of a table row."""
    found: list[tuple[str, Callable[[], object]]] = []
    for cell in call.args:
        if isinstance(cell, ast.Attribute) and isinstance(cell.value, ast.Name) and CELLS.get(cell.value.id, cell.attr) != cell.attr:
            found.append((f"{ast.unparse(cell)} -> {CELLS[cell.value.id]}", lambda c=cell: setattr(c, "attr", CELLS[c.value.id])))
        elif isinstance(cell, ast.Name) and cell.id in STATES and isinstance(call.func, ast.Name) and call.func.id == "Transition":
            found.append((f"{cell.id} -> {STATES[cell.id]}", lambda c=cell: setattr(c, "id", STATES[c.id])))
    return found


def _statements(function: ast.FunctionDef) -> list[tuple[str, Callable[[], object]]]:
    """Changes that leave out a statement with an effect."""
    found: list[tuple[str, Callable[[], object]]] = []
    for holder in ast.walk(function):
        for name in ("body", "orelse"):
            block = getattr(holder, name, None)
            if not isinstance(block, list):
                continue
            for i, statement in enumerate(block):
                if _acts(statement):
                    words = f"line {statement.lineno} left out: {ast.unparse(statement)[:50]}"
                    found.append((words, lambda block=block, i=i: block.__setitem__(i, ast.Pass())))
    return found


def _acts(statement: ast.AST) -> bool:
    if isinstance(statement, ast.Expr):
        return not isinstance(statement.value, ast.Constant)
    if isinstance(statement, ast.Assign):
        return any(isinstance(t, ast.Attribute | ast.Subscript) for t in statement.targets)
    return isinstance(statement, ast.AugAssign)


def _become(node: ast.AST, other: ast.AST) -> None:
    """Turns `node` into a copy of `other`, in place."""
    node.__class__ = other.__class__
    node.__dict__.clear()
    node.__dict__.update(other.__dict__)


# ---------------------------------------------------------------- running one


def _uncompiled(tree: ast.Module) -> ast.Module:
    """The module in plain Python: Numba would spend seconds on each mutant, or serve it code that it compiled before."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            node.decorator_list = [each for each in node.decorator_list if not ast.unparse(each).startswith("njit")]
    return tree


class Loader(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Serves the mutant in place of its module."""

    def __init__(self, name: str, tree: ast.Module) -> None:
        self._name, self._code = name, compile(_uncompiled(tree), name, "exec")

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The mutant's spec, or None for every other module."""
        return importlib.util.spec_from_loader(fullname, self) if fullname == self._name else None

    def exec_module(self, module: ModuleType) -> None:
        """Runs the mutant."""
        exec(self._code, module.__dict__)


def start(name: str, tree: ast.Module, quiet: bool) -> int:
    """Forks a process that runs the tests of module `name` on `tree` and exits with pytest's status. Returns the process id."""
    process = os.fork()
    if process:
        return process
    if quiet:
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
    signal.setitimer(signal.ITIMER_PROF, TIMEOUT_S)
    status = 99
    try:
        import pytest

        sys.meta_path.insert(0, Loader(name, tree))
        status = int(pytest.main([*QUICKLY, *TARGETS[name]]))
    except BaseException as error:  # whatever a mutant raises ends here
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
    finally:
        sys.stdout.flush()
        os._exit(status)


def run(name: str, todo: list[Mutant], jobs: int) -> list[Mutant]:
    """Runs mutants in `jobs` processes; returns the survivors."""
    waiting, running, survivors = list(reversed(todo)), dict[int, Mutant](), list[Mutant]()
    while waiting or running:
        while waiting and len(running) < jobs:
            mutant = waiting.pop()
            running[start(name, mutant.tree, quiet=True)] = mutant
        process, status = os.wait()
        mutant = running.pop(process)
        if os.waitstatus_to_exitcode(status) == 0:
            survivors.append(mutant)
            print(f"  SURVIVED {name}:{mutant.line}: {mutant.what}", flush=True)
    return survivors


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs all mutants of the requested modules; returns the exit status."""
    parser = Parser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("module", nargs="*", help="last part of a module's name; all modules if none is given")
    parser.add_argument("--jobs", type=whole(1), default=os.cpu_count() or 1, help="number of parallel processes")
    parser.add_argument("--list", action="store_true", help="only list the mutants, without running tests")
    options = parser.parse_args(arguments)
    short = [name.rpartition(".")[2] for name in TARGETS]
    if unknown := [name for name in options.module if name not in short]:
        parser.error(f"{', '.join(unknown)}: unknown; there are {', '.join(short)}")
    os.chdir(ROOT)
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    sys.path.insert(0, str(ROOT))
    for heavy in HEAVY:
        importlib.import_module(heavy)
    if loaded := [name for name in TARGETS if name in sys.modules]:
        print(f"cannot mutate what is loaded already: {', '.join(loaded)}", file=sys.stderr)
        return 2
    names = [name for name in TARGETS if not options.module or name.rpartition(".")[2] in options.module]
    return list_mutants(names) if options.list else run_mutants(names, options.jobs)


def source_of(name: str) -> str:
    """Source of a module."""
    return (ROOT / (name.replace(".", "/") + ".py")).read_text()


def list_mutants(names: Sequence[str]) -> int:
    """Lists the mutants that would be run; returns the exit status."""
    for name in names:
        print("\n".join(f"{name}:{m.line}: {m.what}" for m in mutants(source_of(name))))
    return 0


def run_mutants(names: Sequence[str], jobs: int) -> int:
    """Runs all mutants of these modules; returns the exit status."""
    total = alive = 0
    for name in names:
        source = source_of(name)
        todo, began = list(mutants(source)), time.monotonic()
        # served like its mutants: otherwise a module that cannot even be imported this way would count as killed
        _, status = os.waitpid(start(name, ast.parse(source), quiet=False), 0)
        if os.waitstatus_to_exitcode(status) != 0:
            print(f"{name}: its tests fail without any mutant", file=sys.stderr)
            return 2
        survivors = run(name, todo, jobs)
        total, alive = total + len(todo), alive + len(survivors)
        print(f"{name}: {len(todo) - len(survivors)} killed, {len(survivors)} survived, {time.monotonic() - began:.0f} s", flush=True)
    print(f"mutants: {total - alive} killed, {alive} survived")
    return 1 if alive else 0


if __name__ == "__main__":
    run_tool(main)
