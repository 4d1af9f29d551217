"""Help in groups, advice for a misspelt word, errors in one line."""

from __future__ import annotations

import pytest

from appliance.core.menu import CommandParser, Menu, one_of

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
