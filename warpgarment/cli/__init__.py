"""The command line: `warpgarment <verb> --help`.

A verb is a dataclass, whose fields are the options, and a function called with it. Nothing is imported before its
verb is called, so help is quick and training's dependencies are asked for by training's verbs alone.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from warpgarment.errors import MeshError
from warpgarment.progress import bars

_ROOM = "warpgarment"
NOT_FREE = 3  # exit status where a result was written that is not free of crossings
JOBS_FAILED = 4  # exit status where some jobs of a list failed
CLOSED = 141  # exit status where what is printed is no longer read, as shells have it for programs that a pipe ends
_EXTRAS = {
    "newton": "physics",
    "gpytoolbox": "physics",
    "anny": "bodies",
    "mannequin": "bodies",
    "pxr": "usd",
    "alembic3d": "alembic",
    "imath": "alembic",
    "pyvista": "window",
    "viser": "browser",
    "imageio": "view",
    "imageio_ffmpeg": "view",
    "PIL": "view",
    "matplotlib": "view",
    "tensorboard": "train",
    "ray": "cluster",
    "huggingface_hub": "hub",
}  # what to install where a module is missing


@dataclass(frozen=True)
class Verb:
    """Where a verb's options (a dataclass) and its function (called with the options) live."""

    module: str
    options: str
    function: str
    summary: str


VERBS = {
    "demo": Verb(
        "cli.demo", "Demo", "run", "Roll out the bundled garments on the bundled body; film, USD and figures."
    ),
    "simulate": Verb(
        "cli.simulate", "Simulate", "run", "Dress a moving body: garment files, body motion, output file."
    ),
    "dress": Verb(
        "cli.dress", "Dress", "run", "Put a garment of another body, pose or unit on the first frame of a body."
    ),
    "generate": Verb(
        "training.generate.run", "GenerateConfig", "generate", "Simulate training sequences with a physics teacher."
    ),
    "train": Verb("training.train", "TrainConfig", "train", "Train a network on sequences."),
    "dataset": Verb("training.cli", "Dataset", "run", "Check a data set, write a page about it, or import others."),
    "evaluate": Verb(
        "training.evaluate.measure",
        "EvaluateConfig",
        "evaluate",
        "Roll a network out on test sequences and measure it.",
    ),
    "bench": Verb("cli.bench", "Bench", "run", "Time a rollout by stage on this machine."),
    "info": Verb("cli.info", "Info", "run", "Say what a file holds: objects, pieces, size, unit, axis, rate, frames."),
    "view": Verb("cli.view", "View", "run", "Look at a motion, or draw it to a PNG or MP4 without a display."),
    "convert": Verb(
        "cli.convert", "Convert", "run", "Convert a motion between npz, USD, glTF, PC2 and folders of OBJ."
    ),
    "doctor": Verb("cli.doctor", "Doctor", "run", "Versions, devices, installed extras, and a quick self check."),
}


def usage() -> str:
    """What `warpgarment --help` prints."""
    verbs = "\n".join(f"  {name:<10}{verb.summary}" for name, verb in VERBS.items())
    return (
        "usage: warpgarment VERB [options]\n\n"
        "Neural garment dynamics for any garment on any moving body.\n\n"
        f"verbs:\n{verbs}\n\n"
        "options:\n  -h, --help  this text, or a verb's options: warpgarment VERB --help\n"
        "  --version   the installed version\n"
    )


BUSY = 0.5  # cores that other processes had in the last minute, from which on threads are not to spin
SPINS = "1000"  # what libgomp takes itself where there are more threads than cores; 300,000 otherwise


def _let_threads_sleep() -> None:
    """Lets torch's threads sleep soon when they wait for each other, on a machine that has other work.

    Otherwise they spin for a millisecond or more. Where another process has one of the cores, every operation then
    waits for a thread whose core is spinning: a step of unrolled training took 90 s in place of 4. Torch reads this
    when it is imported. What the user has set stays.
    """
    busy = hasattr(os, "getloadavg") and os.getloadavg()[0] > BUSY
    if busy and not os.environ.get("OMP_WAIT_POLICY"):
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one verb.

    Args:
        arguments: Without the program's name; `sys.argv` by default.

    Returns:
        The exit status: 0; 2 where the user has to change something, which one line on stderr names; 1 for a fault of
        the program, where the line says in which file its traceback is kept; 3 where a result was written, and garments
        that should not cross do, or were not all looked at; 4 where some jobs of a list failed; 141, without a word,
        where nobody reads what it prints any more, as in `warpgarment train --help | head`.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        try:
            return _run(arguments)
        finally:
            sys.stdout.flush()  # of help too, which ends the program; otherwise Python itself would complain at the end
    except BrokenPipeError as error:
        if not _nobody_reads():
            return _own_up(error)
        for stream in (sys.stdout, sys.stderr):  # what they still hold goes nowhere
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return CLOSED


def _run(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(usage(), end="")
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(version("warpgarment"))
        return 0
    name = arguments[0].replace("_", "-")
    if name not in VERBS:
        return _complain(f"there is no verb {arguments[0]!r}. Verbs: {', '.join(VERBS)}.")

    _let_threads_sleep()
    verb = VERBS[name]
    try:
        options = _options(verb, name, arguments[1:])
        with bars():
            status = getattr(importlib.import_module(f"{_ROOM}.{verb.module}"), verb.function)(options)
    except BrokenPipeError:
        raise
    except (FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError, PermissionError) as error:
        return _complain(f"{type(error).__name__}: {error}")
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get((error.name or "").split(".")[0])
        if extra is None:
            return _own_up(error)
        from warpgarment.errors import MissingExtra

        return _complain(f"MissingExtra: {MissingExtra(extra, f'warpgarment {name}')}")
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        if not type(error).__module__.startswith(_ROOM):
            return _own_up(error)  # not one of the errors that name a remedy
        return _complain(f"{type(error).__name__}: {error}")
    return status if type(status) is int else 0


def _nobody_reads() -> bool:
    """Whether the output or the messages of this program go into a pipe whose other end is closed."""
    import select

    if not hasattr(select, "poll"):
        return True  # it can be asked on POSIX alone
    asked = select.poll()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            asked.register(stream.fileno(), 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in asked.poll(0))


@contextlib.contextmanager
def spoken(where: str = "", /, **options: str) -> Iterator[None]:
    """Lets errors and warnings about files name options of the command line instead of Python's arguments.

    Warnings are printed, each as a line.

    Args:
        where: What a warning is about, before its text: the line of a list of jobs.
        options: The option for each argument, such as ``mesh="--body-mesh"``.
    """

    from warpgarment.geometry.checks import REMEDY
    from warpgarment.geometry.seams import REMEDY as SEWING

    argument = re.compile(rf'(?<![\w-])({"|".join(options) or "(?!)"})=(?:"([^"]*)"|True\b)?')

    def translated(text: str) -> str:
        if "clean" in options:
            text = text.replace(REMEDY, f"Use {options['clean']}, or remove them.")
            text = text.replace(SEWING, f"{options['clean']} joins them.")
        return argument.sub(lambda found: f"{options[found[1]]} {found[2] or ''}".rstrip(), text)

    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", UserWarning)
        try:
            yield
        except MeshError as error:
            raise MeshError(translated(str(error))) from error
        finally:
            for warning in dict.fromkeys(translated(str(w.message)) for w in heard):
                print(f"warpgarment: {where}{' '.join(warning.split())}", file=sys.stderr)


def _options(verb: Verb, name: str, arguments: Sequence[str]) -> object:
    import tyro

    config = getattr(importlib.import_module(f"{_ROOM}.{verb.module}"), verb.options)
    return tyro.cli(config, prog=f"warpgarment {name}", args=list(arguments), description=verb.summary)


def kept_traceback(error: Exception) -> str:
    """Keeps the traceback of a fault of the program in a file; returns in words where it is."""
    import tempfile
    import traceback

    text = "".join(traceback.format_exception(error))
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="warpgarment-fault-", suffix=".txt", encoding="utf-8", delete=False
        ) as file:
            file.write(f"warpgarment {' '.join(sys.argv[1:])}\n\n{text}")
    except OSError:
        print(text, file=sys.stderr, end="")  # nowhere to keep it
        return "its traceback is above"
    return f"its traceback is in {file.name}"


def explained(error: Exception) -> str:
    """An error as the text of one line: what it is and the remedy that it names, or where its traceback is."""
    if isinstance(error, OSError) or type(error).__module__.startswith(_ROOM):
        text = f"{type(error).__name__}: {error}"
    else:
        fault = f"a fault of the program, not of its input: {type(error).__name__}: {error}"
        text = f"{fault}; {kept_traceback(error)}. Please report it."
    return " ".join(text.split())


def _own_up(error: Exception) -> int:
    """Says that the program is at fault, and where the traceback is."""
    where = kept_traceback(error)
    _complain(f"a fault of the program, not of its input: {type(error).__name__}: {error}; {where}. Please report it.")
    return 1


def _complain(message: str) -> int:
    print(f"warpgarment: {' '.join(message.split())}", file=sys.stderr)
    return 2
