"""Make a wheel and an sdist that are ready for a package index, and check them.

    python -m tools.make.release https://github.com/OWNER/potr_cl [-o dist]

An index shows the README away from its repository. So in a copy of the tracked files the links of the README become
absolute, to the tag of this version, and pyproject.toml gets the project's URLs; from that copy both are built. Then
``twine check --strict`` and ``check-wheel-contents`` look at them, and what may not be in them is looked for: relative
links, and anything of scenes that are not free. The viewer of pages is built first, where Node and a compiler for
WebAssembly are; else a line says that it is not in. The sdist must have every tracked file, so that the tests run from
it. Needs the extra ``release``; git tells which files are tracked.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

from potr_cl import __version__
from potr_cl.formats.scenes.page import TEMPLATE
from tools.make import web

ROOT = Path(__file__).parents[2]
_LINK = re.compile(r"(!?)(\[(?:[^\[\]]|\[[^\]]*\])*\]\()([^)\s]+)(\))")
_ABSOLUTE = ("http://", "https://", "#", "mailto:")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url", help="of the repository, where it can be browsed")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist", metavar="DIR")
    args = parser.parse_args()
    lack = web.lacking()
    if lack:
        print(f"made without the viewer of pages, so that `encode -o scene.html` will refuse: {lack}", file=sys.stderr)
    else:
        web.build()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
        tracked = [name for name in listed.decode().split("\0") if name]
        for name in tracked:
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            (copy / name).write_bytes((ROOT / name).read_bytes())
        if not lack:
            shutil.copyfile(TEMPLATE, copy / TEMPLATE.relative_to(ROOT))
        readme, project = copy / "README.md", copy / "pyproject.toml"
        readme.write_text(absolute_links(readme.read_text("utf-8"), args.url), "utf-8")
        project.write_text(with_urls(project.read_text("utf-8"), args.url), "utf-8")
        _run("build", "--outdir", str(args.output.resolve()), str(copy))
    stem = f"potr_cl-{__version__}"
    # Its name says for which machine the compiled part of the decoder is.
    wheel = max(args.output.glob(f"{stem}-*.whl"), key=lambda path: path.stat().st_mtime)
    sdist = args.output / f"{stem}.tar.gz"
    _run("twine", "check", "--strict", str(wheel), str(sdist))
    _run("check_wheel_contents", str(wheel))
    with zipfile.ZipFile(wheel) as contents, tarfile.open(sdist) as source:
        members = source.getnames()
        names = [*contents.namelist(), *members]
        shown = contents.read(f"{stem}.dist-info/METADATA").decode()
    if missing := left_out(tracked, members):
        sys.exit(f"the sdist lacks {', '.join(missing)}: add them to MANIFEST.in")
    unfree = [name for name in names if "lego" in name.lower()]
    left = relative_links(shown.partition("\n\n")[2])
    if unfree or left:
        sys.exit(f"not fit for an index: {', '.join(unfree + left)}")
    for path in (wheel, sdist):
        print(f"{path}: {path.stat().st_size} bytes")


def absolute_links(text: str, url: str, ref: str = f"v{__version__}") -> str:
    """A Markdown page of the repository's root with links that work anywhere.

    Args:
        url: of the repository.
        ref: the tag, branch or commit that links lead to.
    """

    def absolute(match: re.Match[str]) -> str:
        picture, begin, target, end = match.groups()
        if target.startswith(_ABSOLUTE):
            return match[0]
        return f"{picture}{begin}{url.rstrip('/')}/{'raw' if picture else 'blob'}/{ref}/{target}{end}"

    return _LINK.sub(absolute, text)


def relative_links(text: str) -> list[str]:
    """The links of a Markdown page that work in the repository alone."""
    return [match[3] for match in _LINK.finditer(text) if not match[3].startswith(_ABSOLUTE)]


def with_urls(project: str, url: str) -> str:
    """pyproject.toml with the URLs that an index shows beside the page."""
    url = url.rstrip("/")
    urls = {
        "Homepage": url,
        "Documentation": f"{url}/tree/v{__version__}/docs",
        "Changelog": f"{url}/blob/v{__version__}/CHANGELOG.md",
        "Issues": f"{url}/issues",
    }
    lines = "".join(f'{name} = "{each}"\n' for name, each in urls.items())
    return project.replace("[project.scripts]\n", f"[project.urls]\n{lines}\n[project.scripts]\n")


def left_out(tracked: Sequence[str], members: Sequence[str]) -> list[str]:
    """Tracked files that an sdist lacks, whose members all lie in one folder; git's own do not count."""
    found = {member.partition("/")[2] for member in members}
    return [name for name in tracked if name not in found and Path(name).name != ".gitignore"]


def _run(module: str, *arguments: str) -> None:
    done = subprocess.run([sys.executable, "-m", module, *arguments], check=False)
    if done.returncode:
        sys.exit(done.returncode)


if __name__ == "__main__":
    main()
