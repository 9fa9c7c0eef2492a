"""Tables as text and as Markdown."""

from __future__ import annotations

from terrafusion.datasets.core.tables import markdown_table, text_table

HEADS = ("name", "m")
ROWS = [["a|b", "1.00"], ["c", "12.50"]]


def test_a_text_table_is_aligned() -> None:
    assert text_table(HEADS, ROWS, right=(1,)) == ["name      m", "a|b    1.00", "c     12.50"]
    assert text_table(HEADS, []) == ["name  m"]


def test_a_markdown_table_escapes_bars() -> None:
    assert markdown_table(HEADS, ROWS) == [
        "| name | m |",
        "| --- | --- |",
        r"| a\|b | 1.00 |",
        "| c | 12.50 |",
    ]
