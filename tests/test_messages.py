"""One rule over every place that raises an error: its message says what to do."""

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

from palpate.core import errors
from tests.factories.paths import ROOT

OURS = {name for name, _ in inspect.getmembers(errors, inspect.isclass)}
ADVICE = re.compile(
    r"; |\bmust |\bsuch as |^name |"
    r": (?:add|apt|export|give|install|name|say|set|take|this machine)\b"
)
"""Advice comes after a semicolon, or is the sentence itself."""
PARTS = (
    "appliance/palpate/bundle/onnx_check",
    "train/palpate_train/data/files",
    "train/palpate_train/data/frames.py",
    "train/palpate_train/data/raw_files.py",
    "train/palpate_train/data/sampling.py",
    "train/palpate_train/data/group_values.py",
)
"""Their messages say what is wrong with a node, a file or an option; the caller adds the rest."""


def literal(node: ast.AST) -> str:
    """The words of a raised error, without the values in them; "" for another node."""
    if not (isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args):
        return ""
    if not (isinstance(node.exc.func, ast.Name) and node.exc.func.id in OURS):
        return ""
    parts = (c.value for c in ast.walk(node.exc.args[0]) if isinstance(c, ast.Constant))
    return " ".join(part for part in parts if isinstance(part, str))


def test_each_error_says_what_to_do():
    """The message of each error has advice; hundreds are looked at."""
    # A shorter text only frames the message of another error
    fewest_words = 4

    def raised() -> Iterator[tuple[str, str]]:
        """Place and literal text of each error of ours that is raised with words of its own."""
        for folder in ("appliance", "train"):
            for path in sorted((ROOT / folder).rglob("*.py")):
                where = path.relative_to(ROOT).as_posix()
                if where.startswith(PARTS):
                    continue
                for node in ast.walk(ast.parse(path.read_text())):
                    text = literal(node)
                    if len(text.split()) >= fewest_words:
                        yield f"{where}:{getattr(node, 'lineno', 0)}", text

    found = list(raised())
    assert len(found) > 300
    assert [where for where, text in found if not ADVICE.search(text)] == []


def test_the_rule_sees_a_message_without_advice(tmp_path: Path):
    """A message that only complains is found, one with advice and another's error are not."""
    code = """raise FormatError(f"{path} holds no frames at all")
raise FormatError(f"{path} holds no frames; record some")
raise KeyError("there is no such key in it")"""
    texts = [literal(node) for node in ast.parse(code).body]
    assert [bool(text and not ADVICE.search(text)) for text in texts] == [True, False, False]
