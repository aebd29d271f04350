"""The card of a data set that somebody hostile has made, from the command line to what a browser would show of it.

The page is rendered by markdown-it, a parser that this project has not written.
"""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import pytest
from markdown_it import MarkdownIt
from support import sequences as synthetic_sequences

from warpgarment import cli

TAG = "<script>alert(1)</script>"
PICTURE = "![x](https://tracker.invalid/x.png)"
LINK = "[click](javascript:alert(1))"
BAR = "a|b `c|d` | e"
NASTY = f"{TAG} {PICTURE} {LINK} {BAR} **bold** <img src=x onerror=alert(1)>"
BREAK = f"x\n\n# heading\n\n| a |\n| --- |\n| {TAG} |\n\n{PICTURE}"


class Shown(HTMLParser):
    """What a page consists of: names of its tags, places it fetches or leads to, cells of its tables."""

    def __init__(self):
        super().__init__()
        self.tags, self.places, self.rows = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.places += [value for name, value in attrs if name in ("src", "href")]
        assert not [name for name, _ in attrs if name.startswith("on")], attrs
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_data(self, data):
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data


@pytest.fixture
def hostile(tmp_path):
    """A set in which every name is hostile, and every entry that may be a text is one."""
    root = tmp_path / "set"
    material = {"name": NASTY, "category": NASTY, "material": {NASTY: 1.0}}
    entries = {
        "category": NASTY, "motion": BREAK, "garment": NASTY, "body": {"kind": NASTY, NASTY: 1.0}, "number": 0,
        "versions": {NASTY: BREAK}, "garments": [material], "figures": {NASTY: 1.0}, "cut_short": NASTY,
        "rejected_attempts": [{"reason": f"{NASTY}: {k}", "motion": BREAK} for k in range(3)],
    }  # fmt: skip
    synthetic_sequences.write(root, "a", frames=3, around=8, rings=4, manifest=entries)
    common = {
        "configuration": {"recipe": NASTY, "seed": 1, "teacher": NASTY, "held_out": [NASTY], NASTY: NASTY},
        "teacher": {"name": NASTY, NASTY: BREAK}, "command": BREAK, "versions": {NASTY: BREAK}, "numbers": [[0, 0]],
    }  # fmt: skip
    (root / "set.json").write_text(json.dumps(common))
    return root


def test_the_page_shows_names_as_text(hostile, capsys):
    """A stranger's names become scripts, pictures that tell on who looks, links, headings, or cells of a table."""
    assert cli.main(["dataset", "card", str(hostile)]) == 0, capsys.readouterr().err
    page = (hostile / "card.md").read_text("utf-8")
    assert "alert" in page  # the names are there
    shown = Shown()
    shown.feed(MarkdownIt("commonmark", {"html": True}).enable("table").render(page))
    assert not {"script", "iframe", "svg", "object"} & set(shown.tags)
    assert all(re.fullmatch(r"card/\w+\.png", place) for place in shown.places), shown.places
    assert shown.tags.count("h1") == 1
    assert shown.tags.count("img") == len(shown.places)
    cells = [cell.strip() for row in shown.rows for cell in row]
    assert NASTY in cells, "the category is not what it is in the manifest"
    assert all("| e" in cell for cell in cells if "](javascript" in cell), "a bar of a name has ended its cell"


def test_wrong_kinds_in_the_set_are_one_line(hostile, capsys):
    """A manifest whose entries are of other kinds ends in a traceback, or in a page of nonsense."""
    manifest = hostile / "a" / "manifest.json"
    before = json.loads(manifest.read_text())
    wrong = {"category": [NASTY], "motion": {"a": NASTY}, "frames": NASTY, "fps": None, "garments": NASTY, "body": [1]}
    for key, value in wrong.items():
        manifest.write_text(json.dumps(before | {key: value}))
        assert cli.main(["dataset", "card", str(hostile)]) == 2
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1
        assert key in said[0]
    assert not (hostile / "card.md").exists()
