"""No circle of imports, no trainer below the seam of methods, no long file, no long function."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "leco_plugin"

WITHOUT_NERFSTUDIO = (
    "learning",
    *("models.mixture", "models.region", "models.gate", "models.field", "models.losses"),
    *("models.objective", "models.rendering", "samplers", "space", "occupancy", "log"),
)
"""Modules and packages that nothing of nerfstudio is imported with."""

KNOWN: list[tuple[str, str]] = []
"""Imports, (who, whom), that are in a circle or reach nerfstudio today. It may only shrink."""

MOST_LINES, MOST_LINES_OF_A_FUNCTION = 400, 60


@cache
def modules() -> dict[str, Path]:
    """All modules of the package, by their dotted names."""
    found = {}
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def statements(body: list[ast.stmt]) -> Iterator[ast.Import | ast.ImportFrom]:
    """Imports that run when a module is imported: none in functions, or for type checkers."""
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.If):
            if "TYPE_CHECKING" not in ast.unparse(node.test):
                yield from statements(node.body)
            yield from statements(node.orelse)
        elif isinstance(node, ast.Try):
            for part in (node.body, node.orelse, node.finalbody):
                yield from statements(part)
            for handler in node.handlers:
                yield from statements(handler.body)
        elif isinstance(node, ast.With | ast.ClassDef):
            yield from statements(node.body)


@cache
def imports(name: str) -> frozenset[str]:
    """What a module imports: modules of the package, and names of others' packages."""
    path = modules()[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found: set[str] = set()
    for node in statements(ast.parse(path.read_text()).body):
        if isinstance(node, ast.Import):
            asked = {alias.name for alias in node.names}
        else:
            above = package.split(".")[: len(package.split(".")) - node.level + 1]
            source = ".".join([*(above if node.level else []), *filter(None, [node.module])])
            asked = {f"{source}.{alias.name}" for alias in node.names}
        for one in asked:
            whole = one if one in modules() else one.rpartition(".")[0]
            found.add(whole if whole in modules() else one.partition(".")[0])
    return frozenset(found - {name})


def with_packages(name: str) -> set[str]:
    """A module and the packages around it, whose `__init__` is imported first."""
    parts = name.split(".")
    return {".".join(parts[: count + 1]) for count in range(len(parts))} & set(modules())


def graph(left_out: list[tuple[str, str]]) -> dict[str, frozenset[str]]:
    """What each module of ours imports of ours, without some imports."""
    return {
        name: frozenset(
            other for other in imports(name) if other in modules() and (name, other) not in left_out
        )
        for name in modules()
    }


def circle_in(found: dict[str, frozenset[str]]) -> list[str]:
    """The modules of a circle; empty where there is none."""
    try:
        TopologicalSorter(found).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def way_to_nerfstudio(name: str, left_out: list[tuple[str, str]]) -> list[str]:
    """Modules by which one comes to import nerfstudio; empty where it does not."""
    ways = {one: [one] for one in with_packages(name)}
    todo = list(ways)
    while todo:
        at = todo.pop()
        for other in sorted(imports(at)):
            if (at, other) in left_out:
                continue
            if other == "nerfstudio":
                return [*ways[at], other]
            for one in with_packages(other) - ways.keys():
                ways[one] = [*ways[at], one]
                todo.append(one)
    return []


def below_the_seam() -> list[str]:
    """All modules of `WITHOUT_NERFSTUDIO`."""
    wanted = [f"{PACKAGE}.{name}" for name in WITHOUT_NERFSTUDIO]
    found = [n for n in modules() for one in wanted if n == one or n.startswith(f"{one}.")]
    assert set(wanted) <= set(found)
    return found


def faults(left_out: list[tuple[str, str]]) -> list[str]:
    """A circle, and each module below the seam that imports nerfstudio, in words."""
    circle = circle_in(graph(left_out))
    ways = [way_to_nerfstudio(name, left_out) for name in below_the_seam()]
    return [" -> ".join(way) for way in (circle, *ways) if way]


def test_imports_are_found() -> None:
    learner = imports("leco_plugin.learning.learner")
    assert {"leco_plugin.models.mixture", "leco_plugin.log", "torch"} <= learner
    assert "leco_plugin.scenes.learning_data" not in learner  # for type checkers alone
    assert "nerfstudio" in imports("leco_plugin.models.leco")
    assert circle_in({"a": frozenset("b"), "b": frozenset("ca"), "c": frozenset()})
    assert way_to_nerfstudio("leco_plugin.models.leco", [])


def test_no_module_imports_itself_by_way_of_others() -> None:
    assert circle_in(graph(KNOWN)) == []


@pytest.mark.parametrize("name", below_the_seam())
def test_the_core_imports_nothing_of_nerfstudio(name: str) -> None:
    assert " -> ".join(way_to_nerfstudio(name, KNOWN)) == ""


def private_names_of_nerfstudio() -> set[str]:
    """What its objects keep to themselves, but for what configs are documented to have."""
    (folder,) = find_spec("nerfstudio").submodule_search_locations
    texts = [path.read_text(encoding="utf8") for path in Path(folder).rglob("*.py")]
    return {name for text in texts for name in re.findall(r"self\.(_[a-z]\w*)", text)} - {"_target"}


def test_what_nerfstudio_keeps_to_itself_is_read_in_studio_alone() -> None:
    """What a subclass overrides, or asks its parent class for, is no such thing."""
    names, found = private_names_of_nerfstudio(), set()
    for module, path in modules().items():
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if "._" in text else ():
            if isinstance(node, ast.Attribute) and node.attr in names:
                holder = ast.unparse(node.value)
                if holder not in ("self", "cls", "super()"):
                    found.add((module, f"{holder}.{node.attr}"))
    assert {"trainer._start_step", "trainer._after_train"} <= {text for _, text in found}
    assert {each for each in found if not each[0].startswith(f"{PACKAGE}.studio.")} == set()


@pytest.mark.parametrize("known", KNOWN, ids=str)
def test_what_is_known_is_still_so(known: tuple[str, str]) -> None:
    """What is in order again leaves the list."""
    assert faults([one for one in KNOWN if one != known])


def blocks(node: ast.AST) -> Iterator[ast.AST]:
    """All statements in a node, at any depth; a function or class may be in no other place."""
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, ast.stmt | ast.excepthandler | ast.match_case):
            yield inner
            yield from blocks(inner)


def long_functions() -> set[str]:
    """Names of the package's functions above the limit."""
    return {
        node.name
        for path in modules().values()
        for node in blocks(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.end_lineno - node.lineno >= MOST_LINES_OF_A_FUNCTION
    }


def test_no_file_is_long() -> None:
    lengths = {name: len(path.read_text().splitlines()) for name, path in modules().items()}
    assert {name: lines for name, lines in lengths.items() if lines > MOST_LINES} == {}


def test_no_function_is_long() -> None:
    assert not long_functions()


@pytest.mark.parametrize("folder", ["benchmarks", "examples", "tests"])
def test_no_program_hides_a_module_of_the_standard_library(folder: str) -> None:
    """Python puts the folder of a program before all others."""
    names = {path.stem for path in (ROOT / folder).glob("*.py")}
    assert names & sys.stdlib_module_names == set()
