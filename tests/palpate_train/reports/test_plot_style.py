"""The style of all pictures: light and dark without a page, and titles of axes."""

from collections.abc import Callable
from xml.etree import ElementTree

import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate_train.reports import plot_style
from tests.factories.browser import contrast

Draw = Callable[[Figure, Axes], None]


def drawn(draw: Draw, plain: bool = False) -> str:
    """A picture with one plot with numbers on both axes, to which `draw` is applied."""
    figure, axes = plot_style.single_axes(2.0, 0.1, 0.9, 0.3, 0.4)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    for axis in (axes.xaxis, axes.yaxis):
        plot_style.set_ticks(axis, (0, 0.5, 1), "s")
    draw(figure, axes)
    return plot_style.to_svg(figure, "about", plain)


@pytest.mark.parametrize(
    ("draw", "there"),
    [
        (lambda figure, axes: None, ["", ""]),
        (lambda figure, axes: axes.set_xlabel("time, s"), ["time, s", ""]),
        (
            lambda figure, axes: (axes.set_xlabel("time, s"), axes.set_ylabel("share, %")),
            ["time, s", "share, %"],
        ),
        (
            lambda figure, axes: (figure.supxlabel("time, s"), figure.supylabel("share")),
            ["time, s", "share"],
        ),
        (lambda figure, axes: plot_style.set_ticks(axes.xaxis, (0, 1), bare=True), [""]),
        (
            lambda figure, axes: plot_style.set_categories(axes.yaxis, (0, 1), ("wood", "foam")),
            [""],
        ),
        (
            lambda figure, axes: (
                plot_style.set_ticks(axes.xaxis, ()),
                plot_style.set_ticks(axes.yaxis, ()),
            ),
            [],
        ),
    ],
    ids=["none", "one", "both", "shared", "no numbers", "names", "no ticks"],
)
def test_an_axis_with_numbers_says_what_it_shows_or_that_it_does_not(draw: Draw, there: list[str]):
    """The title of an axis is an attribute; axes without numbers need none."""

    def titles(svg: str) -> list[str | None]:
        """The titles of the axes with numbers."""
        return [
            found
            for node in ElementTree.fromstring(svg).iter()
            if (found := node.get("data-axis")) is not None
        ]

    assert titles(drawn(draw)) == there


def test_colours_are_those_of_the_page_or_plain():
    """A picture of a page has roles; one outside of a page needs no style sheet."""
    assert "var(--" in drawn(lambda figure, axes: None)
    plain = drawn(lambda figure, axes: None, plain=True)
    assert "var(" not in plain
    assert "<style" not in plain


@pytest.mark.parametrize("look", [0, 1], ids=["light", "dark"])
def test_texts_of_every_role_can_be_read(look: int):
    """All text has a contrast of at least 4.5 to the background (WCAG 2.1, 1.4.3)."""
    colours = {role: both[look] for role, both in plot_style.ROLES.items()}
    rgb = {role: [int(c[i : i + 2], 16) for i in (1, 3, 5)] for role, c in colours.items()}
    for role in ("text", "grey", "accent"):
        assert contrast(rgb[role], rgb["background"]) >= 4.5, role


@pytest.mark.parametrize(
    ("ticks", "labels"),
    [
        ((0.9, 0.925, 0.95, 0.975, 1.0), ["90", "92.5", "95", "97.5", "100 %"]),
        ((0.0, 1 / 3, 0.7000000001), ["0", "33.3333", "70 %"]),
        ((-0.5, 0.987), ["−50", "98.7 %"]),
    ],
)
def test_ticks_have_as_many_decimals_as_they_need(ticks: tuple[float, ...], labels: list[str]):
    """No label is rounded to the places of another; matplotlib's, which may be, are refused."""
    figure, axes = plot_style.single_axes(2, 0.1, 0.9, 0.1, 0.1)
    axes.set_xlim(-1, 1)
    with pytest.raises(TypeError, match="set_ticks"):
        plot_style.to_svg(figure, "ticks")
    plot_style.set_ticks(axes.xaxis, ticks, percent=True)
    plot_style.set_ticks(axes.yaxis, [1e-5, 12_500], "ms")
    plot_style.to_svg(figure, "ticks")
    assert [label.get_text() for label in axes.get_xticklabels()] == labels
    assert [label.get_text() for label in axes.get_yticklabels()] == ["0.00001", "12500 ms"]
    assert list(axes.get_xticks()) == list(ticks)
