"""Blocks of code of a page, and how a command is tried: run with small numbers, or its options read."""

from __future__ import annotations

import ast
import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import tyro
from markdown_it import MarkdownIt

from warpgarment import cli

ROOT = Path(__file__).parents[3]
SHELL = ("sh", "bash", "")
SMALLER = {  # what is added to a command, by its verb, so that it takes seconds
    "demo": "--frames 3 --moments 2 --no-film",
    "view": "--size 96 128",
    "bench": "--frames 2",
    "generate": "--sequences 1 --frames 6 --least-frames 4 --faces 300 --attempts 1",
    "train": "--steps 2 --batch-size 2 --statistics-batches 1 --validate-frames 3 --log-every 1",
    "evaluate": "--frames 3 --max-sequences 1 --no-picture",
}


class Block(NamedTuple):
    """A block of code: its language, its text, and the line on which it begins."""

    language: str
    text: str
    line: int


def blocks(path: Path) -> Iterator[Block]:
    """The blocks of a page; the language of those without a fence is "indented"."""
    for token in MarkdownIt("commonmark").parse(path.read_text("utf-8")):
        if token.type in ("fence", "code_block"):
            assert token.map is not None
            language = token.info.strip() if token.type == "fence" else "indented"
            yield Block(language, token.content, token.map[0] + 1)


def commands(text: str) -> list[list[str]]:
    """Words of each command of a block, with lines that end in a backslash joined, and without comments."""
    joined = re.sub(r"\\\n\s*", " ", text)
    found = [shlex.split(line, comments=True) for line in joined.splitlines()]
    return [part for words in found for part in _split(words) if part]


def _split(words: list[str]) -> Iterator[list[str]]:
    if words[:1] == ["for"]:
        yield words
        return
    part: list[str] = []
    for word in words:
        if word in ("&&", "||", "|"):
            yield part
            part = []
        else:
            part.append(word)
    yield part


def run(words: list[str]) -> int:
    """Runs `warpgarment VERB ...` with small numbers; returns its exit status."""
    return cli.main([*words[1:], *shlex.split(SMALLER.get(words[1], ""))])


def read_options(words: list[str]) -> None:
    """Reads the options of `warpgarment VERB ...` without running it; three dots stand for options of training."""
    verb = cli.VERBS[words[1]]
    config = getattr(importlib.import_module(f"warpgarment.{verb.module}"), verb.options)
    dots = ["--steps", "1"] if words[1] == "train" else []
    given = [part for word in words[2:] for part in (dots if word == "..." else [word])]
    tyro.cli(config, prog=words[1], args=given)


def check(words: list[str]) -> None:
    """Checks a command that is not one of warpgarment: that what it names is there."""
    first, rest = words[0], words[1:]
    if first.endswith("torchrun"):
        read_options(["warpgarment", *rest[rest.index("warpgarment") + 1 :]])
    elif first == "make":
        targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert {word for word in rest if "=" not in word} <= set(targets), words
    elif first == "pip":
        _check_install(words)
    elif first.startswith("python") and rest[0] == "-m":
        assert importlib.util.find_spec(rest[1]), words
    elif first.startswith("python") and rest[0] == "-c":
        ast.parse(rest[1])
    elif first in ("python", "pytest", "bash") or first.startswith("PYTHON="):
        named = [word for word in words if word.endswith((".py", ".sh"))]
        assert named, words
        assert all((ROOT / name).exists() for name in named), words
    else:
        assert first in ("git", "cd", "export", "for"), f"{words}: nothing checks this command"


def _check_install(words: list[str]) -> None:
    text = (ROOT / "pyproject.toml").read_text()
    extras = set(re.findall(r"^(\w+) = \[", text.split("[project.optional-dependencies]")[1].split("\n[")[0], re.M))
    for word in words:
        if found := re.search(r"\[(.*)\]", word):
            assert set(found[1].split(",")) <= extras, words
    if "-c" in words:
        assert (ROOT / words[words.index("-c") + 1]).exists()
