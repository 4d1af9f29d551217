/* The latest sweeps, as a list with filters. */

import {byId, changed, clock, common, count, counted, fill, made, mark, percentAtMost} from "./parts.js";
import {WORDS} from "./verdict.js";

const SHOWN = 200;
const statuses = new Set(); // which are shown; none: all
let all = false;

export function key(one) { return `${one.pid}-${one.sweep}`; }

/* known: verdicts (each with its time `at`, in ms), notes and the run of this page's program. chosen: the sweep that is looked at. */
export function drawSweeps(known, chosen, again) {
  drawFilter(known.verdicts);
  const wanted = known.verdicts.filter((one) => !statuses.size || statuses.has(one.status)).reverse();
  const shown = all ? wanted : wanted.slice(0, SHOWN), rows = byId("rows");
  if (changed(rows, [shown.length, shown[0] && key(shown[0]), known.notes.length, [...statuses], known.run])) {
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

function drawFilter(verdicts) {
  const counts = counted(verdicts.map((one) => one.status)), names = ["all", ...common(counts)];
  const there = new Map([...byId("filter").children].map((one) => [one.dataset.status, one]));
  if ([...there.keys()].join() !== names.join()) {
    for (const [name, one] of there) if (!names.includes(name)) one.remove();
    names.forEach((name, i) => {
      const button = there.get(name) ?? made("button");
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
  made("span", "number", one.label ? percentAtMost(one.probability) : "", made_row);
  made("span", "ms number", one.label ? `${(one.latency_ns / 1e6).toFixed(1)} ms` : "", made_row);
  if (one.moved !== null) made("span", "more", one.moved, made_row);
  return made_row;
}

/* select: called with the sweep that was chosen, by hand or with the arrows. again: draws the page again. */
export function listenToSweeps(select, again) {
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
