"""Help in groups, advice for a misspelt word, errors in one line."""

from __future__ import annotations

import argparse

import pytest

from palpate.core.menu import CommandParser, Menu, one_of

MENU = Menu(
    "feel",
    "Feels things.",
    {"run": {"go": "start it"}, "look": {"status": "show its state"}},
    version="feel 1",
    ending="exit codes: 0",
)


@pytest.mark.parametrize("words", [[], ["-h"], ["--help"], ["help"]])
def test_a_program_alone_prints_its_help(words: list[str], capsys: pytest.CaptureFixture[str]):
    """Every command stands below its heading with its description; exit code 0."""
    assert MENU.answer(words) == 0
    assert capsys.readouterr().out == (
        "usage: feel COMMAND [OPTIONS]\n\nFeels things.\n\nrun:\n  go      start it\n\n"
        "look:\n  status  show its state\n\nfeel COMMAND --help shows the options of a command.\n\n"
        "exit codes: 0\n"
    )


def test_a_command_is_left_to_the_program(capsys: pytest.CaptureFixture[str]):
    """Nothing is printed."""
    assert MENU.answer(["status", "--help"]) is None
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("word", "hint"),
    [("stauts", "did you mean 'status'?"), ("xyzzy", "`feel --help` lists them")],
)
def test_a_misspelt_command(word: str, hint: str, capsys: pytest.CaptureFixture[str]):
    """One line with a similar name, or with the way to all names; exit code 2."""
    assert MENU.answer([word]) == 2
    assert capsys.readouterr().err == f"feel: there is no command {word!r}; {hint}\n"


def test_the_version(capsys: pytest.CaptureFixture[str]):
    """--version is answered where there is a version, and refused where there is none."""
    assert MENU.answer(["--version"]) == 0
    assert capsys.readouterr().out == "feel 1\n"
    assert Menu("feel", "", MENU.groups).answer(["--version"]) == 2


@pytest.mark.parametrize(
    ("word", "hint"), [("instal", "did you mean 'install'?"), ("xyzzy", "use one of install, list")]
)
def test_a_misspelt_action(word: str, hint: str, capsys: pytest.CaptureFixture[str]):
    """The error is one line, and argparse's exit code stays."""
    parser = CommandParser("feel bundles")
    parser.add_argument("action", metavar="ACTION", type=one_of("action", ["install", "list"]))
    assert parser.parse_args(["list"]).action == "list"
    with pytest.raises(SystemExit) as ended:
        parser.parse_args([word])
    assert ended.value.code == 2
    assert capsys.readouterr().err == (
        f"feel bundles: argument ACTION: there is no action {word!r}; {hint};"
        " `feel bundles --help` shows the options\n"
    )


def chosen(*words: str) -> argparse.Namespace:
    """The arguments of a command with actions."""
    parser = CommandParser("feel bundles", description="Bundles.")
    parser.choose("action", {"list": "show all", "install": "take DIR"}, default="list")
    parser.only_for("install")("folder", needed=True, nargs="?", metavar="DIR")
    parser.only_for("list")("--json", action="store_true")
    parser.add_argument("--board")
    return parser.parse(words)


def test_options_of_actions(capsys: pytest.CaptureFixture[str]):
    """Each action takes its own options and those of all, in any order; help lists the actions."""
    assert vars(chosen()) == {"action": "list", "folder": None, "json": False, "board": None}
    assert chosen("--json", "list").json
    args = chosen("install", "--board", "b", "here")
    assert (args.action, args.folder, args.board) == ("install", "here", "b")
    with pytest.raises(SystemExit) as ended:
        chosen("--help")
    assert ended.value.code == 0
    assert "  install  take DIR\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["install"], "install needs DIR"),
        (["list", "here"], "DIR is for install, not for list"),
        (["install", "here", "--json"], "--json is for list, not for install"),
        (["lst"], "there is no action 'lst'; did you mean 'list'?"),
        (["list", "--jsn"], "unrecognized arguments: --jsn"),
    ],
)
def test_options_of_another_action(words: list[str], text: str, capsys: pytest.CaptureFixture[str]):
    """One line that names the option, exit code 2."""
    with pytest.raises(SystemExit) as ended:
        chosen(*words)
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert text in err
    assert err.count("\n") == 1
