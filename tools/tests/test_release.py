"""What an index shows of the package works away from the repository, and nothing in it is of an unfree scene."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tools.make.release import absolute_links, left_out, relative_links, with_urls

ROOT = Path(__file__).parents[2]
URL = "https://example.org/someone/potr_cl/"


def test_links_of_the_readme_lead_to_the_repository() -> None:
    text = (ROOT / "README.md").read_text("utf-8") + "\n[here](#limits)\n"
    assert relative_links(text)
    made = absolute_links(text, URL, "v1")
    assert relative_links(made) == []
    assert "](https://example.org/someone/potr_cl/raw/v1/docs/images/plush.jpg)" in made
    assert "](https://example.org/someone/potr_cl/blob/v1/docs/cli.md)" in made
    assert "](#limits)" in made, "a link within the page stays as it is"


def test_files_that_the_sdist_lacks() -> None:
    tracked = [".gitignore", "README.md", ".ci/run", "tests/data/a.ply"]
    assert left_out(tracked, ["p-1", "p-1/README.md", "p-1/.ci/run", "p-1/tests/data/a.ply", "p-1/PKG-INFO"]) == []
    assert left_out(tracked, ["p-1", "p-1/README.md", "p-1/tests/data/b.ply"]) == [".ci/run", "tests/data/a.ply"]


def test_whatever_is_tracked_at_the_top_goes_into_the_sdist() -> None:
    """As MANIFEST.in says, or by itself: the package and what pip reads."""
    said = (ROOT / "MANIFEST.in").read_text("utf-8").split()
    itself = {"LICENSE", "MANIFEST.in", "README.md", "potr_cl", "pyproject.toml", "setup.py", ".gitignore"}
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a clone")
    assert {name.split("/")[0] for name in listed.stdout.splitlines()} <= itself | set(said)


def test_urls_of_the_project() -> None:
    tomllib = pytest.importorskip("tomllib", reason="since Python 3.11")
    project = tomllib.loads(with_urls((ROOT / "pyproject.toml").read_text("utf-8"), URL))["project"]
    assert project["urls"]["Homepage"] == URL.rstrip("/")
    assert set(project["urls"]) == {"Homepage", "Documentation", "Changelog", "Issues"}
    assert project["scripts"]


def test_nothing_is_of_a_scene_that_is_not_free() -> None:
    """Lego may be used for non-commercial research only: its figures may be told, its splats and pictures not kept."""
    try:
        listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a clone")
    assert [name for name in listed.splitlines() if "lego" in name.lower()] == []
