"""Completion of commands, options and file names in shells: ``potr-cl --print-completion SHELL``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from potr_cl.cli.guard import ReadCameras, ReadFile, ReadPhotographs, WrittenFile, WrittenFolder, read_file
from potr_cl.cli.outputs import place, scene_output
from potr_cl.cli.terminal import say
from potr_cl.errors import UsageError
from potr_cl.host.installation import install_command

#: Those that shtab writes scripts for.
SHELLS = ("bash", "zsh", "fish", "tcsh", "powershell")


class PrintCompletion(argparse.Action):
    """An option that prints the script by which a shell completes the command line, and ends the program.

    Raises:
        UsageError: the library that makes the script is not installed.
    """

    def __call__(self, parser: argparse.ArgumentParser, _namespace: Any, value: Any, _option: Any = None) -> None:
        try:
            import shtab
        except ImportError as error:
            raise UsageError(f"--print-completion needs the library shtab: {install_command('completion')}") from error
        from potr_cl.cli.views import cameras_to_read  # on use: every command imports this module

        for action in _all_actions(parser):
            if action.type in (ReadPhotographs, WrittenFolder):
                action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
            elif action.type in (read_file, scene_output, place, cameras_to_read) or (
                isinstance(action.type, type) and issubclass(action.type, (ReadFile, ReadCameras, WrittenFile))
            ):
                action.complete = shtab.FILE  # type: ignore[attr-defined]
        say(shtab.complete(parser, value))
        parser.exit()


def _all_actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _all_actions(command)
