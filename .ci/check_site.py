"""Looks through a built site: every link leads somewhere, to a place that is there, and nothing comes from other hosts.

    python .ci/check_site.py build/site        prints each fault and where it is; exit status 1 if there is any

Links to other hosts are counted and not followed: whether they answer is not a matter of this repository.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

FETCHED = {("script", "src"), ("img", "src"), ("link", "href"), ("iframe", "src"), ("source", "src"), ("video", "src")}
OF_STYLE = re.compile(r"""url\(\s*['"]?([a-z]+:)?//|@import\s+['"](?:[a-z]+:)?//""")
UNRENDERED = re.compile(r"\\\(|\\\[|class=\"arithmatex\"|<m\w+>\\\w*")


class Seen(HTMLParser):
    """What a page names: links, what a browser fetches, and the places in it that a link can lead to."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.places: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes links, fetched files and anchors."""
        known = {name: value or "" for name, value in attrs}
        self.places |= {known[name] for name in ("id", "name") if name in known}
        if tag == "link" and known.get("rel") in ("canonical", "next", "prev"):
            return
        if tag == "a" and "href" in known:
            self.links.append(known["href"])
        self.fetched += [known[name] for kind, name in FETCHED if kind == tag and name in known]


def faults(site: Path) -> tuple[list[str], int]:
    """Faults of a site, each as "page: what is wrong", and the number of links to other hosts."""
    seen = {}
    for path in sorted(site.rglob("*.html")):
        seen[path] = Seen()
        seen[path].feed(path.read_text(encoding="utf-8"))
    found, away = [], 0
    for path, page in seen.items():
        name = path.relative_to(site).as_posix()
        for link in [*page.links, *page.fetched]:
            parts = urlsplit(link)
            if parts.scheme in ("data", "mailto") or (parts.scheme and link in page.links):
                away += parts.scheme.startswith("http")
                continue
            if parts.scheme or parts.netloc:
                found.append(f"{name}: fetches {link}")
                continue
            target = site / parts.path.lstrip("/") if parts.path.startswith("/") else path.parent / unquote(parts.path)
            target = (target if parts.path else path).resolve()
            target = target / "index.html" if target.is_dir() else target
            if not target.exists():
                found.append(f"{name}: {link} leads nowhere")
            elif parts.fragment and target in seen and unquote(parts.fragment) not in seen[target].places:
                found.append(f"{name}: {link}: there is no such place in that page")
        if hit := UNRENDERED.search(re.sub(r"<(code|pre).*?</\1>", "", path.read_text(encoding="utf-8"), flags=re.S)):
            found.append(f"{name}: a formula was not rendered: {hit[0]}")
    for path in sorted(site.rglob("*.css")):
        if OF_STYLE.search(path.read_text(encoding="utf-8")):
            found.append(f"{path.relative_to(site).as_posix()}: fetches from another host")
    return found, away


def main(site: Path) -> int:
    """Prints the faults of a site; returns the exit status."""
    found, away = faults(site.resolve())
    for fault in found:
        print(fault)
    pages = len(list(site.rglob("*.html")))
    print(f"{pages} pages, {len(found)} faults, {away} links to other hosts (not followed)")
    return 1 if found or not pages else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
