"""Writing pictures: PNG, MP4, captions. Needs the extra `view`; files are written completely or not at all."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from warpgarment.errors import MissingExtra
from warpgarment.io.disk.atomic import atomic_file

from .encoder import Encoder

INK, MUTED = "#2f3640", "#77808c"


def caption(image: np.ndarray, text: str) -> np.ndarray:
    """The picture, uint8 [H, W, 3], with small grey text in its lower left corner."""
    size = max(11, image.shape[0] // 26)
    return _written(image, text, (size // 2, image.shape[0] - size - size // 2), size, MUTED)


def titled(image: np.ndarray, text: str, size: int = 15) -> np.ndarray:
    """The picture, uint8 [H, W, 3], below a band with one line of text; `size` is that of the letters in pixels."""
    band = np.full((2 * size, image.shape[1], 3), 255, dtype=np.uint8)
    return np.concatenate([_written(band, text, (size // 2, size // 2 - 1), size, INK), image])


def _written(image: np.ndarray, text: str, corner: tuple[int, int], size: int, color: str) -> np.ndarray:
    with _needs_view():
        from PIL import Image, ImageDraw, ImageFont
    picture = Image.fromarray(image)
    ImageDraw.Draw(picture).text(corner, text, fill=color, font=ImageFont.load_default(size))
    return np.asarray(picture)


def write_png(path: str | Path, image: np.ndarray, *, colors: int | None = None) -> None:
    """Writes a picture as PNG, completely or not at all.

    Args:
        path: File to write.
        image: sRGB picture, uint8 [H, W, 3].
        colors: Size of the palette, at most 256, which makes the file three times smaller; None keeps all colours.
    """
    with _needs_view():
        import imageio.v3 as iio
        from PIL import Image
    with atomic_file(Path(path)) as temporary:
        if colors is None:
            iio.imwrite(temporary, image, extension=".png")
        else:
            Image.fromarray(image).quantize(colors, kmeans=2).save(temporary, "PNG", optimize=True)


def write_mp4(path: str | Path, frames: Iterable[np.ndarray], fps: float = 30.0) -> int:
    """Writes pictures as an H.264 film that browsers play.

    Args:
        path: File to write.
        frames: sRGB pictures of one size, uint8 [H, W, 3].
        fps: Frames per second.

    Returns:
        Number of pictures.

    Raises:
        OutputError: ffmpeg cannot be started, or fails, as it does on a full disk; an old film stays.
    """
    with _needs_view():
        from imageio_ffmpeg import get_ffmpeg_exe
    count, sink = 0, None
    with atomic_file(Path(path)) as temporary:
        try:
            for image in frames:
                height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2  # 4:2:0 needs even sizes
                image = np.ascontiguousarray(image[:height, :width])
                if sink is None:
                    sink = Encoder(get_ffmpeg_exe(), temporary, Path(path), (width, height), fps)
                sink.send(image)
                count += 1
        except BaseException:
            if sink is not None:
                sink.abandon()
            raise
        if sink is None:
            raise ValueError("write_mp4 was given no frame; pass at least one")
        sink.finish()
    return count


@contextlib.contextmanager
def _needs_view() -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtra("view", "Writing pictures and films") from error
