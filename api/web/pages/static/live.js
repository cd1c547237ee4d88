// The live view of a test: its own drawing on two canvases, fed by a WebSocket.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const words = JSON.parse(document.getElementById("words").textContent);
const STALE_S = 0.5;
const FONT = "system-ui, 'DejaVu Sans', sans-serif";
let colours = {};
const byId = (name) => document.getElementById(name);
const state = {
  test: data.test, heard: 0, torqueAge: 0, connected: true, dirty: true, duration: (data.test.planned || {}).duration_s || data.test.duration_s || 0,
  time: [], low: [], high: [], pulseTime: [], width: [], elapsed: 0,
};

function shown(text) { return String(text).replace("-", "−"); }
function segmentWords(name) { const [kind, number] = name.split(" "); return words.segments[name] || (words.segments[kind] ? words.segments[kind] + " " + number : name); }
const parts = () => state.laid || (state.test.planned || {}).segments || [];
function say(name, text) { const box = byId(name); if (box.textContent !== text) box.textContent = text; }

function take(message) {
  if (message.type === "history") {
    Object.assign(state, { time: message.time_s, low: message.torque_min_nm, high: message.torque_max_nm, pulseTime: message.pulse_time_s, width: message.pulse_width_us });
    if (message.duration_s) state.duration = message.duration_s;
    if (data.sensor) takeAngles(message);
  } else if (message.type === "live") {
    state.heard = performance.now();
    state.torqueAge = message.torque_age_s;
    if (message.test_id === state.test.id) addFrame(message);
    showNumbers(message);
  } else if (message.type === "adaptive") {
    showAdaptive(message);
  } else if (message.type === "joint") {
    showJoint(message);
  } else if (message.type === "test") {
    showTest(message.test, message.words);
    if (message.test.state !== "running") showEnough(false);
  } else if (message.type === "link" || message.type === "idle") {
    state.connected = message.type === "link" ? message.connected : message.rig_connected;
  }
  state.dirty = true;
}

function showEnough(may) { // the button that ends a test well, where it has one
  const form = byId("enough");
  if (form) form.hidden = !may;
}

function addFrame(message) {
  state.elapsed = message.elapsed_s;
  if (message.duration_s) state.duration = message.duration_s;
  state.time.push(...message.time_s); state.low.push(...message.torque_min_nm); state.high.push(...message.torque_max_nm);
  state.pulseTime.push(...message.pulse_time_s); state.width.push(...message.pulse_width_us);
  if (message.pauses.length) {
    say("paused", words.paused.replace("{time}", shown(message.pauses[message.pauses.length - 1].for_s.toFixed(1)))); byId("paused").hidden = false;
  }
  if (data.sensor) takeAngles(message);
  if (state.test.joint) showTorqueTime(message.torque_time_nms);
  if (!state.test.adaptive && !(state.test.joint && state.test.joint.coverage)) return;
  if (state.test.adaptive) showDose(message.torque_time_nms);
  if (laidEnd(message.laid_segments) !== laidEnd(state.laid || [])) { state.laid = message.laid_segments; drawTrack(); }
}

function laidEnd(segments) { // the end of a test replaces a segment that was laid: their number stays
  const last = segments[segments.length - 1];
  return last ? last.name + " " + last.end_s : "";
}

function showNumbers(message) {
  const last = message.torque_max_nm.length - 1;
  if (last >= 0) say("torque", shown(((message.torque_max_nm[last] + message.torque_min_nm[last]) / 2).toFixed(2)) + " N·m");
  if (message.pulse_width_us.length) say("width", message.pulse_width_us[message.pulse_width_us.length - 1].toFixed(0) + " µs");
  if (message.test_id !== state.test.id) return;
  showSegment(message.segment);
  say("dose", shown((message.charge_uc / 1000).toFixed(2)) + " mC" + " · " + words.pulses.replace("{count}", message.sent_pulses));
  say("left", Math.max(0, Math.ceil(message.duration_s - message.elapsed_s)) + " s");
  say("lost", String(message.lost_samples));
  byId("progress").value = message.duration_s ? message.elapsed_s / message.duration_s : 0;
}

let segment = null;
function showSegment(name) {
  say("segment", name ? segmentWords(name) : "–");
  byId("segment").title = name || "";
  if (segment && name && name !== segment) tone.segment();
  segment = name;
}

function showTest(test, told) {
  const wasOpen = !state.test.done;
  state.test = test;
  if (test.state !== "running") byId("paused").hidden = true;
  const tag = byId("state");
  tag.textContent = words.states[test.state] || test.state; tag.className = "tag tag-" + test.state;
  const job = test.identification;
  if (segment && test.state !== "running") { segment = null; tone.end(); }
  if (test.state === "identifying") {
    delete byId("live").dataset.stopKeys; // nothing is sent any more: Space is a key like any other
    say("left", job && job.time_left_s ? Math.ceil(job.time_left_s) + " s" : "–");
    say("segment", words.identifying); byId("segment").title = told.work; byId("progress").value = job ? job.progress : 0;
  }
  const carrying = byId("keep-plain");
  if (carrying) carrying.hidden = !(test.state === "identifying" && job && job.verb === "carry");
  if (test.reason) { say("reason", told.reason); byId("reason").hidden = false; }
  const next = test.model_id ? "/models/" + test.model_id : test.joint && test.state === "completed" ? "/participants/" + test.participant + "/joint" : location.pathname;
  if (test.done && wasOpen) leave(next);
}

function leave(next) { // not before the answer to what was pressed
  if (answering()) setTimeout(() => leave(next), 1000); else location.replace(next);
}

function age() {
  if (state.test.done) return;
  const since = state.heard ? (performance.now() - state.heard) / 1000 : null;
  const seconds = since === null ? null : since + state.torqueAge;
  say("age", seconds === null ? "–" : seconds < 1 ? Math.round(seconds * 1000) + " ms" : shown(seconds.toFixed(1)) + " s");
  const running = state.test.state === "running";
  const stale = refused || (running && (!state.connected || !open || seconds === null || seconds > STALE_S));
  byId("stale").hidden = !stale;
  byId("live").classList.toggle("is-stale", stale);
  if (stale) say("stale", refused ? words.signed_out : !open ? words.no_service : !state.connected ? words.no_rig : words.old);
}

// ---- drawing -----------------------------------------------------------------------------------

function nice(span, count) {
  const rough = span / count, power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((m) => m * power).find((step) => step >= rough);
}

// `across`: where the chart ends on the right, and what is said there; null: another chart below says it.
function frame(canvas, low, high, title, unit, across = { last: Math.max(state.duration, 1), words: words.time }) {
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  const w = Math.round(box.width * ratio), h = Math.round(box.height * ratio);
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const pen = canvas.getContext("2d");
  pen.reset(); pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, box.width, box.height);
  const area = { left: 62, right: box.width - 10, top: 26, bottom: box.height - (across ? 34 : 10) };
  const span = across ? across.last : Math.max(state.duration, 1);
  const x = (t) => area.left + (t / span) * (area.right - area.left);
  const y = (v) => area.bottom - ((v - low) / (high - low)) * (area.bottom - area.top);
  pen.font = "13px " + FONT; pen.fillStyle = colours.dim; pen.lineWidth = 1; pen.strokeStyle = colours.grid;
  const ystep = nice(high - low, box.height < 170 ? 3 : 5), xstep = nice(span, box.width < 520 ? 4 : 8);
  pen.textAlign = "right"; pen.textBaseline = "middle";
  for (let v = Math.ceil(low / ystep) * ystep; v <= high + 1e-9; v += ystep) {
    pen.beginPath(); pen.moveTo(area.left, y(v)); pen.lineTo(area.right, y(v)); pen.stroke();
    pen.fillText(shown(+v.toFixed(6)), area.left - 8, y(v));
  }
  pen.textAlign = "center"; pen.textBaseline = "top";
  for (let t = 0; across && t <= span + 1e-9; t += xstep) pen.fillText(shown(+t.toFixed(6)), x(t), area.bottom + 5);
  pen.textAlign = "right"; if (across) pen.fillText(across.words, area.right, area.bottom + 20);
  pen.textAlign = "left"; pen.fillStyle = colours.ink; pen.font = "600 13px " + FONT; pen.fillText(title + (unit && " (" + unit + ")"), 4, 3);
  pen.beginPath(); pen.rect(area.left, 0, area.right - area.left + 2, area.bottom + 1); pen.clip();
  return { pen, x, y, area };
}

function segments({ pen, area, x }) {
  for (const part of parts()) {
    if (part.name !== "validate") continue;
    pen.fillStyle = colours["held-out"];
    pen.fillRect(x(part.start_s), area.top, x(part.end_s) - x(part.start_s), area.bottom - area.top);
  }
}

function limitLine({ pen, y, area }, value, text, colour = colours.limit) {
  pen.save();
  pen.strokeStyle = pen.fillStyle = colour; pen.lineWidth = 1.5; pen.setLineDash([7, 5]);
  pen.beginPath(); pen.moveTo(area.left, y(value)); pen.lineTo(area.right, y(value)); pen.stroke();
  pen.font = "600 12px " + FONT; pen.textAlign = "right"; pen.textBaseline = "top";
  pen.fillText(text.replace("{limit}", shown(+value.toFixed(1))), area.right - 4, y(value) + 4);
  pen.restore();
}

function drawTorque() {
  const limit = data.limits.torque_nm;
  let low = 0, high = limit || 1;
  for (let i = 0; i < state.time.length; i++) { if (state.low[i] < low) low = state.low[i]; if (state.high[i] > high) high = state.high[i]; }
  const room = (high - low) * 0.06;
  const drawn = frame(byId("torque-chart"), low - (low < 0 ? room : 0), high + room, words.torque, "N·m");
  const { pen, x, y, area } = drawn;
  segments(drawn);
  const columns = new Map(); // one envelope a pixel: min and max, so that no peak is lost
  for (let i = 0; i < state.time.length; i++) {
    const column = Math.round(x(state.time[i])), known = columns.get(column);
    if (!known) columns.set(column, [state.low[i], state.high[i]]);
    else { if (state.low[i] < known[0]) known[0] = state.low[i]; if (state.high[i] > known[1]) known[1] = state.high[i]; }
  }
  const points = [...columns.entries()];
  pen.fillStyle = colours["torque-band"]; pen.strokeStyle = colours.torque; pen.lineWidth = 1.6; pen.lineJoin = "round";
  pen.beginPath();
  points.forEach(([column, [, top]], i) => (i ? pen.lineTo(column, y(top)) : pen.moveTo(column, y(top))));
  points.reverse().forEach(([column, [bottom]]) => pen.lineTo(column, y(bottom)));
  pen.fill();
  pen.beginPath();
  points.reverse().forEach(([column, [bottom, top]], i) => { const mid = y((bottom + top) / 2); if (i) pen.lineTo(column, mid); else pen.moveTo(column, mid); });
  pen.stroke();
  if (limit) limitLine(drawn, limit, words.stops);
  if (limit && low < -limit / 2) limitLine(drawn, -limit, words.stops);
  cursor(pen, x, area);
}

function drawWidth() {
  const limit = data.limits.pulse_width_us;
  let high = limit || 100;
  for (const value of data.planned_us) if (value > high) high = value;
  for (const value of state.width) if (value > high) high = value;
  const drawn = frame(byId("width-chart"), 0, high * 1.08, words.width, "µs");
  const { pen, x, y, area } = drawn;
  segments(drawn);
  stairs(pen, x, y, data.planned_us.map((_, i) => i / data.pulse_rate_hz), data.planned_us, colours.plan, 1.2);
  stairs(pen, x, y, state.pulseTime, state.width, colours.width, 1.8);
  if (limit) limitLine(drawn, limit, words.comfort);
  cursor(pen, x, area);
}

function stairs(pen, x, y, times, values, colour, width) {
  pen.strokeStyle = colour; pen.lineWidth = width; pen.beginPath();
  for (let i = 0; i < times.length; i++) {
    if (i) pen.lineTo(x(times[i]), y(values[i - 1])); else pen.moveTo(x(times[i]), y(0));
    if (!i || values[i] !== values[i - 1]) pen.lineTo(x(times[i]), y(values[i]));
  }
  pen.stroke();
}

function cursor(pen, x, area) {
  if (state.test.done || !state.elapsed) return;
  pen.strokeStyle = colours.cursor; pen.lineWidth = 1; pen.beginPath();
  pen.moveTo(x(state.elapsed), area.top); pen.lineTo(x(state.elapsed), area.bottom); pen.stroke();
}

function drawTrack() {
  const track = byId("track"), shownParts = parts(), last = shownParts[shownParts.length - 1];
  const open = state.laid && last && state.duration > last.end_s ? [{ name: "rest", start_s: last.end_s, end_s: state.duration }] : [];
  track.replaceChildren(...[...shownParts, ...open].map((part) => {
    const box = document.createElement("span");
    box.style.flexGrow = part.end_s - part.start_s; box.style.flexBasis = "0"; box.textContent = part.name === "rest" ? "" : segmentWords(part.name); box.title = part.name; box.className = "part part-" + part.name.split(" ")[0];
    return box;
  }));
  for (const box of track.children) if (box.scrollWidth > box.clientWidth) box.textContent = box.textContent.split(" (")[0]; // what stands in brackets has no room
}

function draw() {
  if (state.dirty) { state.dirty = false; drawTorque(); drawWidth(); if (state.test.adaptive) drawKnown(); if (data.sensor) drawAngles(); }
  requestAnimationFrame(draw);
}

// ---- the line to the service -------------------------------------------------------------------

const REFUSED = [4401, 4403]; // the session has ended, is locked or may no longer: somebody may sign in again in another tab
let open = false, refused = false;
function connect() {
  const socket = new WebSocket(location.origin.replace(/^http/, "ws") + "/v1/tests/" + data.test.id + "/live");
  socket.onmessage = (event) => {
    const message = JSON.parse(event.data);
    if (message.type === "problem") return; // why it closes is in the code of its closing
    open = true; refused = false;
    take(message);
  };
  socket.onclose = (event) => { open = false; refused = REFUSED.includes(event.code); if (!state.test.done) setTimeout(connect, refused ? 2000 : 500); };
}

// ---- colours and the window --------------------------------------------------------------------

function readColours() {
  for (const name of ["ink", "dim", "grid", "torque", "torque-band", "width", "plan", "limit", "cursor", "held-out", "zero", "mark", "chart"]) colours[name] = colourOf(name);
  state.dirty = true;
}

function fit() { // the charts take what the window has below the page's head
  const live = byId("live");
  live.style.setProperty("--above", Math.round(live.getBoundingClientRect().top + scrollY) + "px");
  state.dirty = true;
}

addEventListener("resize", fit);
addEventListener("colours", readColours);
new ResizeObserver(fit).observe(document.getElementById("main"));
readColours();
fit();
if (state.test.adaptive) { state.laid = []; showAdaptive(state.test.adaptive); }
if (state.test.joint) { if (state.test.joint.coverage) state.laid = []; showJoint(state.test.joint); }
drawTrack();
connect();
setInterval(age, 100);
requestAnimationFrame(draw);
