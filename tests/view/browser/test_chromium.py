"""If these failed, people would open the page and see no dressed body, a still one, or controls without effect.

A real browser looks at it: `apt-get install chromium` brings one on Debian and Ubuntu; without, these are skipped.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from support.pages.chromium import FOUND, Chromium

import warpgarment as wg

pytest.importorskip("viser", reason='the page needs viser: pip install "warpgarment[browser]"')
pytestmark = pytest.mark.skipif(FOUND is None, reason="no Chromium is installed (apt-get install chromium)")

BUTTONS = "[...document.querySelectorAll('button')].map(e => e.textContent.trim())"
TIME = r"(document.body.innerText.match(/frame (\d+), /) || [])[1]"


CLOSE = "document.querySelectorAll('.mantine-Notification-closeButton')"
SCENE = 660  # pixels: the panel is to the right


def _settled(browser: Chromium) -> None:
    """Waits until the scene is drawn, and closes the note that it is drawn without a graphics card."""
    browser.rest(2.0)
    browser.run(f"{CLOSE}.forEach(e => e.click())")
    browser.until(f"{CLOSE}.length === 0", 60)
    browser.rest(1.0)


def _garment(picture: np.ndarray) -> np.ndarray:
    """Pixels of the coral of the first garment, in any light: much more red than green and blue."""
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return (r > 1.6 * g) & (r > 1.6 * b) & (r > 60)


def _body(picture: np.ndarray) -> np.ndarray:
    """Pixels of skin, in any light: a warm grey. The floor and the panel are neutral or blue."""
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return (r - b >= 6) & (r - b <= 45) & (r >= g) & (g >= b) & (r < 240)


def _saved(tmp_path: Path, name: str) -> Path:
    """Where a picture is kept: in the folder that $WARPGARMENT_PICTURES names, to look at it."""
    return Path(os.environ.get("WARPGARMENT_PICTURES", tmp_path)) / name


def test_a_dressed_body_is_seen_and_plays(tmp_path: Path) -> None:
    """The page would be empty, stand still, or its boxes do nothing.

    Both colours cover at least 1 % of the picture; the body is seen above the dress and below it; between frames at
    least 0.5 % of all pixels change; switched off, less than a tenth of the body's pixels is left.
    """
    assets = wg.demo.assets()
    motion = assets.garments["dress"].truth
    (tmp_path / "profile").mkdir()
    with wg.browse(motion, assets.body, port=0) as page, Chromium(tmp_path / "profile", (1000, 560)) as browser:
        browser.open(page.url)
        browser.until(f"{BUTTONS}.includes('Play')", 300)
        browser.until(TIME, 120)
        _settled(browser)
        first = browser.picture(_saved(tmp_path, "first.png"))
        dress, skin = _garment(first), _body(first)
        assert dress.mean() > 0.01
        assert skin.mean() > 0.01
        rows = [np.flatnonzero(mask.sum(1) > 3) for mask in (dress, skin)]
        assert rows[1][0] < rows[0][0] < rows[0][-1] < rows[1][-1], "head above the dress, feet below"
        columns = [np.flatnonzero(mask.sum(0) > 3).mean() for mask in (dress, skin)]
        assert abs(columns[0] - columns[1]) < 60, "the dress is where the body is"

        begin = len(browser.received)
        browser.click("Play")
        browser.until(f"{BUTTONS}.includes('Pause')", 60)
        browser.until(f"Number({TIME}) >= 20", 120)
        browser.click("Pause")
        browser.until(f"{BUTTONS}.includes('Play')", 60)
        frames = [size for size in browser.received[begin:] if size > 12 * len(motion.vertices[0])]
        largest = 12 * (len(motion.vertices[0]) + len(assets.body.vertices[0]))
        assert len(frames) >= 2
        assert max(frames) < largest + 5_000, "positions alone are sent"
        browser.rest(2.0)
        later = browser.picture(_saved(tmp_path, "later.png"))
        assert _garment(later).mean() > 0.01
        assert _body(later).mean() > 0.01
        assert (np.abs(first.astype(int) - later).max(axis=2) > 30).mean() > 0.005

        browser.click("body")
        browser.rest(3.0)
        alone = browser.picture(_saved(tmp_path, "alone.png"))
        assert _body(alone).sum() < 0.1 * _body(later).sum()
        assert _garment(alone).mean() > 0.01
        assert not browser.errors


def test_colors_and_a_second_result(tmp_path: Path) -> None:
    """Colours would be plain, or the second result lie in the first.

    Two shirts are seen, with a gap. By distance, less than 30 % of the coral is left; on each side green faces, about a
    centimetre from the body, cover 1 % of the picture, and blue ones, at the hem, 50 pixels.
    """
    assets = wg.demo.assets()
    motion = assets.garments["tshirt"].truth
    garment = assets.garments["tshirt"].garment
    other = wg.GarmentMotion(motion.vertices, motion.faces, motion.fps, name="other")
    (tmp_path / "profile").mkdir()
    page = wg.browse(motion, assets.body, beside=other, rest=[garment.vertices], port=0)
    with page, Chromium(tmp_path / "profile", (1000, 560)) as browser:
        browser.open(page.url)
        browser.until(TIME, 300)
        _settled(browser)
        plain = browser.picture(_saved(tmp_path, "beside.png"))
        columns = np.flatnonzero(_garment(plain).sum(0) > 5)
        parts = np.split(columns, np.flatnonzero(np.diff(columns) > 8) + 1)
        assert sum(len(part) > 20 for part in parts) == 2, "two shirts, with a gap"
        page.panel.color.value = "distance to the body"
        browser.until("document.body.innerText.includes('red: inside it')", 120)
        browser.rest(3.0)
        colored = browser.picture(_saved(tmp_path, "distance.png"))
        assert _garment(colored).sum() < 0.3 * _garment(plain).sum()
        for half in np.array_split(colored[:, :SCENE].astype(int), 2, axis=1):
            r, g, b = half.transpose(2, 0, 1)
            assert ((g > r + 30) & (g > b)).mean() > 0.01, "green: a centimetre from the body"
            assert ((b > g + 20) & (b > r)).sum() > 50, "blue: the hem is farther away"
        assert not browser.errors
