"""Names of outputs that are being written, and what is left of them when their process is killed.

A process that is killed cannot tidy up: its hidden file stays beside the output. The name says whose it is, so a later
save in the same folder removes what belongs to nobody any more, and never what a living process writes.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
import uuid
import zlib
from functools import cache
from pathlib import Path

OLD = 3 * 86400  # seconds without a change after which a file of another machine, or without a process, is left over
_LONGEST = 40  # characters of the output's name that are kept, so that the hidden one is not too long for the disk
_NAME = re.compile(
    r"\.(?P<stem>.+)\.(?:(?P<place>[0-9a-f]{8})-(?P<process>\d+)-)?[0-9a-f]{8}\.(?P<kind>partial|aside)(?P<suffix>\.[^.]*)?",
    re.DOTALL,
)
_mine: set[str] = set()  # names that this process is writing to


@cache
def _place() -> str:
    """Checksum of where numbers of processes mean the same: the machine since it was started, and its name space."""
    words = [os.uname().nodename if hasattr(os, "uname") else os.environ.get("COMPUTERNAME", "")]
    with contextlib.suppress(OSError):
        words.append(Path("/proc/sys/kernel/random/boot_id").read_text())
        words.append(os.readlink("/proc/self/ns/pid"))
    return f"{zlib.crc32(' '.join(words).encode()):08x}"


def beside(path: Path, aside: bool = False) -> Path:
    """A hidden name in the same folder, hence file system, with the suffix in lower case (USD's writer looks at it).

    Args:
        path: The output.
        aside: Whether it is for an old folder on its way out, which may be put back, not for something unfinished.
    """
    kind = "aside" if aside else "partial"
    label = f"{path.stem[:_LONGEST]}.{_place()}-{os.getpid()}-{uuid.uuid4().hex[:8]}.{kind}"
    hidden = path.with_name(f".{label}{path.suffix[:_LONGEST].lower()}")
    _mine.add(hidden.name)
    return hidden


def finished(*paths: Path) -> None:
    """Forgets names that `beside` has given."""
    _mine.difference_update(path.name for path in paths)


def remove_leftovers(folder: Path, back: Path | None = None, old: float = OLD) -> None:
    """Removes what processes that were killed have left in a folder, as far as that is allowed.

    Args:
        folder: The folder of an output.
        back: An output that is a folder: where it is missing and was moved aside, it is put back.
        old: Seconds without a change after which that of another machine, or of nobody in particular, goes.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        found = [(entry, match) for entry in entries if (match := _NAME.fullmatch(entry.name))]
        for entry, match in found:
            with contextlib.suppress(OSError):
                if not _left(entry, match, old):
                    continue
                if match["kind"] == "aside":
                    if back is None or match["stem"] != back.stem[:_LONGEST]:
                        continue  # it may be all that there is of another output
                    if (match["suffix"] or "") != back.suffix[:_LONGEST].lower():
                        continue
                    if not back.exists():
                        os.replace(entry.path, back)
                        continue
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    os.unlink(entry.path)


def _left(entry: os.DirEntry[str], match: re.Match[str], old: float) -> bool:
    """Whether nobody writes there any more."""
    if match["place"] == _place() and os.name == "posix":
        process = int(match["process"])
        return entry.name not in _mine if process == os.getpid() else not _lives(process)
    return time.time() - entry.stat(follow_symlinks=False).st_mtime > old


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
