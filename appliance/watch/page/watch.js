/* The page beside the robot: the box's last verdict first, then the skin, the sweep, the shift, and the box itself. */

import {listen} from "/events.js";
import {ago, byId, clock, count, frame, made, mark, percent, put} from "/parts.js";
import {SkinPicture, wayBack} from "/skin.js";
import {course, signal, spectrogram} from "/plots.js";

const SPOKEN_MS = 3000, SHOWN = 200, KEPT = 5000, PICTURES = 20;
const SKIN = new SkinPicture(document.createElement("div"));
let known; // what the box has said; see begin()
let reached = null, answers = true, wallMs = 0, dirty = true, spokenAt = -Infinity, showAll = false, statuses = new Set(), drawnRows = "";

function begin() {
  known = {run: "", hello: null, box: null, health: null, view: null, verdicts: [], notes: [], minutes: [], signals: new Map(),
    labels: new Map(), pictures: new Map(), chosen: null, heardAt: 0};
}
begin();

/* Times. The box counts nanoseconds since its start; `wallMs` is what this device's clock showed then. */
function wall(ns) { return wallMs + ns / 1e6; }
function key(one) { return `${one.pid}-${one.sweep}`; }

/* Events, as appliance/watch/board.py sends them. */
const HEARD = {
  now(ns) { wallMs = Date.now() - ns / 1e6; },
  begin(run) { begin(); known.run = run; },
  hello(hello) { known.hello = hello; known.labels.set(hello.bundle, hello.labels); },
  box(box) { known.box = box; },
  health(health) { known.health = health; known.heardAt = wall(health.time_ns); },
  state(state) { if (known.health) Object.assign(known.health, state); },
  view(view) { known.view = view; if (!known.box) known.heardAt = Date.now(); },
  verdict(verdict) {
    known.verdicts.push(verdict);
    if (known.verdicts.length > KEPT) known.verdicts.shift();
  },
  note(note) { known.notes.push(note); },
  minute(minute) { known.minutes.push(minute); },
  signal(one) {
    known.signals.set(key(one), one.number);
    if (known.signals.size > PICTURES) known.signals.delete(known.signals.keys().next().value);
  },
};

function live() { return reached === true && (known.box ? known.box.there && known.health?.skin === "streaming" : known.view?.skin === "streaming"); }

/* Why what is shown is not of this moment; "" where it is. */
function trouble() {
  const last = known.heardAt ? `; last heard of it ${ago(Date.now() - known.heardAt)} ago` : "";
  if (reached === null) return "";
  if (!reached) return `${answers ? "the box answers, but has no news" : "no connection to the box"}${last}; trying again`;
  if (known.box && !known.box.there) return `the box is away${last}: ${known.box.why}`;
  if (known.health && known.health.skin !== "streaming" && !sees("align")) return `no skin: ${known.health.skin}${known.health.trouble && `; ${known.health.trouble}`}`;
  return "";
}

/* Which view is shown: the box at work, or the skin alone to align it; `palpate align` has the second only. */
function sees(view) { return view === (!known.box && known.view ? "align" : location.hash === "#align" ? "align" : "watch"); }

function choose() {
  const aligning = sees("align");
  document.body.dataset.view = aligning ? "align" : "watch";
  byId("watch").hidden = aligning;
  byId("align").hidden = !aligning;
  byId("views").hidden = !known.box;
  put("title", known.box || !known.view ? "Palpate" : "Align the skin");
  for (const link of byId("views").children) link.toggleAttribute("aria-current", (link.hash === "#align") === aligning);
  for (const link of byId("views").querySelectorAll("[aria-current]")) link.setAttribute("aria-current", "page");
  const place = document.querySelector(aligning ? "#align .skin" : "#watch .skin");
  if (SKIN.parent !== place) {
    place.append(...SKIN.parent.childNodes);
    SKIN.parent = place;
  }
}

function drawHeader() {
  const source = (known.hello ?? known.view)?.source ?? "usb", {health, view} = known;
  byId("unsigned").hidden = !health?.unsigned;
  const bundle = known.box ? health?.model ?? "" : view?.bundle ?? "";
  byId("bundle").hidden = !bundle;
  put("bundle", bundle);
  const skin = known.box ? health?.skin : view?.skin;
  const said = reached !== true ? "no connection" : known.box && !known.box.there ? "box away" : !skin ? "waiting" :
    skin !== "streaming" || !known.box ? `skin ${skin}` : health.sweeping ? "sweeping" : health.ready ? "ready" : "not ready";
  const why = trouble();
  frame({state: said, fine: live(), source, why: sees("align") ? "" : why}); // there the words say it
  document.body.classList.toggle("stale", Boolean(why));
}

function drawVerdict() {
  const last = known.verdicts.at(-1);
  byId("status").hidden = !last;
  if (!last) return put("which", "no verdict yet");
  mark(byId("status"), last.status);
  put("which", `sweep ${last.sweep}, ${ago(Date.now() - wall(last.time_ns))} ago`);
  const words = last.label || last.reason || last.status;
  byId("label").className = last.label ? "" : "words";
  byId("label").style.setProperty("--letters", Math.max(...words.split(" ").map((word) => word.length), Math.ceil(words.length / 2)));
  put("label", words);
  const fused = last.fused > 1 ? `${last.fused} sweeps of one object` : "", early = last.share < 1 ? `early, at ${percent(last.share)} of the window` : "";
  const detail = [fused, early, last.detail === last.moved ? "" : last.detail].filter(Boolean).join(", ");
  const sure = last.label ? percent(last.probability) : "";
  if (byId("sure").dataset.shown !== sure + detail) {
    byId("sure").dataset.shown = sure + detail;
    byId("sure").replaceChildren(sure);
    if (detail) made("small", "", detail, byId("sure"));
  }
  if (byId("moved").dataset.shown !== last.moved) {
    byId("moved").dataset.shown = last.moved;
    byId("moved").replaceChildren(...(last.moved ? [`${last.moved}: `] : []));
    if (last.moved) Object.assign(made("a", "", "align the skin", byId("moved")), {href: "#align"});
  }
}

function drawSkin() {
  const {view} = known;
  if (!view) return;
  SKIN.show(view);
  const axes = known.hello?.format.axes > 1 ? "; the axis along the normal" : "";
  put("contact", `raw counts above the lowest seen${axes}`);
  document.body.dataset.state = view.state;
}

function drawWords() {
  const {view} = known, news = trouble();
  if (news || !view) {
    document.body.dataset.state = "no-connection";
    if (news) put("message", known.box && reached ? "the box is away" : "no connection");
    if (news) put("hint", known.box || answers ? news : "see that palpate align still runs on the box, and the tunnel to it");
    byId("push").toggleAttribute("hidden", true);
    return;
  }
  put("message", (view.state === "in-place" ? "✓ " : "") + view.message.replace(/ (?=mm|\d)/g, "\u00a0"));
  put("hint", view.hint);
  const unit = view.contact ? "mm" : "taxels", turned = wayBack(view);
  put("figures", view.centre ? `centre: row ${view.centre[0].toFixed(1)}, column ${view.centre[1].toFixed(1)} ${unit} from taxel 1.1` : "");
  byId("push").toggleAttribute("hidden", turned === null);
  byId("push").firstElementChild.setAttribute("transform", `rotate(${turned ?? 0})`);
  byId("where").hidden = Boolean(view.fingertip) || !view.load.length;
  byId("key").hidden = false;
  for (const name of ["t", "h"]) byId("key").querySelector("." + name).hidden = !view.contact;
  const text = `${view.message}. ${view.hint}`;
  if (byId("spoken").textContent !== text && performance.now() - spokenAt > SPOKEN_MS) {
    spokenAt = performance.now();
    byId("spoken").textContent = text;
  }
}

/* The sweep that is looked at: the one that was chosen, else the last. */
function looked() { return known.verdicts.find((one) => key(one) === known.chosen) ?? known.verdicts.at(-1); }

function drawSweep() {
  const one = looked();
  byId("follow").hidden = !known.chosen;
  if (!one) {
    put("sweep-said", "probabilities, signal and spectrogram of each sweep appear here");
    signal(byId("signal"), null, "no sweep yet");
    spectrogram(byId("spectrogram"), null, "no sweep yet");
    return;
  }
  put("sweep-title", `Sweep ${one.sweep}, ${clock(wall(one.time_ns))}`);
  const took = `answered in ${(one.latency_ns / 1e6).toFixed(1)} ms`, lost = one.lost ? `, ${one.lost} frames lost` : "";
  put("sweep-said", one.scores.length ? `${one.status}; ${took}${lost}` : `${one.status}: ${one.reason}${one.detail && ` (${one.detail})`}`);
  drawScores(one);
  const picture = known.pictures.get(key(one)), number = known.signals.get(key(one));
  const why = number === undefined ? "the signal of this sweep is not kept" : picture === null ? "asking the box" : "the box has no signal of it";
  signal(byId("signal"), picture, why);
  spectrogram(byId("spectrogram"), picture, why);
  if (number !== undefined && picture === undefined && reached) fetchPicture(key(one), number);
}

function drawScores(one) {
  const labels = known.labels.get(one.bundle) ?? [], list = byId("scores");
  const shown = one.scores.map((p, i) => [labels[i] ?? `label ${i + 1}`, p]).sort((a, b) => b[1] - a[1]);
  if (list.dataset.shown === JSON.stringify(shown)) return;
  list.dataset.shown = JSON.stringify(shown);
  list.replaceChildren(...shown.map(([label, p]) => {
    const item = made("li"), bar = document.createElement("meter");
    made("span", "", label, item).title = label;
    bar.value = p;
    bar.setAttribute("aria-label", label);
    item.append(bar);
    made("span", "number", percent(p), item);
    return item;
  }));
}

async function fetchPicture(which, number) {
  known.pictures.set(which, null);
  const {pictures} = known;
  let picture = false;
  try {
    const answer = await fetch(`/sweep/${number}`, {cache: "no-store"});
    if (answer.ok) picture = await answer.json();
  } catch { /* shown as no signal; asked again when the connection is back */ }
  pictures.set(which, picture);
  while (pictures.size > PICTURES) pictures.delete(pictures.keys().next().value);
  dirty = true;
}

function drawFilter() {
  const counts = new Map();
  for (const {status} of known.verdicts) counts.set(status, (counts.get(status) ?? 0) + 1);
  const names = ["all", ...[...counts.keys()].sort((a, b) => counts.get(b) - counts.get(a) || a.localeCompare(b))];
  const there = new Map([...byId("filter").children].map((one) => [one.dataset.status, one]));
  if ([...there.keys()].join() !== names.join()) {
    for (const [name, one] of there) if (!names.includes(name)) one.remove();
    names.forEach((name, i) => {
      const button = there.get(name) ?? Object.assign(document.createElement("button"), {type: "button"});
      button.dataset.status = name;
      if (byId("filter").children[i] !== button) byId("filter").insertBefore(button, byId("filter").children[i] ?? null);
    });
  }
  for (const button of byId("filter").children) {
    const {status} = button.dataset, text = status === "all" ? `all ${count(known.verdicts.length)}` : `${status} ${count(counts.get(status))}`;
    if (button.textContent !== text) button.textContent = text;
    button.setAttribute("aria-pressed", status === "all" ? !statuses.size : statuses.has(status));
  }
}

function drawHistory() {
  drawFilter();
  const wanted = known.verdicts.filter((one) => !statuses.size || statuses.has(one.status)).reverse();
  const first = known.verdicts[0];
  put("counted", first ? `since ${clock(wall(first.time_ns))}; what this page's program has seen` : "no sweep yet");
  const shown = wanted.slice(0, showAll ? KEPT : SHOWN), rows = byId("rows");
  const content = JSON.stringify([shown.length, shown[0] && key(shown[0]), known.notes.length, [...statuses], known.run, wallMs > 0]);
  if (content !== drawnRows) {
    drawnRows = content;
    const before = rows.scrollTop, height = rows.scrollHeight, notes = statuses.size ? [] : [...known.notes].reverse();
    const parts = [];
    for (const one of shown) {
      while (notes.length && notes[0].time_ns >= one.time_ns) parts.push(made("p", "note", `${clock(wall(notes[0].time_ns))}  ${notes.shift().text}`));
      parts.push(row(one));
    }
    rows.replaceChildren(...parts);
    if (shown.length < wanted.length) made("button", "all", `show all ${count(wanted.length)}`, rows).addEventListener("click", () => { showAll = dirty = true; });
    if (before > 0) rows.scrollTop = before + rows.scrollHeight - height;
  }
  const chosen = looked() && key(looked());
  for (const one of rows.querySelectorAll(".row")) one.setAttribute("aria-selected", one.dataset.key === chosen);
  const active = rows.querySelector("[aria-selected=true]");
  if (active) rows.setAttribute("aria-activedescendant", active.id);
  else rows.removeAttribute("aria-activedescendant");
}

function row(one) {
  const made_row = made("div", "row");
  made_row.id = `row-${key(one)}`;
  made_row.dataset.key = key(one);
  made_row.setAttribute("role", "option");
  made("span", "", clock(wall(one.time_ns)), made_row);
  made("span", "id number", one.sweep, made_row);
  const what = made("span", "what", "", made_row);
  if (one.status !== "ok") mark(made("span", "chip", "", what), one.status);
  what.append(one.label || one.detail);
  what.title = one.label || one.reason;
  made("span", "number", one.label ? percent(one.probability) : "", made_row);
  made("span", "ms number", one.label ? `${(one.latency_ns / 1e6).toFixed(1)} ms` : "", made_row);
  if (one.moved) made("span", "more", one.moved, made_row);
  return made_row;
}

function select(which) {
  known.chosen = which;
  dirty = true;
}

function drawCourse() {
  const answered = known.verdicts.filter((one) => one.label);
  const sorted = answered.map((one) => one.latency_ns / 1e6).sort((a, b) => a - b);
  const latency = sorted.length ? `median ${sorted[sorted.length >> 1].toFixed(1)} ms, longest ${sorted.at(-1).toFixed(1)} ms` : "no sweep yet";
  put("latency-said", latency);
  course(byId("latency"), answered.map((one) => [wall(one.time_ns), one.latency_ns / 1e6, one.status !== "ok"]), {clock, nothing: "no sweep yet"});
  if (answered.length) byId("latency").setAttribute("aria-label", `latency of ${answered.length} sweeps: ${latency}`);
  const {health} = known, loss = !health ? "no news yet" : !health.loss_known ? `at least ${count(health.lost_frames)}: this skin does not count its frames`
    : `${count(health.lost_frames)} of ${count(health.frames + health.lost_frames)} since the start`;
  put("loss-said", loss);
  const points = known.minutes.map((one) => [wall(one.time_ns), (100 * one.lost) / Math.max(1, one.frames + one.lost), one.lost > 0]);
  course(byId("loss"), points, {bars: true, clock, nothing: "the first minute is not over"});
  if (points.length) byId("loss").setAttribute("aria-label", `lost frames in ${points.length} minutes: ${loss}`);
}

function drawFacts() {
  const {hello, health} = known;
  if (!hello || !health) return;
  const {format} = hello, grid = [format.rows, format.cols, ...(format.axes > 1 ? [format.axes] : [])].join("x");
  const own = new Set(["version", "skin", "trouble", "bundle", "source", "model"]);
  const facts = {bundle: health.model ? `${health.model} (${health.bundle})` : health.bundle || "none",
    ...Object.fromEntries(Object.entries(health).filter(([name, value]) => typeof value === "string" && value && !own.has(name))),
    skin: `${hello.skin}, ${grid} ${format.dtype} at ${format.rate_hz} Hz`, answered: `${count(health.answered)} sweeps`,
    running: `${ago((health.time_ns - health.since_ns) / 1e6)}, palpate ${health.version}, process ${health.pid}`,
    ...(health.dropped ? {serial: `${count(health.dropped)} sentences dropped, since nobody read them`} : {}),
    ...(health.garbage_bytes ? {wire: `${count(health.garbage_bytes)} bytes in no packet`} : {})};
  const list = byId("facts").querySelector("dl"), names = Object.keys(facts);
  if ([...list.querySelectorAll("dt")].map((one) => one.textContent).join() !== names.join()) {
    list.replaceChildren(...names.flatMap((name) => [made("dt", "", name), made("dd")]));
  }
  list.querySelectorAll("dd").forEach((one, i) => { if (one.textContent !== facts[names[i]]) one.textContent = facts[names[i]]; });
}

function draw() {
  dirty = false;
  choose();
  drawHeader();
  drawSkin();
  if (sees("align")) return drawWords();
  drawVerdict();
  drawHistory();
  drawSweep();
  drawCourse();
  drawFacts();
}

/* Only what has changed many times a second is drawn as often. */
function tick() {
  if (dirty) draw();
  requestAnimationFrame(tick);
}

const FAST = new Set(["view", "now"]);
listen(Object.fromEntries(Object.entries(HEARD).map(([name, act]) => [name, (content) => {
  act(content);
  if (!FAST.has(name) || sees("align") || document.body.dataset.view === "") dirty = true;
  else drawSkin();
}])), (there, program) => {
  [reached, answers] = [there, program];
  if (there) for (const [which, picture] of known.pictures) if (!picture) known.pictures.delete(which);
  dirty = true;
});

byId("rows").addEventListener("click", (event) => {
  const chosen = event.target.closest(".row");
  if (chosen) select(chosen.dataset.key);
});
byId("rows").addEventListener("keydown", (event) => {
  const all = [...byId("rows").querySelectorAll(".row")], at = all.findIndex((one) => one.getAttribute("aria-selected") === "true");
  const to = {ArrowDown: at + 1, ArrowUp: at - 1, Home: 0, End: all.length - 1, PageDown: at + 10, PageUp: at - 10}[event.key];
  if (to === undefined || !all.length || event.target !== byId("rows")) return;
  event.preventDefault();
  const next = all[Math.max(0, Math.min(all.length - 1, to))];
  select(next.dataset.key);
  next.scrollIntoView({block: "nearest"});
});
byId("filter").addEventListener("click", (event) => {
  const {status} = event.target.dataset;
  if (!status) return;
  if (status === "all") statuses.clear();
  else if (!statuses.delete(status)) statuses.add(status);
  dirty = true;
});
byId("follow").addEventListener("click", () => select(null));
addEventListener("hashchange", () => { dirty = true; });
addEventListener("resize", () => { dirty = true; });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { dirty = true; });
setInterval(() => { dirty = true; }, 1000);
tick();
