/* How many verdicts of each material and status there were in a shift, today or in 30 days, the trend of those without an answer, and
   all of them as a CSV file. The box's program counts them (appliance/palpate/web/history.py). */

import {asked, byId, changed, clock, common, count, fill, made, percent, put} from "./parts.js";
import {trend} from "./plots.js";

const PERIODS = {0: "this shift", 1: "today", 30: "30 days"}, EVERY_MS = 30_000, SOON_MS = 1500;
const found = {}; // by period: what the box answered, with the time `at` when it was asked
let period = 0, newest = 0;

function day(ms) { return new Date(ms).toLocaleDateString("en-GB", {day: "numeric", month: "short"}); }

/* Ask for a period that is shown, again after a new verdict or from time to time. again: draws when the answer is there. */
async function ask(which, again) {
  const before = found[which], now = Date.now();
  if (before && (before.asking || now - before.at < SOON_MS || (before.at > newest + SOON_MS && now - before.at < EVERY_MS))) return;
  found[which] = {...before, at: now, asking: true};
  const got = await asked(`history/${which}`); // without an answer, what was there before stays
  found[which] = {...before, ...got, why: got?.why, at: now, asking: false};
  again();
}

/* A row for each material, with its statuses; below them the sweeps without a material. */
function drawTable(table, counts, shown) {
  const named = new Map(), without = new Map(), statuses = new Map();
  for (const [status, label, n] of counts) {
    if (!label) without.set(status, n);
    else {
      if (!named.has(label)) named.set(label, new Map());
      named.get(label).set(status, n);
      statuses.set(status, (statuses.get(status) ?? 0) + n);
    }
  }
  const columns = common(statuses), head = made("tr"), body = [];
  for (const text of ["material", ...columns, "all"]) made("th", "", text, head).scope = "col";
  const line = (name, values) => {
    const one = made("tr");
    made("th", "", name, one).scope = "row";
    for (const value of values) made("td", "", value === "" ? "" : count(value), one);
    body.push(one);
  };
  for (const label of [...named.keys()].sort((a, b) => shown(a).localeCompare(shown(b)))) {
    const of = named.get(label);
    line(shown(label), [...columns.map((status) => of.get(status) ?? 0), [...of.values()].reduce((a, b) => a + b)]);
  }
  for (const status of common(without)) line(status, [...columns.map(() => ""), without.get(status)]);
  fill(table, made("thead"), made("tbody"));
  if (counts.length) table.tHead.append(head);
  table.tBodies[0].append(...body);
}

function total(counts, test) { return counts.filter(test).reduce((sum, one) => sum + one[2], 0); }

/* What was counted, in a sentence. */
export function sentence(of) {
  if (!of?.counts) return of?.why ?? "asking the box";
  const all = total(of.counts, () => true), since = of.kept_s ? Math.max(of.kept_s, of.from_s) : of.from_s;
  if (!all) return `no sweep since ${clock(1000 * since)}`;
  const sure = total(of.counts, (one) => one[0] === "ok"), none = total(of.counts, (one) => !one[1]);
  const begin = of.span_s < 86400 ? clock(1000 * since) : day(1000 * since);
  return `${count(all)} sweeps since ${begin}: ${count(sure)} named (${percent(sure / all)}), ${count(all - sure - none)} not sure, ${count(none)} without a material`;
}

function drawOne(where, of, shown) {
  const one = byId(where), counts = of?.counts ?? [];
  put(`${where}-counted`, sentence(of));
  put(`${where}-kept`, !of?.counts ? "" : of.kept_s ? "Counted since the page's program was started. To keep 90 days: sudo systemctl enable --now palpate-bridge@memory" : "");
  const content = counts.map(([status, label, n]) => [status, label && shown(label), n]); // names may come later
  if (changed(one, content)) drawTable(one.querySelector("table"), counts, shown);
}

/* What is known of this shift. heardAt: when the last verdict came, in ms. */
export function shiftOf(heardAt, again) {
  newest = heardAt;
  ask(0, again);
  return found[0];
}

/* shown: the name of a label for people. */
export function drawShift(heardAt, shown, again) { drawOne("tally", shiftOf(heardAt, again), shown); }

export function drawHistory(heardAt, shown, again) {
  newest = heardAt;
  ask(period, again);
  const of = found[period];
  for (const button of byId("periods").children) button.setAttribute("aria-pressed", button.dataset.period === `${period}`);
  drawOne("past", of, shown);
  byId("rows-file").href = `verdicts/${period}`;
  byId("rows-file").download = `palpate-${PERIODS[period].replace(" ", "-")}.csv`;
  const label = of?.span_s < 86400 ? (ms) => clock(ms).slice(0, 5) : day;
  const words = trend(byId("trend"), of?.trend ?? [], of, label);
  byId("trend").setAttribute("aria-label", words);
  put("trend-said", words);
}

export function listenToHistory(again) {
  for (const [days, words] of Object.entries(PERIODS)) {
    const button = made("button", "", words[0].toUpperCase() + words.slice(1), byId("periods"));
    button.dataset.period = days;
    button.addEventListener("click", () => {
      period = Number(days);
      again();
    });
  }
}

export function save() { byId("rows-file").click(); }
