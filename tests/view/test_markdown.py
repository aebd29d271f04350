"""Tables in Markdown: as they were written before, character by character."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

import pytest

from benchmarks import report, teacher, teachers_side_by_side
from warpgarment.training.data import card_page
from warpgarment.training.evaluate import measure as evaluate
from warpgarment.training.tables.protocol import FIGURES, skipped_lines
from warpgarment.training.tables.report import grid, means_table
from warpgarment.view.markdown import code, escape, table

RESULTS = Path(report.__file__).parent / "results"


def recorded(name: str) -> tuple[dict, str]:
    """A published result and the page that was written of it."""
    return json.loads((RESULTS / f"{name}.json").read_text("utf-8")), (RESULTS / f"{name}.md").read_text("utf-8")


def test_columns_are_aligned_as_asked():
    """Numbers stand at the left, or words at the right; by hand."""
    rows = [["a", 1, 0.5], ["b", "2", ""]]
    assert table(["", "n", "x"], rows) == ["|  | n | x |", "| --- | ---: | ---: |", "| a | 1 | 0.5 |", "| b | 2 |  |"]
    assert table(["", "n", "x"], rows, text=3)[1] == grid(["", "n", "x"], [])[1] == "| --- | --- | --- |"
    assert table(["", "n", "x"], iter(rows), text=0)[1] == "| ---: | ---: | ---: |"
    assert table(("n", "x", "what"), [], text=("what", "other"))[1] == "| ---: | ---: | --- |"
    assert card_page.table(["a", "b"], {"k": 1}.items()) == ["| a | b |", "| --- | ---: |", "| k | 1 |", ""]


def test_rows_have_a_cell_for_each_column():
    """A cell is missing and all that follow stand under the heading of another."""
    with pytest.raises(ValueError, match="a row of 1 cells in a table of 2 columns: \\['x'\\]"):
        table(["a", "b"], [["x"]])


@pytest.mark.parametrize("name", ["evaluation_fast", "evaluation_small"])
def test_evaluations_are_written_as_published(name):
    """The page of an evaluation reads otherwise than the published one of the same figures."""
    result, page = recorded(name)
    assert evaluate.table(result) == page


def test_benchmarks_are_written_as_published():
    """The page of the benchmarks, all parts of it, reads otherwise than the published one of the same rows."""
    result, page = recorded("cpu")
    written = report.markdown(result["machine"], result["command"], result["rows"])
    assert {row["part"] for row in result["rows"]} == set(report.TITLES)
    assert written == page


@pytest.mark.parametrize("name", ["newton", "blender"])
def test_teachers_are_written_as_published(name):
    """The page of a teacher's times reads otherwise than the published one of the same rows."""
    result, page = recorded(f"teacher_{name}_cpu")
    assert teacher.markdown(result["machine"], result["command"], result["rows"]) == page


def test_teachers_side_by_side_are_written_as_published():
    """The page that compares teachers reads otherwise than the published one of the same rows."""
    result, page = recorded("teachers")
    how = f"--frames {result['frames']} --material {result['material']}"
    parts = (result[name] for name in ("machine", "rows", "apart", "checks"))
    written = teachers_side_by_side.markdown(*parts, how)
    assert written == page


@pytest.mark.parametrize(
    ("name", "extra"),
    [
        ("table1", {"steps": "steps", "hours": "hours"}),
        ("table1_fast", {"steps": "steps", "hours": "hours"}),
        ("figure12", {"count": "sequences"}),
    ],
)
def test_tables_are_written_as_published(name, extra):
    """A table of the paper reads otherwise than the published one of the same rows."""
    result, page = recorded(name)
    assert "\n".join(means_table(result["rows"], extra)) in page


STRANGE = (
    "<img src=x onerror=alert(1)>", "[a](http://b.c)", "![a](//b.c/d.png)", "a|b", "`x` ``y``", "**bold** _it_ ~~no~~",
    "a\n\n# heading\n- item", "&lt;b&gt;", "\\", "\\|", "$x^2$ $`y`$", "<!-- ",
    "https://b.c www.b.c me@b.c", "\x1b[31m",
)  # fmt: skip


@pytest.mark.parametrize("text", STRANGE)
def test_text_of_others_is_shown_as_text(text):
    """A name in a manifest would become a tag, a picture of another host or a cell of a table."""
    escaped = escape(text)
    assert "\n" not in escaped
    assert not set("<>\x1b") & set(escaped)
    bare = re.sub(r"\\[!-/:-@\[-`{-~]", "", escaped)  # without what a backslash makes plain
    assert not set("`*|~$\\#") & set(re.sub(r"&#\d+;", "", bare))
    assert not re.search(r"!\[|\][(\[:]", bare)
    assert not re.search(r"https?:|www\.|@", bare)
    shown = html.unescape(re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", escaped))
    assert shown == " ".join("".join(c if c.isprintable() else " " for c in text).split())
    span = code(text)
    assert "|" not in span  # it would end a cell, also within a span
    if "|" in text:
        inside = span.removeprefix("<code>").removesuffix("</code>")
        assert html.unescape(re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", inside)) == shown
        return
    fence = re.match("`+", span)[0]
    assert span.endswith(fence)
    assert fence not in re.findall("`+", span[len(fence) : -len(fence)])


def test_names_of_others_in_tables_and_evaluations():
    """A sequence, a category or a reason of a stranger's set would be a tag, or a cell of its own, in a page."""
    name = "<b>x|y</b> `z`"
    figures = dict.fromkeys(FIGURES, 1.0) | {"failed": 0, "sequences": 1}
    rows = [{"label": f"{name}, never seen", "mean": {"cold": {"network": figures}}}]
    result = {
        "network": {"file": name}, "settings": {"data": name}, "frames_predicted": 1, "seconds_per_frame": 1.0,
        "mean": {"cold": {"network": figures}}, "skipped": {name: name},
        "sequences": [{"sequence": name, "start": "cold", "frames": 1, "network": figures}],
    }  # fmt: skip
    for lines in (means_table(rows), skipped_lines({name: name}), evaluate.table(result).splitlines()):
        assert "x" in "".join(lines)
        assert "<b>" not in "".join(lines)
        bare = [line.replace("\\|", "") for line in lines if line.startswith("|")]
        assert not bare or {line.count("|") for line in bare} <= {bare[0].count("|"), bare[-1].count("|")}
        assert not any("x|y" in line for line in lines)


def test_ordinary_names_stay_as_they_are():
    """Pages would be full of backslashes. Exact."""
    for name in ("cmu_07_01", "T-shirt", "procedural:sway 3", "depth [mm]", "newton 1.0.1+cpu"):
        assert escape(name) == name
