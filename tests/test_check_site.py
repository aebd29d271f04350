"""What `make docs` looks for in a built site is found, on small sites with one fault each."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

FILE = Path(__file__).resolve().parents[1] / ".ci" / "check_site.py"


@pytest.fixture(scope="module")
def check_site():
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("check_site", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["check_site"] = module
    spec.loader.exec_module(module)
    return module


def site(folder: Path, body: str) -> Path:
    """A site of a page with this body, and of a second one with a place "there"."""
    (folder / "other").mkdir()
    (folder / "index.html").write_text(f"<html><body>{body}</body></html>")
    (folder / "other" / "index.html").write_text('<h2 id="there">x</h2><a href="../">up</a>')
    (folder / "style.css").write_text("p { background: url('mark.svg') }")
    return folder


def test_a_sound_site(check_site, tmp_path, capsys):
    """A link into another page, to a place in it, to a mail address or another host would count as a fault."""
    good = '<a href="other/#there">a</a><a href="https://example.org">b</a><a href="mailto:a@b.c">c</a><math></math>'
    assert check_site.main(site(tmp_path, good)) == 0
    assert "2 pages, 0 faults, 1 links to other hosts" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ('<a href="gone/">a</a>', "index.html: gone/ leads nowhere"),
        ('<img src="gone.png">', "index.html: gone.png leads nowhere"),
        ('<a href="other/#elsewhere">a</a>', "there is no such place in that page"),
        ('<a href="#elsewhere">a</a>', "there is no such place in that page"),
        ('<script src="https://cdn.example.org/x.js"></script>', "fetches https://cdn.example.org/x.js"),
        ('<link rel="stylesheet" href="//fonts.example.org/x.css">', "fetches //fonts.example.org/x.css"),
        (r"the formula \(x\)", "a formula was not rendered"),
    ],
)
def test_a_fault_is_found(check_site, tmp_path, capsys, body, said):
    """A link to nowhere, a file of another host or a formula left as text would pass `make docs`."""
    assert check_site.main(site(tmp_path, body)) == 1
    assert said in capsys.readouterr().out


def test_a_style_that_fetches(check_site, tmp_path, capsys):
    """Fonts of another host would be fetched by a style sheet."""
    site(tmp_path, "")
    (tmp_path / "style.css").write_text("@font-face { src: url(https://fonts.example.org/x.woff2) }")
    assert check_site.main(tmp_path) == 1
    assert "style.css: fetches from another host" in capsys.readouterr().out
