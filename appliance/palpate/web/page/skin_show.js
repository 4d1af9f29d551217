/* The page of `palpate skin show`: every axis of a skin, its noise and its faults. */
import {listen} from "./events.js";
import {byId, count, figure as text, fill, frame, last, made, put} from "./parts.js";
import {shades} from "./skin.js";

const NUMBERED = 8;
let built = "", tiles = [];

function build([rows, cols, axes], unit) {
  fill(byId("maps"));
  tiles = [];
  for (let a = 0; a < axes; a++) {
    const axis = axes > 1 ? `axis ${a + 1}${a + 1 === axes ? " (normal)" : ""}: ` : "", figure = made("figure", "", undefined, byId("maps"));
    made("figcaption", "", `${axis}${unit || "raw counts"} above the lowest seen; row 1 is at the top, column 1 at the left`, figure);
    const grid = made("div", cols > NUMBERED ? "grid small" : "grid", undefined, figure);
    grid.setAttribute("role", "img");
    grid.setAttribute("aria-label", `${axis}${rows} rows and ${cols} columns of taxels`);
    grid.style.gridTemplateColumns = `repeat(${cols}, minmax(0, 1fr))`;
    tiles.push(Array.from({length: rows * cols}, () => made("div", "taxel", undefined, grid)));
    figure.style.setProperty("--shape", cols / rows);
  }
}

function name(r, c, a, axes) { return `${r + 1}.${c + 1}${axes > 1 ? ` axis ${a + 1}` : ""}`; }

function draw(view) {
  const [, cols, axes] = view.shape, kinds = ["stuck", "dead", "saturated"], shade = shades();
  const faulty = new Set(kinds.flatMap((kind) => view[kind]));
  view.load.forEach((map, a) => map.forEach((row, r) => row.forEach((load, c) => {
    const tile = tiles[a][r * cols + c], {back, front} = shade(load / view.full);
    const called = name(r, c, a, axes);
    tile.style.backgroundColor = back;
    tile.style.color = front;
    tile.classList.toggle("faulty", faulty.has(called));
    tile.title = `taxel ${called}: ${text(load, view.full, view.unit)}, noise ${view.noise[a][r][c].toPrecision(2)} ${view.unit}`;
    if (cols <= NUMBERED) tile.textContent = text(load, view.full, view.unit);
  })));
  const noise = view.noise.flat(2).sort((a, b) => a - b);
  put("noise", noise.length ? `${noise[noise.length >> 1].toPrecision(2)}, ${last(noise).toPrecision(2)} ${view.unit}` : "–");
  const found = kinds.filter((kind) => view[kind].length).map((kind) => `${kind}: ${view[kind].join(", ")}`);
  put("faults", found.join("; ") || "no fault seen");
  byId("faults").className = found.length ? "" : "fine";
}

function show(view) {
  if (built !== `${view.shape}`) { build(view.shape, view.unit); built = `${view.shape}`; }
  frame({state: view.state, fine: view.state === "streaming", source: view.source});
  put("skin", view.skin);
  byId("trouble").hidden = !view.trouble;
  put("trouble", view.trouble);
  put("rate", view.rate_hz === null ? "–" : `${view.rate_hz.toFixed(1)} Hz`);
  put("frames", count(view.frames));
  put("lost", view.lost === null ? "cannot be known" : count(view.lost));
  if (view.load.length) draw(view);
}

listen({view: show}, (there) => {
  document.body.classList.toggle("gone", !there);
  if (there) return;
  frame({state: "no connection", fine: false, why: "no connection to palpate skin show; trying again"});
});
