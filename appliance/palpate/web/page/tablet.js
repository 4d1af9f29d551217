/* The page on a tablet at the robot: the whole screen, a screen that stays on, a tone on a refusal, and keys. */

import {byId, made, put} from "./parts.js";

const TONES = {warn: [660, 660], bad: [440, 330], away: [440, 330, 220]}, TONE_S = .18;
let lock = null, audio = null;

/* Keeps the screen on while the page is seen; browsers allow it over HTTPS and on the machine itself. */
async function stayAwake() {
  if (document.visibilityState !== "visible" || (lock && !lock.released)) return;
  try {
    lock = await navigator.wakeLock.request("screen");
  } catch {
    lock = null;
  }
  put("awake", lock ? "the screen stays on" : "this browser may turn the screen off");
}

export function full(on) {
  document.body.classList.toggle("full", on);
  byId("full").setAttribute("aria-pressed", on);
  if (on) document.documentElement.requestFullscreen?.().catch(() => {}); // without it the card fills the window
  else if (document.fullscreenElement) document.exitFullscreen();
}

function sound(on) {
  byId("tone").setAttribute("aria-pressed", on);
  if (on && !audio) audio = new AudioContext(); // browsers allow it after a touch or a key alone
}

/* Plays the tone of a refusal, if it is wanted. */
export function play(tone) {
  if (byId("tone").getAttribute("aria-pressed") !== "true" || !TONES[tone]) return;
  TONES[tone].forEach((hz, i) => {
    const one = audio.createOscillator(), at = audio.currentTime + i * TONE_S * 1.3;
    one.frequency.value = hz;
    one.connect(audio.destination);
    one.start(at);
    one.stop(at + TONE_S);
  });
}

function toggle(id, act) { return () => act(byId(id).getAttribute("aria-pressed") !== "true"); }

/* keys: what further keys do, by letter: [in words, function]. */
export function listenToTablet(keys) {
  const every = {f: ["full screen, and back", toggle("full", full)], t: ["tone on a refusal, on and off", toggle("tone", sound)], ...keys};
  for (const [letter, [words]] of Object.entries(every)) {
    made("dt", "", letter, byId("keys"));
    made("dd", "", words, byId("keys"));
  }
  byId("full").addEventListener("click", every.f[1]);
  byId("tone").addEventListener("click", every.t[1]);
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest("input, textarea, select")) return;
    if (event.key === "Escape") full(false);
    every[event.key.toLowerCase()]?.[1]();
  });
  document.addEventListener("fullscreenchange", () => { if (!document.fullscreenElement) full(false); });
  document.addEventListener("visibilitychange", stayAwake);
  stayAwake();
}
