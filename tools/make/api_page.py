"""The page docs/api.md, from the docstrings of the package: :func:`api_page`; python -m tools.make.docs writes it.

First the public names, then the modules of ``_MODULES`` in full, then every module with its first sentence. What stands
in the source is taken as it stands there. The common generators make web pages, or know nothing of arguments that share
one line ("fx, fy: focal lengths in pixels").
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import potr_cl
from tools.make.markdown import NOTICE, cell, table

#: The names of the package by what one does with them, in the order of the page. All of ``potr_cl.__all__`` stand here.
_PUBLIC = {
    "Files of scenes and cameras": (
        "read_scene",
        "read_cameras",
        "load_scene",
        "load_cameras",
        "save",
        "convert",
        "info",
        "SceneInfo",
        "Scene",
        "Camera",
    ),
    "Encode and decode": (
        "encode",
        "Encoded",
        "EncodeOptions",
        "encode_to_target",
        "Target",
        "encode_ladder",
        "decode",
        "decode_to_device",
    ),
    "One stage alone": (
        "prune",
        "PrunedScene",
        "compact",
        "CompactedScene",
        "refit",
        "RefittedScene",
        "fit",
        "FittedScene",
        "removal_effects",
        "RemovalEffects",
    ),
    "Pictures": ("render", "Rendering", "Renderings", "preview", "compare", "SceneComparison", "view"),
    "Views for scenes without cameras": ("place_cameras", "look_around", "turntable"),
    "Errors": (
        "PotrError",
        "DataError",
        "UsageError",
        "DeviceError",
        "DeviceMemoryError",
        "UnreachableError",
        "WriteError",
    ),
}

#: Modules that are told in full to those who build on the package or change it; of a name that ends with a dot, all
#: modules of that folder.
_MODULES = (
    "potr_cl.api.",
    "potr_cl.formats.",
    "potr_cl.stages.",
    "potr_cl.pipeline.",
    "potr_cl.raster.",
    "potr_cl.quality.metrics",
    "potr_cl.codec.decoder",
    "potr_cl.ondevice.decode",
    "potr_cl.opencl.discovery",
    "potr_cl.opencl.device",
    "potr_cl.opencl.kernel",
    "potr_cl.opencl.memory",
    "potr_cl.opencl.quirks",
)

_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Yields)((?:, \w+)*):(?: (.*))?$")
_TITLES = {"Args": "Arguments"}
_ITEM = re.compile(r"^ {4}([*\w]+(?:, [*\w]+)*): ?(.*)$")


def api_page() -> str:
    """The text of docs/api.md."""
    told = [name for names in _PUBLIC.values() for name in names]
    missing = set(potr_cl.__all__) ^ {*told, "__version__"}
    if missing:
        raise SystemExit(
            f"tools/make/api_page.py, _PUBLIC: {', '.join(sorted(missing))} stands only there or in __all__"
        )
    parts = [
        "# Python interface",
        NOTICE,
        "[The names of potr_cl](#the-names-of-potr_cl) are for programs that compress scenes. "
        "[Modules](#modules) describes single modules in full, for those who build on the package or change it. "
        "[All modules](#all-modules) has a line for each module.",
        "Shapes of arrays stand in round brackets: N splats, M spherical-harmonics coefficients a channel, H rows and "
        "W columns of a picture.",
        "## The names of potr_cl",
    ]
    for title, names in _PUBLIC.items():
        parts.append(f"### {title}")
        for name in names:
            parts += _object(name, getattr(potr_cl, name), "####")
    parts.append("## Modules")
    for name in _modules_in_full():
        parts += _module(importlib.import_module(name))
    parts += ["## All modules", table(("module", "what it holds"), [(f"`{m}`", cell(s)) for m, s in _index()])]
    return "\n\n".join(parts) + "\n"


def _modules_in_full() -> Iterator[str]:
    for name in _MODULES:
        if name.endswith("."):
            folder = importlib.import_module(name[:-1])
            yield name[:-1]
            yield from (name + found.name for found in pkgutil.iter_modules(folder.__path__) if not found.ispkg)
        else:
            yield name


def _index() -> Iterator[tuple[str, str]]:
    """Every module of the package and the first sentence of its docstring."""
    for found in sorted(pkgutil.walk_packages(potr_cl.__path__, "potr_cl."), key=lambda found: found.name):
        if found.name.endswith("__main__"):
            continue
        path = Path(potr_cl.__file__).parent.joinpath(*found.name.split(".")[1:])
        file = path / "__init__.py" if found.ispkg else path.with_suffix(".py")
        if not file.exists():  # compiled: its Python neighbours say what it is
            continue
        source = file.read_text("utf-8")
        docstring = ast.get_docstring(ast.parse(source)) or ""
        first = " ".join(docstring.split("\n\n")[0].split())
        yield found.name, _inline(re.split(r"(?<=[.?!])(?<!et al\.)\s", first)[0])


def _is_above(name: str, value: Any) -> bool:
    """Whether this very thing stands among the public names; a module may have another of the same name."""
    return name in potr_cl.__all__ and getattr(potr_cl, name) is value


def _module(module: ModuleType) -> Iterator[str]:
    yield f"### {module.__name__}"
    if module.__doc__:
        yield _markdown(module.__doc__)
    own = {name: value for name, value in vars(module).items() if _is_own(module, name, value)}
    above = [f"[`{name}`](#{name.lower()})" for name in own if _is_above(name, own[name])]
    if above:
        yield f"{', '.join(above)}: see above."
    for name, value in own.items():
        if not _is_above(name, value):
            yield from _object(name, value, "####")


def _is_own(module: ModuleType, name: str, value: Any) -> bool:
    """Whether a name of a module is a public class or function that is defined there."""
    public = not name.startswith("_") and (inspect.isclass(value) or inspect.isfunction(value))
    return public and value.__module__ == module.__name__


def _object(name: str, value: Any, level: str) -> Iterator[str]:
    """A function, or a class with its public methods."""
    node = ast.parse(textwrap.dedent(inspect.getsource(value))).body[0]
    yield f"{level} {name}"
    if isinstance(node, ast.FunctionDef):
        yield _code(_call(name, node, f" -> {ast.unparse(node.returns)}" if node.returns else ""))
        yield _markdown(ast.get_docstring(node) or "")
        return
    assert isinstance(node, ast.ClassDef)
    yield _code(_class(node))
    yield _markdown(ast.get_docstring(node) or "")
    for method in node.body:
        if isinstance(method, ast.FunctionDef) and not method.name.startswith("_") and ast.get_docstring(method):
            yield from _method(name, method)


def _method(owner: str, node: ast.FunctionDef) -> Iterator[str]:
    kinds = {ast.unparse(decorator) for decorator in node.decorator_list}
    result = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    if kinds & {"property", "cached_property", "functools.cached_property"}:
        yield f"**`{owner}.{node.name}{result}`**"
    else:
        yield _code(_call(f"{owner}.{node.name}", node, result, bound="staticmethod" not in kinds))
    yield _markdown(ast.get_docstring(node) or "")


def _class(node: ast.ClassDef) -> str:
    """A class as it is called: a dataclass with its fields, another with the arguments of its constructor."""
    bases = f"({', '.join(map(ast.unparse, node.bases))})" if node.bases else ""
    made = next((m for m in node.body if isinstance(m, ast.FunctionDef) and m.name == "__init__"), None)
    if made is not None:
        return _call(node.name, made, "", bound=True)
    fields = [
        _field(statement)
        for statement in node.body
        if isinstance(statement, ast.AnnAssign) and not ast.unparse(statement.target).startswith("_")
    ]
    head = [f"@{ast.unparse(decorator)}" for decorator in node.decorator_list] + [f"class {node.name}{bases}"]
    return "\n".join([*head[:-1], head[-1] + (":" if fields else ""), *(f"    {field}" for field in fields)])


def _field(node: ast.AnnAssign) -> str:
    """A field of a dataclass; of a stage's option the default and the flag that sets it."""
    made = node.value
    if isinstance(made, ast.Call) and ast.unparse(made.func) == "option":
        flag = next((ast.literal_eval(each.args[0]) for each in made.args[1:] if isinstance(each, ast.Call)), None)
        text = f"{ast.unparse(node.target)}: {ast.unparse(node.annotation)} = {ast.unparse(made.args[0])}"
        return f"{text}  # {flag}" if flag else text
    return ast.unparse(node)


def _call(name: str, node: ast.FunctionDef, result: str, bound: bool = False) -> str:
    """A call with its parameters as the source has them, in lines of at most 100 characters."""
    given = node.args
    plain = [*given.posonlyargs, *given.args]
    defaults: list[ast.expr | None] = [None] * (len(plain) - len(given.defaults)) + [*given.defaults]
    parameters = [_parameter(p, d) for p, d in zip(plain, defaults, strict=True)][1 if bound else 0 :]
    if given.vararg:
        parameters.append(f"*{ast.unparse(given.vararg)}")
    elif given.kwonlyargs:
        parameters.append("*")
    parameters += [_parameter(p, d) for p, d in zip(given.kwonlyargs, given.kw_defaults, strict=True)]
    if given.kwarg:
        parameters.append(f"**{ast.unparse(given.kwarg)}")
    line = f"{name}({', '.join(parameters)}){result}"
    if len(line) <= 100:
        return line
    return "\n".join([f"{name}(", *(f"    {parameter}," for parameter in parameters), f"){result}"])


def _parameter(parameter: ast.arg, default: ast.expr | None) -> str:
    text = ast.unparse(parameter)
    return text if default is None else f"{text} = {ast.unparse(default)}"


def _code(text: str) -> str:
    """A block of code; quotes as the formatter of the project's code has them, not as ast does."""
    text = re.sub(r"'([^'\"]*)'", r'"\1"', text)
    return f"```python\n{text}\n```"


def _markdown(docstring: str) -> str:
    """A docstring as Markdown: its sections become lists, its references code."""
    lines: list[str] = []
    section = False
    for line in inspect.cleandoc(docstring).splitlines():
        heading = _SECTION.match(line)
        item = _ITEM.match(line) if section else None
        if heading:
            section = True
            title = ", ".join(_TITLES.get(name, name) for name in (heading[1], *heading[2].split(", ")) if name)
            lines += [f"**{title}:** {_inline(heading[3] or '')}", ""]
        elif item:
            names = ", ".join(f"`{name}`" for name in item[1].split(", "))
            lines.append(f"- {names}: {_inline(item[2])}")
        elif section and line.startswith("    "):
            lines.append(f"  {_inline(line.strip())}" if lines and lines[-1] else _inline(line.strip()))
        else:
            section = section and not line
            lines.append(line if line.startswith("    ") else _inline(line))
    return re.sub(r"\n{3,}", "\n\n", "\n".join(line.rstrip() for line in lines)).strip()


def _inline(text: str) -> str:
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text)
    text = re.sub(r"``([^`]+)``", r"`\1`", text)
    text = re.sub(r"::$", ":", text)
    return "".join(part if part.startswith("`") else _escaped(part) for part in re.split(r"(`[^`]*`)", text))


def _escaped(text: str) -> str:
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", text.replace("<", "&lt;").replace("*", "\\*"))
