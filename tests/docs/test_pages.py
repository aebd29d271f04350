"""Every block of README.md and of the documentation is tried.

Blocks of Python run one after the other in a namespace of their page, on the first six frames of the bundled walk
(`support/documentation/stage.py`). Commands of `warpgarment` run in this process, with the small numbers of `SMALLER`.
On the pages of `LONG`, which say so, and for verbs that `RUNS_ON` another page, their options are read instead.
Pages of `RUN` are carried out by the tests named there. Other commands are checked for what they name: targets of make,
extras, modules, scripts.
"""

from __future__ import annotations

import json
import re
import shutil
import warnings
from pathlib import Path

import pytest
from support.documentation import pages, stage

import warpgarment as wg

PAGES = ["README.md", "CONTRIBUTING.md", *(f"docs/{path.name}" for path in sorted((pages.ROOT / "docs").glob("*.md")))]
PAGES += ["training/README.md", "benchmarks/README.md", "findings/README.md"]
PAGES += [f"warpgarment/assets/weights/{path.name}" for path in sorted(wg.demo.ASSETS.parent.glob("weights/*.md"))]
LONG = {  # pages whose commands take long, and say so in the words of SENTENCE
    *("training/README.md", "docs/materials.md", "docs/layersnet.md", "docs/physics.md"),
    *("docs/rounding.md", "docs/hostile_files.md", "benchmarks/README.md", "findings/README.md"),
}
SENTENCE = "Commands on this page take long: tests read their options and do not run them."
RUN = {"docs/extending.md": "tests/test_extending_*.py carry out all of it"}
NOT_RUN = {  # blocks of Python that say so in their first line, by what that line says
    ("docs/readers.md", "# not run by the tests: needs a sample of CLOTH3D and a body model"),
    ("docs/readers.md", "# not run by the tests: needs the SMPL model files"),
    ("docs/bodies.md", "# not run by the tests: making Anny's body takes two minutes"),
    ("docs/viewer.md", "# not run by the tests: waits for Ctrl+C"),
}
CARDS = "warpgarment/assets/weights/"  # whose commands are those that made the networks
RUNS_ON = {  # verbs that run on one page, and of which the options are read on all others
    **dict.fromkeys(("generate", "train", "evaluate", "dataset"), "docs/own_data.md"),
    **{
        "dress": "docs/dressing.md",
        "bench": "docs/live.md",
        "doctor": "docs/troubleshooting.md",
        "demo": "tests/test_demo.py",
    },
}


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """The files of `support/documentation/stage.py`."""
    folder = tmp_path_factory.mktemp("stage")
    stage.write(folder)
    return folder


@pytest.mark.parametrize("page", [page for page in PAGES if page not in RUN])
def test_blocks_of_a_page(page, files, tmp_path, monkeypatch, capsys):
    """A reader who copies a block would get an error: a wrong name, an option that is gone, a missing file."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wg.demo, "assets", lambda *_: stage.assets())
    known: dict = {}
    for block in pages.blocks(pages.ROOT / page):
        where = f"{page}:{block.line}"
        if block.language == "python":
            if (page, block.text.splitlines()[0]) in NOT_RUN:
                continue
            known = known or stage.names(tmp_path)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                exec(compile(block.text, where, "exec"), known)
        elif block.language == "json":
            assert all(json.loads(line) for line in block.text.splitlines()), where
        elif block.language in pages.SHELL or block.text.startswith(("warpgarment ", "python ")):
            for words in pages.commands(block.text):
                _try(words, page, where, capsys)
        else:
            assert block.language in ("text", "indented"), f"{where}: nothing tries a block of {block.language}"


def _try(words: list[str], page: str, where: str, capsys) -> None:
    if words[0] != "warpgarment":
        if words[0].isidentifier() or words[0][0].isalpha():
            return pages.check(words)
        pytest.fail(f"{where}: {words} is no command")
    if len(words) < 2 or words[1] not in pages.cli.VERBS:
        assert words[1:] in (["--help"], ["VERB", "--help"]), where
        return None
    apart = {"--browser", "--dress"} & set(words)  # a server until it is stopped, a minute: tests/view, tests/dressing
    several = words[1] == "dress" and "--body" in words  # a minute: tests/dressing
    if apart or several or page in LONG or page.startswith(CARDS) or RUNS_ON.get(words[1], page) != page:
        return pages.read_options(words)
    status = pages.run(words)
    assert status in (0, 3), f"{where}: exit status {status}: {capsys.readouterr().err}"
    return None


def test_what_is_not_run_says_so():
    """A page would look tried and not be: pages of LONG have the sentence, blocks of NOT_RUN their line, no others."""
    for page in PAGES:
        text = (pages.ROOT / page).read_text("utf-8")
        assert (SENTENCE in text) == (page in LONG), page
        marked = {(page, line.strip()) for line in text.splitlines() if "# not run by the tests" in line}
        assert marked == {entry for entry in NOT_RUN if entry[0] == page}


def test_the_reference_has_every_public_name():
    """A name of `import warpgarment` would be missing from the reference; kernels have a page of their own."""
    text = (pages.ROOT / "docs" / "api.md").read_text("utf-8")
    shown = set(re.findall(r"^::: warpgarment\.(\S+)", text, re.MULTILINE))
    homes = {f"{home}.{name}" for name, home in wg._HOME.items()} | set(wg._MODULES.values())
    covered = {place for place in homes if any(place == name or place.startswith(f"{name}.") for name in shown)}
    assert homes - covered == {"kernels"}
