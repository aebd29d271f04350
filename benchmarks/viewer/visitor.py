"""Somebody who looks at a page of viser without a browser: a web socket that counts what comes."""

from __future__ import annotations

import threading
import time

import msgspec
import viser
from viser import _messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect


class Visitor:
    """A client of a page, as in ``with Visitor(page.url) as visitor:``.

    Attributes:
        received: Bytes of each message that has come.
    """

    def __init__(self, url: str) -> None:
        self.received: list[int] = []
        self._socket = connect(
            url.replace("http", "ws"), subprotocols=[f"viser-v{viser.__version__}"], max_size=None, open_timeout=60
        )
        camera = _messages.ViewerCameraMessage(
            (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 3.0), 0.5, 0.01, 100.0, 480, 640, (0.0, 1.0, 0.0), (0.0, 1.0, 0.0)
        )
        self._socket.send(msgspec.msgpack.encode(camera.as_serializable_dict()))
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def __enter__(self) -> Visitor:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._thread.join(30)

    def _listen(self) -> None:
        try:
            for message in self._socket:
                self.received.append(len(message))
        except ConnectionClosed:
            pass

    def quiet(self, seconds: float = 0.5) -> None:
        """Waits until nothing has come for a while."""
        count, since = -1, time.monotonic()
        while time.monotonic() - since < seconds:
            if len(self.received) != count:
                count, since = len(self.received), time.monotonic()
            time.sleep(0.02)

    def bytes(self, begin: int = 0) -> int:
        """Bytes of all messages from one on."""
        return sum(self.received[begin:])
