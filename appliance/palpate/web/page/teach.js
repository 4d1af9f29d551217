/* The page of `palpate teach`: what to do next, the materials, what was learnt, and the bundle that is made of it. */

import {ago, byId, changed, enable, fill, made, percentAtMost, put} from "./parts.js";
import {drawHeader, drawLast, drawMoves, live, may, ordered, run, seen, shown, startAddress} from "./recording.js";

const STEPS = {start: "waiting for the processor", features: "looking at the sweeps", heads: "learning", bundle: "checking"};
const NOT_THIS = "not this"; // the material of sweeps over other things, which move the limit of unknown ones
let ended = false, usedMs = 0;

function teach() { return seen.recording?.teach ?? null; }

function byPage() { return seen.recording?.commands.includes("START"); }

function drawTask() {
  const {recording, last} = seen;
  enable(byId("add-button"), may("teach"));
  if (!recording) return;
  const trying = recording.trying, now = teach(), name = recording.material;
  if (trying) {
    put("what", shown(last?.label) || (last ? last.reason || last.status : "Try it"));
    put("count", last?.label ? `${percentAtMost(last.probability)} sure` : `it knows ${trying.labels.map(shown).join(", ")}`);
  } else if (now) {
    const n = now.materials[name] ?? 0;
    put("what", shown(name) || "Name a material");
    put("count", !name ? "" : n < recording.good ? `sweep ${n + 1} of ${recording.good}` : `${n} sweeps: enough of it, or go on`);
  }
  byId("sweep-button").hidden = !byPage();
  put("sweep-button", recording.sweeping ? "Stop" : "Start");
  enable(byId("sweep-button"), may() && recording.skin === "streaming" && (trying || Boolean(name)));
  for (const id of ["discard", "move", "skip", "place", "rename", "undo"]) byId(id).hidden = Boolean(trying);
  if (!trying) drawMoves(byId("name").value.trim());
  enable(byId("discard"), may() && recording.discard != null);
  put("discard", recording.discard == null ? "Discard" : `Discard sweep ${recording.discard}`);
  enable(byId("skip"), may("teach") && now && Object.keys(now.materials).length > 1);
  enable(byId("place"), may() && Boolean(name));
  put("place", recording.position ? `Another place (now ${recording.position})` : "Another place");
}

function drawMaterials() {
  const {recording} = seen;
  const held = teach()?.materials ?? Object.fromEntries((recording?.trying?.labels ?? []).map((name) => [name, null]));
  if (!changed(byId("materials"), [held, recording?.displays, recording?.material, Boolean(recording?.trying), may("teach")])) return;
  fill(byId("materials"), ...Object.entries(held).map(([name, n]) => {
    const row = made("li"), pick = made("button", "", n === null ? shown(name) : `${shown(name)}: ${n}`, row);
    pick.dataset.material = name;
    pick.setAttribute("aria-pressed", `${!recording.trying && name === recording.material}`);
    enable(pick, may("teach"));
    if (n !== null) {
      const forget = made("button", "forget", "Forget", row);
      forget.dataset.forget = name;
      forget.setAttribute("aria-label", `Forget ${shown(name)}`);
      enable(forget, may("teach"));
    }
    return row;
  }));
}

function drawLearnt() {
  const {recording} = seen, now = teach(), trying = recording?.trying, learnt = now?.learnt;
  if (trying) {
    put("accuracy", `${trying.model} is on trial`);
    const alike = trying.alike.map(shown).join(" and ");
    put("learnt", alike ? `${trying.taught}; most easily taken for each other: ${alike}` : trying.taught);
    put("advice", "Slide over each material. Press one of them to teach more, or Finish to hand over to the robot.");
  } else if (learnt) {
    const {accuracy, low, high} = learnt;
    put("accuracy", `${(100 * accuracy).toFixed(0)} % right, between ${(100 * low).toFixed(0)} and ${(100 * high).toFixed(0)}`);
    put("learnt", `${learnt.text}${now.assessing ? "; looking again" : ""}`);
    put("advice", learnt.advice);
  } else if (now) {
    put("accuracy", now.assessing ? "looking at the sweeps" : now.fewest === 1 ? "nothing yet: two sweeps of a new material are needed" : "nothing yet: two sweeps of two materials are needed");
    put("learnt", "");
    put("advice", "");
  }
  const suspects = [...(learnt?.no_slides ?? []), ...(learnt?.suspects ?? [])];
  if (changed(byId("suspects"), suspects)) {
    fill(byId("suspects"), ...suspects.map((one) => {
      const row = made("li", "", one.text);
      if (now.materials[one.looks_like] === undefined) return row;
      const button = made("button", "", `Move to ${shown(one.looks_like)}`, row);
      button.dataset.move = `${Number(one.sweep.split("-")[1])},${one.looks_like}`;
      return row;
    }));
  }
  byId("use").hidden = Boolean(trying);
  byId("done").hidden = !trying;
  enable(byId("done"), may("teach"));
  const many = Object.entries(now?.materials ?? {}).filter(([name, n]) => n > 0 && name !== NOT_THIS).length;
  byId("other").hidden = Boolean(now?.base.length);
  enable(byId("other"), may("teach"));
  enable(byId("use"), may("teach") && now && many >= now.fewest && !now.using);
  byId("using").hidden = !now?.using;
  if (!now?.using) usedMs = 0;
  else {
    if (!usedMs) usedMs = Date.now();
    if (now.using.done > 0) byId("progress").value = now.using.done;
    else byId("progress").removeAttribute("value"); // it moves, so that nobody takes it for dead
    const left = now.using.left_s ? `, about ${Math.ceil(now.using.left_s)} s left` : "";
    put("left", `${STEPS[now.using.step] ?? now.using.step}, for ${ago(Date.now() - usedMs)}${left}`);
  }
  byId("trouble").hidden = !now?.trouble;
  put("trouble", now?.trouble ?? "");
}

function drawSweep() {
  const {last} = seen;
  drawLast();
  if (!last) return put("outcome", "no sweep yet");
  const wrong = last.faulty ? `${last.reason}; it does not count` : "";
  put("outcome", [wrong, last.detail].filter(Boolean).join("; ") || "checked: contact, saturation, stuck and dead taxels, rest");
}

/* The box works for the robot now, and this program has ended. */
function drawEnd() {
  ended = true;
  put("what", "Done");
  put("count", "The box works for the robot now");
  for (const one of document.querySelectorAll("#task .buttons, #teach > :not(#task)")) one.hidden = true;
  byId("watched").hidden = location.port !== "8138";
  byId("to-watch").href = `${startAddress()}#watch`;
}

function draw() {
  drawHeader();
  if (seen.finished) return drawEnd();
  if (ended) return location.reload(); // it was started again
  drawTask();
  drawMaterials();
  drawLearnt();
  drawSweep();
}

/* Sends an order. Why it was refused, "" where it was not. */
function send(...words) {
  return ordered(async (order) => {
    const why = await order(...words);
    put("said", why);
    return why;
  });
}

function skip() {
  const names = Object.keys(teach().materials), at = names.indexOf(seen.recording.material);
  send("TEACH", names[(at + 1) % names.length]);
}

async function finish() {
  if (!(await send("DONE"))) Object.assign(seen, {finished: true, dirty: true});
}

const PRESSED = {
  "sweep-button": () => send(seen.recording.sweeping ? "STOP" : "START"),
  discard: () => send("DISCARD", `${seen.recording.discard}`),
  skip,
  place: () => send("NEXT"),
  move: () => send("MOVE", `${seen.recording.newest[0]},${seen.recording.material}`),
  rename,
  undo: () => send("UNDO"),
  use: () => send("USE"),
  done: finish,
  other: () => send("TEACH", NOT_THIS),
};

byId("teach").addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (!button || button.id === "add-button" || button.getAttribute("aria-disabled") === "true") return;
  const {material, forget, move} = button.dataset;
  if (move) send("MOVE", move);
  else if (material) send("TEACH", material);
  else if (forget) send("FORGET", forget);
  else PRESSED[button.id]();
  if (!forget) button.blur(); // so that the pedal's Enter starts a sweep
});
async function rename() {
  const name = byId("name").value.trim();
  if (!(await send("RENAME", `${seen.recording.material},${name}`)) && byId("name").value.trim() === name) byId("name").value = "";
}
async function add() {
  const name = byId("name").value.trim();
  if (!live()) return put("said", "no connection yet: add it again when the page has one");
  if (name && !(await send("TEACH", name)) && byId("name").value.trim() === name) {
    byId("name").value = "";
    document.activeElement?.blur(); // field or button: so that the pedal starts a sweep
  }
}
byId("add-button").addEventListener("click", add);
byId("name").addEventListener("input", () => { seen.dirty = true; });
byId("name").addEventListener("keydown", (event) => { if (event.key === "Enter") add(); });
function press() {
  if (byPage() && byId("sweep-button").getAttribute("aria-disabled") === "false") PRESSED["sweep-button"]();
}

function hear(one) {
  if (Boolean(seen.recording?.trying) !== Boolean(one.trying)) seen.last = null;
  Object.assign(seen, {recording: one, dirty: true});
}

function wanted() { return live() && (seen.recording.trying || seen.recording.material); }

run({name: "palpate teach", draw, wanted, pedal: press, heard: {recording: hear}});
