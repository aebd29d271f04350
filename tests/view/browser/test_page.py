"""If these failed, the page would send what has not changed, fill memory, outlive its closing, or lie about runs."""

from __future__ import annotations

import socket
import threading
import time

import numpy as np
import pytest
from support.scenes import network, simulator, skirt, walk

import warpgarment as wg
from warpgarment.errors import UsageError
from warpgarment.kernels.features.channels import OUTDOOR
from warpgarment.view.browser import reruns
from warpgarment.view.browser.stage import DISTANCE, ERROR, PLAIN, STRAIN

pytest.importorskip("viser", reason='the page needs viser: pip install "warpgarment[browser]"')
from benchmarks.viewer.visitor import Visitor

FRAMES = 30
OVERHEAD = 4_000  # bytes of names, colours, the slider and the time, of a frame


@pytest.fixture
def motions() -> tuple[wg.GarmentMotion, wg.BodyMotion]:
    """A skirt that follows a capsule."""
    body, garment = walk(FRAMES), skirt()
    moved = garment.vertices + (body.vertices.mean(1) - body.vertices[0].mean(0))[:, None].astype(np.float32)
    return wg.GarmentMotion(moved, garment.faces, 30.0, name="skirt"), body


def _until(condition, seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def _rows(triangles: np.ndarray) -> list[tuple[float, ...]]:
    """Corners of triangles, in an order of their own."""
    return sorted(map(tuple, triangles.reshape(-1, 9)))


def _shows(page, frame: int) -> bool:
    return page.stage.looks is not None and page.stage.looks.frame == frame


def test_a_frame_is_its_positions(motions) -> None:
    """Faces, or a body that does not move, would be sent with each frame: 12 bytes a vertex of what moves is enough."""
    motion, body = motions
    still = wg.BodyMotion(body.vertices[:1], body.faces)
    for shown, moving in ((body, len(body.vertices[0])), (still, 0)):
        with wg.browse(motion, shown, port=0) as page, Visitor(page.url) as visitor:
            _until(lambda page=page: _shows(page, 0))
            visitor.quiet()
            for frame in (3, 4):
                before = len(visitor.received)
                page._post(lambda page=page, frame=frame: page._scrubbed(frame))
                _until(lambda page=page, frame=frame: _shows(page, frame))
                visitor.quiet()
                positions = 12 * (len(motion.vertices[0]) + moving)
                assert positions < visitor.bytes(before) < positions + OVERHEAD


def test_nothing_is_sent_while_nothing_changes(motions) -> None:
    """A held frame, one that is shown to nobody, or a part that is switched off would go on being sent."""
    motion, body = motions
    with wg.browse(motion, body, port=0) as page:
        page._post(lambda: page._scrubbed(5))
        time.sleep(0.3)
        assert page.stage.looks is None, "nobody looks"
        with Visitor(page.url) as visitor:
            _until(lambda: _shows(page, 5))
            visitor.quiet()
            before = len(visitor.received)
            time.sleep(1.0)
            assert visitor.bytes(before) < 200
            page.panel.shown["body"].value = False
            visitor.quiet()
            before = len(visitor.received)
            page._post(lambda: page._scrubbed(6))
            _until(lambda: _shows(page, 6))
            visitor.quiet()
            assert visitor.bytes(before) < 12 * len(motion.vertices[0]) + OVERHEAD, "the body is not shown"


def test_playback_does_not_fill_memory(motions) -> None:
    """Frames that were shown would be kept by the server for clients to come: it holds as many messages as before."""
    motion, body = motions
    with wg.browse(motion, body, port=0) as page, Visitor(page.url) as visitor:
        held = page.server._websock_server._broadcast_buffer.message_from_id
        _until(lambda: _shows(page, 0))
        page.panel.speed.value = 2.0
        page._post(page._pressed)
        _until(lambda: len(visitor.received) > 30)
        early = len(held)
        _until(lambda: len(visitor.received) > 150)
        assert len(held) <= early + 5


@pytest.mark.parametrize("color", [STRAIN, DISTANCE, ERROR])
def test_colors_are_of_all_faces(motions, color: str) -> None:
    """Faces would be missing, or the plain garment lie over the coloured one. Steps together have all faces, once."""
    motion, body = motions
    other = wg.GarmentMotion(motion.vertices * np.float32([1.1, 1, 1.1]), motion.faces, 30.0, name="skirt")
    with wg.browse(motion, body, beside=other, port=0) as page, Visitor(page.url):
        assert page.stage.figures() == [PLAIN, DISTANCE, STRAIN, ERROR]
        page.panel.color.value = color
        for frame in (7, 12):
            page._post(lambda frame=frame: page._scrubbed(frame))
            _until(lambda frame=frame: _shows(page, frame) and page.stage.looks.color == color)
            for side in ("first", "second"):
                path = f"/results/{side}/skirt/"
                shown = {n: h for n, h in page.stage.nodes.items() if n.startswith(path) and h.visible}
                assert all(f"/{color}/" in name for name in shown)
                corners = np.concatenate([handle.vertices[handle.faces] for handle in shown.values()])
                wanted = (motion if side == "first" else other).vertices[frame][motion.faces]
                assert _rows(corners) == _rows(wanted)
            assert page.panel.legend.content.count("<span") == len(page.stage.scale.colors)


def test_live_runs_answer_to_the_controls() -> None:
    """The page would show another run than its sliders and menus say, or not tell how far it is."""
    made = simulator(network(outdoor=OUTDOOR.names))
    live = wg.Rerun(made, skirt(), walk(6))
    with wg.browse(live, port=0) as page, Visitor(page.url):
        _until(lambda: page.reruns.run is not None and page.reruns.run.done)
        _until(lambda: page.live.progress.value == 100.0)
        page.live.speed.value, page.live.angle.value = 8.0, 90.0
        page.live.materials[0].value = "denim"
        time.sleep(2 * reruns.SETTLE)
        _until(lambda: page.reruns.run.settings.materials == (wg.Material.denim(),) and page.reruns.run.done)
        run = page.reruns.run
        np.testing.assert_allclose(run.settings.wind.rows, [[-8.0, 0.0, 0.0]], atol=1e-9, err_msg="from +X")
        wanted = made.rollout(skirt(), walk(6), wind=run.settings.wind, materials=wg.Material.denim())
        np.testing.assert_array_equal(run.frames[0], wanted.vertices)
        _until(lambda: page.stage.sides[0].garments[0].frames is run.frames[0])
        assert "6 of 6 frames" in page.live.words.content


def test_closing_ends_everything(motions) -> None:
    """Threads, or a port that is taken, would stay behind, also while a run goes on; closing twice would fail."""
    before = {thread.name for thread in threading.enumerate()}
    page = wg.browse(wg.Rerun(simulator(network()), skirt(), walk(200)), port=0)
    port = page.server.get_port()
    _until(lambda: page.reruns.run is not None and page.reruns.run.ready > 1)
    page.close()
    page.close()
    page.wait()
    assert not page.reruns.run.ready == 200
    ours = {t.name for t in threading.enumerate()} - before
    assert not [name for name in ours if name.startswith("warpgarment")]
    with socket.create_server(("127.0.0.1", port)):
        pass


def test_ports_and_hosts(motions) -> None:
    """Another page's port would be taken, or one that was asked for be another one without a word."""
    with wg.browse(motions[0], port=0) as page:
        taken = page.server.get_port()
        assert page.url == f"http://127.0.0.1:{taken}"
        with pytest.raises(UsageError, match=f"port {taken} is taken"):
            wg.browse(motions[0], port=taken)
    with pytest.raises(UsageError, match=r"cannot be served at '192\.0\.2\.1'"):
        wg.browse(motions[0], host="192.0.2.1")
    with pytest.raises(UsageError, match="between 0 and 65535"):
        wg.browse(motions[0], port=70_000)


def test_what_does_not_fit_is_refused(motions) -> None:
    """A traceback, or an empty page, in place of a sentence."""
    motion, body = motions
    with pytest.raises(UsageError, match="no garment"):
        wg.browse([], body)
    with pytest.raises(UsageError, match="112 vertices, at rest 5"):
        wg.browse(motion, body, rest=[np.zeros((5, 3))])
    late = wg.GarmentMotion(motion.vertices, motion.faces, 30.0, start=100.0)
    with pytest.raises(UsageError, match="no frame in common"):
        wg.browse(motion, beside=late)
