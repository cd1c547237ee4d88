// A line chart on a canvas, in the colours of page.css.
"use strict";
const FONT = "system-ui, 'DejaVu Sans', sans-serif";
let colours = {};
const colour = (name) => (colours[name] ??= colourOf(name));
const shown = (value, digits) => value.toFixed(digits).replace("-", "−");
const extent = (values, low, high) => [values.reduce((a, b) => Math.min(a, b), low), values.reduce((a, b) => Math.max(a, b), high)];
addEventListener("colours", () => { colours = {}; });

function niceStep(span, count) {
  const rough = span / count, power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((m) => m * power).find((step) => step >= rough);
}

// `across`: the value at the right end, and what is said there (empty: the chart below says it). `shades`: [from, to, colour];
// `bands`: [x, low, high, colour]; `lines`: [x, y, colour, in steps]; `limits`: [value, text]; `cursor`: a value, if not 0.
function chart(id, { title, low, high, across: [last, words], shades = [], bands = [], lines = [], limits = [], cursor = 0 }) {
  const canvas = document.getElementById(id), ratio = devicePixelRatio || 1, { width, height } = canvas.getBoundingClientRect();
  canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
  const left = 62, right = width - 16, top = 26, bottom = height - (words ? 34 : 10), pen = canvas.getContext("2d");
  const x = (value) => left + (value / last) * (right - left), y = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);

  function draw(name, lineWidth, dash, points) {
    pen.strokeStyle = colour(name); pen.lineWidth = lineWidth; pen.setLineDash(dash); pen.lineJoin = "round";
    pen.beginPath();
    for (const [at_x, at_y] of points) pen.lineTo(at_x, at_y);
    pen.stroke();
  }
  function write(text, at_x, at_y, align, baseline, name = "dim", font = "13px ") {
    Object.assign(pen, { font: font + FONT, fillStyle: colour(name), textAlign: align, textBaseline: baseline });
    pen.fillText(text, at_x, at_y);
  }

  pen.scale(ratio, ratio);
  const step_y = niceStep(high - low, height < 170 ? 3 : 5), step_x = niceStep(last, width < 520 ? 4 : 8);
  for (let value = Math.ceil(low / step_y) * step_y; value <= high + 1e-9; value += step_y) {
    draw(Math.abs(value) < 1e-9 ? "zero" : "grid", 1, [], [[left, y(value)], [right, y(value)]]);
    write(String(+value.toFixed(6)).replace("-", "−"), left - 8, y(value), "right", "middle");
  }
  for (let value = 0; words && value <= last + 1e-9; value += step_x) write(String(+value.toFixed(6)), x(value), bottom + 5, "center", "top");
  write(words, right, bottom + 20, "right", "top");
  write(title, 4, 3, "left", "top", "ink", "600 13px ");
  pen.beginPath(); pen.rect(left, 0, right - left + 2, bottom + 1); pen.clip();
  for (const [from, to, name] of shades) { pen.fillStyle = colour(name); pen.fillRect(x(from), top, x(to) - x(from), bottom - top); }
  for (const [xs, lows, highs, name] of bands) {
    pen.beginPath();
    xs.forEach((value, k) => pen.lineTo(x(value), y(highs[k])));
    for (let k = xs.length - 1; k >= 0; k--) pen.lineTo(x(xs[k]), y(lows[k]));
    pen.fillStyle = colour(name); pen.fill();
  }
  for (const [xs, ys, name, steps] of lines) draw(name, 1.8, [], xs.flatMap((value, k) => (steps ? [[x(value), y(k ? ys[k - 1] : 0)], [x(value), y(ys[k])]] : [[x(value), y(ys[k])]])));
  for (const [value, text] of limits) {
    draw("limit", 1.5, [7, 5], [[left, y(value)], [right, y(value)]]);
    write(text, right - 4, y(value) + (y(value) + 20 < bottom ? 4 : -16), "right", "top", "limit", "600 12px ");
  }
  if (cursor) draw("cursor", 1, [], [[x(cursor), top], [x(cursor), bottom]]);
}
