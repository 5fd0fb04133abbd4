"""Which functions and classes can be reached from refield's public names and commands, read with ast; nothing is run.

A name leads to what it is bound to, through imports and what packages hand on. An attribute of something unknown leads
to the methods of that name of every class that is itself reached, and to functions of that name of modules which the
file holds as modules (as the kernels' twins are). So what is found unreached is not called by anyone; a method that is
found reached may be another's namesake. Annotations lead nowhere, but for those of a class's fields, which the command
line builds.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from refield.cli import COMMANDS

SOURCE = Path(__file__).parent.parent / "src" / "refield"
Node = tuple[str, str]
"""a module, ``field.warp``, and a name in it, ``Move`` or ``Move.arrived``; an empty name is all else that it runs"""

CALLED_BY_OTHERS = re.compile(r"__\w+__|forward|backward|_repr_\w+_")
"""methods that Python, torch and notebooks call"""


class Module:
    """A file's names: what it defines, and what it imports from us."""

    def __init__(self, path: Path) -> None:
        parts = path.relative_to(SOURCE).with_suffix("").parts
        self.name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        self.defined: dict[str, list[ast.AST]] = defaultdict(list)
        """by name, methods as ``C.m``: what runs when it is used"""
        self.bases: dict[str, list[ast.expr]] = {}
        self.imported: dict[str, tuple[str, str]] = {}
        """by name: a module of ours, and what was taken from it: a name in it, or a module below it"""
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for statement in tree.body:
            self._define(statement)
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "refield":
                home = (node.module or "").removeprefix("refield").removeprefix(".")
                self.imported |= {a.asname or a.name: (home, a.name) for a in node.names}

    def _define(self, statement: ast.stmt) -> None:
        if isinstance(statement, ast.FunctionDef):
            self.defined[statement.name].append(statement)
        elif isinstance(statement, ast.ClassDef):
            self.bases[statement.name] = statement.bases
            self.defined[statement.name] += [*statement.decorator_list, *statement.bases]
            for inner in statement.body:
                method = isinstance(inner, ast.FunctionDef)
                self.defined[f"{statement.name}.{inner.name}" if method else statement.name].append(inner)
        elif isinstance(statement, ast.Assign | ast.AnnAssign):
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            for name in (n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)):
                self.defined[name] += [statement.value] if statement.value else []
        elif not isinstance(statement, ast.Import | ast.ImportFrom):
            self.defined[""].append(statement)


@cache
def modules() -> dict[str, Module]:
    return {m.name: m for m in map(Module, sorted(SOURCE.rglob("*.py")))}


def bound(module: str, name: str) -> Node | str | None:
    """What a name in a module stands for: a definition, a module of ours (as text), or nothing of ours."""
    seen = set()
    while (module, name) not in seen:
        seen.add((module, name))
        here = modules()[module]
        if name in here.defined:
            return module, name
        inner = f"{module}.{name}" if module else name
        if name not in here.imported:
            return inner if inner in modules() else None
        home, attribute = here.imported[name]
        if (home, attribute) == (module, name):  # a package's own module
            return inner if inner in modules() else None
        if home not in modules():
            return None
        module, name = home, attribute
    return None


class Search:
    """What has been reached so far."""

    def __init__(self) -> None:
        self.nodes: set[Node] = set()
        self._asked: set[str] = set()  # names of attributes of unknown things
        self._to_do: list[Node] = []

    def reach(self, node: Node) -> None:
        if node in self.nodes:
            return
        self.nodes.add(node)
        self._to_do.append(node)
        module, name = node
        if "" in modules()[module].defined:
            self.reach((module, ""))
        if name in modules()[module].bases:
            for method in methods(node):
                if last(method) in self._asked or CALLED_BY_OTHERS.fullmatch(last(method)):
                    self.reach(method)

    def run(self) -> None:
        while self._to_do:
            module, name = self._to_do.pop()
            for part in modules()[module].defined[name]:
                for node in code(part):
                    self._look(module, node)

    def _look(self, module: str, node: ast.AST) -> None:
        if isinstance(node, ast.Name):
            found = bound(module, node.id)
            if isinstance(found, tuple):
                self.reach(found)
        elif isinstance(node, ast.Attribute):
            owner = bound(module, node.value.id) if isinstance(node.value, ast.Name) else None
            if isinstance(owner, str):
                found = bound(owner, node.attr)
                if isinstance(found, tuple):
                    self.reach(found)
            else:
                self._ask(module, node.attr)
        elif (
            isinstance(node, ast.Call)
            and ast.unparse(node.func) == "getattr"
            and isinstance(node.args[1], ast.Constant)
        ):
            self._ask(module, node.args[1].value)

    def _ask(self, module: str, attribute: str) -> None:
        for name in modules()[module].imported:
            home = bound(module, name)
            found = bound(home, attribute) if isinstance(home, str) else None
            if isinstance(found, tuple):
                self.reach(found)
        if attribute not in self._asked:
            self._asked.add(attribute)
            for owner in list(self.nodes):
                for method in methods(owner):
                    if last(method) == attribute:
                        self.reach(method)


def last(method: Node) -> str:
    return method[1].rpartition(".")[2]


def methods(node: Node) -> list[Node]:
    module, name = node
    if name not in modules()[module].bases:
        return []
    return [(module, n) for n in modules()[module].defined if n.startswith(f"{name}.")]


def code(part: ast.AST) -> Iterator[ast.AST]:
    """What may run, with all that stands in it; of annotations, only a field's."""
    yield part
    skipped = ("annotation", "returns") if isinstance(part, ast.arg | ast.FunctionDef) else ()
    for field, value in ast.iter_fields(part):
        if field in skipped:
            continue
        for inner in value if isinstance(value, list) else [value]:
            if isinstance(inner, ast.AST):
                yield from code(inner)


@cache
def reached() -> frozenset[Node]:
    """All that someone may run who uses the commands and the public names alone."""
    search = Search()
    for command in COMMANDS:
        search.reach((f"commands.{command}", "run"))
        search.reach((f"commands.{command}", command.capitalize()))
    for name in modules()[""].imported:
        found = bound("", name)
        assert isinstance(found, tuple), name
        search.reach(found)
        for method in methods(found):
            if not last(method).startswith("_"):
                search.reach(method)
    search.run()
    return frozenset(search.nodes)
