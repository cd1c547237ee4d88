// The page of a running test, fed by a WebSocket: numbers, charts, and how old they are.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const STALE_S = 0.5, DEG = 180 / Math.PI;
const SAMPLES = ["time_s", "torque_min_nm", "torque_max_nm", "pulse_time_s", "pulse_width_us"];
const series = { time_s: [], torque_min_nm: [], torque_max_nm: [], pulse_time_s: [], pulse_width_us: [], angle_time_s: [], angle_rad: [], velocity_rad_s: [] };
const planned = data.test.planned || {}, grows = data.test.adaptive || data.test.joint?.coverage; // its segments are laid while it runs
const state = {
  test: data.test, adaptive: null, joint: null, parts: grows ? [] : planned.segments || [], segment: null, heard: 0, torqueAge: 0,
  connected: true, dirty: true, elapsed: 0, duration: planned.duration_s || data.test.duration_s || 0,
};
const byId = (id) => document.getElementById(id);
const heldRange = () => [-2, 2].map((k) => (state.test.joint.target_rad + k * state.test.joint.tolerance_rad) * DEG); // outside it a held test stops

function say(id, text) { const box = byId(id); if (box && box.textContent !== text) box.textContent = text; }
function hide(id, hidden) { const box = byId(id); if (box) box.hidden = hidden; }

function segmentWords(name) {
  const [kind, number] = name.split(" "), words = data.words.segment;
  return words[name] || (words[kind] ? `${words[kind]} ${number}` : name);
}

// ---- messages ------------------------------------------------------------------------------------------------------

function take(message) {
  if (message.type === "history") {
    for (const name of Object.keys(series)) series[name] = message[name];
    state.duration = message.duration_s || state.duration;
  } else if (message.type === "live") takeFrame(message);
  else if (message.type === "adaptive") showAdaptive(message);
  else if (message.type === "joint") showJoint(message);
  else if (message.type === "test") showTest(message.test, message.words);
  else if (message.type === "link") state.connected = message.connected;
  else if (message.type === "idle") state.connected = message.rig_connected;
  state.dirty = true;
}

function takeFrame(frame) {
  const { torque_min_nm: low, torque_max_nm: high, pulse_width_us: widths } = frame;
  state.heard = performance.now(); state.torqueAge = frame.torque_age_s;
  if (high.length) say("torque", `${shown((high.at(-1) + low.at(-1)) / 2, 2)} N·m`);
  if (widths.length) say("width", `${shown(widths.at(-1), 0)} µs`);
  if (frame.test_id !== state.test.id) return;
  state.elapsed = frame.elapsed_s; state.duration = frame.duration_s || state.duration;
  for (const name of SAMPLES) series[name].push(...frame[name]);
  if (data.sensor) takeAngle(frame);
  if (frame.pauses.length) { say("paused", `The computer stopped for ${shown(frame.pauses.at(-1).for_s, 1)} s. No current flowed meanwhile. The test goes on.`); hide("paused", false); }
  if (state.segment && frame.segment && frame.segment !== state.segment) beep(660);
  state.segment = frame.segment;
  say("segment", frame.segment ? segmentWords(frame.segment) : "–"); byId("segment").title = frame.segment || "";
  say("dose", `${shown(frame.charge_uc / 1000, 2)} mC · pulses: ${frame.sent_pulses}`);
  say("left", `${Math.max(0, Math.ceil(frame.duration_s - frame.elapsed_s))} s`);
  say("lost", String(frame.lost_samples));
  byId("progress").value = frame.duration_s ? frame.elapsed_s / frame.duration_s : 0;
  say("dose-used", shown(frame.torque_time_nms, 1) + (state.test.joint ? " N·m·s" : ""));
  if (byId("dose-left")) byId("dose-left").value = frame.torque_time_nms;
  if (grows && JSON.stringify(frame.laid_segments) !== JSON.stringify(state.parts)) { state.parts = frame.laid_segments; showTrack(); }
}

function takeAngle({ elapsed_s, angle_rad, velocity_rad_s }) {
  if (typeof angle_rad !== "number" || typeof velocity_rad_s !== "number") { say("angle", "–"); return; }
  series.angle_time_s.push(elapsed_s); series.angle_rad.push(angle_rad); series.velocity_rad_s.push(velocity_rad_s);
  for (const id of ["angle", "held-angle"]) say(id, `${shown(angle_rad * DEG, 0)}°`);
  if (!byId("held")) return;
  const [low, high] = heldRange();
  byId("held").classList.toggle("is-there", angle_rad * DEG >= low && angle_rad * DEG <= high);
}

function showAdaptive(status) { // a test that stops itself
  const { words, least_known: least, problem } = state.adaptive = status;
  if (words) say("known-words", words);
  if (least) say("least-known", `Least known: torque near ${shown(least.pulse_width_us, 0)} µs, response ${shown(least.time_s, 2)} s after a step.`);
  say("why-fixed", problem || ""); hide("why-fixed", !problem); hide("stops-once", !!problem);
  hide("enough", !["choosing", "fixed"].includes(status.state));
}

function showJoint(status) { // a guided test of a moving joint
  const { words, coverage, problem } = state.joint = status, missing = byId("missing"), lines = (words || []).slice(0, 3);
  if (!missing) return;
  if (words && missing.textContent !== lines.join("")) missing.replaceChildren(...lines.map((textContent) => act.make("li", { textContent })));
  say("why-fixed", problem || ""); hide("why-fixed", !problem);
  if (coverage) { say("share-words", `${shown(100 * coverage.share, 0)} %`); byId("share-seen").value = coverage.share; }
  hide("enough", !["watching", "alone"].includes(status.state));
}

function showTest(test, words) {
  const wasOpen = !state.test.done, job = test.identification, identifying = test.state === "identifying";
  state.test = test;
  byId("state").textContent = data.words.state[test.state] || test.state; byId("state").className = "tag tag-" + test.state;
  if (test.state !== "running") {
    hide("paused", true); hide("enough", true);
    if (state.segment) { state.segment = null; beep(523, 659, 784); }
  }
  if (identifying) {
    delete byId("live").dataset.stopKeys; // nothing is sent any more: Space is a key like any other
    say("left", job?.time_left_s ? `${Math.ceil(job.time_left_s)} s` : "–");
    say("segment", "the model is being fitted"); byId("segment").title = words.work; byId("progress").value = job ? job.progress : 0;
  }
  hide("plain-model", !(identifying && job?.verb === "carry"));
  if (test.model_id) byId("plain-model").querySelector("a").href = "/models/" + test.model_id;
  if (test.reason) { say("reason", words.reason); hide("reason", false); }
  const next = test.model_id ? "/models/" + test.model_id : test.joint && test.state === "completed" ? `/participants/${test.participant}/joint` : location.pathname;
  if (test.done && wasOpen) leave(next);
}

function leave(next) { // not before the answer to what was pressed
  if (answering()) setTimeout(() => leave(next), 1000); else location.replace(next);
}

function showTrack() {
  const end_s = state.parts.at(-1)?.end_s || 0, rest = grows && state.duration > end_s ? [{ name: "rest", start_s: end_s, end_s: state.duration }] : [];
  byId("track").replaceChildren(...[...state.parts, ...rest].map(({ name, start_s, end_s: stop_s }) => {
    const box = act.make("span", { textContent: name === "rest" ? "" : segmentWords(name), title: name, className: "part part-" + name.split(" ")[0] });
    box.style.flex = `${stop_s - start_s} 0 0`;
    return box;
  }));
}

// ---- age, tone and connection --------------------------------------------------------------------------------------

let open = false, refused = false; // the connection; refused: the session has ended or may no longer
function showAge() {
  if (state.test.done) return;
  const age_s = state.heard ? (performance.now() - state.heard) / 1000 + state.torqueAge : null;
  say("age", age_s === null ? "–" : age_s < 1 ? `${Math.round(age_s * 1000)} ms` : `${shown(age_s, 1)} s`);
  const stale = refused || (state.test.state === "running" && (!state.connected || !open || age_s === null || age_s > STALE_S));
  hide("stale", !stale);
  byId("live").classList.toggle("is-stale", stale);
  if (stale) say("stale", refused ? "You are signed out. Display out of date: do not rely on it. The stop button still works. Sign in again in another tab to see more."
    : !open ? "No connection to the service. Display out of date: do not rely on it. If the stop button does not answer, use the emergency switch on the stimulator."
    : !state.connected ? "The rig cannot be reached. Display out of date: do not rely on it; use the emergency switch on the stimulator if unsure."
    : "Display out of date. Do not rely on it; press Stop if unsure.");
}

let sound = null; // while the box is ticked
byId("tone").addEventListener("change", ({ target }) => { sound = target.checked ? new AudioContext() : null; beep(660); });
function beep(...pitches_hz) {
  for (const [k, pitch_hz] of sound ? pitches_hz.entries() : []) {
    const voice = new OscillatorNode(sound, { frequency: pitch_hz }), volume = new GainNode(sound, { gain: 0.2 }), start_s = sound.currentTime + 0.2 * k;
    voice.connect(volume).connect(sound.destination);
    voice.start(start_s); voice.stop(start_s + 0.16);
  }
}

function connect() {
  const socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/v1/tests/${data.test.id}/live`);
  socket.onmessage = (event) => {
    const message = JSON.parse(event.data);
    if (message.type === "problem") return; // why it closes is in the code of its closing
    open = true; refused = false;
    take(message);
  };
  socket.onclose = ({ code }) => { // somebody may sign in again in another tab
    open = false; refused = [4401, 4403].includes(code);
    if (!state.test.done) setTimeout(connect, refused ? 2000 : 500);
  };
}

// ---- charts ---------------------------------------------------------------------------------------------------------

function draw() {
  if (state.dirty) { state.dirty = false; drawCharts(); }
  requestAnimationFrame(draw);
}

function drawCharts() {
  const { time_s, torque_min_nm, torque_max_nm, pulse_time_s, pulse_width_us } = series;
  const { torque_nm: largest_nm, pulse_width_us: widest_us } = data.limits, plan_s = data.planned_us.map((_, k) => k / data.pulse_rate_hz);
  const checks = state.parts.filter(({ name }) => name === "validate").map(({ start_s, end_s }) => [start_s, end_s, "held-out"]);
  const over = (words) => ({ across: [Math.max(state.duration, 1), words], shades: checks, cursor: state.elapsed });
  const [low, high] = extent([...torque_min_nm, ...torque_max_nm], 0, largest_nm || 1), room = 0.06 * (high - low);
  const both = largest_nm && low < -largest_nm / 2 ? [largest_nm, -largest_nm] : largest_nm ? [largest_nm] : [];
  chart("torque-chart", {
    ...over(""), title: "Torque (N·m)", low: low < 0 ? low - room : 0, high: high + room,
    bands: [[time_s, torque_min_nm, torque_max_nm, "torque-band"]],
    lines: [[time_s, torque_min_nm.map((value, k) => (value + torque_max_nm[k]) / 2), "torque"]],
    limits: both.map((value) => [value, `stops at ${shown(largest_nm, 1)} N·m`]),
  });
  chart("width-chart", {
    ...over("Time (s)"), title: "Pulse width (µs)", low: 0, high: 1.08 * extent([...data.planned_us, ...pulse_width_us], 0, widest_us || 100)[1],
    lines: [[plan_s, data.planned_us, "plan", true], [pulse_time_s, pulse_width_us, "width", true]],
    limits: widest_us ? [[widest_us, `comfort maximum ${shown(widest_us, 0)} µs`]] : [],
  });
  if (state.test.adaptive) drawKnowledge(state.adaptive?.knowledge);
  if (data.sensor) drawAngles(state.test.joint, over(""));
}

function drawKnowledge(knowledge) { // both curves of a test that stops itself, with the bands in which they lie
  const { recruitment, step_response, curve_percent, step_percent } = knowledge || {};
  curve("curve-chart", recruitment && [recruitment.pulse_width_us, recruitment.torque_nm, recruitment.lower_nm, recruitment.upper_nm], "Recruitment curve", curve_percent, " (N·m)", [data.limits.pulse_width_us || 300, "Pulse width (µs)"]);
  curve("step-chart", step_response && [step_response.time_s, step_response.value, step_response.lower, step_response.upper], "Step response", step_percent, "", [1, "Time after the step (s)"]);
}

function curve(id, known, title, percent, unit, [last, words]) {
  const [x, y, lows, highs] = known || [[], [], [], []], [low, high] = extent([...lows, ...highs], 0, known ? -Infinity : 1);
  const heading = known ? `${title}, known within ${shown(percent, 1)} %${unit}` : `${title}: nothing is known yet${unit}`;
  chart(id, { title: heading, low, high: low + 1.04 * (high - low || 1), across: [x.at(-1) || last, words], bands: [[x, lows, highs, "torque-band"]], lines: [[x, y, "torque"]] });
}

function drawAngles(joint, time) {
  const angles_deg = series.angle_rad.map((rad) => rad * DEG), velocities_deg = series.velocity_rad_s.map((rad) => rad * DEG);
  const limits = !joint ? [] : joint.kind === "held" ? heldRange() : joint.range_rad.map((rad) => rad * DEG);
  const [low, high] = extent([...limits, ...angles_deg], limits.length ? Infinity : 0, 10), fastest = extent(velocities_deg.map(Math.abs), 0, 60)[1], room = 0.06 * (high - low);
  chart("angle-chart", { ...time, title: "Joint angle (°)", low: low - room, high: high + room, lines: [[series.angle_time_s, angles_deg, "torque"]], limits: limits.map((value) => [value, ""]) });
  chart("velocity-chart", { ...time, title: "Velocity of the joint, bending is positive (°/s)", low: -1.12 * fastest, high: 1.12 * fastest, lines: [[series.angle_time_s, velocities_deg, "torque"]] });
  if (state.joint?.coverage) drawCoverage(state.joint.coverage);
}

// A row for each way to move, fast bending at the top; a cell fills as its angles are passed at its speed.
function drawCoverage({ time_s, asked, seen_s, angle_edges_rad, velocity_edges_rad_s }) {
  const names = ["straightening, fast", "straightening, slow", "nearly still", "bending, slow", "bending, fast"];
  const cellOf = (value, edges) => edges.filter((edge) => value >= edge).length; // of the edges between cells
  const row = cellOf(series.velocity_rad_s.at(-1), velocity_edges_rad_s), column = cellOf(series.angle_rad.at(-1), angle_edges_rad.slice(1, -1));
  const cell = (seen, r, c) => {
    const share = Math.min(1, seen / seen_s + 1e-6), box = act.make("td", { className: `${asked[r][c] ? "is-asked" : ""} ${r === row && c === column ? "is-now" : ""}`, textContent: asked[r][c] && share === 1 ? "✓" : "" });
    box.style.setProperty("--share", `${100 * share}%`);
    return box;
  };
  const rows = names.map((name, r) => act.make("tr", {}, act.make("th", { scope: "row", textContent: name }), ...time_s[r].map((seen, c) => cell(seen, r, c))));
  const heads = angle_edges_rad.slice(1).map((rad, c) => act.make("th", { textContent: `${shown(angle_edges_rad[c] * DEG, 0)}–${shown(rad * DEG, 0)}°` }));
  byId("coverage").replaceChildren(...rows.reverse(), act.make("tr", {}, act.make("td"), ...heads));
}

addEventListener("colours", () => { state.dirty = true; });
new ResizeObserver(() => { state.dirty = true; }).observe(byId("live"));
if (state.test.adaptive) showAdaptive(state.test.adaptive);
if (state.test.joint) showJoint(state.test.joint);
showTrack();
connect();
setInterval(showAge, 100);
draw();
