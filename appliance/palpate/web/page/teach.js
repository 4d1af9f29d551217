/* The page of `palpate teach`: what to do next, the materials, what was learnt, and the bundle that is made of it. */

import {listen} from "/events.js";
import {ago, byId, call, enable, frame, listenToPedal, made, mark, order, put} from "/parts.js";
import {signal} from "/plots.js";

const STEPS = {start: "starting", features: "looking at the sweeps", heads: "learning", bundle: "checking"};
let key, recording, last; // events of these names, as appliance/palpate/web/record.py sends them
let picture = null, listed = "", reached = null, ordering = false, dirty = true, wallMs = 0;

function begin() {
  key = "";
  recording = last = null;
}
begin();

function live() { return reached === true && recording !== null; }

function teach() { return recording?.teach ?? null; }

/* A material by the name that people read. */
function shown(name) { return (recording?.trying ?? recording)?.displays?.[name] ?? name; }

function byPage() { return recording?.commands.includes("START"); }

function drawHeader() {
  const skin = recording && recording.skin !== "streaming" ? `no skin: ${recording.skin}${recording.trouble && `; ${recording.trouble}`}` : "";
  const heard = recording ? `; last heard of it ${ago(Date.now() - wallMs - recording.time_ns / 1e6)} ago` : "";
  const why = reached === false ? `no connection to palpate teach${heard}; trying again` : skin;
  const state = !reached ? "no connection" : !recording ? "waiting" : skin ? `skin ${recording.skin}` : recording.sweeping ? "sweeping" : "ready";
  frame({state, fine: live() && !skin, source: recording?.source, why});
  document.body.classList.toggle("stale", Boolean(why));
  byId("format").hidden = !recording;
  if (recording) put("format", recording.format);
}

function drawCall() {
  const wanted = live() && (recording.trying || recording.material);
  const [words, seconds] = wanted ? call(recording, (Date.now() - wallMs) * 1e6) : ["", ""];
  put("call", words);
  put("countdown", seconds);
}

function drawTask() {
  enable(byId("add-button"), live());
  if (!recording) return;
  const trying = recording.trying, now = teach(), name = recording.material;
  if (trying) {
    put("what", shown(last?.label) || (last ? last.reason || last.status : "Try it"));
    put("count", last?.label ? `${(100 * last.probability).toFixed(0)} % sure` : `it knows ${trying.labels.map(shown).join(", ")}`);
  } else if (now) {
    const n = now.materials[name] ?? 0;
    put("what", shown(name) || "Name a material");
    put("count", !name ? "" : n < recording.good ? `sweep ${n + 1} of ${recording.good}` : `${n} sweeps: enough of it, or go on`);
  }
  byId("sweep-button").hidden = !byPage();
  put("sweep-button", recording.sweeping ? "Stop" : "Start");
  enable(byId("sweep-button"), live() && recording.skin === "streaming" && (trying || Boolean(name)));
  for (const id of ["discard", "skip", "place"]) byId(id).hidden = Boolean(trying);
  enable(byId("discard"), live() && recording.discard != null);
  put("discard", recording.discard == null ? "Discard" : `Discard sweep ${recording.discard}`);
  enable(byId("skip"), live() && now && Object.keys(now.materials).length > 1);
  enable(byId("place"), live() && Boolean(name));
  put("place", recording.position ? `Another place (now ${recording.position})` : "Another place");
}

function drawMaterials() {
  const held = teach()?.materials ?? Object.fromEntries((recording?.trying?.labels ?? []).map((name) => [name, null]));
  const content = JSON.stringify([held, recording?.displays, recording?.material, Boolean(recording?.trying), live()]);
  if (content === listed) return;
  listed = content;
  byId("materials").replaceChildren(...Object.entries(held).map(([name, n]) => {
    const row = made("li"), pick = made("button", "", n === null ? shown(name) : `${shown(name)}: ${n}`, row);
    pick.type = "button";
    pick.dataset.material = name;
    pick.setAttribute("aria-pressed", `${!recording.trying && name === recording.material}`);
    enable(pick, live());
    if (n !== null) {
      const forget = made("button", "forget", "Forget", row);
      forget.type = "button";
      forget.dataset.forget = name;
      forget.setAttribute("aria-label", `Forget ${shown(name)}`);
      enable(forget, live());
    }
    return row;
  }));
}

function drawLearnt() {
  const now = teach(), trying = recording?.trying, learnt = now?.learnt;
  if (trying) {
    put("accuracy", `${trying.model} is on trial`);
    put("learnt", trying.taught);
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
  const suspects = [...(learnt?.no_slides ?? []), ...(learnt?.suspects ?? [])].map((one) => one.text);
  if (byId("suspects").dataset.text !== suspects.join()) {
    byId("suspects").dataset.text = suspects.join();
    byId("suspects").replaceChildren(...suspects.map((text) => made("li", "", text)));
  }
  byId("use").hidden = Boolean(trying);
  byId("done").hidden = !trying;
  enable(byId("done"), live());
  const many = Object.values(now?.materials ?? {}).filter((n) => n > 0).length;
  enable(byId("use"), live() && now && many >= now.fewest && !now.using);
  byId("using").hidden = !now?.using;
  if (now?.using) {
    byId("progress").value = now.using.done;
    put("left", `${STEPS[now.using.step] ?? now.using.step}${now.using.left_s ? `, about ${Math.ceil(now.using.left_s)} s left` : ""}`);
  }
  byId("trouble").hidden = !now?.trouble;
  put("trouble", now?.trouble ?? "");
}

function drawSweep() {
  byId("status").hidden = !last;
  if (!last) {
    put("sweep-title", "Last sweep");
    put("outcome", "no sweep yet");
    return signal(byId("signal"), null, "no sweep yet");
  }
  mark(byId("status"), last.status);
  put("sweep-title", `Sweep ${last.sweep}, ${ago(Date.now() - wallMs - last.time_ns / 1e6)} ago`);
  const wrong = last.faulty ? `${last.reason}; it does not count` : "";
  put("outcome", [wrong, last.detail].filter(Boolean).join("; ") || "nothing is wrong with it");
  const drawing = picture?.sweep === last.sweep ? picture : null;
  signal(byId("signal"), drawing?.taxels ? drawing : null, last.signal ? "asking palpate teach" : "it has no window", recording?.unit || undefined);
  if (last.signal && !drawing && reached) fetchPicture(last.sweep);
}

async function fetchPicture(sweep) {
  picture = {sweep};
  try {
    const answer = await fetch(`/sweep/${sweep}`, {cache: "no-store"});
    if (answer.ok && last?.sweep === sweep) picture = await answer.json();
  } catch { /* asked again when the connection is back */ }
  dirty = true;
}

function draw() {
  dirty = false;
  drawHeader();
  drawTask();
  drawMaterials();
  drawLearnt();
  drawSweep();
}

/* Sends an order. Why it was refused, "" where it was not. */
async function send(...words) {
  if (ordering) return "the order before is not answered yet";
  ordering = true;
  const why = await order("palpate teach", key, ...words);
  put("said", why);
  ordering = false;
  dirty = true;
  return why;
}

function skip() {
  const names = Object.keys(teach().materials), at = names.indexOf(recording.material);
  send("TEACH", names[(at + 1) % names.length]);
}

const PRESSED = {
  "sweep-button": () => send(recording.sweeping ? "STOP" : "START"),
  discard: () => send("DISCARD", `${recording.discard}`),
  skip,
  place: () => send("NEXT"),
  use: () => send("USE"),
  done: () => send("DONE"),
};

byId("teach").addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (!button || button.id === "add-button" || button.getAttribute("aria-disabled") === "true") return;
  const {material, forget} = button.dataset;
  if (material) send("TEACH", material);
  else if (forget) send("FORGET", forget);
  else PRESSED[button.id]();
  if (!forget) button.blur(); // so that the pedal's Enter starts a sweep
});
async function add() {
  const name = byId("name").value.trim();
  if (!live()) return put("said", "no connection yet: add it again when the page has one");
  if (name && !(await send("TEACH", name)) && byId("name").value.trim() === name) {
    byId("name").value = "";
    document.activeElement?.blur(); // field or button: so that the pedal starts a sweep
  }
}
byId("add-button").addEventListener("click", add);
byId("name").addEventListener("keydown", (event) => { if (event.key === "Enter") add(); });
listenToPedal(() => {
  if (byPage() && byId("sweep-button").getAttribute("aria-disabled") === "false") PRESSED["sweep-button"]();
});

listen({
  now(ns) { wallMs = Date.now() - ns / 1e6; },
  begin,
  key(one) { key = one; },
  recording(one) {
    if (Boolean(recording?.trying) !== Boolean(one.trying)) last = null;
    recording = one;
    dirty = true;
  },
  sweep(one) {
    last = one;
    dirty = true;
  },
}, (there) => {
  reached = there;
  if (there && !picture?.taxels) picture = null;
  dirty = true;
});

function tick() {
  if (dirty) draw();
  drawCall();
  requestAnimationFrame(tick);
}
window.addEventListener("resize", () => { dirty = true; });
setInterval(() => { dirty = true; }, 1000);
tick();
