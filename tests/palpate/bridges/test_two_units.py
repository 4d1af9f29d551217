"""Two units with simulated skins, the bridge that fuses them, their pages and their status: each
program as a process, as on a box with two fingers."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.bundle.bundle import Bundle
from palpate.client.answers import Answer
from palpate.core import sentences
from palpate.core.config import FEED
from palpate.core.runtime_folder import STATUS
from tests.factories.browser import BrowsedPage, until
from tests.factories.paths import ROOT

pytestmark = pytest.mark.slow  # in real time or slower
FINGERS = ("left", "right")
SWEEPS = 200
LIMIT_S = 120


class Pair:
    """The units of a box with two fingers, in `folder`. Both slide over one material, however long
    after the other a busy machine starts one: a sweep of `model` that it is sure of."""

    def __init__(self, folder: Path, stack: ExitStack, model: Bundle) -> None:
        self._folder, self._stack = folder, stack
        np.savez(
            folder / "good.npz",
            samples=np.repeat(model.golden[:1], SWEEPS, axis=0),
            labels=np.zeros(SWEEPS, int),
            materials=["good"],
            rate_hz=model.format.rate_hz,
            group_recording=np.zeros(SWEEPS, int),
        )
        for name in FINGERS:
            (folder / name).mkdir()
            keys = f'runtime = "{folder / name}"\nfolder = "{folder / name}-store"\n'
            (folder / f"{name}.toml").write_text(f"[store]\n{keys}")
            self.start(*self.words("run", name), "--sim", f"replay:{folder / 'good.npz'}")
        until(lambda: all((folder / name / STATUS).exists() for name in FINGERS), LIMIT_S)

    def words(self, command: str, name: str) -> list[str]:
        """The command for a finger."""
        site = str(self._folder / "palpate.toml")
        unit = "tests.factories.paced_unit"
        return [sys.executable, "-m", unit, site, command, "--unit", name]

    def start(self, *words: str, **more: Any) -> subprocess.Popen[str]:
        """Start a program, which ends with the test."""
        more = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL} | more
        one = self._stack.enter_context(subprocess.Popen(words, cwd=ROOT, text=True, **more))
        self._stack.callback(one.kill)
        return one

    def hand(self) -> subprocess.Popen[str]:
        """The bridge; its sentences come from its standard output."""
        fingers = [f"{name}={self._folder / name / FEED}" for name in FINGERS]
        bridge = sys.executable, "-m", "palpate.bridges", "fuse", "--fingers", *fingers
        return self.start(*bridge, stdout=subprocess.PIPE)

    def page(self, name: str) -> str:
        """The address of the page of a finger."""
        words = [*self.words("watch", name), "--web", "0"]
        page = self.start(*words, stderr=subprocess.PIPE)
        assert page.stderr
        return page.stderr.readline().split("page: ")[1].strip()

    def status(self, name: str) -> list[str]:
        """What `palpate status` prints."""
        words = self.words("status", name)
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT_S)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory, default_bundle: Bundle) -> Iterator[Pair]:
    """Two units that run."""
    with ExitStack() as stack:
        yield Pair(tmp_path_factory.mktemp("pair"), stack, default_bundle)


def test_a_good_pair_is_answered_as_one_hand(pair: Pair):
    """Both fingers are answered, then the hand, without a word about a fault, until SIGTERM."""
    # Lines of the bridge until both fingers have answered a sweep
    many = 40
    bridge = pair.hand()
    assert bridge.stdout
    answers: list[tuple[str, Answer]] = []
    for line, _ in zip(bridge.stdout, range(many), strict=False):
        said = sentences.read(line.encode())
        if said.kind in ("FIN", "RES"):
            read = Answer.of_finger if said.kind == "FIN" else Answer.of
            answers.append((said.kind, read(said.fields)))
        last = answers[-3:]
        if [kind for kind, _ in last] == ["FIN", "FIN", "RES"] and last[-1][1].status == "ok":
            break
    else:
        pytest.fail(str(answers))
    left, right, hand = (answer for _, answer in last)
    assert {left.label, right.label} >= {hand.label}
    assert hand.detail == ""
    bridge.terminate()
    assert bridge.wait(LIMIT_S) == 0


@pytest.mark.parametrize("name", FINGERS)
def test_its_pages_and_status_say_which_finger_and_each_thing_once(
    browser: Any, pair: Pair, name: str
):
    """A good finger shows no alarm, and a skin card with its name. No fact of its status comes
    twice."""
    seen = BrowsedPage(browser, f"{pair.page(name)}/#watch")
    tones: set[str] = set()

    def good() -> bool:
        tones.add(seen.page.get_attribute("#verdict", "data-tone"))
        return "good" in tones

    until(lambda: seen.page.locator(".skin .tile").count() == 16, LIMIT_S)
    until(good, LIMIT_S)
    assert not tones & {"warn", "bad"}
    assert seen.text("#skin-title") == f"Skin of {name}"
    assert not seen.errors
    heads = [line.split()[0] for line in pair.status(name)]
    facts = [head for head in heads if head != "sweep"]
    assert len(facts) == len(set(facts)) > 3
