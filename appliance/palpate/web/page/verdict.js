/* The card that is read from two metres: what the box said, whether that can be trusted, and what to do now. */

import {ago, byId, changed, clock, fill, made, mark, percent, percentAtMost, put} from "./parts.js";
import {STATUSES} from "./statuses.js";

/* By status: how the card is coloured, what the box says in words, and what to do. */
export const WORDS = {...STATUSES, displaced: ["warn", "Displaced", "The skin has moved: align it."]};

/* By state of the skin: what is wrong, and what to do. */
const SKINS = {
  absent: ["No skin", "check its cable"],
  lost: ["Skin lost", "check its cable"],
  silent: ["Skin silent", "it sends nothing, check its cable"],
  busy: ["Skin in use", "another program uses it"],
  denied: ["Skin refused", "the box may not open it, call a technician"],
  mismatch: ["Wrong skin", "connect the skin that was taught"],
};

export function skin(state) { return SKINS[state] ?? [`Skin ${state}`, "call a technician"]; }

/* Shapes differ as colours do: a round tick, a triangle, an octagon, a switch, three dots. */
const SIGNS = {
  good: "M 50 6 A 44 44 0 1 1 49.9 6 Z M 29 51 L 44 67 L 72 35",
  warn: "M 50 8 L 96 90 H 4 Z M 50 36 V 60 M 50 74 V 75",
  bad: "M 32 6 H 68 L 94 32 V 68 L 68 94 H 32 L 6 68 V 32 Z M 50 26 V 56 M 50 72 V 73",
  away: "M 32 20 A 40 40 0 1 0 68 20 M 50 6 V 46",
  plain: "M 50 6 A 44 44 0 1 1 49.9 6 Z M 29 50 H 30 M 50 50 H 51 M 71 50 H 72",
};

const PEN = document.createElement("canvas").getContext("2d");

/* How wide a text is in the card's letters, in em. */
function width(text) {
  PEN.font = `700 100px ${getComputedStyle(document.body).fontFamily}`;
  return PEN.measureText(text).width / 100;
}

/* Widest line of a text in letters so large that its longest word fills the card, or all of it two lines. */
function widest(text) { return Math.max(1, ...text.split(" ").map(width), width(text) / 1.9); }

function of(sweep, now) { return `sweep ${sweep.sweep}, ${clock(sweep.at)}, ${ago(now - sweep.at)} ago`; }

function before(last, now) { return last ? `Before that: ${last.name || last.status}, ${of(last, now)}.` : ""; }

/* What the card shows. verdict: the last one with its time `at`, in ms; fresh: whether it is of the program that runs now. swept: whether
   it is of a sweep before the open sweep. away: why nothing is heard, with lastAt (0: unknown); null where the box is heard. */
export function card({verdict, fresh, swept, health, windowS, away, detail, lastAt, now}) {
  if (away !== null) {
    const since = lastAt ? `Last heard at ${clock(lastAt)}, ${ago(now - lastAt)} ago.` : "";
    return {tone: "away", status: "off", words: away, advice: since, small: before(verdict, now), detail};
  }
  if (health && health.skin !== "streaming") {
    const [words, advice] = skin(health.skin);
    return {tone: "bad", status: "no skin", words, advice: `${advice[0].toUpperCase()}${advice.slice(1)}.`, small: before(verdict, now), detail: health.trouble};
  }
  const next = !health ? "" : health.sweeping ? "Sweeping now" : health.ready ? "Ready for the next sweep" : "Not ready: wait";
  if (!verdict || !fresh) {
    const words = !health ? "Waiting" : health.ready || health.sweeping ? "Ready" : "Not ready";
    return {tone: "plain", status: "", words, advice: "No sweep yet since the box was started.", small: before(verdict, now), detail: "", next};
  }
  if (swept) return {tone: "plain", status: "", words: "Sweeping", advice: "", small: before(verdict, now), detail: ""};
  return answer(verdict, windowS, next, now);
}

function answer(verdict, windowS, next, now) {
  const moved = verdict.moved !== null, status = moved && (verdict.status === "ok" || verdict.status === "unknown") ? "displaced" : verdict.status;
  let [tone, words, advice] = WORDS[status] ?? ["bad", verdict.status, verdict.reason];
  if (verdict.status === "short" && windowS) advice = `Slide for longer than ${windowS} s.`;
  const named = verdict.status === "ok", candidate = verdict.label ? `${verdict.name}, ${percentAtMost(verdict.probability)}` : "";
  const more = [named ? percent(verdict.probability) : candidate && `Perhaps ${candidate}`,
    verdict.fused > 1 ? `${verdict.fused} sweeps of one object` : "", verdict.share < 1 ? `early, at ${percent(verdict.share)} of the window` : ""];
  return {tone, status: named && !moved ? "ok" : status, words: named ? verdict.name : words, advice, next, of: of(verdict, now),
    small: more.filter(Boolean).join(", "), moved: verdict.moved,
    detail: [verdict.detail === verdict.moved ? "" : verdict.detail, verdict.reason].filter(Boolean).join("; "), named};
}

export function drawCard(shown) {
  const one = byId("verdict"), label = byId("label");
  one.dataset.tone = shown.tone;
  byId("sign").firstElementChild.setAttribute("d", SIGNS[shown.tone]);
  mark(byId("status"), shown.status);
  byId("status").hidden = !shown.named; // the words say the same where there is no label
  put("which", shown.of ?? "");
  if (label.textContent !== shown.words) {
    label.style.setProperty("--wide", widest(shown.words).toFixed(2));
    label.style.setProperty("--whole", Math.max(1, width(shown.words)).toFixed(2));
  }
  put("label", shown.words);
  put("advice", shown.advice);
  put("sure", shown.small);
  put("next", shown.next ?? "");
  byId("why").hidden = !shown.detail;
  put("detail", shown.detail);
  const moved = shown.moved ?? null; // a card without an answer has none
  if (!changed(byId("moved"), moved)) return;
  fill(byId("moved"), ...(moved === null ? [] : [`${moved}: `]));
  if (moved !== null) Object.assign(made("a", "", "align the skin", byId("moved")), {href: "#align"});
}
