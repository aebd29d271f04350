"""Hooks of mkdocs (mkdocs.yml): pages that lie outside docs/, links between them, formulas without a script.

Pages are written for the repository: they name other files by paths from where they lie, and can be read there. Here
those of `OUTSIDE` join the site, links to them are turned to where they are in it, and links to files that the site
does not have, such as code, become their text. Formulas become MathML, so no page fetches a script or a font.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import check_tree
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = {  # folders and files of the repository, and where they are in the site
    "training/README.md": "training/README.md",
    "benchmarks/README.md": "benchmarks/README.md",
    "benchmarks/results": "benchmarks/results",
    "findings/README.md": "findings/README.md",
    "warpgarment/assets/weights": "weights",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "CHANGELOG.md": "CHANGELOG.md",
}
KINDS = (".md", ".png")
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")
FENCE = re.compile(r"^( *)(```+|~~~+).*?^\1\2 *$", re.MULTILINE | re.DOTALL)
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def places() -> dict[str, str]:
    """Every file of the site: its path in the repository, and its path in the site."""
    found = {path.relative_to(ROOT).as_posix(): path.relative_to(ROOT / "docs").as_posix() for path in _files("docs")}
    for source, target in OUTSIDE.items():
        for path in _files(source):
            inside = path.relative_to(ROOT / source).as_posix()
            found[path.relative_to(ROOT).as_posix()] = target if inside == "." else f"{target}/{inside}"
    return found


def _files(name: str) -> list[Path]:
    at = ROOT / name
    return [at] if at.is_file() else sorted(path for path in at.rglob("*") if path.suffix in KINDS)


def on_startup(command: str, dirty: bool) -> None:
    """Lays the packages out under their installed names, from which docstrings are read."""
    check_tree.link(ROOT)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the files outside docs/."""
    for source, target in places().items():
        if not source.startswith("docs/"):
            files.append(File.generated(config, target, abs_src_path=str(ROOT / source)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turns links of the repository into links of the site."""
    known = places()
    sources = {target: source for source, target in known.items()}
    source, target = sources[page.file.src_uri], page.file.src_uri
    code = [match.span() for match in FENCE.finditer(markdown)]

    def turned(match: re.Match[str]) -> str:
        picture, text, link = match.groups()
        if "://" in link or link.startswith(("#", "mailto:")) or any(a <= match.start() < b for a, b in code):
            return match[0]
        path, _, anchor = link.partition("#")
        wanted = os.path.normpath(os.path.join(os.path.dirname(source), unquote(path)))
        if wanted == "README.md":
            wanted = "docs/index.md"
        if wanted in known:
            there = os.path.relpath(known[wanted], os.path.dirname(target) or ".")
            return f"{picture}[{text}]({there}{'#' + anchor if anchor else ''})"
        if (ROOT / wanted).exists() and not picture:
            return text if text.strip("`") == wanted else f"{text} (`{wanted}`)"
        return match[0]  # of which mkdocs then says that it leads nowhere

    return LINK.sub(turned, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turns formulas into MathML."""

    def turned(match: re.Match[str]) -> str:
        text = match[3].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
        return convert(text, display="block" if match[2] == "[" else "inline")

    return FORMULA.sub(turned, html)


def on_config(config: MkDocsConfig, **_: Any) -> MkDocsConfig:
    """Leaves the line about the tools out of the footer."""
    config.extra["generator"] = False
    return config
