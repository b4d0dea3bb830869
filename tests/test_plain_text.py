"""Text that is shown: nothing in it acts on a terminal, and it is never long."""

from __future__ import annotations

import json
import logging
import math

import pytest

from potr_cl.errors import DataError, PotrError
from potr_cl.plain_text import LONGEST_LINE, LONGEST_VALUE, plain, plain_document, plain_fact, plain_lines

HOSTILE = "a\x1b]0;title\x07b\r\n\u202ec\ud800\u2028\x9b31m\x7f"


@pytest.mark.parametrize("text", ["", "plain", "an ü, a 3 and a 中", "C:\\x1b is a folder"])
def test_what_is_plain_stays(text: str) -> None:
    assert plain(text) == text


def test_what_is_not_plain_stands_as_escapes() -> None:
    shown = plain(HOSTILE)
    assert shown.isprintable()
    assert shown.startswith("a\\x1b]0;title\\x07b\\r\\n\\u202ec\\ud800\\u2028")
    assert plain(shown) == shown
    shown.encode("utf-8")
    assert plain_lines("a\n\x1bb\n") == "a\n\\x1bb\n"
    assert plain(10**5000) == "a number of thousands of digits"


@pytest.mark.parametrize("each", ["x", "\x1b", "\U0001f600", "\ud800", "ab\n"])
@pytest.mark.parametrize("longest", [40, LONGEST_LINE])
def test_what_is_long_keeps_both_ends(each: str, longest: int) -> None:
    shown = plain("begin" + each * 60_000 + "end", longest)
    assert shown.isprintable()
    assert len(shown) <= longest
    assert shown.startswith("begin")
    assert shown.endswith("end")


def test_documents_are_json_whatever_they_hold() -> None:
    document = {
        HOSTILE: [HOSTILE, math.nan, math.inf, 10**400, 10**5000, (1, 2.5, True, None)],
        "nested": {"a": object()},
    }
    shown = plain_document(document)
    text = json.dumps(shown, allow_nan=False, ensure_ascii=False)
    assert json.loads(text.encode()) == shown
    name, *_ = shown
    assert name == plain(HOSTILE)
    assert shown[name] == [plain(HOSTILE), None, None, None, None, [1, 2.5, True, None]]


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.5, 0.5), (3, 3), (None, None), (math.nan, None), (10**400, None), ({"a": 1}, None), ("\x1b", "\\x1b")],
)
def test_facts_are_short(value: object, shown: object) -> None:
    assert plain_fact(value) == shown
    assert len(plain_fact("x" * 1000)) == LONGEST_VALUE


def test_errors_are_plain_whoever_makes_them() -> None:
    error = DataError(f"'{HOSTILE}': {'x' * 60_000}")
    assert str(error).isprintable()
    assert len(str(error)) <= LONGEST_LINE
    assert str(PotrError(error)) == str(error)


def test_log_records_are_plain_for_every_handler(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "potr_cl"):
        logging.getLogger("potr_cl").warning("'%s': dropped %d splats", HOSTILE, 3)
    assert caplog.records[0].getMessage() == plain(f"'{HOSTILE}': dropped 3 splats")
