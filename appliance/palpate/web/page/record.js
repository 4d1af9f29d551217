/* The page of a recording: what is there and what is missing, the last sweep, the skin; and the labels, which are set here. */

import {byId, changed, enable, fill, made, put} from "./parts.js";
import {spectrogram} from "./plots.js";
import {drawHeader, drawLast, drawMoves, live, may, ordered, run, seen, shown} from "./recording.js";
import {SkinPicture} from "./skin.js";

const FIELDS = ["material", "position", "session"], SKIN = new SkinPicture(document.querySelector(".skin"));
let view, drawn = {};

function named(material, position) { return material ? shown(material) + (position && ` at ${position}`) : "no material"; }

function drawLabels() {
  const {recording} = seen;
  for (const id of ["set", "next"]) enable(byId(id), may());
  if (!recording) return;
  put("now", named(recording.material, recording.position));
  for (const name of FIELDS) { // what a person has typed and not set yet stays
    const value = name === "material" ? shown(recording[name]) : recording[name];
    if (byId(name).value === (drawn[name] ?? "")) byId(name).value = value;
    drawn[name] = value;
  }
  put("trigger", recording.trigger);
  drawMoves(byId("material").value.trim());
  byId("sweeps").hidden = !recording.commands.includes("START");
  enable(byId("start"), may() && recording.ready && Boolean(recording.material));
  enable(byId("stop"), may() && recording.sweeping);
}

function sorted(values) { return [...new Set(values)].sort((a, b) => a.localeCompare(b, "en", {numeric: true})); }

function drawCounts() {
  const {recording} = seen;
  if (!recording) return;
  const {counts, material, position, target} = recording, held = new Map(counts.map(([m, p, n]) => [JSON.stringify([m, p]), n]));
  const materials = sorted([...counts.map((one) => one[0]), ...(material ? [material] : [])]);
  const positions = sorted([...counts.map((one) => one[1]), ...(material ? [position] : [])]);
  const box = byId("counts");
  if (changed(box, [materials, positions, recording.displays])) {
    const head = made("tr"), body = materials.map((name) => {
      const row = made("tr");
      made("th", "", shown(name), row).scope = "row";
      for (const at of positions) Object.assign(made("button", "", "", made("td", "", undefined, row)).dataset, {material: name, position: at});
      return row;
    });
    made("td", "", undefined, head);
    for (const at of positions) made("th", "", at || "no position", head).scope = "col";
    fill(box.querySelector("thead"), ...(materials.length ? [head] : []));
    fill(box.querySelector("tbody"), ...body);
    for (const [id, names] of [["materials", materials.map(shown)], ["positions", positions]]) {
      fill(byId(id), ...names.filter(Boolean).map((value) => Object.assign(made("option"), {value})));
    }
  }
  for (const field of box.querySelectorAll("button")) {
    const {material: m, position: p} = field.dataset, n = held.get(JSON.stringify([m, p])) ?? 0, text = `${n} of ${target}`;
    if (field.textContent !== text) field.textContent = text;
    field.className = n >= target ? "done" : "";
    field.setAttribute("aria-label", `${named(m, p)}: ${text}`);
    field.setAttribute("aria-pressed", m === material && p === position);
    enable(field, may());
  }
  put("missing", recording.missing);
}

function outcome(sweep) {
  const became = seen.recording?.last;
  if (became?.sweep !== sweep.sweep) return "";
  const of = named(became.material, became.position);
  return {stored: `${of}, stored as ${became.detail.split(" ")[0]}`, skipped: "not stored, since it has no window", discarded: `${of}, discarded`,
    }[became.outcome] ?? `not stored: ${became.detail}`;
}

function drawSweep() {
  const {recording, last} = seen, which = recording?.discard ?? null, {picture, why} = drawLast();
  enable(byId("discard"), may() && which !== null);
  put("discard", which === null ? "Discard" : `Discard sweep ${which}`);
  spectrogram(byId("spectrogram"), picture, why);
  if (!last) return;
  put("outcome", outcome(last));
  const wrong = last.status === "recorded" ? "" : `${last.reason}; it is not counted`;
  const lost = last.lost ? `${last.lost} lost frames filled in` : "";
  put("check", [wrong, last.detail, lost].filter(Boolean).join("; ") || "checked: contact, saturation, stuck and dead taxels; nothing is wrong");
}

function drawSkin() {
  if (!view) return;
  SKIN.show(view);
  document.body.dataset.state = view.state;
  put("contact", view.state === "wait" ? `${view.message}: ${view.hint}` : `${view.load_unit || "raw counts"} above the lowest seen`);
}

function draw() {
  drawHeader();
  drawLabels();
  drawCounts();
  drawSweep();
}

/* Sends orders one after another, until one is refused: [command, text, what is said, its field]. */
function send(orders) {
  return ordered(async (order) => {
    for (const name of FIELDS) byId(name).removeAttribute("aria-invalid");
    let said = "";
    for (const [command, text, done, field] of orders) {
      const why = await order(command, text);
      said = why || done;
      byId("said").className = why ? "wrong" : "";
      if (why && field) byId(field).setAttribute("aria-invalid", "true");
      if (why) break;
      if (field) drawn[field] = byId(field).value = text.trim();
    }
    put("said", said);
  });
}

function setLabels() {
  const changed = FIELDS.filter((name) => byId(name).value !== drawn[name]);
  send(changed.map((name) => [name.toUpperCase(), byId(name).value, `${changed.join(", ")} set`, name]));
}

const PRESSED = {
  set: setLabels,
  next: () => send([["NEXT", "", "next position"]]),
  start: () => send([["START", "", "started"]]),
  stop: () => send([["STOP", "", "stopped"]]),
  move: () => send([["MOVE", `${seen.recording.newest[0]},${seen.recording.material}`, "moved"]]),
  rename: () => send([["RENAME", `${seen.recording.material},${byId("material").value.trim()}`, "renamed"]]),
  undo: () => send([["UNDO", "", "undone"]]),
  discard: () => send([["DISCARD", `${seen.recording.discard}`, `sweep ${seen.recording.discard} discarded`]]),
};

byId("record").addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (!button || button.getAttribute("aria-disabled") === "true") return;
  if (event.detail) button.blur(); // not after a key: so that the pedal starts a sweep
  const {material, position} = button.dataset;
  if (!material) return PRESSED[button.id]();
  send([["MATERIAL", material, "", "material"], ["POSITION", position, `now ${named(material, position)}`, "position"]]);
});
byId("fields").addEventListener("input", () => { seen.dirty = true; });
byId("fields").addEventListener("keydown", (event) => { if (event.key === "Enter" && may()) setLabels(); });

function press() {
  const button = byId(seen.recording?.sweeping ? "stop" : "start");
  if (seen.recording?.commands.includes("START") && button.getAttribute("aria-disabled") === "false") PRESSED[button.id]();
}

function hear(one) {
  view = one;
  drawSkin();
}

run({name: "palpate record", draw, wanted: live, pedal: press, heard: {view: hear}});
