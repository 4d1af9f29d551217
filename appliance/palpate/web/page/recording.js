/* What the pages of palpate record and palpate teach share: their events, the head, the call, the last sweep and orders. */

import {listen} from "./events.js";
import {ago, asked, byId, call, enable, frame, listenToPedal, mark, order, put, redraw} from "./parts.js";
import {signal} from "./plots.js";

/* key, recording, last: events of these names, as appliance/palpate/web/record.py sends them. picture: of the last sweep.
   finished: the person has ended the program, so that no connection is no fault. dirty: something is to be drawn. */
export const seen = {finished: false, key: "", role: "", recording: null, last: null, picture: null, reached: null, answers: true, wallMs: 0, dirty: true};
let program = "", ordering = false, early = "";

function begin() { Object.assign(seen, {finished: false, key: "", recording: null, last: null}); }

export function live() { return seen.reached === true && seen.recording !== null; }

/* Whether this browser's token allows orders: of a recording, or of teaching too. */
export function may(role = "operate") { return live() && (seen.role === "teach" || seen.role === role); }

/* How long ago something was, by the box's clock. */
export function since(ns) { return `${ago(Date.now() - seen.wallMs - ns / 1e6)} ago`; }

/* Why what is shown is not of this moment; "" where it is. */
function trouble() {
  const {reached, answers, recording, finished} = seen;
  if (reached === null || finished) return "";
  const heard = recording ? `; last heard of it ${since(recording.time_ns)}` : "";
  if (!reached) return `${answers ? `${program} answers, but has no news` : `no connection to ${program}`}${heard}; trying again`;
  if (recording && recording.skin !== "streaming") return `no skin: ${recording.skin}${recording.trouble && `; ${recording.trouble}`}`;
  return "";
}

export function drawHeader() {
  const why = trouble(), {reached, recording} = seen;
  document.body.classList.toggle("stale", Boolean(why));
  const state = seen.finished ? "finished" : !reached ? "no connection" : !recording ? "waiting" : recording.skin !== "streaming" ? `skin ${recording.skin}`
    : recording.sweeping ? "sweeping" : recording.ready ? "ready" : "not ready";
  frame({state, fine: live() && recording.skin === "streaming", source: recording?.source, why});
  put("role", {look: "look only", operate: "operate"}[seen.role] ?? "");
  byId("role").hidden = !byId("role").textContent;
  byId("format").hidden = !recording;
  if (recording) put("format", recording.format);
}

/* A material by the name that people read. */
export function shown(material) { return (seen.recording?.trying ?? seen.recording)?.displays?.[material] ?? material; }

/* The start page on the same machine. */
export function startAddress() { return `${location.protocol}//${location.hostname}:8137/`; }

/* The buttons of a sweep with the wrong material, and of a material with the wrong name. typed: a new name. */
export function drawMoves(typed) {
  const {recording} = seen, {newest, material, undo} = recording;
  byId("move").hidden = !newest || !material || newest[1] === material;
  put("move", newest ? `Move sweep ${recording.discard} to ${shown(material)}` : "Move");
  put("rename", material ? `Rename ${shown(material)}` : "Rename");
  enable(byId("move"), may());
  enable(byId("rename"), may() && Boolean(material && typed) && typed !== shown(material));
  byId("undo").hidden = !undo;
  put("undo", `Undo: ${undo}`);
  enable(byId("undo"), may());
}

function drawCall(wanted) {
  const [words, seconds] = wanted() ? call(seen.recording, (Date.now() - seen.wallMs) * 1e6) : ["", ""];
  put("call", words);
  put("countdown", seconds);
}

/* The picture of the last sweep, null without; it is asked for once. why: why there is none. */
function lastPicture() {
  const {last, picture, reached} = seen;
  if (!last) return {picture: null, why: "no sweep yet"};
  const drawing = picture?.sweep === last.sweep ? picture : null;
  const why = !last.signal ? "it has no window" : drawing?.asked ? `asking ${program}` : "its signal is not kept";
  if (last.signal && !drawing && reached) fetchPicture(last.sweep);
  return {picture: drawing?.taxels ? drawing : null, why};
}

async function fetchPicture(sweep) {
  seen.picture = {sweep, asked: true};
  const got = await asked(`sweep/${sweep}`) ?? {sweep};
  if (seen.last?.sweep === sweep) seen.picture = got;
  seen.dirty = true;
}

/* Draws the last sweep but what was found. Its picture, and why there is none. */
export function drawLast() {
  const {last, recording} = seen, {picture, why} = lastPicture();
  byId("status").hidden = !last;
  if (last) mark(byId("status"), last.status);
  put("sweep-title", last ? `Sweep ${last.sweep}, ${since(last.time_ns)}` : "Last sweep");
  signal(byId("signal"), picture, why, recording?.unit || undefined);
  return {picture, why};
}

/* Does `act` with a function that sends one order and gives why it was refused, "" where it was not; one `act` at a time:
   a press before its end is refused, and said then. */
export async function ordered(act) {
  if (ordering) return early = "a press was ignored: the order before it was not answered yet";
  ordering = seen.dirty = true;
  try {
    return await act((command, text) => order(program, seen.key, command, text));
  } finally {
    if (early) put("said", early);
    [ordering, early] = [false, ""];
    seen.dirty = true;
  }
}

/* name: of the program. draw: draws all. wanted: whether the call is shown. pedal: a press of it. heard: further events. */
export function run({name, draw, wanted, pedal, heard = {}}) {
  program = name;
  if (location.port === "8138") byId("home-link").href = startAddress();
  listen({
    begin,
    now(ns) { seen.wallMs = Date.now() - ns / 1e6; },
    key(one) { seen.key = one; },
    role(one) { Object.assign(seen, {role: one, dirty: true}); },
    recording(one) { Object.assign(seen, {recording: one, dirty: true}); },
    sweep(one) { Object.assign(seen, {last: one, dirty: true}); },
    ...heard,
  }, (reached, answers) => {
    Object.assign(seen, {reached, answers, dirty: true});
    if (reached && !seen.picture?.taxels) seen.picture = null;
  });
  listenToPedal(pedal);
  redraw(Object.assign(seen, {draw, each() { drawCall(wanted); }}));
}
