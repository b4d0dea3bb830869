"""The report in a real browser: on a screen, on a phone, on paper; nothing is loaded, nothing is wrong."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import potr_cl

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.one_runtime]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Path:
    page = tmp_path_factory.mktemp("report") / "report.html"
    potr_cl.encode(
        data / "plush_excerpt.ply", data / "plush_excerpt_cameras.json", preset="fast", iterations=3, report=page
    )
    return page


@pytest.fixture
def shown(report: Path, browser: Any) -> Any:
    """Opens the report in a window of a size."""
    contexts, wrong = [], []

    def show(width: int, height: int) -> Any:
        context = browser.new_context(viewport={"width": width, "height": height})
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: None if request.url[:5] in ("file:", "data:") else wrong.append(request.url))
        page.goto(report.as_uri())
        return page

    yield show
    for context in contexts:
        context.close()
    assert wrong == []


@pytest.mark.parametrize("width", [320, 390, 1280])
def test_nothing_is_wider_than_the_screen(shown, width):
    page = shown(width, 800)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.get_by_role("heading", name="Quality by view").is_visible()
    size = page.evaluate("parseFloat(getComputedStyle(document.querySelector('td')).fontSize)")
    assert size >= 12, "readable on a phone"


def test_the_slider_shows_before_and_after(shown):
    page = shown(1280, 800)
    slider = page.locator(".slider").first
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    page.mouse.click(box["x"] + box["width"] * 0.25, box["y"] + box["height"] / 2)
    assert page.evaluate("parseFloat(document.querySelector('.slider').style.getPropertyValue('--at'))") < 35


def test_paper(shown):
    page = shown(1280, 800)
    pdf = page.pdf(format="A4")
    pages = len(re.findall(rb"/Type\s*/Page\b", pdf))
    assert 1 < pages <= 6
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.body).color") == "rgb(0, 0, 0)"
    assert page.evaluate("getComputedStyle(document.querySelector('.wide')).overflowX") == "visible"
