/* The start: a way to each page, what is connected, and the other boxes of the site. */

import {sentence, shiftOf} from "./history.js";
import {asked, byId, changed, fill, made, put} from "./parts.js";

const EVERY_MS = 10_000, OTHER_PORT = "8138"; // of the pages that record and teach
let askedAt = -Infinity;

/* A page that runs only while a person records or teaches: the way to it, or how to start it. */
function tile(id, runs, words) {
  const one = byId(id), text = one.querySelector("p");
  if (runs) one.href = `${location.protocol}//${location.hostname}:${OTHER_PORT}/`;
  else one.removeAttribute("href");
  one.querySelector("code").hidden = runs;
  const said = runs ? "It runs now." : words;
  if (text.textContent !== said) text.textContent = said;
}

async function askForBoxes() {
  askedAt = performance.now();
  const found = await asked("boxes/0") ?? [];
  if (!changed(byId("boxes"), found)) return;
  byId("boxes-card").hidden = !found.length;
  fill(byId("boxes"), ...found.filter((one) => /^https?:\/\//.test(one.address)).map((one) => {
    const row = made("li");
    made("a", "", one.name, row).href = one.address;
    return row;
  }));
}

/* known: what the box has said. last: its last verdict in words. */
export function drawStart(known, last, heardAt, again) {
  const {hello, health} = known;
  put("start-watch", last);
  put("start-history", sentence(shiftOf(heardAt, again)));
  tile("start-teach", Boolean(health?.teach), "Show the box materials, and let it learn them. On the box:");
  tile("start-record", Boolean(health?.recording && !health.teach), "Record sweeps for training on a desktop. On the box:");
  const there = !hello || !health ? {} : {skin: `${hello.skin}, ${health.skin}`, bundle: health.model || health.bundle || "none",
    frames: `${hello.format.rows}x${hello.format.cols} taxels at ${hello.format.rate_hz} Hz`, ...(hello.finger ? {finger: hello.finger} : {})};
  if (changed(byId("there"), there)) {
    fill(byId("there"), ...Object.entries(there).flatMap(([name, value]) => [made("dt", "", name), made("dd", "", value)]));
  }
  if (performance.now() - askedAt > EVERY_MS) askForBoxes();
}
