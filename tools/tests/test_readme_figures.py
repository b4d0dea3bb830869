"""README.md: its figures are those of the results, and one that is not is found."""

from __future__ import annotations

import dataclasses

import pytest

from tools.make.benchmark_results import load
from tools.make.readme_figures import README, SENTENCES, figures_table, wrong_sentences


def test_the_readme_says_what_was_measured():
    text = README.read_text("utf-8")
    assert wrong_sentences(load(), text) == []
    assert figures_table() in text


@pytest.mark.parametrize("number", range(len(SENTENCES)))
def test_a_sentence_with_another_figure_is_found(number):
    """By a digit more or less, too: 1.17 MB is not 11.17."""
    results, text = load(), " ".join(README.read_text("utf-8").split())
    sentence, figures = SENTENCES[number]
    said = sentence.format(*(figure.text(results) for figure in figures))
    first = figures[0].text(results)
    other = said.replace(first, f"9{first}", 1)
    assert any(said in wrong for wrong in wrong_sentences(results, text.replace(said, other)))


def test_a_figure_that_changes_its_sign_is_found():
    results = load()
    lego = results["photographs/lego"]
    lost = [column.name for column in lego.columns if column.ratio is None].index("lost")
    rows = tuple((*row[:lost], -row[lost], *row[lost + 1 :]) for row in lego.rows)
    changed = {**results, "photographs/lego": dataclasses.replace(lego, rows=rows)}
    assert any("nearer" in wrong for wrong in wrong_sentences(changed, README.read_text("utf-8")))
