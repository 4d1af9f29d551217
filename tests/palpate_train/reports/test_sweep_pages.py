"""The page to leaf through a set: the sweeps that it shows, its size, and its keys in a browser."""

from pathlib import Path
from typing import Any

import pytest

from palpate.core.errors import FormatError
from palpate_train.cli.main import main
from palpate_train.reports import sweep_pages, sweep_plot
from palpate_train.reports.sweep_plot import SweepSource
from tests.factories import rendered
from tests.factories.browser import BrowsedPage
from tests.factories.page_reader import PageReader
from tests.factories.recordings import record
from tests.factories.sweep_sets import easy


def source(count: int) -> SweepSource:
    """A set of `count` equal sweeps."""
    one = sweep_plot.of_set(easy(4), 0)
    return SweepSource("mine.npz", count, lambda number: one)


@pytest.mark.slow
def test_of_a_large_set_sweeps_from_all_over_it_are_shown(monkeypatch: pytest.MonkeyPatch):
    """The first and the last, in order, none twice; as many as fit by their size."""
    assert sweep_pages.chosen(source(7), None) == list(range(7))
    shown = sweep_pages.chosen(source(1000), None)
    assert (len(shown), shown[0], shown[-1]) == (sweep_pages.MOST, 0, 999)
    assert shown == sorted(set(shown))
    monkeypatch.setattr(
        sweep_pages, "MOST_BYTES", 3 * len(sweep_plot.draw(source(1).get(0), plain=False))
    )
    assert sweep_pages.chosen(source(1000), None) == [0, 500, 999]


@pytest.mark.parametrize(
    ("count", "numbers", "message"),
    [(0, None, "mine.npz"), (12, range(5, 13), "0 to 11"), (12, range(3), "holds 1 ")],
)
def test_what_a_page_cannot_show_is_refused(
    count: int, numbers: range | None, message: str, monkeypatch: pytest.MonkeyPatch
):
    """An empty set, missing numbers and too many numbers: each message states what there is."""
    monkeypatch.setattr(sweep_pages, "MOST_BYTES", 1)
    with pytest.raises(FormatError, match=message):
        sweep_pages.chosen(source(count), numbers)


@pytest.mark.slow
def test_the_command_writes_a_page_of_what_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Sweeps of a set and of a folder; an .svg shows one sweep; other files are refused."""
    easy(4).save(tmp_path / "s.npz")
    out = tmp_path / "v.html"
    assert (
        main(["sets", "view", str(tmp_path / "s.npz"), "--number", "10-11", "--out", str(out)]) == 0
    )
    reader = PageReader(out.read_text())
    assert "2 of 12 sweeps of " in reader.text
    assert "11: high, recording 11" in reader.text
    assert reader.faults == []
    assert all(link.startswith(("#", "data:")) for link in reader.links)
    for name, material in (("0", "a"), ("1", "b")):
        record(tmp_path / "box" / f"{name}.npy", material)
    assert main(["sets", "view", str(tmp_path / "box"), "--out", str(out)]) == 0
    assert "2 of 2 sweeps of " in PageReader(out.read_text()).text
    for numbers, file in (("0-1", "v.svg"), ("9-1", "v.html")):
        more = ["--number", numbers, "--out", str(tmp_path / file)]
        assert main(["sets", "view", str(tmp_path / "s.npz"), *more]) != 0
        assert numbers in capsys.readouterr().err


@pytest.fixture
def address(tmp_path: Path) -> str:
    """The address of a page of four sweeps."""
    (tmp_path / "v.html").write_text(sweep_pages.page(source(4), range(4), lambda line: None))
    return rendered.address(tmp_path / "v.html")


@pytest.mark.slow
def test_arrow_keys_turn_the_page(browser: Any, address: str):
    """One at a time, within the ends, and the address names it."""
    seen_page = BrowsedPage(browser, address)
    page = seen_page.page

    def seen() -> list[str]:
        return page.eval_on_selector_all(
            "figure", "all => all.filter((f) => f.checkVisibility()).map((f) => f.id)"
        )

    assert seen() == ["sweep-0"]
    for key, wanted in (
        ("ArrowLeft", 0),
        ("ArrowRight", 1),
        ("ArrowRight", 2),
        ("End", 3),
        ("ArrowRight", 3),
        ("ArrowLeft", 2),
        ("Home", 0),
    ):
        page.keyboard.press(key)
        assert seen() == [f"sweep-{wanted}"]
        assert page.evaluate("location.hash") == f"#sweep-{wanted}"
    page.click("#on")
    assert seen() == ["sweep-1"]
    page.select_option("#which", index=3)
    assert seen() == ["sweep-3"]
    assert page.is_disabled("#on")
    assert seen_page.errors == []


@pytest.mark.slow
@rendered.LOOKS
def test_the_page_can_be_read_everywhere(browser: Any, address: str, width: int, scheme: str):
    """The page can be read at three widths, by day and by night."""
    assert rendered.faults(browser, address, width, scheme) == {}
