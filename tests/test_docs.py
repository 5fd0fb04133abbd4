"""What the documents say is so: every function named exists, every equation has its place."""

from __future__ import annotations

import ast
import importlib
import os
import pydoc
import re
import tomllib
from functools import cache
from pathlib import Path

import pytest

import refield
from refield.cli import COMMANDS
from refield.field.fit import _FORMING, FitConfig
from refield.field.fit_nerfacto import REDUCED, NerfactoFitConfig
from refield.update.config import UpdateConfig
from refield.update.paper.config import PaperUpdateConfig, reduced
from refield.update.supervision import _RING_RAYS
from tests.reach import reached

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src" / "refield"
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
REFERENCE = re.compile(r"`([\w/]+\.py):([\w.]+)`")


@cache
def names_in(path: Path) -> frozenset[str]:
    """Functions, classes, methods and module-level names of a file: ``f``, ``C``, ``C.m``."""
    found: set[str] = set()

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(prefix + node.name)
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{prefix}{node.name}.")
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            found.update(prefix + t.id for t in targets if isinstance(t, ast.Name))

    visit(ast.parse(path.read_text(encoding="utf-8")).body, "")
    return frozenset(found)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_every_function_named_exists(page: Path) -> None:
    for file, name in REFERENCE.findall(page.read_text(encoding="utf-8")):
        assert (SOURCE / file).is_file(), f"{page.name}: there is no {file}"
        assert name in names_in(SOURCE / file), f"{page.name}: {file} has no {name}"


def test_every_equation_of_the_paper_has_its_place() -> None:
    rows = [line for line in (ROOT / "docs/method.md").read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
    places: dict[int, bool] = {}
    for row in rows:
        numbers = re.match(r"\| (\d+)(?:–(\d+))? \|", row)
        if numbers:
            first, last = int(numbers[1]), int(numbers[2] or numbers[1])
            for n in range(first, last + 1):
                places[n] = bool(REFERENCE.search(row))
    assert sorted(places) == list(range(1, 17))
    assert all(places.values()), [n for n, there in places.items() if not there]


NOT_RUN = "not run by the commands"


def rows_of_the_method() -> list[str]:
    rows = [r for r in (ROOT / "docs/method.md").read_text(encoding="utf-8").splitlines() if REFERENCE.search(r)]
    return [r for r in rows if r.startswith("|")]


def test_every_row_of_the_method_says_how_it_differs() -> None:
    assert len(rows_of_the_method()) > 70
    assert not [row for row in rows_of_the_method() if not row.rstrip().removesuffix("|").rpartition("|")[2].strip()]


def test_what_the_method_names_is_run_by_someone() -> None:
    """Each function follows from a command or a public name; or its row says that it does not."""
    for row in rows_of_the_method():
        named = {
            (file.removesuffix(".py").replace("/", ".").removesuffix(".__init__"), n)
            for file, n in REFERENCE.findall(row)
        }
        if NOT_RUN in row:
            assert not named & reached(), row
        else:
            assert named <= reached(), f"{sorted(named - reached())} in: {row}"


def test_numbers_of_the_method_are_those_that_are_used() -> None:
    told = (ROOT / "docs/method.md").read_text(encoding="utf-8")
    update, fit = UpdateConfig(), NerfactoFitConfig()
    assert f"box {update.cut.dilation:g} times as large (`--update.cut.dilation`)" in told
    assert update.ground.reach == 2 and "within twice its size (`--update.ground.reach`)" in told
    assert f"{update.fit.steps} steps at most" in told
    assert f"the paper's {update.supervise.shadow:g} and {update.supervise.far:g} of the width" in told
    assert f"of what they leave {_RING_RAYS // 1000} 000 rays" in told
    paper, small = PaperUpdateConfig(), reduced(PaperUpdateConfig())
    assert paper.dilation == 2 and "the box twice as large (`--update.paper.dilation`)" in told
    assert f"after {paper.steps} steps of {paper.rays} rays; reduced" in told
    assert f"{small.steps} of {small.rays}. The paper" in told
    assert f"{small.steps} steps of {small.rays} rays for the update" in told
    assert f"({fit.steps // 1000} 000 steps of {fit.rays} rays)" in told
    assert f"{REDUCED.steps} steps of {REDUCED.rays} rays" in told
    weights = {FitConfig().distortion, update.fit.distortion}
    assert weights == {0.01} and f"is 0.01 for our field and the helper, nerfstudio's {fit.distortion:g}" in told
    assert f"over the first {_FORMING:g} of a fit" in told


def test_what_nobody_runs_is_found_to_be_so() -> None:
    run = reached()
    assert ("update.train", "update_field") in run  # a public name
    assert ("estimate.register", "register") in run  # called from far away
    assert ("update.routing", "Routing.of") in run  # a method, of something built elsewhere
    assert ("field.kernels.cpu.step", "train_step") in run  # a twin, chosen by device
    assert ("commands.undo", "run") in run
    assert ("field.warp", "two_way") in run  # by the paper's route alone
    tests_alone = {
        ("synthetic.oracles", "AnalyticField"),
        ("scene.similarity", "similarity"),
    }
    benchmarks = {("baselines.retrain", "retrain"), ("baselines.inpaint", "Lama")}
    assert not run & (tests_alone | benchmarks)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_between_documents_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        if made := re.fullmatch(r"options/(\w+)\.md", target):  # by docs/options.py, when the manual is built
            assert made[1] in {"index", *COMMANDS}, f"{page.name}: {target}"
        elif "://" not in target:
            assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_commands_are_real(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    shown = re.findall(r"^(?:.*/bin/)?refield (\w+)", text, re.MULTILINE) + re.findall(r"`refield (\w+)", text)
    assert set(shown) <= set(COMMANDS)


def commands() -> list[str]:
    """The README's lines of shell."""
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    return [line for block in blocks for line in block.splitlines()]


def test_continuous_integration_runs_the_readmes_test_command() -> None:
    (tests,) = [c for c in commands() if c.endswith("pytest")]
    script = ROOT / ".ci" / "run"
    assert tests in script.read_text(encoding="utf-8").splitlines()
    assert os.access(script, os.X_OK)


@pytest.mark.parametrize("page", ["README.md", "docs/limits.md"])
def test_tables_of_figures_hold_none_that_the_results_do_not(page: str) -> None:
    held = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\|.*$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
    figures = [f for row in rows for f in re.findall(r"\d+ of \d+|\d+/\d+|\d+\.\d+|\d+ trials", row)]
    assert len(figures) > 5
    assert not [f for f in figures if not re.search(rf"(?<![\d.]){re.escape(f)}(?!\.?\d)", held)]


def test_demo_and_tests_are_one_line_each() -> None:
    assert sum(c.startswith("python3 -m venv") and "&&" in c for c in commands()) == 2


def snippets() -> list[tuple[str, str]]:
    """Python that is meant to be run: the README's, and the examples."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    files = [(p.name, p.read_text(encoding="utf-8")) for p in sorted((ROOT / "examples").glob("*.py"))]
    return [("README.md", b) for b in blocks] + files


@pytest.mark.parametrize(("name", "source"), snippets(), ids=[n for n, _ in snippets()])
def test_what_snippets_import_exists(name: str, source: str) -> None:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("refield"):
            module = importlib.import_module(node.module)
            missing = [a.name for a in node.names if not hasattr(module, a.name)]
            assert not missing, f"{name}: {node.module} has no {missing}"
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "refield":
            assert hasattr(refield, node.attr), f"{name}: refield has no {node.attr}"


def public() -> list[str]:
    return [name for name in dir(refield) if not name.startswith("__")]


def test_the_table_of_contents_is_complete() -> None:
    for name in public():
        assert getattr(refield, name).__module__.startswith("refield."), name
    told = [line.name for line in declared()]
    assert sorted(told) == public()  # what type checkers see is what there is
    assert all(line.asname == line.name for line in declared())
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        refield.nothing  # noqa: B018


def declared() -> list[ast.alias]:
    """The names that `refield/__init__.py` shows to type checkers."""
    tree = ast.parse((SOURCE / "__init__.py").read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    return [alias for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names]


def test_help_is_short_and_names_everything() -> None:
    for name in public():
        getattr(refield, name)  # what is loaded must not make it longer
    text = pydoc.plain(pydoc.render_doc(refield))
    assert len(text.splitlines()) < 110
    for name in public():
        assert re.search(rf"\b{name}\b", text), name
        assert (getattr(refield, name).__doc__ or "").strip(), f"{name} says nothing of itself"


def test_the_package_says_that_it_is_typed() -> None:
    assert (SOURCE / "py.typed").is_file()


def test_every_dependency_is_explained() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = [*project["dependencies"], *(d for e in project["optional-dependencies"].values() for d in e)]
    told = re.findall(r"^\|.*$", (ROOT / "docs/dependencies.md").read_text(encoding="utf-8"), re.MULTILINE)
    for requirement in needed:
        package = re.split(r"[^\w-]", requirement)[0]
        assert any(re.search(rf"\| {re.escape(package)} \|", row) for row in told), package
