"""How to install what is missing (:func:`install_command`): a command that works wherever this package came from."""

from __future__ import annotations

import re

#: The package, as pip knows it.
_PACKAGE = "potr-cl"


def install_command(extra: str) -> str:
    """What a user types to get what an extra of this package brings.

    The package may have been installed from a clone, from a wheel or from an index, and only an index would know
    "potr-cl[convert]" by that name. So the command names the libraries themselves, as the package's metadata has them.

    Args:
        extra: its name in pyproject.toml.
    """
    # Imported where something is missing: it takes longer than most of this package's own modules.
    from importlib.metadata import PackageNotFoundError, requires

    try:
        needed = requires(_PACKAGE) or []
    except PackageNotFoundError:  # a clone that is run without being installed
        needed = []
    of_extra = re.compile(rf"""\bextra\s*==\s*["']{re.escape(extra)}["']""")
    names = [name.strip() for name, _, marker in (each.partition(";") for each in needed) if of_extra.search(marker)]
    if not names:
        return f'pip install ".[{extra}]" in a clone of the repository'
    return "pip install " + " ".join(f'"{name}"' for name in names)
