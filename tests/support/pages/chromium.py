"""A headless Chromium that is told what to do over its DevTools protocol; no driver is needed, websockets alone.

On Debian and Ubuntu `apt-get install chromium` brings one. It draws WebGL in software.
"""

from __future__ import annotations

import base64
import itertools
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np

NAMES = ("chromium", "chromium-browser", "google-chrome")
FOUND = next((path for path in map(shutil.which, NAMES) if path), None)
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-background-timer-throttling",
    "--disable-backgrounding-occluded-windows",
    "--disable-renderer-backgrounding",
    "--disable-component-update",
    "--disable-extensions",
    "--hide-scrollbars",
    "--mute-audio",
    "--remote-debugging-port=0",
)


class Chromium:
    """One page of a browser, as in ``with Chromium(folder, size) as browser:``.

    Args:
        profile: Empty folder for the browser's own files.
        size: Width and height of the page in pixels.

    Attributes:
        received: Bytes of each message that the page has had over a web socket, in their order.
        errors: Texts of exceptions of the page's scripts.
    """

    def __init__(self, profile: Path, size: tuple[int, int] = (900, 700)) -> None:
        from websockets.sync.client import connect

        assert FOUND is not None
        self.received: list[int] = []
        self.errors: list[str] = []
        self._numbers = itertools.count(1)
        command = [FOUND, *FLAGS, f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}", "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port, path = _told(profile / "DevToolsActivePort", self._process)
            self._socket = connect(f"ws://127.0.0.1:{port}{path}", max_size=None, open_timeout=30)
            target = self._ask("Target.createTarget", {"url": "about:blank"}, session=False)["targetId"]
            attached = self._ask("Target.attachToTarget", {"targetId": target, "flatten": True}, session=False)
            self._session = attached["sessionId"]
            for domain in ("Page", "Runtime", "Network"):
                self._ask(f"{domain}.enable")
            metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
            self._ask("Emulation.setDeviceMetricsOverride", metrics)
            workers = {"autoAttach": True, "waitForDebuggerOnStart": True, "flatten": True}
            self._ask("Target.setAutoAttach", workers)  # web sockets may be those of a worker
        except BaseException:
            self._process.kill()
            raise

    def __enter__(self) -> Chromium:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._process.terminate()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def open(self, url: str) -> None:
        """Goes to a page."""
        self._ask("Page.navigate", {"url": url})

    def run(self, script: str) -> Any:
        """The value of an expression of JavaScript, in the page."""
        told = {"expression": script, "returnByValue": True, "awaitPromise": True}
        return self._ask("Runtime.evaluate", told)["result"].get("value")

    def until(self, script: str, seconds: float = 60.0) -> Any:
        """The value of an expression once it is true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found = self.run(script)
            if found:
                return found
            self.rest(0.2)
        raise TimeoutError(f"not in {seconds:g} s: {script}\n{self.errors}")

    def rest(self, seconds: float) -> None:
        """Lets the page go on for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                self._heard(json.loads(self._socket.recv(timeout=left)))
            except TimeoutError:
                return

    def click(self, text: str) -> None:
        """Clicks the button, or the box with the label, of this text."""
        found = self.run(
            f"""(() => {{
                const same = e => e.textContent.trim() === {json.dumps(text)};
                const button = [...document.querySelectorAll("button")].find(same);
                if (button) {{ button.click(); return true; }}
                const label = [...document.querySelectorAll("label")].find(same);
                const box = label && document.getElementById(label.htmlFor);
                if (box) {{ box.click(); return true; }}
                return false;
            }})()"""
        )
        assert found, f"the page has nothing that says {text!r}"

    def picture(self, path: Path | None = None) -> np.ndarray:
        """What the page looks like, sRGB, uint8 [H,W,3]; also written to a PNG if a path is given."""
        import imageio.v3 as iio

        data = base64.b64decode(self._ask("Page.captureScreenshot", {"format": "png"})["data"])
        if path is not None:
            path.write_bytes(data)
        return np.asarray(iio.imread(data, extension=".png"))[..., :3]

    def _ask(self, method: str, told: dict[str, Any] | None = None, session: bool = True) -> dict[str, Any]:
        number = next(self._numbers)
        message: dict[str, Any] = {"id": number, "method": method, "params": told or {}}
        if session:
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=120))
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self._heard(answer)

    def _heard(self, event: dict[str, Any]) -> None:
        if event.get("method") == "Target.attachedToTarget":
            for method in ("Network.enable", "Runtime.runIfWaitingForDebugger"):
                told = {"id": next(self._numbers), "method": method, "sessionId": event["params"]["sessionId"]}
                self._socket.send(json.dumps(told))
        if event.get("method") == "Network.webSocketFrameReceived":
            held = event["params"]["response"]
            binary = held["opcode"] == 2
            self.received.append(len(held["payloadData"]) * 3 // 4 if binary else len(held["payloadData"]))
        if event.get("method") == "Runtime.exceptionThrown":
            self.errors.append(event["params"]["exceptionDetails"].get("exception", {}).get("description", "?"))


def _told(file: Path, process: subprocess.Popen) -> tuple[str, str]:
    """Port and path that the browser has written down."""
    for _ in range(600):
        if process.poll() is not None:
            raise RuntimeError(f"{FOUND} ended with status {process.returncode} at its start")
        if file.exists() and len(lines := file.read_text().split()) == 2:
            return lines[0], lines[1]
        time.sleep(0.1)
    raise TimeoutError(f"{FOUND} did not say its port ({os.fspath(file)})")
