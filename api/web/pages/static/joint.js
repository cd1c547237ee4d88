// A guided test of a joint: what was seen of angle and velocity, what is missing, and the traces of both.
"use strict";
const DEG = 180 / Math.PI;
const joint = { told: null, words: null, time: [], angle: [], velocity: [], now: null };

function takeAngles(message) { // the history, or one frame
  if (message.type === "history") {
    Object.assign(joint, { time: message.angle_time_s, angle: message.angle_rad.map((v) => v * DEG), velocity: message.velocity_rad_s.map((v) => v * DEG) });
    return;
  }
  if (typeof message.angle_rad !== "number" || typeof message.velocity_rad_s !== "number") { joint.now = null; say("angle", "–"); return; }
  joint.now = [message.angle_rad * DEG, message.velocity_rad_s * DEG];
  joint.time.push(message.elapsed_s); joint.angle.push(joint.now[0]); joint.velocity.push(joint.now[1]);
  say("angle", shown(joint.now[0].toFixed(0)) + "°");
  if (byId("held-angle")) {
    const range = heldRange();
    say("held-angle", shown(joint.now[0].toFixed(0)) + "°");
    byId("held").classList.toggle("is-there", joint.now[0] >= range[0] && joint.now[0] <= range[1]);
  }
}

function showJoint(told) {
  joint.told = told;
  const list = byId("missing");
  if (!list) return;
  if (told.words) joint.words = told.words;
  const lines = (joint.words || []).slice(0, 3);
  if (list.textContent !== lines.join("")) list.replaceChildren(...lines.map((text) => { const item = document.createElement("li"); item.textContent = text; return item; }));
  const why = byId("alone-why");
  why.hidden = !told.problem; if (told.problem) say("alone-why", told.problem);
  if (told.coverage) { say("share-words", shown((100 * told.coverage.share).toFixed(0)) + " %"); byId("share-seen").value = told.coverage.share; }
  showEnough(told.state === "watching" || told.state === "alone");
}

function showTorqueTime(torque_time_nm_s) { if (byId("dose-used")) say("dose-used", shown(torque_time_nm_s.toFixed(1)) + " N·m·s"); }

function heldRange() { // outside it a held test stops
  const { target_rad, tolerance_rad } = state.test.joint;
  return [(target_rad - 2 * tolerance_rad) * DEG, (target_rad + 2 * tolerance_rad) * DEG];
}

function drawAngles() {
  trace("angle-chart", joint.angle, words.angle, "°", angleLines());
  trace("velocity-chart", joint.velocity, words.velocity, "°/s", []);
  drawCoverage();
}

function angleLines() {
  const told = state.test.joint;
  if (!told) return [];
  return told.kind === "held" ? heldRange() : told.range_rad.map((v) => v * DEG);
}

function trace(name, values, title, unit, lines) {
  let low = lines.length ? Math.min(...lines) : 0, high = Math.max(unit === "°" ? 10 : 60, ...lines);
  for (const value of values) { if (value < low) low = value; if (value > high) high = value; }
  if (unit !== "°") { high = Math.max(high, -low); low = -high; }
  const room = 0.06 * (high - low), drawn = frame(byId(name), low - room, high + room, title, unit, null), { pen, x, y, area } = drawn;
  segments(drawn);
  if (low < 0) { pen.strokeStyle = colours.zero; pen.lineWidth = 1; pen.beginPath(); pen.moveTo(area.left, y(0)); pen.lineTo(area.right, y(0)); pen.stroke(); }
  pen.strokeStyle = colours.limit; pen.lineWidth = 1.5; pen.setLineDash([7, 5]);
  for (const line of lines) { pen.beginPath(); pen.moveTo(area.left, y(line)); pen.lineTo(area.right, y(line)); pen.stroke(); }
  pen.setLineDash([]); pen.strokeStyle = colours.torque; pen.lineWidth = 1.8; pen.lineJoin = "round"; pen.beginPath();
  joint.time.forEach((t, i) => (i ? pen.lineTo(x(t), y(values[i])) : pen.moveTo(x(t), y(values[i]))));
  pen.stroke();
  cursor(pen, x, area);
}

// ---- the map of angle and velocity: a row for each way to move, fast bending at the top ------------------------

function drawCoverage() {
  const box = byId("coverage-chart"), told = joint.told && joint.told.coverage;
  if (!box || !told) return;
  const ratio = window.devicePixelRatio || 1, size = box.getBoundingClientRect(), pen = box.getContext("2d");
  box.width = Math.round(size.width * ratio); box.height = Math.round(size.height * ratio);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.font = "12px " + FONT;
  const rows = told.time_s.length, edges = told.angle_edges_rad.map((v) => v * DEG), columns = edges.length - 1;
  const names = words.rows, widest = Math.max(...names.map((name) => pen.measureText(name).width));
  const area = { left: widest + 14, right: size.width - 20, top: 26, bottom: size.height - 36 };
  const high = (area.bottom - area.top) / rows;
  const x = (deg) => area.left + ((deg - edges[0]) / (edges[columns] - edges[0])) * (area.right - area.left);
  pen.textBaseline = "middle"; pen.textAlign = "right"; pen.fillStyle = colours.dim;
  names.forEach((name, row) => pen.fillText(name, area.left - 8, area.bottom - (row + 0.5) * high));
  for (let row = 0; row < rows; row++) for (let column = 0; column < columns; column++) {
    const left = x(edges[column]), top = area.bottom - (row + 1) * high, wide = x(edges[column + 1]) - left;
    cell(pen, left + 1.5, top + 1.5, wide - 3, high - 3, told.asked[row][column], told.time_s[row][column] / told.seen_s);
  }
  pen.textAlign = "center"; pen.textBaseline = "top"; pen.fillStyle = colours.dim;
  for (const edge of edges) if (wideEnough(edges, edge, area)) pen.fillText(shown(edge.toFixed(0)) + "°", x(edge), area.bottom + 4);
  pen.textAlign = "right"; pen.fillText(words.joint_angle, area.right, area.bottom + 20);
  pen.textAlign = "left"; pen.fillStyle = colours.ink; pen.font = "600 13px " + FONT; pen.fillText(words.coverage, 4, 3);
  if (joint.now) point(pen, Math.min(Math.max(x(joint.now[0]), area.left), area.right), area.bottom - high * place(joint.now[1], told.velocity_edges_rad_s), 6);
}

function wideEnough(edges, edge, area) { return (area.right - area.left) / edges.length > 34 || edges.indexOf(edge) % 2 === 0; }

function cell(pen, left, top, wide, high, asked, share) {
  const seen = share >= 1 - 1e-6;
  pen.lineWidth = 1; pen.setLineDash(asked ? [] : [2, 4]); pen.strokeStyle = asked && !seen ? colours.mark : colours.grid;
  if (share > 0) { pen.fillStyle = seen ? colours.torque : colours["torque-band"]; pen.fillRect(left, seen ? top : top + high * (1 - share), wide, seen ? high : high * share); }
  pen.strokeRect(left, top, wide, high); pen.setLineDash([]);
  if (!seen || !asked) return;
  pen.strokeStyle = colours.chart; pen.lineWidth = 2; pen.beginPath(); // a tick: colour alone says nothing to some
  const cx = left + wide / 2, cy = top + high / 2;
  pen.moveTo(cx - 5, cy); pen.lineTo(cx - 1, cy + 4); pen.lineTo(cx + 6, cy - 5); pen.stroke();
}

function place(velocity_deg_s, edges_rad_s) { // rows are equally high, whatever speeds they hold
  const edges = [-120, ...edges_rad_s.map((v) => v * DEG), 120], v = Math.min(Math.max(velocity_deg_s, -119), 119);
  const row = edges.findIndex((edge, i) => v < edges[i + 1]);
  return row + (v - edges[row]) / (edges[row + 1] - edges[row]);
}

function point(pen, x, y, radius) {
  pen.beginPath(); pen.arc(x, y, radius, 0, 2 * Math.PI); pen.fillStyle = colours.width; pen.fill();
  pen.lineWidth = 2; pen.strokeStyle = colours.chart; pen.stroke();
}
