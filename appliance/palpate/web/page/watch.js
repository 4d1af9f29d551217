/* The pages of palpate watch: the start; at the robot the last verdict first, then the skin, the sweep, the shift, and the box
   itself; the alignment of the skin; the history. */

import {listen} from "./events.js";
import {ago, asked, byId, changed, clock, count, figure, fill, frame, last, made, percent, put, redraw} from "./parts.js";
import {course, signal, spectrogram} from "./plots.js";
import {drawHistory, drawShift, listenToHistory, save} from "./history.js";
import {SkinPicture, wayBack} from "./skin.js";
import {drawStart} from "./start.js";
import {drawSweeps, key, listenToSweeps} from "./sweeps.js";
import {listenToTablet, play} from "./tablet.js";
import {card, drawCard, skin} from "./verdict.js";

const VIEWS = ["start", "watch", "align", "history"], SPOKEN_MS = 3000, KEPT = 5000, PICTURES = 20, SCORES = 6;
const SKIN = new SkinPicture(document.createElement("div")), PAGE = {dirty: true, draw};
let known; // what the box has said; see begin()
let reached = null, answers = true, wallMs = 0, spokenAt = -Infinity, allScores = false;

function begin() {
  known = {run: "", hello: null, box: null, health: null, view: null, verdicts: [], notes: [], minutes: [], signals: new Map(),
    labels: new Map(), pictures: new Map(), chosen: null, heardAt: 0, answers: 0, before: 0, sweeping: false};
}
begin();

/* Times. The box counts nanoseconds since its start; `wallMs` is what this device's clock showed then. */
function wall(ns) { return wallMs + ns / 1e6; }

/* How many answers there were when the open sweep began: an answer after that is an early one, of this sweep. */
function note(sweeping) {
  if (sweeping && !known.sweeping) known.before = known.answers;
  known.sweeping = sweeping;
}

/* Events, as appliance/palpate/web/board.py sends them. */
const HEARD = {
  now(ns) { wallMs = Date.now() - ns / 1e6; },
  begin(run) { begin(); known.run = run; },
  hello(hello) { known.hello = hello; known.labels.set(hello.bundle, hello.names); },
  box(box) { known.box = box; },
  health(health) { known.health = health; known.heardAt = wall(health.time_ns); note(health.sweeping); },
  state(state) { if (known.health) Object.assign(known.health, state); note(state.sweeping); },
  view(view) { known.view = view; if (!known.box) known.heardAt = Date.now(); },
  verdict(verdict) {
    known.answers++;
    known.verdicts.push({...verdict, at: wall(verdict.time_ns)});
    if (known.verdicts.length > KEPT) known.verdicts.shift();
  },
  note(note) { known.notes.push({...note, at: wall(note.time_ns)}); },
  minute(minute) { known.minutes.push(minute); },
  signal(one) {
    known.signals.set(key(one), one.number);
    if (known.signals.size > PICTURES) known.signals.delete(known.signals.keys().next().value);
  },
};

function live() { return reached === true && (known.box ? known.box.there && known.health?.skin === "streaming" : known.view?.skin === "streaming"); }

function age() { return known.heardAt ? `, last heard ${ago(Date.now() - known.heardAt)} ago` : ""; }

/* Why nothing is heard of the box, in words for an operator; null where it is heard. */
function away() {
  if (reached === false) return answers ? "The box does not answer" : "No connection to the box";
  return known.box && !known.box.there ? "The box is off or restarting" : null;
}

/* Why what is shown is not of this moment; null where it is. */
function trouble() {
  const gone = away(), {health} = known;
  if (gone !== null) return `${gone}${age()}`;
  if (reached && known.box && health && health.skin !== "streaming" && !sees("align")) return skin(health.skin).join(": ");
  return null;
}

/* Which view is shown; `palpate skin align` has that of alignment only. */
function sees(view) {
  const asked = location.hash.slice(1);
  return view === (!known.box && known.view ? "align" : VIEWS.includes(asked) ? asked : "start");
}

function choose() {
  const aligning = sees("align");
  for (const view of VIEWS) {
    byId(view).hidden = !sees(view);
    if (sees(view)) document.body.dataset.view = view;
  }
  byId("views").hidden = !known.box;
  if (known.box) byId("home-link").setAttribute("href", "#start");
  byId("device").hidden = !known.box || !sees("watch");
  put("title", known.box || !known.view ? "Palpate" : "Align the skin");
  for (const link of byId("views").children) {
    if (sees(link.hash.slice(1))) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
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
  const said = reached !== true ? "no connection" : known.box && !known.box.there ? "box off" : !skin ? "waiting" :
    skin !== "streaming" || !known.box ? `skin ${skin}` : health.sweeping ? "sweeping" : health.ready ? "ready" : "not ready";
  const why = trouble();
  frame({state: said, fine: live(), source, why: sees("align") ? "" : why ?? ""}); // there the words say it
  document.body.classList.toggle("stale", why !== null);
  document.body.classList.toggle("away", away() !== null);
}

let toned = null;

function drawVerdict() {
  const {health, hello, box} = known, verdict = last(known.verdicts);
  const shown = card({verdict, fresh: verdict?.pid === hello?.pid, health,
    swept: known.sweeping && known.answers === known.before, windowS: hello?.window_s, away: away(), lastAt: known.heardAt, now: Date.now(),
    detail: reached ? box?.why ?? "" : "The page tries again by itself."});
  drawCard(shown);
  const event = `${shown.tone} ${shown.tone === "away" ? "" : verdict && key(verdict)}`;
  if (toned !== null && toned !== event) play(shown.tone);
  toned = event;
}

function unit() { return known.hello?.unit || "raw counts"; }

function drawSkin() {
  const {view} = known;
  if (!view) return;
  SKIN.show(view, known.hello?.unit);
  put("skin-title", known.hello?.finger ? `Skin of ${known.hello.finger}` : "Skin");
  const axes = known.hello?.format.axes > 1 ? "; the axis along the normal" : "";
  put("contact", `${unit()} above the lowest seen${axes}`);
  for (const one of document.querySelectorAll(".key:not(.kinds)")) {
    one.hidden = !view.shape || view.state === "no-skin";
    for (const name of ["t", "h"]) one.querySelector(`.${name}`).hidden = !view.contact;
  }
  const at = SKIN.pointed;
  if (at && view.load.length) put("taxel", `row ${at[0] + 1}, column ${at[1] + 1}: ${figure(view.load[at[0]][at[1]], view.full, known.hello?.unit)} ${unit()}`);
  document.body.dataset.state = view.state;
}

function drawWords() {
  const {view} = known, news = trouble();
  if (news !== null || !view) {
    document.body.dataset.state = "no-connection";
    if (news !== null) put("message", known.box && reached ? "the box is off or restarting" : "no connection");
    if (news !== null) put("hint", known.box || answers ? news : "see that palpate skin align still runs on the box, and the tunnel to it");
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
  const text = `${view.message}. ${view.hint}`;
  if (byId("spoken").textContent !== text && performance.now() - spokenAt > SPOKEN_MS) {
    spokenAt = performance.now();
    byId("spoken").textContent = text;
  }
}

/* The sweep that is looked at: the chosen sweep, else the last. */
function looked() { return known.verdicts.find((one) => key(one) === known.chosen) ?? last(known.verdicts); }

function drawSweep() {
  const one = looked();
  byId("follow").hidden = !known.chosen;
  if (!one) {
    put("sweep-said", "probabilities, signal and spectrogram of each sweep appear here");
    signal(byId("signal"), null, "no sweep yet");
    spectrogram(byId("spectrogram"), null, "no sweep yet");
    return;
  }
  put("sweep-title", `Sweep ${one.sweep}, ${clock(one.at)}`);
  const took = `answered in ${(one.latency_ns / 1e6).toFixed(1)} ms`, lost = one.lost ? `, ${one.lost} frames lost` : "";
  put("sweep-said", one.scores.length ? `${one.status}; ${took}${lost}` : `${one.status}: ${one.reason}${one.detail && ` (${one.detail})`}`);
  drawScores(one);
  const picture = known.pictures.get(key(one)), number = known.signals.get(key(one));
  const why = number === undefined ? "the signal of this sweep is not kept" : picture === null ? "asking the box" : "the box has no signal of it";
  signal(byId("signal"), picture, why, unit());
  spectrogram(byId("spectrogram"), picture, why);
  if (number !== undefined && picture === undefined && reached) fetchPicture(key(one), number);
}

function drawScores(one) {
  const labels = known.labels.get(one.bundle) ?? [], list = byId("scores"), more = byId("more");
  const every = one.scores.map((p, i) => [labels[i] ?? `label ${i + 1}`, p]).sort((a, b) => b[1] - a[1]);
  const shown = allScores ? every : every.slice(0, SCORES);
  more.hidden = every.length <= SCORES;
  more.setAttribute("aria-expanded", allScores);
  put("more", allScores ? `the ${SCORES} most probable` : `all ${every.length} materials`);
  if (!changed(list, shown)) return;
  fill(list, ...shown.map(([label, p]) => {
    const item = made("li");
    made("span", "", label, item);
    Object.assign(made("meter", "", undefined, item), {value: p}).setAttribute("aria-label", label);
    made("span", "number", percent(p), item);
    return item;
  }));
}

async function fetchPicture(which, number) {
  known.pictures.set(which, null);
  const {pictures} = known;
  pictures.set(which, await asked(`sweep/${number}`) ?? false);
  while (pictures.size > PICTURES) pictures.delete(pictures.keys().next().value);
  again();
}

function select(which) {
  known.chosen = which;
  again();
}

function drawCourse() {
  const answered = known.verdicts.filter((one) => one.label);
  const sorted = answered.map((one) => one.latency_ns / 1e6).sort((a, b) => a - b);
  const latency = sorted.length ? `median ${sorted[sorted.length >> 1].toFixed(1)} ms, longest ${last(sorted).toFixed(1)} ms` : "no sweep yet";
  put("latency-said", latency);
  course(byId("latency"), answered.map((one) => [one.at, one.latency_ns / 1e6, one.status !== "ok"]), {clock, nothing: "no sweep yet"});
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
    fill(list, ...names.flatMap((name) => [made("dt", "", name), made("dd")]));
  }
  list.querySelectorAll("dd").forEach((one, i) => { if (one.textContent !== facts[names[i]]) one.textContent = facts[names[i]]; });
}

function draw() {
  choose();
  drawHeader();
  drawSkin();
  if (sees("align")) return drawWords();
  const verdict = last(known.verdicts), heardAt = verdict ? verdict.at : 0;
  if (sees("history")) return drawHistory(heardAt, shownAs, again);
  drawVerdict();
  if (sees("start")) return known.box && drawStart(known, byId("label").textContent, heardAt, again);
  drawShift(heardAt, shownAs, again);
  drawSweeps(known, looked(), again);
  drawSweep();
  drawCourse();
  drawFacts();
}

/* Only what has changed many times a second is drawn as often. */
const FAST = new Set(["view", "now"]);
listen(Object.fromEntries(Object.entries(HEARD).map(([name, act]) => [name, (content) => {
  act(content);
  if (!FAST.has(name) || sees("align") || document.body.dataset.view === "") again();
  else drawSkin();
}])), (there, program) => {
  [reached, answers] = [there, program];
  if (there) for (const [which, picture] of known.pictures) if (!picture) known.pictures.delete(which);
  again();
});

function again() { PAGE.dirty = true; }

/* A label by the name that people read. */
function shownAs(label) { return known.hello?.names[known.hello.labels.indexOf(label)] ?? label; }

function go(view) { return () => { if (known.box) location.hash = view; }; }

listenToSweeps(select, again);
listenToHistory(again);
listenToTablet({
  w: ["watch", go("watch")], a: ["align", go("align")], p: ["history", go("history")], l: ["the latest sweep", () => select(null)],
  h: ["latest sweeps; then arrows, Home and End choose one", () => byId("rows").focus()], s: ["save the sweeps as CSV", save],
});
byId("more").addEventListener("click", () => {
  allScores = !allScores;
  again();
});
byId("follow").addEventListener("click", () => select(null));
addEventListener("hashchange", again);
redraw(PAGE);
