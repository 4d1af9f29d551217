/* Pictures of numbers on a canvas: a sweep's signal and spectrogram, latency and loss over time. */

import {count} from "./parts.js";
import {shades} from "./skin.js";

const LEFT = 48, BOTTOM = 20, TOP = 22, RIGHT = 6;

function css(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }

/* A canvas in the screen's own pixels, cleared: its context, width and height of what is inside the axes. */
function begin(canvas) {
  const {width, height} = canvas.getBoundingClientRect(), ratio = devicePixelRatio || 1, paper = canvas.getContext("2d");
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  paper.scale(ratio, ratio);
  paper.font = "12px system-ui, sans-serif";
  return [paper, Math.max(1, width - LEFT - RIGHT), Math.max(1, height - TOP - BOTTOM)];
}

/* A round number of at least `value`: 1, 2 or 5 of some power of ten. */
export function round(value) {
  if (!(value > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((n) => n * power).find((n) => n >= value * (1 - 1e-9));
}

/* up, along: what the axes show, with their units. ends: of the lower one. */
function axes(paper, w, h, low, high, up, along, ends) {
  paper.strokeStyle = css("--line");
  paper.fillStyle = css("--grey");
  paper.lineWidth = 1;
  paper.textBaseline = "middle";
  paper.textAlign = "right";
  for (const [value, y] of [[high, TOP], [(low + high) / 2, TOP + h / 2], [low, TOP + h]]) {
    paper.beginPath();
    paper.moveTo(LEFT, Math.round(y) + .5);
    paper.lineTo(LEFT + w, Math.round(y) + .5);
    paper.stroke();
    paper.fillText(`${Number(value.toPrecision(3))}`, LEFT - 6, Math.max(y, TOP + 4));
  }
  paper.textBaseline = "alphabetic";
  paper.textAlign = "left";
  paper.fillText(ends[0], LEFT, TOP + h + 15);
  paper.textAlign = "right";
  paper.fillText(ends[1], LEFT + w, TOP + h + 15);
  paper.textAlign = "center";
  paper.fillText(along, LEFT + w / 2, TOP + h + 15);
  paper.textAlign = "left";
  paper.fillText(up, 0, 12);
}

function empty(canvas, text) {
  const [paper, w, h] = begin(canvas);
  paper.fillStyle = css("--grey");
  paper.textAlign = "center";
  paper.font = "14px system-ui, sans-serif";
  paper.fillText(text, LEFT + w / 2, TOP + h / 2);
  canvas.setAttribute("aria-label", text);
  return text;
}

/* picture: of appliance/palpate/web/sweep_picture.py, or null; why: what is said without one. unit: of its numbers. */
export function signal(canvas, picture, why, unit = "raw counts") {
  if (!picture) return empty(canvas, why);
  const [paper, w, h] = begin(canvas), {taxels, seconds} = picture;
  const most = round(Math.max(1, ...taxels.flatMap((one) => one.high)));
  const least = -round(-Math.min(0, ...taxels.flatMap((one) => one.low))) * (taxels.some((one) => Math.min(...one.low) < 0) ? 1 : 0);
  axes(paper, w, h, least, most, unit, "seconds", ["0", seconds.toFixed(1)]);
  paper.strokeStyle = css("--heat");
  paper.globalAlpha = Math.max(.25, 1 / Math.sqrt(taxels.length));
  const y = (value) => TOP + h - (h * (value - least)) / (most - least);
  for (const {low, high} of taxels) {
    paper.beginPath();
    low.forEach((value, i) => {
      const x = LEFT + (w * (i + .5)) / low.length;
      paper.lineTo(x, y(value));
      paper.lineTo(x, y(high[i]));
    });
    paper.stroke();
  }
  const drawn = taxels.length < picture.of ? `the ${taxels.length} most loaded of ${picture.of} taxels` : `${taxels.length} taxels`;
  canvas.setAttribute("aria-label", `${unit} of ${drawn} over ${seconds.toFixed(1)} s, at most ${Math.max(...taxels.flatMap((one) => one.high))}`);
}

export function spectrogram(canvas, picture, why) {
  if (!picture || picture.trouble) return empty(canvas, picture ? picture.trouble : why);
  const [paper, w, h] = begin(canvas), {spectrogram: shares, band_hz, step_s, top_hz} = picture;
  const most = Math.max(1e-9, ...shares.flat()), shade = shades(), y = (hz) => TOP + h - (h * Math.min(hz, top_hz)) / top_hz;
  axes(paper, w, h, 0, top_hz, "Hz", "seconds", ["0", (shares.length * step_s).toFixed(1)]);
  const dx = w / shares.length;
  shares.forEach((column, i) => column.forEach((share, k) => {
    paper.fillStyle = shade(Math.sqrt(share / most)).back;
    paper.fillRect(LEFT + i * dx, y((k + 1) * band_hz), dx + .6, y(k * band_hz) - y((k + 1) * band_hz) + .6);
  }));
  const loudest = shares.map((column) => column.indexOf(Math.max(...column))).sort((a, b) => a - b)[shares.length >> 1];
  const about = Math.min((loudest + .5) * band_hz, top_hz);
  canvas.setAttribute("aria-label", `spectrogram up to ${top_hz.toFixed(0)} Hz, strongest at about ${about.toFixed(0)} Hz`);
}

/* points: [milliseconds of the clock, value, whether it is marked]; as dots, or as bars where `bars`. */
export function course(canvas, points, {bars = false, clock, nothing}) {
  if (!points.length) return empty(canvas, nothing);
  const [paper, w, h] = begin(canvas), last = points[points.length - 1][0], first = Math.min(points[0][0], last - 600_000);
  const most = round(Math.max(bars ? .01 : 1, ...points.map((point) => point[1])));
  axes(paper, w, h, 0, most, bars ? "% of each minute" : "milliseconds", "time of day", [clock(first).slice(0, 5), clock(last).slice(0, 5)]);
  const x = (at) => LEFT + (w * (at - first)) / (last - first || 1), y = (value) => TOP + h - (h * value) / most;
  for (const marked of [false, true]) {
    paper.fillStyle = css(marked ? "--off" : "--heat");
    for (const [at, value] of points.filter((point) => Boolean(point[2]) === marked)) {
      if (bars) paper.fillRect(x(at) - 1, y(value), 2, TOP + h - y(value));
      else paper.fillRect(x(at) - 1.5, y(value) - 1.5, 3, 3);
    }
  }
}

/* spans: [index, all, unsure, unknown] of verdicts.trend; of: its from_s, to_s and span_s. label: a time in ms for the axis. What it
   shows, in words. */
export function trend(canvas, spans, of, label) {
  const sum = (k) => spans.reduce((all, span) => all + span[k], 0), all = sum(1);
  if (!all) return empty(canvas, "no sweep yet");
  const [paper, w, h] = begin(canvas), whole = Math.max(1, Math.ceil((of.to_s - of.from_s) / of.span_s)), dx = w / whole;
  const share = ([, n, unsure, unknown]) => 100 * (unsure + unknown) / n, most = Math.min(100, round(Math.max(5, ...spans.map(share))));
  axes(paper, w, h, 0, most, "% of the sweeps", "", [label(1000 * of.from_s), label(1000 * of.to_s)]);
  for (const [i, n, unsure, unknown] of spans) {
    let y = TOP + h;
    for (const [part, colour] of [[unknown, "--heat"], [unsure, "--off"]]) {
      const up = (h * 100 * part) / n / most;
      paper.fillStyle = css(colour);
      paper.fillRect(LEFT + i * dx + 1, y - up, Math.max(1, dx - 2), up);
      y -= up;
    }
    paper.fillStyle = css("--grey");
    paper.fillRect(LEFT + i * dx + 1, TOP + h - 1, Math.max(1, dx - 2), 2); // sweeps were made
  }
  return `unsure ${(100 * sum(2) / all).toFixed(1)} %, unknown ${(100 * sum(3) / all).toFixed(1)} % of ${count(all)} sweeps`;
}
