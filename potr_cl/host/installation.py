"""How to install what is missing (:func:`install_command`): a command that works wherever this package came from."""

from __future__ import annotations


def install_command(extra: str) -> str:
    """What a user types to get what an extra of this package brings.

    Where the package is installed, pip takes the extra's libraries from its metadata: no index need know the package.

    Args:
        extra: its name in pyproject.toml.
    """
    # Imported where something is missing: it takes longer than most of this package's own modules.
    from importlib.metadata import PackageNotFoundError, version

    try:
        version("potr-cl")
    except PackageNotFoundError:  # a clone that is run without being installed
        return f'pip install ".[{extra}]" in a clone of the repository'
    return f'pip install "potr_cl[{extra}]"'
