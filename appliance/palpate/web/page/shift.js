/* The sweeps of this shift: a list with filters, counts by material and status, and all of them as a CSV file. */

import {byId, clock, count, fill, last, made, mark, percent, put} from "./parts.js";
import {WORDS} from "./verdict.js";

const SHOWN = 200;
const statuses = new Set(); // which are shown; none: all
let drawn = "", all = false;

export function key(one) { return `${one.pid}-${one.sweep}`; }

/* known: verdicts (each with its time `at`, in ms), notes and the run of this page's program. chosen: the sweep that is looked at. */
export function drawShift(known, chosen, again) {
  drawFilter(known.verdicts);
  drawTally(known.verdicts);
  const wanted = known.verdicts.filter((one) => !statuses.size || statuses.has(one.status)).reverse();
  const shown = all ? wanted : wanted.slice(0, SHOWN), rows = byId("rows");
  const content = JSON.stringify([shown.length, shown[0] && key(shown[0]), known.notes.length, [...statuses], known.run]);
  if (content !== drawn) {
    drawn = content;
    const before = rows.scrollTop, height = rows.scrollHeight, notes = statuses.size ? [] : [...known.notes].reverse(), parts = [];
    for (const one of shown) {
      while (notes.length && notes[0].time_ns >= one.time_ns) parts.push(made("p", "note", `${clock(notes[0].at)}  ${notes.shift().text}`));
      parts.push(row(one));
    }
    fill(rows, ...parts);
    if (shown.length < wanted.length) made("button", "all", `show all ${count(wanted.length)}`, rows).addEventListener("click", () => { all = true; again(); });
    if (before > 0) rows.scrollTop = before + rows.scrollHeight - height;
  }
  for (const one of rows.querySelectorAll(".row")) one.setAttribute("aria-selected", Boolean(chosen) && one.dataset.key === key(chosen));
  const active = rows.querySelector("[aria-selected=true]");
  if (active) rows.setAttribute("aria-activedescendant", active.id);
  else rows.removeAttribute("aria-activedescendant");
}

function counted(values) {
  const counts = new Map();
  for (const one of values) counts.set(one, (counts.get(one) ?? 0) + 1);
  return counts;
}

function common(counts) { return [...counts.keys()].sort((a, b) => counts.get(b) - counts.get(a) || a.localeCompare(b)); }

function drawFilter(verdicts) {
  const counts = counted(verdicts.map((one) => one.status)), names = ["all", ...common(counts)];
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
    const {status} = button.dataset, text = status === "all" ? `all ${count(verdicts.length)}` : `${status} ${count(counts.get(status))}`;
    if (button.textContent !== text) button.textContent = text;
    button.setAttribute("aria-pressed", status === "all" ? !statuses.size : statuses.has(status));
  }
}

/* A row for each material that was named, with its statuses; below them the sweeps without a material. */
function drawTally(verdicts) {
  const table = byId("tally").querySelector("table"), named = verdicts.filter((one) => one.label), nameless = verdicts.filter((one) => !one.label);
  byId("save").setAttribute("aria-disabled", !verdicts.length);
  if (!verdicts.length) return put("counted", "no sweep yet");
  const sure = verdicts.filter((one) => one.status === "ok").length;
  put("counted", `${count(verdicts.length)} sweeps since ${clock(verdicts[0].at)}: ${count(sure)} named (${percent(sure / verdicts.length)}), `
    + `${count(named.length - sure)} not sure, ${count(nameless.length)} without a material`);
  const content = `${verdicts.length} ${key(verdicts[0])} ${key(last(verdicts))}`;
  if (table.dataset.shown === content) return;
  table.dataset.shown = content;
  const columns = common(counted(named.map((one) => one.status))), head = made("tr"), body = [];
  for (const text of ["material", ...columns, "all"]) made("th", "", text, head).scope = "col";
  const line = (name, values) => {
    const one = made("tr");
    made("th", "", name, one).scope = "row";
    for (const value of values) made("td", "", value === "" ? "" : count(value), one);
    body.push(one);
  };
  for (const name of [...new Set(named.map((one) => one.name))].sort((a, b) => a.localeCompare(b))) {
    const of = counted(named.filter((one) => one.name === name).map((one) => one.status));
    line(name, [...columns.map((status) => of.get(status) ?? 0), [...of.values()].reduce((a, b) => a + b)]);
  }
  const without = counted(nameless.map((one) => one.status));
  for (const status of common(without)) line(status, [...columns.map(() => ""), without.get(status)]);
  fill(table, made("thead"), made("tbody"));
  table.tHead.append(head);
  table.tBodies[0].append(...body);
}

function row(one) {
  const made_row = made("div", "row");
  made_row.id = `row-${key(one)}`;
  made_row.dataset.key = key(one);
  made_row.setAttribute("role", "option");
  made("span", "", clock(one.at), made_row);
  made("span", "id number", one.sweep, made_row);
  const what = made("span", "what", "", made_row);
  if (one.status !== "ok") mark(made("span", "chip", "", what), one.status);
  what.append(one.name || (WORDS[one.status] ?? ["", "", one.reason])[2]); // the chip says the rest
  if (!one.label) what.title = one.reason;
  made("span", "number", one.label ? percent(one.probability) : "", made_row);
  made("span", "ms number", one.label ? `${(one.latency_ns / 1e6).toFixed(1)} ms` : "", made_row);
  if (one.moved) made("span", "more", one.moved, made_row);
  return made_row;
}

/* The time of a verdict by this device's clock, with its zone (ISO 8601). */
function stamp(ms) {
  const away = -new Date(ms).getTimezoneOffset(), zone = `${away < 0 ? "-" : "+"}${new Date(Math.abs(away) * 60_000).toISOString().slice(11, 16)}`;
  return new Date(ms + away * 60_000).toISOString().slice(0, -1) + zone;
}

/* A text for CSV (RFC 4180), which a spreadsheet must not take for a formula. */
function cell(value) {
  const text = typeof value === "string" && /^[=+\-@\t]/.test(value) ? `'${value}` : `${value}`;
  return /[",\r\n]/.test(text) ? `"${text.replace(/"/g, '""')}"` : text;
}

export function csv(verdicts) {
  const columns = {
    time: (one) => stamp(one.at), box_process: (one) => one.pid, sweep: (one) => one.sweep, status: (one) => one.status, material: (one) => one.label,
    probability: (one) => (one.label ? one.probability.toFixed(4) : ""), fused: (one) => one.fused, lost_frames: (one) => one.lost,
    latency_ms: (one) => (one.label ? (one.latency_ns / 1e6).toFixed(2) : ""), bundle: (one) => one.bundle, moved: (one) => one.moved,
    detail: (one) => one.detail,
  };
  return [Object.keys(columns), ...verdicts.map((one) => Object.values(columns).map((of) => of(one)))]
    .map((values) => `${values.map(cell).join(",")}\r\n`).join("");
}

export function save(verdicts) {
  if (!verdicts.length) return;
  const link = made("a");
  link.href = URL.createObjectURL(new Blob([csv(verdicts)], {type: "text/csv"}));
  link.download = `palpate-${stamp(Date.now()).slice(0, 16).replace("T", "-").replace(":", "")}.csv`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/* select: called with the sweep that was chosen, by hand or with the arrows. again: draws the page again. */
export function listenToShift(select, again) {
  const rows = byId("rows");
  rows.addEventListener("click", (event) => {
    const chosen = event.target.closest(".row");
    if (chosen) select(chosen.dataset.key);
  });
  rows.addEventListener("keydown", (event) => {
    const every = [...rows.querySelectorAll(".row")], at = every.findIndex((one) => one.getAttribute("aria-selected") === "true");
    const to = {ArrowDown: at + 1, ArrowUp: at - 1, Home: 0, End: every.length - 1, PageDown: at + 10, PageUp: at - 10}[event.key];
    if (to === undefined || !every.length || event.target !== rows) return;
    event.preventDefault();
    const next = every[Math.max(0, Math.min(every.length - 1, to))];
    select(next.dataset.key);
    next.scrollIntoView({block: "nearest"});
  });
  byId("filter").addEventListener("click", (event) => {
    const {status} = event.target.dataset;
    if (!status) return;
    if (status === "all") statuses.clear();
    else if (!statuses.delete(status)) statuses.add(status);
    again();
  });
}
