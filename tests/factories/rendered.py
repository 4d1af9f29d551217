"""Illegible parts of a page or picture in a browser, at several widths, light and dark."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

SCHEMES = ("light", "dark")
LOOKS = pytest.mark.parametrize(
    ("width", "scheme"),
    [
        pytest.param(width, scheme, marks=[pytest.mark.thorough] * (scheme != usual))
        for width, usual in ((390, "light"), (1024, ""), (1920, "dark"))
        for scheme in SCHEMES
    ],
)
"""Widths of a phone, a tablet and a desktop with colour schemes. Colours depend on the scheme alone
and places on the width alone, and what is legible on the others is so on a tablet."""
TALLEST = 16000
"""Height of the window. It has to hold the whole page, because colours are read by position."""
FAULTS = """() => {
  const root = document.body ?? document.documentElement;
  const wide = document.documentElement.clientWidth;
  document.querySelectorAll("details").forEach((one) => { one.open = true; });
  const all = (what) => [...document.querySelectorAll(what)].filter((one) => one.checkVisibility());
  const words = (one) => one.textContent.trim().slice(0, 60);
  const box = (one) => one.getBoundingClientRect();
  const colour = (text) => {
    const parts = (text.match(/[\\d.]+/g) ?? ["0", "0", "0", "0"]).map(Number);
    const scale = text.startsWith("color(") ? 255 : 1;
    return [...parts.slice(0, 3).map((one) => one * scale), parts[3] ?? 1];
  };
  const over = (top, below) => below.slice(0, 3)
    .map((one, i) => top[i] * top[3] + one * (1 - top[3]));
  const paint = (one, what) => {
    const style = getComputedStyle(one), made = colour(style[what]);
    made[3] *= Number(style.opacity) * (what === "fill" ? Number(style.fillOpacity) : 1);
    return made;
  };
  const ancestors = (one) => one ? [one, ...ancestors(one.parentElement)] : [];
  const shape = (one) => one instanceof SVGElement;
  const behind = (one) => {
    const at = box(one), point = [at.left + at.width / 2, at.top + at.height / 2];
    const drawn = shape(one) ? document.elementsFromPoint(...point) : [];
    const shapes = drawn.slice(drawn.indexOf(one) + 1)
      .filter((other) => shape(other) && !["text", "svg"].includes(other.tagName));
    const boxes = ancestors(one).filter((other) => !shape(other));
    const layers = [...shapes.map((other) => paint(other, "fill")),
      ...boxes.map((other) => paint(other, "backgroundColor"))];
    const haloed = shape(one) && getComputedStyle(one).paintOrder.startsWith("stroke");
    const halo = haloed ? [colour(getComputedStyle(one).stroke)] : [];
    return [...halo, ...layers].reverse().reduce((below, top) => over(top, below), [255, 255, 255]);
  };
  const light = (rgb) => rgb.map((one) => one / 255)
    .map((one) => one <= 0.04045 ? one / 12.92 : ((one + 0.055) / 1.055) ** 2.4)
    .reduce((sum, one, i) => sum + one * [0.2126, 0.7152, 0.0722][i], 0);
  const contrast = (one) => {
    const below = behind(one), front = over(paint(one, shape(one) ? "fill" : "color"), below);
    const [dark, bright] = [light(front), light(below)].sort((a, b) => a - b);
    return (bright + 0.05) / (dark + 0.05);
  };
  const texts = [];
  const walk = document.createTreeWalker(root, NodeFilter.SHOW_TEXT);
  for (let node = walk.nextNode(); node; node = walk.nextNode()) {
    const one = node.parentElement;
    const hidden = ["script", "style", "title", "desc", "metadata"];
    const told = hidden.includes(one.tagName.toLowerCase());
    if (!node.textContent.trim() || told || !one.checkVisibility()) continue;
    if (box(one).width) texts.push(one);
  }
  const outside = (text) => {
    const inner = box(text), outer = box(text.ownerSVGElement);
    return inner.left < outer.left - 1 || inner.right > outer.right + 1
      || inner.top < outer.top - 1 || inner.bottom > outer.bottom + 1;
  };
  const scrolls = (one) => one.scrollWidth > one.clientWidth + 1;
  return {
    "page wider than the window":
      document.documentElement.scrollWidth > wide + 1 && document.body
        ? [`${document.documentElement.scrollWidth}`] : [],
    "verdict out of sight": all(".verdict").filter((one) => box(one).right > wide + 1).map(words),
    "scrolls without keyboard": all("div")
      .filter((one) => scrolls(one) && (one.tabIndex < 0 || !one.getAttribute("role"))).map(words),
    "text outside its picture": all("svg text")
      .filter((one) => one.ownerSVGElement && outside(one)).map(words),
    "axis without title": all('[data-axis=""]').map(words),
    "head without scope": all("th:not([scope])").map(words),
    "low contrast": texts.filter((one) => contrast(one) < 4.5)
      .map((one) => `${contrast(one).toFixed(1)} ${words(one)}`),
    "raw brace": texts.map(words).filter((one) => /[{}]/.test(one)),
  };
}"""
"""The faults of a page by kind, each with its texts."""


def faults(browser: Any, address: str, width: int, scheme: str) -> Mapping[str, list[str]]:
    """Illegible texts of a page by kind of fault, at a width, by day ("light") or night."""
    context = browser.new_context(
        viewport={"width": width, "height": 900}, color_scheme=scheme, reduced_motion="reduce"
    )
    try:
        page = context.new_page()
        page.goto(address)
        page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        high = page.evaluate("Math.ceil(document.documentElement.getBoundingClientRect().height)")
        page.set_viewport_size({"width": width, "height": min(max(high, 900), TALLEST)})
        found: dict[str, list[str]] = page.evaluate(FAULTS)
    finally:
        context.close()
    return {kind: texts for kind, texts in found.items() if texts}


def address(path: Path) -> str:
    """The URL of a file."""
    return path.resolve().as_uri()
