"""The names that documents and CI use: targets of make, campaigns, studies."""

import importlib.util
import re
import subprocess

import pytest

from palpate_studies.__main__ import PROGRAM
from tests.campaigns import __main__ as campaigns
from tests.campaigns import processors
from tests.factories.paths import ROOT

READ = (".md", ".py", ".toml", ".yml", ".yaml", ".html", ".j2", ".service")
"""Suffixes of files that name commands; .ci/run does, too."""


def texts() -> dict[str, str]:
    """Each file of the project that may name a command, and its text."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    ).stdout.splitlines()
    named = (name for name in listed if name.endswith(READ) or name.startswith(".ci/"))
    return {name: (ROOT / name).read_text() for name in named if (ROOT / name).exists()}


def targets() -> list[str]:
    """The targets that `make help` lists."""
    return re.findall(r"(?m)^([a-z-]+):.*## ", (ROOT / "Makefile").read_text())


def unknown(pattern: str, known: set[str]) -> list[str]:
    """File and name of every match whose first group is not a known name."""
    return [
        f"{file}: {name}"
        for file, text in texts().items()
        for name in re.findall(pattern, text)
        if name not in known
    ]


def test_make_has_few_targets():
    """At most 16 targets; each is listed and phony."""
    phony = re.search(r"(?m)^\.PHONY: (.*)$", (ROOT / "Makefile").read_text())
    assert phony
    assert sorted(phony[1].split()) == sorted(targets())
    assert len(targets()) <= 16


def test_files_name_targets_that_exist():
    """No document, message or test names a dropped target."""
    assert unknown(r"(?:`|run: |step \w+ )make ([a-z-]+)", set(targets())) == []


def test_files_name_campaigns_and_studies_that_exist():
    """The same for campaigns and studies."""
    names = set(campaigns.CAMPAIGNS)
    assert unknown(r"(?:-m tests\.campaigns|\$campaign) ([a-z][a-z0-9-]*)", names) == []
    studies = {*PROGRAM.commands}
    assert unknown(r"(?:-m palpate_studies|\$study) ([a-z][a-z-]*)", studies) == []


@pytest.mark.parametrize("name", campaigns.CAMPAIGNS)
def test_a_campaign_runs_something_that_exists(name: str):
    """The module is there, and so are the tests."""
    campaign = campaigns.CAMPAIGNS[name]
    if campaign.command[0] == "make":
        assert f"\n{campaign.command[1]}:" in (ROOT / "Makefile").read_text()
    else:
        assert campaign.command[0] == "-m"
        assert importlib.util.find_spec(campaign.command[1])
    assert all((ROOT / path).exists() for path in campaign.paths)


def test_the_numerical_packages_have_tests():
    """pytest would say only that it ran none."""
    assert [path for path in processors.NUMERICAL if not (ROOT / path).is_dir()] == []
