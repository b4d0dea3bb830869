"""The documentation against what it speaks of: links, paths, names, commands, the table of folders, the recipes."""

from __future__ import annotations

import importlib
import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from potr_cl.cli import command_parser
from tests.test_layout import FOLDERS

ROOT = Path(__file__).parents[1]
#: Pages for people; data's descriptions too.
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "tests").rglob("*.md")])
#: Pages that speak of the code as it is now, but for those that are made from it; others tell of what was.
PRESENT = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md")),
    *sorted(path for path in (ROOT / "docs").glob("*.md") if path.stem not in ("api", "cli")),
]
#: Modules at the package's top, which the table of folders leaves out.
MODULES = ("errors", "plain_text")
#: Sections of docs/architecture.md, and the tests that must pass besides those that they bring.
RECIPES = {
    "Add a stage": ["tests/test_api.py", "tests/api/test_keywords.py::test_every_option_is_a_keyword"],
    "Add a kernel": ["tests/opencl/test_kernel.py"],
    "Try a variant of a kernel": [],
    "Add a format": ["tests/formats/test_registry.py"],
    "Add an output": [],
    "Add a device quirk": ["tests/opencl/test_quirks.py"],
}


def ids(paths: list[Path]) -> list[str]:
    return [str(path.relative_to(ROOT)) for path in paths]


def without_code(text: str) -> str:
    """A page without its blocks of code."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"^ {4}.*$", "", text, flags=re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives a page's headings."""
    found: Counter[str] = Counter()
    names = set()
    for title in re.findall(r"^#{1,6} (.+)$", without_code(page.read_text("utf-8")), re.MULTILINE):
        shown = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title.strip()).lower()
        name = re.sub(r"[^\w\- ]", "", shown).replace(" ", "-")
        names.add(f"{name}-{found[name]}" if found[name] else name)
        found[name] += 1
    return names


@pytest.mark.parametrize("page", PAGES, ids=ids(PAGES))
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"`[^`\n]*`", "", without_code(page.read_text("utf-8")))
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{link}: there is no such file"
        assert ROOT in target.parents, f"{link} leads out of the repository"
        assert not anchor or anchor in anchors(target), f"{link}: the page has no such heading"


@pytest.mark.parametrize("page", PRESENT, ids=ids(PRESENT))
def test_paths_and_names_exist(page: Path) -> None:
    """What stands in `…` and looks like a path of the repository, or a name of the package."""
    of_recipes = {path for title in RECIPES for path, _, _ in recipe(title)}
    for quoted in re.findall(r"`([^`\n]+)`", without_code(page.read_text("utf-8"))):
        if quoted in of_recipes:
            continue
        if re.fullmatch(r"(potr_cl|tests|tools|docs|\.ci)/[\w./*-]*", quoted):
            assert list(ROOT.glob(quoted.rstrip("/"))), f"there is no {quoted}"
        elif re.fullmatch(rf"({'|'.join([*FOLDERS, 'cl'])})/[\w./*-]*", quoted):
            assert list((ROOT / "potr_cl").glob(quoted.rstrip("/"))), f"there is no potr_cl/{quoted}"
        elif re.fullmatch(r"(potr_cl|tools)(\.\w+)+", quoted):
            assert resolves(quoted), f"there is no {quoted}"


def resolves(name: str) -> bool:
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


def commands(page: Path) -> Iterator[list[str]]:
    """The calls of the command line in a page's indented blocks, without comments, and in its tables."""
    text = page.read_text("utf-8")
    for line in re.findall(r"^ {4}(.+)$", text, re.MULTILINE):
        for call in re.findall(r"(?:python -m potr_cl|^\$? *potr-cl) ([^&|]+)", line):
            yield shlex.split(call, comments=True)
    for row in re.findall(r"^\|.+$", text, re.MULTILINE):
        for call in re.findall(r"`potr-cl (\w[^`]+)`", row):
            yield shlex.split(call)


@pytest.mark.parametrize("page", PRESENT, ids=ids(PRESENT))
def test_commands_are_understood(page: Path) -> None:
    found = [call for call in commands(page) if "--haze" not in call]
    assert found or page.name != "README.md"
    for call in found:
        command_parser(call).parse_args(call)


@pytest.mark.parametrize("page", PRESENT, ids=ids(PRESENT))
def test_flags_exist(page: Path) -> None:
    known = set(re.findall(r"`(--[\w-]+)", (ROOT / "docs" / "cli.md").read_text("utf-8")))
    # Of a recipe, of tools, of Docker and of Dask.
    elsewhere = {"--haze", "--check", "--split", "--replay", "--user", "--memory-limit", "--as-large"}
    for quoted in re.findall(r"`([^`\n]+)`", without_code(page.read_text("utf-8"))):
        if not quoted.startswith(("python -m pytest", "python -m tools", "ruff", "pip", "git")):
            for flag in re.findall(r"(?<![\w-])--[a-z][\w-]+", quoted):
                assert flag in known | elsewhere, f"no command has {flag}"


def test_every_extra_is_described() -> None:
    tomllib = pytest.importorskip("tomllib", reason="since Python 3.11")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    page = (ROOT / "docs" / "install.md").read_text("utf-8")
    assert [extra for extra in project["optional-dependencies"] if f"`{extra}`" not in page] == []


def test_generated_pages_are_current() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tools.make.docs", "--check"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


# The table of folders


def folders_of_the_page() -> dict[str, set[str]]:
    """What each folder may import, as docs/architecture.md says."""
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)/` \|[^|]*\|[^|]*\| ([^|]*) \|$", text, re.MULTILINE)
    names = {folder for folder, _ in rows}
    return {
        folder: names if allowed == "all of them" else set() if allowed == "nothing" else set(allowed.split(", "))
        for folder, allowed in rows
    }


def test_the_table_of_folders_is_that_of_the_layers() -> None:
    """tests/test_layout.py compares the layers with the imports that there are."""
    wanted = {folder: may_import - set(MODULES) for folder, may_import in FOLDERS.items() if folder not in MODULES}
    assert folders_of_the_page() == wanted


# The recipes


def section(title: str) -> str:
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    return text.split(f"\n## {title}\n")[1].split("\n## ")[0]


def recipe(title: str) -> list[tuple[str, str, str]]:
    """Path, kind and text of each block of code of a section that stands below its path."""
    return re.findall(r"^`([\w./]+)`:\n\n```(\w+)\n(.*?)^```$", section(title), re.MULTILINE | re.DOTALL)


def changed(text: str, diff: str) -> str:
    """A file with a diff of the recipes: parts that @@ divides, each of which fits at one place."""
    for part in diff.split("@@\n"):
        lines = part.splitlines()
        old = "\n".join(line[1:] for line in lines if line[0] in " -")
        new = "\n".join(line[1:] for line in lines if line[0] in " +")
        assert text.count(old) == 1, f"the recipe does not fit: {old}"
        text = text.replace(old, new)
    return text


@pytest.mark.slow
def test_recipes_can_be_followed(tmp_path: Path) -> None:
    """Their files and changes, put into one copy of the package, pass their own tests and those that they name.

    And the commands that they show do what they should, and the linter has nothing to say of what they add.
    """
    for folder in ("potr_cl", "tests", "tools", "docs"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__", "images"))
    for file in ("pyproject.toml", "README.md", "CONTRIBUTING.md"):
        shutil.copy(ROOT / file, tmp_path)
    # A quirk has no file of its own: it is an entry of quirks.py. Type checkers need the keywords of options by name,
    # and what a stage has found out.
    lists = {"potr_cl/opencl/quirks.py", "potr_cl/api/choices.py", "potr_cl/stages/stage.py"}
    tests, run, docs = [], [], ["tools.make.docs"]
    for title, checks in RECIPES.items():
        blocks = recipe(title)
        assert blocks, title
        elsewhere = 0
        for path, kind, text in blocks:
            file = tmp_path / path
            if kind == "diff":
                file.write_text(changed(file.read_text("utf-8"), text), "utf-8")
                if path.startswith("potr_cl/") and path not in lists:
                    elsewhere += sum(line.startswith("+") for line in text.splitlines())
            else:
                assert not file.exists(), f"{path} is there already: the recipe needs another example"
                file.write_text(text, "utf-8")
        assert elsewhere <= 2, f"{title}: an addition should take two lines elsewhere at the most"
        shows = [line.split()[2:] for line in re.findall(r"^ {4}(python -m .+)$", section(title), re.MULTILINE)]
        own = [path for path, kind, _ in blocks if path.startswith("tests/") and kind != "diff"]
        assert shows or own or checks, f"{title}: a recipe that nobody tries"
        run += [words for words in shows if words[-1] not in own and words != docs]
        tests += [*own, *checks]
    run.append(docs)
    if importlib.util.find_spec("ruff"):
        run.append(["ruff", "check", "--no-cache", "."])
    run.append(["pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow", *dict.fromkeys(tests)])
    for command in run:
        done = subprocess.run(
            [sys.executable, "-m", *command], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
