"""Times the page of `wg.browse`: frames a second and bytes a frame that reach somebody who looks, and runs again.

    python -m benchmarks.viewer [--seconds 10]

The motion is the demo's dress on its body. What is run again is the demo's outfit in its wind, by the network `layers`.
Frames are counted at the other end of a web socket on the same machine; no browser draws them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import warpgarment as wg
from warpgarment.objects.wind import Wind
from warpgarment.view.browser.page import Browser
from warpgarment.view.browser.reruns import Settings

from .visitor import Visitor

FRAMES = 30  # of a run
SMALL = 2_000  # bytes: messages below are of the controls


def until(condition: Callable[[], object], seconds: float = 600.0) -> float:
    """Waits for a condition; returns the seconds that it took."""
    began = time.perf_counter()
    while not condition():
        if time.perf_counter() - began > seconds:
            raise TimeoutError
        time.sleep(0.002)
    return time.perf_counter() - began


def played(page: Browser, visitor: Visitor, color: str, seconds: float) -> str:
    """A row of a table: frames a second, and bytes a frame, with a colour."""
    page.panel.color.value = color
    visitor.quiet()
    begin, since = len(visitor.received), time.perf_counter()
    page._post(page._pressed)
    time.sleep(seconds)
    passed = time.perf_counter() - since
    page._post(page._pressed)
    visitor.quiet()
    frames = [size for size in visitor.received[begin:] if size > SMALL]
    return f"| {color} | {len(frames) / passed:.1f} | {sum(frames) / max(len(frames), 1):,.0f} |"


def main() -> None:
    """Prints two tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each measurement")
    options = parser.parse_args()
    assets = wg.demo.assets()
    dress = assets.garments["dress"]
    with wg.browse(dress.truth, assets.body, rest=[dress.garment.vertices], port=0) as page:
        with Visitor(page.url) as visitor:
            until(lambda: page.stage.looks)
            print("| color | frames a second | bytes a frame |\n| --- | ---: | ---: |")
            for color in page.stage.figures():
                print(played(page, visitor, color, options.seconds), flush=True)
    outfit = assets.outfit
    assert outfit is not None
    simulator = wg.Simulator.from_pretrained("layers", device="cpu")
    first = list(outfit.first_vertices)
    live = wg.Rerun(simulator, outfit.outfit, assets.collider, first_vertices=first, wind=outfit.wind, frames=FRAMES)
    with wg.browse(live, assets.body, port=0) as page, Visitor(page.url):
        assert page.reruns is not None
        until(lambda: page.reruns.run is not None and page.reruns.run.done)
        print(
            f"\n| run | first frame after [s] | {FRAMES} frames after [s] | ms a frame |\n| --- | ---: | ---: | ---: |"
        )
        for speed in (4.0, 10.0):
            old = page.reruns.run
            page.ask(Settings(tuple(live.materials), Wind([0, 0, -1], speed)))
            began = until(lambda old=old: page.reruns.run is not old and page.reruns.run.ready)
            run = page.reruns.run
            ended = began + until(lambda run=run: run.done)
            print(f"| wind of {speed:g} m/s | {began:.2f} | {ended:.1f} | {1e3 * run.seconds / (run.ready - 1):.0f} |")


if __name__ == "__main__":
    main()
