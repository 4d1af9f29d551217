/* What the pages' scripts share: elements, and figures in words. */

const TONES = {ok: "good", recorded: "good", unsure: "warn", undecided: "warn", unknown: "warn", conflict: "warn",
  displaced: "warn", aborted: "plain", off: "plain"};

const ORDER_MS = 10_000;

document.documentElement.setAttribute("data-runs", "yes"); // see old.js

/* How often each value is there, and the values, the most frequent first. */
export function counted(values) {
  const counts = new Map();
  for (const one of values) counts.set(one, (counts.get(one) ?? 0) + 1);
  return counts;
}

export function common(counts) { return [...counts.keys()].sort((a, b) => counts.get(b) - counts.get(a) || a.localeCompare(b)); }

export const byId = (id) => document.getElementById(id);

export function last(values) { return values[values.length - 1]; }

/* Makes `children` the only ones: Element.replaceChildren is younger than many tablets. */
export function fill(parent, ...children) {
  parent.textContent = "";
  parent.append(...children);
}

export function put(id, text) { if (byId(id).textContent !== text) byId(id).textContent = text; }

/* A button that can do nothing now keeps the focus that it has. */
export function enable(button, can) { if (button.getAttribute("aria-disabled") !== `${!can}`) button.setAttribute("aria-disabled", `${!can}`); }

export function made(name, classes, text, parent) {
  const one = document.createElement(name);
  if (classes) one.className = classes;
  if (text !== undefined) one.textContent = text;
  if (name === "button") one.type = "button";
  parent?.append(one);
  return one;
}

/* Whether an element shows other content than this, and so is to be drawn again. */
export function changed(element, content) {
  const before = element.dataset.shown;
  return before !== (element.dataset.shown = JSON.stringify(content));
}

/* Calls page.draw() where page.dirty was set, once a second, and where the window or its colours change; and page.each() in every frame. */
export function redraw(page) {
  const again = () => { page.dirty = true; }, tick = () => {
    if (page.dirty) {
      page.dirty = false;
      page.draw();
    }
    page.each?.();
    requestAnimationFrame(tick);
  };
  addEventListener("resize", again);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
  setInterval(again, 1000);
  tick();
}

/* What the box answers, null without an answer: the head says that there is no connection, and it is asked again when there is one. */
export async function asked(path) {
  try {
    const answer = await fetch(path, {cache: "no-store"});
    return answer.ok ? await answer.json() : null;
  } catch {
    return null;
  }
}

/* Draws the head of a page. state: of the skin, in words; fine: whether it streams. source: of the frames, if known. why: why
   what is shown is not of this moment, "" where it is. */
export function frame({state, fine, source, why = ""}) {
  put("state", state);
  byId("state").className = fine ? "pill fine" : "pill";
  if (source) {
    byId("simulated").hidden = source === "usb";
    put("simulated", source === "replay" ? "REPLAYED" : "SIMULATED");
  }
  byId("banner").hidden = !why;
  put("banner", why);
}

/* Sends a command with the page's key, as on the serial line. What became of it: "", or why it was refused. */
export async function order(program, key, command, text = "") {
  const ending = new AbortController(), late = setTimeout(() => ending.abort(), ORDER_MS);
  const headers = {"Content-Type": "application/json", "X-Palpate-Key": key};
  const sent = fetch("order", {method: "POST", body: JSON.stringify({command, text}), signal: ending.signal, headers});
  try { // of what the network does, and of nothing else
    const answer = await sent;
    return answer.ok ? "" : (await answer.text()).trim() || `${program} answers ${answer.status}`;
  } catch {
    return `no connection to ${program}; what holds now is shown when it is back`;
  } finally {
    clearTimeout(late);
  }
}

/* Writes a sweep's status, in the colour of what it means. */
export function mark(chip, status) {
  chip.textContent = status;
  chip.dataset.tone = TONES[status] ?? "bad";
}

export function clock(ms) { return new Date(ms).toLocaleTimeString("en-GB"); }

export function ago(ms) {
  const s = Math.max(0, Math.round(ms / 1000));
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${String(s % 60).padStart(2, "0")} s`;
  return s < 86400 ? `${Math.floor(s / 3600)} h ${Math.floor(s / 60) % 60} min` : `${Math.floor(s / 86400)} d ${Math.floor(s / 3600) % 24} h`;
}

/* What a person does now, and for how many seconds where sweeps are timed; "" where nothing is planned. recording: as record.py
   sends it. nowNs: by the box's clock. */
export function call(recording, nowNs) {
  if (recording.skin !== "streaming") return ["", ""];
  const left = recording.due_ns ? Math.max(0, recording.due_ns - nowNs) / 1e9 : null;
  if (recording.sweeping) return ["Slide now", left === null ? "" : left.toFixed(1)];
  if (left !== null) return ["Next sweep in", `${Math.ceil(left)}`];
  if (recording.commands.includes("START") && !recording.material) return ["Name a material", ""];
  return [recording.commands.includes("START") ? "Press Start, Space or the pedal" : `Waiting for ${recording.trigger}`, ""];
}

/* A USB pedal is a keyboard with one key; it starts and stops a sweep unless a field or a button has the focus. */
export function listenToPedal(press) {
  document.addEventListener("keydown", (event) => {
    if (!["Space", "Enter", "NumpadEnter"].includes(event.code) || event.target.closest("input, button")) return;
    event.preventDefault();
    if (!event.repeat) press();
  });
}

/* Never more than it is: 99.96 % that did not suffice is not 100.0 %. */
export function percentAtMost(p) { return percent(Math.floor(1000 * p + 1e-6) / 1000); }

export function percent(p) { return `${(100 * p).toFixed(1)}\u00a0%`; }

/* A load in text, as `figure` of appliance/palpate/alignment/live.py. */
export function figure(value, full, unit) { return value.toFixed(unit === "N" ? 2 : !unit || full >= 100 ? 0 : full >= 10 ? 1 : 2); }

export function count(n) { return n.toLocaleString("en"); }
