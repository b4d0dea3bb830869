"""Libraries that are missing or warn: what is said of an extra, and warnings that are not shown meanwhile."""

from __future__ import annotations

import importlib.metadata
import warnings
from contextlib import ExitStack

import pytest
from PIL import Image

from potr_cl.formats.images import opened_image
from potr_cl.host.libraries import install_command, whatever_warns, without_warnings
from potr_cl.opencl.program_cache import building


def test_a_missing_extra_is_installed_from_where_the_package_came_from(monkeypatch):
    monkeypatch.setattr(importlib.metadata, "version", lambda _name: "1.0")
    assert install_command("view") == 'pip install "potr_cl[view]"'  # whatever index it is on, or none

    def unknown(_name):
        raise importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(importlib.metadata, "version", unknown)
    assert install_command("view") == 'pip install ".[view]" in a clone of the repository'


@pytest.fixture
def shown():
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        yield shown


def test_nothing_is_shown_until_the_last_block_ends(shown):
    before = list(warnings.filters)
    first, second = ExitStack(), ExitStack()
    first.enter_context(without_warnings())
    second.enter_context(without_warnings())
    warnings.warn("one", stacklevel=1)
    first.close()
    warnings.warn("two", stacklevel=1)
    second.close()
    assert list(warnings.filters) == before
    with pytest.raises(KeyError), without_warnings():
        raise KeyError
    warnings.warn("three", stacklevel=1)
    assert [str(each.message) for each in shown] == ["three"]


def test_a_photograph_that_is_read_beside_a_build(tmp_path, shown, monkeypatch):
    """One thread reads photographs while another builds kernels, whose compiler chats."""
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    before = list(warnings.filters)
    reader, builder, opened_by_pillow = ExitStack(), ExitStack(), Image.open

    def opened(*arguments, **choices):
        builder.enter_context(building("a program", alone=False))
        return opened_by_pillow(*arguments, **choices)

    monkeypatch.setattr(Image, "open", opened)
    reader.enter_context(opened_image(tmp_path / "a.png", ["PNG"]))
    warnings.warn("chat of a compiler", stacklevel=1)
    builder.close()
    reader.close()
    assert list(warnings.filters) == before
    assert shown == []


def test_filters_that_others_put_in_front_do_not_count():
    with warnings.catch_warnings(), without_warnings(), warnings.catch_warnings():
        warnings.simplefilter("error")
        with without_warnings():
            warnings.warn("nobody hears it", stacklevel=1)


@pytest.mark.parametrize("interrupted", [0, 1, 3])
def test_work_that_warnings_end_is_done_again(interrupted):
    """Others put filters in front while it is at work, from other threads or from the same one."""
    tries = []

    def work():
        tries.append(1)
        if len(tries) <= interrupted:
            warnings.simplefilter("error")
        warnings.warn("a compiler has said something", stacklevel=1)
        return "built"

    with warnings.catch_warnings():
        assert whatever_warns(work) == "built"
    assert len(tries) == interrupted + 1


def test_work_that_warnings_always_end_ends_and_other_errors_are_raised_at_once():
    def warning():
        warnings.simplefilter("error")
        warnings.warn("a compiler has said something", RuntimeWarning, stacklevel=1)

    with warnings.catch_warnings(), pytest.raises(RuntimeWarning):
        whatever_warns(warning)
    tries = []

    def failing():
        tries.append(1)
        raise ValueError("wrong")

    with pytest.raises(ValueError, match="wrong"):
        whatever_warns(failing)
    assert len(tries) == 1
