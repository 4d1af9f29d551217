/* The skin as a picture: the load of each taxel, the contact, where it lay in training, and the way back. */

import {figure, fill} from "./parts.js";

const SVG = "http://www.w3.org/2000/svg", TAXEL = 100, RING = 21, TIP = 90, RIM = 14, SIDE = 62;
const NUMBERED = 8; // a larger skin gets no numbers, and names every fourth row and column
const PLAIN = 5; // signs and letters grow with a larger skin

function element(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  parent.append(made);
  return made;
}

/* A colour of the style sheet, #rrggbb, as three numbers. */
export function colour(name) {
  const text = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  return [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16));
}

/* Relative luminance (WCAG 2.1). White or black, whichever has more contrast, has at least 4.58 on any colour. */
function luminance(rgb) {
  const linear = rgb.map((v) => v / 255).map((v) => (v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4));
  return .2126 * linear[0] + .7152 * linear[1] + .0722 * linear[2];
}

/* Colours of loads, of shares from 0 to 1: the background, and what can be read on it. */
export function shades() {
  const none = colour("--tile"), full = colour("--heat");
  return (share) => {
    const part = Math.min(1, Math.max(0, share)), mixed = none.map((v, i) => Math.round(v + part * (full[i] - v)));
    return {back: `rgb(${mixed})`, front: luminance(mixed) > .179 ? "#000" : "#fff"};
  };
}

/* Draws views (appliance/palpate/alignment/live.py) into an element. */
export class SkinPicture {
  /* pointed: [row, column] of the taxel that was pointed at last, or touched. */
  constructor(parent) { this.parent = parent; this.drawn = ""; this.pointed = null; }

  /* unit: of the loads, where the view says none. */
  show(view, unit = view.load_unit) {
    const drawn = JSON.stringify([view.shape, view.contact, view.fingertip]);
    if (drawn !== this.drawn) {
      fill(this.parent);
      this.build(view);
      this.drawn = drawn;
    }
    const loads = view.load.flat(), shade = shades();
    this.tiles.forEach((tile, i) => {
      const {back, front} = shade((loads[i] ?? 0) / view.full);
      tile.style.fill = back;
      if (!this.counts.length) return;
      this.counts[i].style.fill = front;
      this.counts[i].textContent = loads.length ? figure(loads[i], view.full, unit) : "";
    });
    this.centre.style.visibility = view.centre ? "visible" : "hidden";
    this.way.style.visibility = "hidden";
    if (!view.centre) return;
    const [x, y] = at(view.centre, view.contact);
    this.centre.style.transform = `translate(${x}px, ${y}px) scale(${this.big})`;
    if (view.state === "off") this.pointOut(...at(view.nearest, view.contact), x, y);
  }

  build(view) {
    const [rows, cols] = view.shape, w = cols * TAXEL, h = rows * TAXEL, tip = view.fingertip;
    const most = Math.max(rows, cols), big = Math.max(1, most / PLAIN), far = TIP * big;
    this.big = big; // signs and letters of a large skin, whose taxels are small on the screen
    const left = -SIDE * big - (tip === "first-column") * far, top = -34 * big - (tip === "first-row") * far;
    const right = w + RIM + 6 + (tip === "last-column") * far, bottom = h + RIM + 6 + (tip === "last-row") * far;
    const svg = element("svg", {viewBox: `${left} ${top} ${right - left} ${bottom - top}`, role: "img",
      preserveAspectRatio: "xMidYMid"}, this.parent);
    svg.style.setProperty("--big", big);
    svg.setAttribute("aria-label", `${rows} rows and ${cols} columns of taxels${tip && `; the fingertip is at the ${tip.replace("-", " ")}`}`);
    for (const name of ["pointermove", "pointerdown"]) svg.addEventListener(name, (event) => {
      const {row, col} = event.target.dataset;
      if (row) this.pointed = [Number(row), Number(col)];
    });
    this.pointed = null;
    if (tip) drawTip(svg, tip, w, h, big);
    element("rect", {class: "board", x: -RIM, y: -RIM, width: w + 2 * RIM, height: h + 2 * RIM, rx: 18}, svg);
    [this.tiles, this.counts] = [[], []];
    const named = (i, count) => most <= NUMBERED || i === 0 || i === count - 1 || (i + 1) % 4 === 0;
    for (let r = 0; r < rows; r++) {
      if (named(r, rows)) element("text", {class: "name", x: -RIM - 24 * big, y: (r + 0.5) * TAXEL}, svg, most > NUMBERED ? r + 1 : `row ${r + 1}`);
      for (let c = 0; c < cols; c++) {
        const box = {x: c * TAXEL + 4, y: r * TAXEL + 4, width: TAXEL - 8, height: TAXEL - 8, rx: 10};
        this.tiles.push(element("rect", {class: "tile", "data-row": r, "data-col": c, ...box}, svg));
        if (most <= NUMBERED) this.counts.push(element("text", {class: "count", x: (c + 0.5) * TAXEL, y: (r + 0.82) * TAXEL}, svg));
      }
    }
    for (let c = 0; c < cols; c++) {
      if (named(c, cols)) element("text", {class: "name", x: (c + 0.5) * TAXEL, y: -RIM - 11 * big}, svg, most > NUMBERED ? c + 1 : `column ${c + 1}`);
    }
    if (view.contact) drawTrained(svg, view.contact);
    this.way = element("g", {id: "way"}, svg);
    for (const name of ["edge", "line"]) element("path", {class: name}, this.way);
    this.centre = element("g", {id: "centre"}, svg);
    for (const r of [RING, RING]) element("circle", {r}, this.centre);
    element("path", {d: "M -7 0 H 7 M 0 -7 V 7"}, this.centre);
  }

  /* The way in which the skin has to be moved: a trained position comes under the contact, which stays where it is. */
  pointOut(x0, y0, x, y) {
    const [dx, dy, length] = direction(x0, y0, x, y), end = length - (RING + 6) * this.big, side = 12 * this.big;
    if (end < side) return;
    const tip = [x0 + dx * end, y0 + dy * end], wing = (turn) => `${tip[0] - side * (dx + turn * dy)} ${tip[1] - side * (dy - turn * dx)}`;
    const drawn = `M ${x0} ${y0} L ${tip.join(" ")} M ${wing(1)} L ${tip.join(" ")} L ${wing(-1)}`;
    for (const path of this.way.children) path.setAttribute("d", drawn);
    this.way.style.visibility = "visible";
  }
}

/* The same way as an angle from upwards, clockwise, in degrees; null where the skin need not be moved. */
export function wayBack(view) {
  if (view.state !== "off") return null;
  const [dx, dy] = direction(...at(view.nearest, view.contact), ...at(view.centre, view.contact));
  return Math.atan2(dx, -dy) * 180 / Math.PI;
}

function direction(x0, y0, x, y) {
  const length = Math.hypot(x - x0, y - y0);
  return [(x - x0) / length, (y - y0) / length, length];
}

/* From the box's coordinates (mm, or taxels where it knows no mm; row, column) to the picture's (x, y). */
function at(point, contact) {
  const pitch = contact ? contact.pitch_mm : 1;
  return [(point[1] / pitch + 0.5) * TAXEL, (point[0] / pitch + 0.5) * TAXEL];
}

function drawTrained(svg, contact) {
  const {rows_mm, cols_mm, limit_mm, pitch_mm} = contact, halo = element("g", {id: "halo"}, svg);
  const spots = rows_mm.map((mm, i) => at([mm, cols_mm[i]], contact));
  for (const [x, y] of spots) element("circle", {class: "halo", cx: x, cy: y, r: (limit_mm / pitch_mm) * TAXEL}, halo);
  for (const [x, y] of spots) element("circle", {class: "trained", cx: x, cy: y, r: 3.5}, svg);
}

/* The end of the finger, as a cap on the side of the skin that is nearest to it. */
function drawTip(svg, side, w, h, big) {
  const turn = {"first-row": 0, "last-column": 90, "last-row": 180, "first-column": 270}[side];
  const [along, across] = turn % 180 ? [w, h] : [h, w], half = across / 2, top = -along / 2 - RIM, far = TIP * big;
  const cap = element("g", {transform: `translate(${w / 2} ${h / 2}) rotate(${turn})`}, svg);
  element("path", {class: "finger", d: `M ${-half} ${top} C ${-half} ${top - far} ${half} ${top - far} ${half} ${top} Z`}, cap);
  const [x, y] = {0: [w / 2, -RIM - 48 * big], 90: [w + RIM + 34 * big, h / 2], 180: [w / 2, h + RIM + 30 * big], 270: [-RIM - 56 * big, h / 2]}[turn];
  element("text", {class: "name", x, y, "writing-mode": turn % 180 ? "vertical-rl" : "horizontal-tb"}, svg, "fingertip");
}
