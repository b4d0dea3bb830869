"""Who may know whom: the package's folders in layers, tests and tools beside it. Data flows one way, see FOLDERS."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = "potr_cl"

#: What each folder (or module) at the package's top may import, besides itself. It may name only what stands above it:
#: so there is no way round in a circle. A folder that needs one more adds it here, and says in the commit why.
FOLDERS: dict[str, set[str]] = {
    "plain_text": set(),
    "errors": {"plain_text"},
    "host": {"errors"},
    "native": {"errors"},
    "model": {"errors", "host", "native"},
    "opencl": {"errors", "host"},
    "raster": {"errors", "host", "model", "opencl"},
    "placement": {"errors", "host", "model", "opencl"},
    "workers": {"errors", "host", "opencl"},
    "codec": {"errors", "host", "native", "model"},
    "ondevice": {"errors", "host", "model", "opencl", "raster", "codec"},
    "clustering": {"errors", "host", "model", "opencl"},
    "formats": {"plain_text", "errors", "host", "model", "opencl", "codec", "clustering"},
    "views": {"errors", "host", "model", "opencl", "raster", "workers"},
    "quality": {"errors", "host", "model", "opencl", "placement", "raster", "views", "workers", "formats"},
    "outputs": {"errors", "host", "native", "model", "opencl", "raster", "codec", "ondevice", "formats", "clustering"},
    "stages": {
        "errors", "host", "model", "opencl", "placement",
        "raster", "views", "workers", "codec", "quality", "outputs",
    },
    "pipeline": {
        "errors", "host", "model", "opencl", "placement",
        "raster", "views", "workers", "codec", "stages", "quality", "outputs",
    },
    "levels": {
        "errors", "host", "model", "opencl", "raster", "workers", "stages", "quality", "pipeline",
    },
    "report": {"plain_text", "errors", "model", "opencl", "codec", "formats", "quality", "pipeline"},
    "viewer": {"plain_text", "errors", "host", "model", "opencl", "raster", "formats", "quality", "report"},
    "api": {
        "plain_text", "errors", "host", "model", "opencl", "placement",
        "raster", "views", "codec", "ondevice", "formats", "stages",
        "quality", "pipeline", "levels", "report", "outputs", "viewer", "workers",
    },
    # The commands as functions, and tables and words for its help.
    "cli": {"plain_text", "errors", "host", "model", "formats", "outputs", "report", "api"},
}  # fmt: skip
#: They offer the whole package under short names, and start it.
ENTRIES = {"__init__", "__main__"}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


def sources(folder: str) -> list[Path]:
    found = sorted((ROOT / folder).rglob("*.py"))
    assert found, f"no Python files in {folder}: the test looks in the wrong place"
    return found


@functools.cache
def is_module(name: str) -> bool:
    place = ROOT.joinpath(*name.split("."))
    return place.with_suffix(".py").exists() or place.is_dir()


def statements(node: ast.AST, only_at_import: bool) -> list[ast.Import | ast.ImportFrom]:
    """The import statements below a node; they stand in bodies, never in expressions, which are not looked into."""
    found: list[ast.Import | ast.ImportFrom] = []
    blocks = [getattr(node, name, []) for name in ("body", "orelse", "finalbody", "handlers", "cases")]
    for child in (child for block in blocks if isinstance(block, list) for child in block):
        late = only_at_import and (
            isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef))
            or (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test))
        )
        if isinstance(child, (ast.Import, ast.ImportFrom)):
            found.append(child)
        elif not late:
            found += statements(child, only_at_import)
    return found


@functools.cache
def statements_of(path: Path) -> tuple[list[ast.Import | ast.ImportFrom], list[ast.Import | ast.ImportFrom]]:
    """The import statements of a file, and those that run when it is imported itself; its tree is not kept."""
    tree = ast.parse(path.read_text("utf-8"))
    return statements(tree, only_at_import=False), statements(tree, only_at_import=True)


@functools.cache
def imports(path: Path, only_at_import: bool = False) -> list[tuple[str, int]]:
    """Modules that a file imports, and where: anywhere in it, or just what runs when it is imported itself.

    ``from a import b`` counts as ``a.b`` where that is a module, else as ``a``.
    """
    found = []
    for node in statements_of(path)[only_at_import]:
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        else:
            assert not node.level, f"{path}:{node.lineno}: a relative import"
            assert node.module
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found += [(name if is_module(name) else node.module, node.lineno) for name in names]
    return found


def folder_of(module: str) -> str | None:
    """The folder or module at the package's top that a module lies in; None of the package itself and of others."""
    parts = module.split(".")
    return parts[1] if parts[0] == PACKAGE and len(parts) > 1 else None


def test_the_table_leads_one_way_and_has_every_folder() -> None:
    above: set[str] = set()
    for folder, known in FOLDERS.items():
        assert known <= above, f"{folder} may import {known - above}, which does not stand above it"
        above.add(folder)
    top = (ROOT / PACKAGE).iterdir()
    there = {path.stem for path in top if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert there - ENTRIES == FOLDERS.keys()


def test_folders_import_what_they_may() -> None:
    """And nobody the whole package from within: ``import potr_cl`` would be a way round all layers."""
    wrong = []
    for path in sources(PACKAGE):
        own = path.relative_to(ROOT / PACKAGE).with_suffix("").parts[0]
        for node in statements_of(path)[False]:
            if isinstance(node, ast.Import) and any(alias.name == PACKAGE for alias in node.names):
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno}: imports the whole package")
        for module, line in imports(path):
            folder = folder_of(module)
            if own not in ENTRIES and folder is not None and folder not in {own, *FOLDERS[own]}:
                wrong.append(f"{path.relative_to(ROOT)}:{line}: {own} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_no_modules_import_each_other() -> None:
    """Within a folder either: what runs when a module is imported never comes back to it."""
    graph = {module_name(p): {m for m, _ in imports(p, only_at_import=True)} for p in sources(PACKAGE)}
    done: set[str] = set()

    def visit(module: str, way: list[str]) -> None:
        assert module not in way, " -> ".join([*way[way.index(module) :], module])
        if module not in done:
            for other in sorted(graph[module] & graph.keys()):
                visit(other, [*way, module])
            done.add(module)

    for module in sorted(graph):
        visit(module, [])


@pytest.mark.parametrize(
    ("folder", "others"), [(PACKAGE, {"tests", "tools"}), ("tests", {"tools"}), ("tools", {"tests"})]
)
def test_package_tests_and_tools_stay_apart(folder: str, others: set[str]) -> None:
    """Tools may use the float64 definitions; the tools' own tests, in tools/tests, what tests share, too."""
    mentioned = re.compile(rf"^\s*(from|import) .*\b({'|'.join(others)})\b", re.MULTILINE)
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: imports {module}"
        for path in sources(folder)
        if path.parent != ROOT / "tools" / "tests" and mentioned.search(path.read_text("utf-8"))
        for module, line in imports(path)
        if module.split(".")[0] in others and not (folder == "tools" and module.startswith("tests.reference"))
    ]
    assert not wrong, "\n".join(wrong)


def test_an_import_is_found_wherever_it_stands(tmp_path: Path) -> None:
    file = tmp_path / "file.py"
    file.write_text(
        "from typing import TYPE_CHECKING\n"
        "import potr_cl.cli.files as files\n"
        "if TYPE_CHECKING:\n    from potr_cl.model import camera\n"
        "def f():\n    from potr_cl.model.scene import Scene\n"
        "class A:\n    from tools import bench\n"
    )
    everywhere = {module for module, _ in imports(file)}
    assert everywhere == {"typing", "potr_cl.cli.files", "potr_cl.model.camera", "potr_cl.model.scene", "tools.bench"}
    assert {m for m, _ in imports(file, only_at_import=True)} == {"typing", "potr_cl.cli.files", "tools.bench"}


def test_guides_name_files_that_are_there() -> None:
    """A package's docstring says where to begin: it names modules of the package, or of folders below."""
    for guide in sorted((ROOT / PACKAGE).rglob("__init__.py")):
        text = ast.get_docstring(ast.parse(guide.read_text("utf-8"))) or ""
        for named in re.findall(r"(?<![\w/`.])(?:[\w]+/)*\w+\.py\b", text):
            found = [*guide.parent.glob(named), *(ROOT / PACKAGE).glob(named), *ROOT.glob(named)]
            assert found, f"{guide.relative_to(ROOT)} names {named}, which is not there"
