"""The parser of arguments: argparse's, but a wrong call is told in one line that says what is missing, what it should
be, and what was probably meant; and what is typed is shown harmlessly."""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NoReturn

from potr_cl.cli.guard import ReadCameras, ReadFile, ReadPhotographs, WrittenFile, WrittenFolder, read_file
from potr_cl.cli.outputs import place, scene_output
from potr_cl.cli.terminal import note, say
from potr_cl.errors import UsageError
from potr_cl.host.libraries import install_command
from potr_cl.plain_text import plain

#: More digits than any number of views, steps or splats has.
_MOST_DIGITS = 12
#: Of a value that was typed, characters that are shown.
_SHOWN = 60
#: A value that begins as an option does.
_NEGATIVE = re.compile(r"-(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|inf|infinity)$", re.IGNORECASE)
#: What argparse says when arguments are missing; their names follow.
_MISSING = "the following arguments are required: "


class CommandParser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line and exit with 2."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # Newer Pythons' help has colours as escape sequences, which our own output makes harmless, that is, shows.
        self.color = False
        # Until 3.14, argparse took -1e-3 for an option; and a box without an end has a corner at -inf.
        self._negative_number_matcher = _NEGATIVE

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """As argparse's, but an option that there is not is reported before arguments that are missing.

        Without its value a misspelt ``--output`` would else be told as a missing one.
        """
        words = sys.argv[1:] if args is None else list(args)
        if self._commands is None:
            for word in _options(words):
                name = word.partition("=")[0]
                if not any(known.startswith(name) for known in self._option_string_actions):
                    self._refuse_option(name)
        found, surplus = super().parse_known_args(words, namespace)
        if surplus and self._commands is None:
            if surplus[0].startswith("-"):
                self._refuse_option(surplus[0])
            self.error(f"'{_shown(surplus[0])}' is one argument too many")
        return found, surplus

    def error(self, message: str) -> NoReturn:
        """Say what is wrong in one line, and exit with 2."""
        if message.startswith(_MISSING):
            names = message[len(_MISSING) :].split(", ")
            message = "; ".join(map(_missing, (each for each in self._actions if _name(each) in names))) or message
        note(plain(f"{self.prog}: {message} (see {self.prog} --help)"), "error")
        sys.exit(2)

    @property
    def _commands(self) -> argparse._SubParsersAction[Any] | None:
        found = (each for each in self._actions if isinstance(each, argparse._SubParsersAction))
        return next(found, None)

    def _refuse_option(self, name: str) -> NoReturn:
        near = difflib.get_close_matches(name, self._option_string_actions, 1)
        if not near:
            self.error(f"unknown option '{_shown(name)}'")
        self.error(f"unknown option '{_shown(name)}': did you mean {_usage(self._option_string_actions[near[0]])}?")

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        try:
            return super()._get_value(action, arg_string)
        except argparse.ArgumentError as error:
            kind = {float: "a number", int: "a whole number"}.get(action.type)  # type: ignore[call-overload]
            if kind is None:
                self.error(f"{_name(action)}: {error.message}")
            self.error(f"{_name(action)} is '{_shown(arg_string)}', it must be {kind}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError:
            choices = [str(each) for each in action.choices or ()]
            near = difflib.get_close_matches(str(value), choices, 1)
            if action is not self._commands:
                meant = f"; did you mean {near[0]}?" if near else ""
                self.error(f"{_name(action)} is '{_shown(value)}', it must be {_one_of(choices)}{meant}")
            elif near:
                self.error(f"unknown command '{_shown(value)}': did you mean {near[0]}?")
            elif "." in str(value):
                self.error(
                    f"'{_shown(value)}' stands where a command should: {_one_of(choices)}; to compress a scene: "
                    f"{self.prog} encode {_shown(value)} -o OUT.potr"
                )
            self.error(f"unknown command '{_shown(value)}': it must be {_one_of(choices)}")

    def _match_argument(self, action: argparse.Action, arg_strings_pattern: str) -> int:
        try:
            return super()._match_argument(action, arg_strings_pattern)
        except argparse.ArgumentError:
            wanted = f"{action.nargs} values" if isinstance(action.nargs, int) and action.nargs > 1 else "a value"
            if isinstance(action.metavar, tuple):
                wanted += f", {' '.join(action.metavar)}"
            self.error(f"{_name(action)} needs {wanted}: {_described(action)}")

    def _print_message(self, message: str, file: Any = None) -> None:
        # The help and the version; argparse writes them as they are, and lets errors pass.
        (note if file is sys.stderr else say)(message.rstrip("\n"))


def whole_number(text: str) -> int:
    """An integer of a size that something may be counted in; a type of arguments.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    try:
        if len(text) <= _MOST_DIGITS:
            return int(text)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"{plain(text, 40)!r} is not a whole number of at most {_MOST_DIGITS} digits")


def number_or_auto(text: str) -> int | str:
    """An integer, or the word "auto"; a type of arguments.

    Raises:
        argparse.ArgumentTypeError: it is neither.
    """
    return text if text == "auto" else whole_number(text)


def _options(words: Iterable[str]) -> Iterable[str]:
    """The words that argparse takes for long options."""
    for word in words:
        if word == "--":
            return
        if word.startswith("--") and " " not in word:
            yield word


def _name(action: argparse.Action) -> str:
    """As argparse names it in its messages."""
    if action.option_strings:
        return "/".join(action.option_strings)
    return action.metavar if isinstance(action.metavar, str) else action.dest


def _usage(action: argparse.Action) -> str:
    """The option as it is typed, with its value."""
    flag = action.option_strings[-1] if action.option_strings else ""
    return " ".join(word for word in (flag, _value(action)) if word)


def _value(action: argparse.Action) -> str:
    if action.nargs == 0:
        return ""
    if isinstance(action.metavar, str):
        return action.metavar
    return "|".join(map(str, action.choices)) if action.choices else action.dest.upper()


def _missing(action: argparse.Action) -> str:
    if isinstance(action, argparse._SubParsersAction):
        return f"a command is missing: {_one_of(list(action.choices))}"
    flag = action.option_strings[0] if action.option_strings else ""
    return f"{' '.join(word for word in (flag, _value(action)) if word)}{_help(action)} is missing"


def _described(action: argparse.Action) -> str:
    return f"{_value(action)}{_help(action)}"


def _help(action: argparse.Action) -> str:
    """What a value is, in brackets: the help up to its first semicolon, for what follows is advice."""
    return f" ({action.help.partition(';')[0]})" if action.help else ""


def _one_of(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"


def _shown(value: Any) -> str:
    return plain(value, _SHOWN)


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
        from potr_cl.cli.options import cameras_to_read  # on use: every command imports this module

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
