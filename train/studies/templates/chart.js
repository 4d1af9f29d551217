// The controls of the chart: what is chosen stands in the address, `draw` shows it. No library, no request.
"use strict";
const { dots, costs, accuracies } = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const START = { x: "ms_p50", y: Object.keys(accuracies)[0], xlog: "1", stretch: "1", sort: "accuracy", off: "" };
const SIDES = [[-7, -8, "end"], [0, -11, "middle"], [9, 4, "start"], [-9, 4, "end"], [8, 16, "start"], [0, 19, "middle"],
  [8, -8, "start"], [-8, 16, "end"]];  // where a name may stand beside its dot, the best first
const LEFT = 48, RIGHT = 16, TOP = 12, BOTTOM = 30, NEAR = 30;
const SHARES = [0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1];  // ticks, closer together where the best are
let chosen = { ...START };  // as in the address
let spots = [];  // one for each network that is seen: {i, other: forms, x, y: figures, px, py: places, best}, cheapest first
let current = -1;  // index of the dot that the tip describes
let marks = [];  // one element for each dot, there or not

const percents = (v) => (100 * v).toFixed(1);
const share = (v) => `${percents(v)} %`;
const interval = (a) => `${percents(a.low)} – ${percents(a.high)} %`;
const digits = (v) => Number(v.toPrecision(3)).toLocaleString("en", { maximumFractionDigits: 6 });
const number = (v) => (v >= 1e6 ? `${digits(v / 1e6)} M` : v >= 1e4 ? `${digits(v / 1e3)} k` : digits(v));
const amount = (v, unit) => (unit === "KB" && v >= 1000 ? `${digits(v / 1000)} MB` : unit ? `${digits(v)} ${unit}` : number(v));
const cost = (dot, key) => (dot[key] == null ? "–" : amount(dot[key], costs[key].unit));
const filters = () => [...document.querySelectorAll("#precision input, #family input")];
const hidden = () => new Set(chosen.off.split(",").filter(Boolean));
const safe = (text) => text.replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);

// Which of the points {x: cost, y: accuracy} no other dominates, as pareto.py has it.
function front(points) {
  return points.map((p) => !points.some((o) => o.x <= p.x && o.y >= p.y && (o.x !== p.x || o.y !== p.y)));
}

// Each network once, as pareto.py has it: in the form that costs least, and in its other precision.
function seen() {
  const off = hidden(), networks = new Map();
  dots.forEach((dot, i) => {
    if (off.has(dot.precision) || off.has(dot.family) || dot[chosen.x] == null || !(chosen.y in dot.accuracy)) return;
    const point = { i, x: dot[chosen.x], y: dot.accuracy[chosen.y].mean, late: dot.precision !== "int8" };
    networks.set(dot.network, [...(networks.get(dot.network) ?? []), point]);
  });
  const points = [...networks.values()].map((forms) => {
    const [first, ...rest] = forms.sort((a, b) => a.x - b.x || a.late - b.late);
    const on_box = forms.some(({ i }) => dots[i].runs_on_box);
    return { ...first, on_box, other: rest.find(({ late }) => late !== first.late) };
  });
  front(points).forEach((best, k) => { points[k].best = best; });
  return points.sort((a, b) => a.x - b.x || b.y - a.y);
}

// A way from figures to 0..1, and its ticks.
function scale(values, log, pad) {
  let [low, high] = [Math.min(...values), Math.max(...values)];
  const to = log ? Math.log10 : (v) => v;
  const margin = (to(high) - to(low)) * pad || (log ? 0.2 : high * 0.2 || 1);
  const [a, b] = [to(low) - margin, to(high) + margin];
  const third = (b - a) / 3, ten = 10 ** Math.floor(Math.log10(third)), step = ten * [5, 2, 1].find((k) => k * ten <= third);
  const ticks = [];
  if (log) for (let k = Math.floor(a); k <= b; k++) for (const m of b - a > 1.6 ? [1, 3] : [1, 2, 3, 5]) ticks.push(m * 10 ** k);
  else for (let k = Math.ceil(Math.max(a, 0) / step); k * step <= b; k++) ticks.push(k * step);
  return { at: (v) => (to(v) - a) / (b - a), ticks: ticks.filter((t) => to(t) >= a && to(t) <= b) };
}

// Accuracy upwards, to 100 %: as it is, or by the root of the error.
function upwards(lows, stretched) {
  const to = stretched ? (v) => -Math.sqrt(Math.max(1 - v, 0)) : (v) => v;
  const low = to(Math.max(Math.min(...lows) - 0.04, 0)), ticks = stretched ? SHARES : SHARES.filter((t) => t !== 0.99);
  return { at: (v) => (to(v) - low) / (to(1) - low), ticks: ticks.filter((t) => to(t) >= low) };
}

function draw() {
  const width = $("plot").clientWidth, height = Math.round(Math.min(Math.max(width * 0.6, 330), 520));
  spots = seen();
  document.querySelector("#plot svg").setAttribute("viewBox", `0 0 ${width} ${height}`);
  const entries = spots.map((s) => dots[s.i].accuracy[chosen.y]);
  const ends = spots.flatMap((s) => (s.other ? [s.x, s.other.x] : [s.x])), { chance } = accuracies[chosen.y];
  const xs = scale(ends.length ? ends : [1], chosen.xlog === "1", 0.06);
  const ys = upwards([...entries.map((e) => e.low), chance || 1, entries.length ? 1 : 0], chosen.stretch === "1");
  const px = (v) => LEFT + xs.at(v) * (width - LEFT - RIGHT);
  const py = (v) => height - BOTTOM - ys.at(v) * (height - TOP - BOTTOM);
  for (const spot of spots) {
    [spot.px, spot.py] = [px(spot.x), py(spot.y)];
    if (spot.other) [spot.other_px, spot.other_py] = [px(spot.other.x), py(spot.other.y)];
  }
  $("grid").innerHTML = grid(xs, ys, px, py, width, height) + guessing(chance, py, width);
  $("arrows").innerHTML = arrows(px, py);
  $("stairs").setAttribute("d", stairs(width - RIGHT));
  marks.forEach((mark) => { mark.style.display = "none"; });
  for (const spot of spots) place(spot, py);
  $("names").innerHTML = names(width, chance ? py(chance) : height);
  const [x, y] = [costs[chosen.x], accuracies[chosen.y]];
  $("axes").innerHTML = `${safe(y.short)}: ${safe(y.about)}.<br>${safe(x.short)}: ${safe(x.about)}.`;
  table();
  if (spots.length && !spots.some((s) => marks[s.i].tabIndex === 0)) stop_at(spots[0].i);
  show(spots.some((s) => s.i === current) ? current : -1);
}

// Tab stops at one dot only; from there arrow keys go on.
function stop_at(i) {
  marks.forEach((mark, k) => { mark.tabIndex = k === i ? 0 : -1; });
}

function grid(xs, ys, px, py, width, height) {
  const unit = costs[chosen.x].unit, bottom = height - BOTTOM;
  const every = Math.max(1, Math.ceil(xs.ticks.length / (width / 62)));
  const across = xs.ticks.map((t, k) => `<line x1="${px(t)}" x2="${px(t)}" y1="${TOP}" y2="${bottom}"/>` + (k % every ? ""
    : `<text x="${px(t)}" y="${bottom + 20}" text-anchor="middle">${amount(t, unit)}</text>`));
  const up = ys.ticks.map((t, k) => `<line y1="${py(t)}" y2="${py(t)}" x1="${LEFT}" x2="${width - RIGHT}"/>
    <text x="${LEFT - 8}" y="${py(t) + 4}" text-anchor="end">${digits(100 * t)}${k === ys.ticks.length - 1 ? " %" : ""}</text>`);
  return across.join("") + up.join("");
}

// Where a model would be that only guesses.
function guessing(chance, py, width) {
  return chance ? `<line class="chance" x1="${LEFT}" x2="${width - RIGHT}" y1="${py(chance)}" y2="${py(chance)}"/>
    <text x="${width - RIGHT}" y="${py(chance) - 4}" text-anchor="end">guessing: ${share(chance)}</text>` : "";
}

// From a network in float to itself in int8.
function arrows(px, py) {
  return spots.filter((s) => s.other).map((s) => {
    const [from, to] = s.late ? [s, s.other] : [s.other, s];
    return `<line class="${dots[s.i].family === "Palpate" ? "ours" : ""}" x1="${px(from.x)}" y1="${py(from.y)}" x2="${px(to.x)}"
      y2="${py(to.y)}" marker-end="url(#head)"/>`;
  }).join("");
}

// The front as stairs: what accuracy a cost buys.
function stairs(end) {
  const best = spots.filter((s) => s.best);
  return best.map((s, k) => (k ? `H${s.px}V${s.py}` : `M${s.px} ${s.py}`)).join("") + (best.length ? `H${end}` : "");
}

function place(spot, py) {
  const mark = marks[spot.i], { low, high } = dots[spot.i].accuracy[chosen.y];
  mark.style.display = "";
  mark.style.transform = `translate(${spot.px}px, ${spot.py}px)`;
  mark.classList.toggle("best", spot.best);
  mark.classList.toggle("abroad", !spot.on_box);
  mark.dataset.cost = spot.x;
  mark.dataset.mean = spot.y;
  const bar = mark.querySelector(".bar");
  bar.setAttribute("y1", py(low) - spot.py);
  bar.setAttribute("y2", py(high) - spot.py);
  mark.setAttribute("aria-label", `${dots[spot.i].label}: ${share(spot.y)}, ${cost(dots[spot.i], chosen.x)}`);
}

// Names beside the dots, what the box ships first, then the front; a name that fits nowhere is left out.
function names(width, guessed) {
  const best = spots.filter((s) => s.best);
  const taken = spots.map((s) => [s.px - 6, s.py - 6, s.px + 6, s.py + 6]);
  taken.push([LEFT, guessed - 1, width, guessed + 1], [width - RIGHT - 120, guessed - 15, width, guessed]);
  best.forEach((s, k) => {  // the stairs
    const [end, up] = k + 1 < best.length ? [best[k + 1].px, best[k + 1].py] : [width, s.py];
    taken.push([s.px, s.py - 1, end, s.py + 1], [end - 1, up, end + 1, s.py]);
  });
  for (const s of spots.filter((one) => one.other)) {
    const xs = [s.px, s.other_px], ys = [s.py, s.other_py];
    taken.push([Math.min(...xs), Math.min(...ys) - 2, Math.max(...xs), Math.max(...ys) + 2]);
  }
  const shipped = spots.filter((s) => dots[s.i].chosen), rest = spots.filter((s) => !s.best).sort((a, b) => b.y - a.y);
  return [...new Set([...shipped, ...best, ...rest])].map((s) => {
    const { label, family, chosen: mine } = dots[s.i], text = mine ? label : label.replace("Palpate, ", "");
    const spot = free(s, text.length * 7, width, taken);
    if (!spot) return "";
    taken.push(spot.box);
    const kinds = [s.best ? "best" : "", family === "Palpate" ? "ours" : "", mine ? "chosen" : ""].join(" ");
    return `<text class="${kinds}" x="${spot.x}" y="${spot.y}" text-anchor="${spot.side}">${safe(text)}</text>`;
  }).join("");
}

// The first place beside a dot where a text of this length meets nothing that is taken.
function free(spot, long, width, taken) {
  for (const [dx, dy, side] of SIDES) {
    const x = spot.px + dx, y = spot.py + dy, left = x - { start: 0, middle: long / 2, end: long }[side];
    const box = [left, y - 10, left + long, y + 3];
    const inside = left > LEFT && left + long < width && box[1] > 0;
    if (inside && taken.every((t) => box[0] > t[2] || box[2] < t[0] || box[1] > t[3] || box[3] < t[1])) return { x, y, side, box };
  }
  return null;
}

function show(i) {
  current = i;
  marks.forEach((mark, k) => { mark.classList.toggle("on", k === i); });
  document.querySelectorAll("tbody tr").forEach((row) => row.classList.toggle("on", Number(row.dataset.i) === i));
  const spot = spots.find((s) => s.i === i), tip = $("tip");
  tip.hidden = !spot;
  if (!spot) return;
  tip.innerHTML = description(spot);
  const width = $("plot").clientWidth, { offsetWidth: w, offsetHeight: h } = tip;
  const left = spot.px + 16 + w < width ? spot.px + 16 : spot.px - 16 - w;
  const beside = left >= 0;
  const top = beside ? Math.max(spot.py - h / 2, 0) : spot.py + 16;
  tip.style.transform = `translate(${beside ? left : Math.max(Math.min(spot.px - w / 2, width - w), 0)}px, ${top}px)`;
}

function description(spot) {
  const dot = dots[spot.i], a = dot.accuracy[chosen.y];
  const better = spots.find((o) => o.x <= spot.x && o.y >= spot.y && (o.x !== spot.x || o.y !== spot.y));
  const line = (name, value) => `<dt>${safe(name)}</dt><dd>${safe(value)}</dd>`;
  const rows = [line(accuracies[chosen.y].short + (a.name ? `, ${a.name}` : ""), share(a.mean)),
    line("95 % interval" + (a.n ? `, ${a.n} sweeps` : ""), interval(a)), line("guessing", share(accuracies[chosen.y].chance)),
    ...(spot.other ? [line(`in ${dots[spot.other.i].precision}`, `${share(spot.other.y)}, ${cost(dots[spot.other.i], chosen.x)}`)] : []),
    ...Object.keys(costs).map((key) => line(costs[key].short, cost(dot, key)))];
  return `<b>${safe(dot.label)}</b><br>${safe(dot.name)} · ${safe(dot.family)}${spot.on_box ? "" : " · cannot run on the box"}<br>`
    + (better ? `behind ${safe(dots[better.i].label)}` : "on the Pareto front") + `<dl>${rows.join("")}</dl>`;
}

// All forms of all models that are not filtered out, also those that were not measured so: they come last.
function table() {
  const off = hidden(), best = new Map(spots.map((s) => [s.i, s.best]));
  const cost_of = ({ dot }) => dot[chosen.x] ?? Infinity, mean_of = ({ dot }) => dot.accuracy[chosen.y]?.mean ?? -1;
  const by_cost = (a, b) => Math.sign(cost_of(a) - cost_of(b) || 0), by_mean = (a, b) => mean_of(b) - mean_of(a);
  const [first, then] = chosen.sort === "cost" ? [by_cost, by_mean] : [by_mean, by_cost];
  const rows = dots.map((dot, i) => ({ dot, i })).filter(({ dot }) => !off.has(dot.precision) && !off.has(dot.family))
    .sort((a, b) => first(a, b) || then(a, b));
  const others = Object.keys(costs).filter((key) => key !== chosen.x);
  const sorted = (what, way) => (chosen.sort === what ? ` aria-sort="${way}"` : "");
  const title = (key) => safe(costs[key].short);
  const head = `<th scope="col">model</th>
    <th scope="col"${sorted("accuracy", "descending")}><button data-sort="accuracy">${safe(accuracies[chosen.y].short)}</button></th>
    <th scope="col">95 % interval</th>
    <th scope="col"${sorted("cost", "ascending")}><button data-sort="cost">${title(chosen.x)}</button></th>`
    + others.map((key) => `<th scope="col">${title(key)}</th>`).join("");
  const body = rows.map(({ dot, i }) => {
    const a = dot.accuracy[chosen.y];
    const cells = [...(a ? [share(a.mean), interval(a)] : ["–", "–"]), ...[chosen.x, ...others].map((key) => cost(dot, key))];
    const kinds = [best.get(i) ? "best" : "", dot.family === "Palpate" ? "ours" : ""].join(" ");
    return `<tr data-i="${i}" class="${kinds}"><th scope="row">${dot.runs_on_box ? "" : "○ "}${safe(dot.label)}`
      + `<small>${safe(dot.name)}</small></th>${cells.map((c) => `<td>${c}</td>`).join("")}</tr>`;
  });
  $("table").innerHTML = `<p class="quiet">${rows.length} of ${dots.length} measured forms; bold: on the Pareto front; a dash: not measured.</p>
    <div class="wide"><table><thead><tr>${head}</tr></thead><tbody>${body.join("")}</tbody></table></div>`;
}

function choose(change) {
  chosen = { ...chosen, ...change };
  const changed = Object.entries(chosen).filter(([key, value]) => value !== START[key]);
  history.replaceState(null, "", "#" + new URLSearchParams(changed));
  show_choice();
}

function show_choice() {
  for (const id of ["x", "y"]) $(id).value = chosen[id];
  for (const id of ["xlog", "stretch"]) $(id).checked = chosen[id] === "1";
  const off = hidden();
  filters().forEach((box) => { box.checked = !off.has(box.value); });
  draw();
}

function read_address() {
  const given = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  chosen = { ...START };
  for (const key of Object.keys(START)) if (key in given) chosen[key] = given[key];
  if (!Object.hasOwn(costs, chosen.x)) chosen.x = START.x;
  if (!Object.hasOwn(accuracies, chosen.y)) chosen.y = START.y;
  show_choice();
}

function nearest(event) {
  const box = document.querySelector("#plot svg").getBoundingClientRect();
  const away = (s) => Math.hypot(s.px - event.clientX + box.left, s.py - event.clientY + box.top);
  const [first] = [...spots].sort((a, b) => away(a) - away(b));
  return first && away(first) < NEAR ? first.i : -1;
}

function go(event) {
  const step = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, Home: -Infinity, End: Infinity }[event.key];
  if (event.key === "Escape") show(-1);
  if (!step || !spots.length) return;
  event.preventDefault();
  const here = spots.findIndex((s) => s.i === current);
  marks[spots[Math.max(Math.min(here + step, spots.length - 1), 0)].i].focus();
}

function mark(dot, i) {
  const shape = dot.precision === "int8" ? '<rect class="mark" x="-5" y="-5" width="10" height="10"/>' : '<circle class="mark" r="5.4"/>';
  const kinds = ["dot", dot.family === "Palpate" ? "ours" : "", dot.chosen ? "chosen" : ""].join(" ");
  return `<g class="${kinds}" data-i="${i}" tabindex="-1" role="img"><line class="bar" x1="0" x2="0"/>${shape}`
    + '<circle class="ship" r="10"/><circle class="ring" r="13"/></g>';
}

function begin() {
  const options = (axes) => Object.entries(axes).map(([key, axis]) => `<option value="${key}">${safe(axis.short)}</option>`).join("");
  $("x").innerHTML = options(costs);
  $("y").innerHTML = options(accuracies);
  for (const id of ["precision", "family"]) {
    for (const value of new Set(dots.map((dot) => dot[id]))) {
      $(id).insertAdjacentHTML("beforeend", `<label class="chip"><input type="checkbox" value="${safe(value)}">${safe(value)}</label>`);
    }
    $(id).onchange = () => choose({ off: filters().filter((box) => !box.checked).map((box) => box.value).join() });
  }
  for (const id of ["x", "y"]) $(id).onchange = () => choose({ [id]: $(id).value });
  for (const id of ["xlog", "stretch"]) $(id).onchange = () => choose({ [id]: $(id).checked ? "1" : "0" });
  $("marks").innerHTML = dots.map(mark).join("");
  marks = [...$("marks").children];
  const svg = document.querySelector("#plot svg");
  svg.addEventListener("pointermove", (event) => event.pointerType === "mouse" && show(nearest(event)));
  svg.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && show(-1));
  svg.addEventListener("click", (event) => show(nearest(event)));
  $("plot").addEventListener("keydown", go);
  $("plot").addEventListener("focusin", (event) => {
    stop_at(Number(event.target.dataset.i));
    show(Number(event.target.dataset.i));
  });
  $("plot").addEventListener("focusout", () => show(-1));
  $("table").addEventListener("click", (event) => event.target.dataset.sort && choose({ sort: event.target.dataset.sort }));
  $("still").hidden = true;
  $("controls").hidden = $("plot").hidden = false;
  addEventListener("hashchange", read_address);
  addEventListener("resize", draw);
  read_address();
  requestAnimationFrame(() => $("marks").classList.add("moving"));
}
begin();
