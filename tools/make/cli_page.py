"""The page docs/cli.md, from the command line's own parsers: :func:`cli_page`; python -m tools.make.docs writes it.

argparse's own help is laid out otherwise in each version of Python; this is the same everywhere.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from potr_cl.cli import command_parser
from tools.make.tables import NOTICE, cell, table


def cli_page() -> str:
    """The text of docs/cli.md: every command with its arguments."""
    parser = command_parser()
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    helps = {entry.dest: entry.help or "" for entry in commands._choices_actions}
    parts = [
        "# Command line",
        NOTICE,
        "Every command is called as `python -m potr_cl COMMAND`, or as `potr-cl COMMAND` once the package is "
        "installed. [Usage](usage.md) shows what they are for.",
        "Exit codes: 0 success; 1 bad data, a device that fails, or a target that no quality reaches; 2 wrong usage; "
        "130 interrupted, 143 terminated, 129 the terminal was closed. An output file appears only when it is "
        "whole, and never in the place of an input. Errors are one line on standard error.",
        table(("command", "what it does"), [(f"[`{n}`](#{n})", cell(helps[n])) for n in commands.choices]),
        "Instead of a command:",
        *_arguments(parser),
    ]
    for name, command in commands.choices.items():
        parts += [f"## {name}", _sentence(command.description or helps[name]), f"    {_usage(command)}"]
        parts += _arguments(command)
    return "\n\n".join(parts) + "\n"


def _usage(command: argparse.ArgumentParser) -> str:
    """The command with what it cannot do without."""
    words = [command.prog]
    for action in command._actions:
        if not action.option_strings:
            words.append(_value(action))
        elif action.required:
            words += [action.option_strings[0], _value(action)]
    return " ".join([*words, "[options]"])


def _arguments(command: argparse.ArgumentParser) -> Iterator[str]:
    """A table for each group of arguments, with the groups' own titles but for the two that argparse makes itself."""
    formatter = command._get_formatter()
    alone = {
        id(action): group._group_actions
        for group in command._mutually_exclusive_groups
        for action in group._group_actions
    }
    for number, group in enumerate(command._action_groups):
        rows = []
        for action in group._group_actions:
            if isinstance(action, (argparse._HelpAction, argparse._SubParsersAction)):
                continue
            text = formatter._expand_help(action) if action.help else ""
            others = [f"`{other.option_strings[-1]}`" for other in alone.get(id(action), ()) if other is not action]
            if others:
                text = f"{text} (not together with {', '.join(others)})".strip()
            rows.append((cell(_flags(action)), cell(text)))
        if rows:
            if number > 1 and group.title:
                yield f"{group.title[0].upper()}{group.title[1:]}:"
            yield table(("argument" if number == 0 else "option", "meaning"), rows)


def _flags(action: argparse.Action) -> str:
    """How an argument is written, with the name of its value."""
    if not action.option_strings:
        return f"`{_value(action)}`"
    value = "" if action.nargs == 0 else f" {_value(action)}"
    return ", ".join(f"`{flag}{value}`" for flag in action.option_strings)


def _value(action: argparse.Action) -> str:
    if action.choices is not None:
        return "{" + ",".join(map(str, action.choices)) + "}"
    name = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    return f"{name} …" if action.nargs in ("+", "*") else name


def _sentence(text: str) -> str:
    text = text[0].upper() + text[1:]
    return text if text.endswith(".") else f"{text}."
