// The live view of a test: its own drawing on two canvases, fed by a WebSocket.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const STALE_S = 0.5;
const INK = "#1b2733", DIM = "#52606d", GRID = "#e6eaee", TORQUE = "#0b6b75", WIDTH = "#b4690e", PLAN = "#cfd6dc";
const byId = (name) => document.getElementById(name);
const state = {
  test: data.test, heard: 0, torqueAge: 0, connected: true, dirty: true, duration: (data.test.planned || {}).duration_s || data.test.duration_s || 0,
  time: [], low: [], high: [], pulseTime: [], width: [], elapsed: 0,
};

function minus(text) { return text.replace("-", "−"); }
function say(name, text) { const box = byId(name); if (box.textContent !== text) box.textContent = text; }

function take(message) {
  if (message.type === "history") {
    Object.assign(state, { time: message.time_s, low: message.torque_min_nm, high: message.torque_max_nm, pulseTime: message.pulse_time_s, width: message.pulse_width_us });
    if (message.duration_s) state.duration = message.duration_s;
  } else if (message.type === "live") {
    state.heard = performance.now();
    state.torqueAge = message.torque_age_s;
    if (message.test_id === state.test.id) addFrame(message);
    showNumbers(message);
  } else if (message.type === "test") {
    showTest(message.test);
  } else if (message.type === "link" || message.type === "idle") {
    state.connected = message.type === "link" ? message.connected : message.rig_connected;
  }
  state.dirty = true;
}

function addFrame(message) {
  state.elapsed = message.elapsed_s;
  if (message.duration_s) state.duration = message.duration_s;
  state.time.push(...message.time_s); state.low.push(...message.torque_min_nm); state.high.push(...message.torque_max_nm);
  state.pulseTime.push(...message.pulse_time_s); state.width.push(...message.pulse_width_us);
}

function showNumbers(message) {
  const last = message.torque_max_nm.length - 1;
  if (last >= 0) say("torque", minus(((message.torque_max_nm[last] + message.torque_min_nm[last]) / 2).toFixed(2)) + " N·m");
  if (message.pulse_width_us.length) say("width", message.pulse_width_us[message.pulse_width_us.length - 1].toFixed(0) + " µs");
  if (message.test_id !== state.test.id) return;
  say("segment", message.segment || "–");
  say("left", Math.max(0, Math.ceil(message.duration_s - message.elapsed_s)) + " s");
  say("lost", String(message.lost_samples));
  byId("progress").value = message.duration_s ? message.elapsed_s / message.duration_s : 0;
}

let leaving = false;  // a form was sent, be it the stop: its answer is what comes next, not this page's own
addEventListener("submit", () => { leaving = true; });
addEventListener("pageshow", () => { leaving = false; });

function showTest(test) {
  const wasOpen = !state.test.done;
  state.test = test;
  const tag = byId("state");
  tag.textContent = test.state; tag.className = "tag tag-" + test.state;
  const job = test.identification;
  if (test.state === "identifying") { say("left", "identifying"); say("segment", job ? job.text || job.state : "identifying"); byId("progress").value = 1; }
  if (test.reason) { say("reason", test.reason); byId("reason").hidden = false; }
  if (test.done && wasOpen && !leaving) location.replace(test.model_id ? "/models/" + test.model_id : location.pathname);
}

function age() {
  if (state.test.done) return;
  const since = state.heard ? (performance.now() - state.heard) / 1000 : null;
  const seconds = since === null ? null : since + state.torqueAge;
  say("age", seconds === null ? "–" : seconds < 1 ? Math.round(seconds * 1000) + " ms" : seconds.toFixed(1) + " s");
  const running = state.test.state === "running";
  const stale = running && (!state.connected || !open || seconds === null || seconds > STALE_S);
  byId("stale").hidden = !stale;
  byId("live").classList.toggle("is-stale", stale);
  if (stale) say("stale", !open ? "No connection to the service. Display out of date: do not rely on it. If the stop button does not answer, use the emergency switch on the stimulator."
    : !state.connected ? "The rig cannot be reached. Display out of date: do not rely on it; use the emergency switch on the stimulator if unsure." : "Display out of date. Do not rely on it; press Stop if unsure.");
}

// ---- drawing -----------------------------------------------------------------------------------

function nice(span, count) {
  const rough = span / count, power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((m) => m * power).find((step) => step >= rough);
}

function frame(canvas, low, high, title, unit) {
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  const w = Math.round(box.width * ratio), h = Math.round(box.height * ratio);
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const pen = canvas.getContext("2d");
  pen.reset(); pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, box.width, box.height);
  const area = { left: 62, right: box.width - 10, top: 26, bottom: box.height - 34 };
  const span = Math.max(state.duration, 1);
  const x = (t) => area.left + (t / span) * (area.right - area.left);
  const y = (v) => area.bottom - ((v - low) / (high - low)) * (area.bottom - area.top);
  pen.font = "13px system-ui, 'DejaVu Sans', sans-serif"; pen.fillStyle = DIM; pen.lineWidth = 1; pen.strokeStyle = GRID;
  const ystep = nice(high - low, 5), xstep = nice(span, box.width < 520 ? 4 : 8);
  pen.textAlign = "right"; pen.textBaseline = "middle";
  for (let v = Math.ceil(low / ystep) * ystep; v <= high + 1e-9; v += ystep) {
    pen.beginPath(); pen.moveTo(area.left, y(v)); pen.lineTo(area.right, y(v)); pen.stroke();
    pen.fillText(minus(String(+v.toFixed(6))), area.left - 8, y(v));
  }
  pen.textAlign = "center"; pen.textBaseline = "top";
  for (let t = 0; t <= span + 1e-9; t += xstep) pen.fillText(String(+t.toFixed(6)), x(t), area.bottom + 5);
  pen.textAlign = "right"; pen.fillText("Time (s)", area.right, area.bottom + 20);
  pen.textAlign = "left"; pen.fillStyle = INK; pen.font = "600 13px system-ui, 'DejaVu Sans', sans-serif"; pen.fillText(title + " (" + unit + ")", 4, 3);
  segments(pen, area, x);
  pen.beginPath(); pen.rect(area.left, 0, area.right - area.left + 2, area.bottom + 1); pen.clip();
  return { pen, x, y, area };
}

function segments(pen, area, x) {
  for (const part of (state.test.planned || {}).segments || []) {
    if (part.name !== "validate") continue;
    pen.fillStyle = "rgba(180,105,14,.06)";
    pen.fillRect(x(part.start_s), area.top, x(part.end_s) - x(part.start_s), area.bottom - area.top);
  }
}

function drawTorque() {
  let low = 0, high = 1;
  for (let i = 0; i < state.time.length; i++) { if (state.low[i] < low) low = state.low[i]; if (state.high[i] > high) high = state.high[i]; }
  const room = (high - low) * 0.06;
  const { pen, x, y, area } = frame(byId("torque-chart"), low - (low < 0 ? room : 0), high + room, "Elbow torque", "N·m");
  const columns = new Map(); // one envelope a pixel: min and max, so that no peak is lost
  for (let i = 0; i < state.time.length; i++) {
    const column = Math.round(x(state.time[i])), known = columns.get(column);
    if (!known) columns.set(column, [state.low[i], state.high[i]]);
    else { if (state.low[i] < known[0]) known[0] = state.low[i]; if (state.high[i] > known[1]) known[1] = state.high[i]; }
  }
  const points = [...columns.entries()];
  pen.fillStyle = "rgba(11,107,117,.25)"; pen.strokeStyle = TORQUE; pen.lineWidth = 1.6; pen.lineJoin = "round";
  pen.beginPath();
  points.forEach(([column, [, top]], i) => (i ? pen.lineTo(column, y(top)) : pen.moveTo(column, y(top))));
  points.reverse().forEach(([column, [bottom]]) => pen.lineTo(column, y(bottom)));
  pen.fill();
  pen.beginPath();
  points.reverse().forEach(([column, [bottom, top]], i) => { const mid = y((bottom + top) / 2); if (i) pen.lineTo(column, mid); else pen.moveTo(column, mid); });
  pen.stroke();
  cursor(pen, x, area);
}

function drawWidth() {
  let high = 100;
  for (const value of data.planned_us) if (value > high) high = value;
  for (const value of state.width) if (value > high) high = value;
  const { pen, x, y, area } = frame(byId("width-chart"), 0, high * 1.08, "Pulse width", "µs");
  stairs(pen, x, y, data.planned_us.map((_, i) => i / data.pulse_rate_hz), data.planned_us, PLAN, 1.2);
  stairs(pen, x, y, state.pulseTime, state.width, WIDTH, 1.8);
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
  pen.strokeStyle = "#9aa5b1"; pen.lineWidth = 1; pen.beginPath();
  pen.moveTo(x(state.elapsed), area.top); pen.lineTo(x(state.elapsed), area.bottom); pen.stroke();
}

function drawTrack() {
  const track = byId("track"), parts = (state.test.planned || {}).segments || [];
  track.replaceChildren(...parts.map((part) => {
    const box = document.createElement("span");
    box.style.flexGrow = part.end_s - part.start_s; box.style.flexBasis = "0"; box.textContent = part.name === "rest" ? "" : part.name; box.className = "part part-" + part.name;
    return box;
  }));
}

function draw() {
  if (state.dirty) { state.dirty = false; drawTorque(); drawWidth(); }
  requestAnimationFrame(draw);
}

// ---- the line to the service -------------------------------------------------------------------

let open = false;
function connect() {
  const socket = new WebSocket(location.origin.replace(/^http/, "ws") + "/v1/tests/" + data.test.id + "/live");
  socket.onopen = () => { open = true; };
  socket.onmessage = (event) => take(JSON.parse(event.data));
  socket.onclose = () => { open = false; if (!state.test.done) setTimeout(connect, 500); };
}

addEventListener("resize", () => { state.dirty = true; });
drawTrack();
connect();
setInterval(age, 100);
requestAnimationFrame(draw);
