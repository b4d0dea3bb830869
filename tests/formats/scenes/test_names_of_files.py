"""Files that scenes name lie in the scene's folder, on Windows too."""

from __future__ import annotations

import ntpath

import pytest

from potr_cl.errors import DataError
from potr_cl.formats.scenes.scene_files import related

NAMES = (
    "means.webp", "level/means.webp", "aux.webp", "level/CON", "nul.tar.gz", "com1 .webp", "means.webp:stream",
    "C:x.webp", "C:/x.webp", "level/C:x.webp", "..\\x.webp", "a/..\\..\\x.webp", "\\\\server\\share\\x.webp",
    "//server/share/x.webp", "../x.webp", "a/../../x.webp", "/x.webp", "", ".", "console.webp", "com.webp",
)  # fmt: skip
HARMLESS = {"means.webp", "level/means.webp", "console.webp", "com.webp"}
ON_OTHER_SYSTEMS = {"aux.webp", "level/CON", "nul.tar.gz", "com1 .webp", "means.webp:stream"}


@pytest.mark.parametrize("windows", [True, False])
@pytest.mark.parametrize("name", NAMES)
def test_names_that_lead_elsewhere_are_refused(tmp_path, name, windows):
    if name in HARMLESS or (not windows and name in ON_OTHER_SYSTEMS):
        found = related(tmp_path / "meta.json", name, windows)
        assert tmp_path in found.parents
        there = ntpath.normpath(ntpath.join("C:\\scene", *found.relative_to(tmp_path).parts))
        assert there.startswith("C:\\scene\\")
    else:
        with pytest.raises(DataError, match="is damaged: it names a file"):
            related(tmp_path / "meta.json", name, windows)
