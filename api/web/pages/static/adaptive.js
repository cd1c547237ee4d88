// What a test that stops itself knows by now: both curves with their bands, drawn with the pens of live.js.
"use strict";
const knows = { told: null, dirty: true };

function showAdaptive(told) {
  knows.told = told; knows.dirty = true;
  if (told.words) say("known-words", told.words);
  if (told.least_known) say("least-known", words.least_known.replace("{width}", shown(told.least_known.pulse_width_us.toFixed(0))).replace("{time}", shown(told.least_known.time_s.toFixed(2))));
  const why = document.getElementById("fixed-why");
  why.hidden = !told.problem; if (told.problem) say("fixed-why", told.problem);
  document.getElementById("stops-once").hidden = !!told.problem;
  showEnough(told.state === "choosing" || told.state === "fixed");
}

function showDose(torque_time_nm_s) {
  say("dose-used", shown(torque_time_nm_s.toFixed(1)));
  document.getElementById("dose-left").value = torque_time_nm_s;
}

function drawKnown() {
  const known = knows.told && knows.told.knowledge, rec = known && known.recruitment, step = known && known.step_response;
  const largest = data.limits.pulse_width_us || 300;
  band("curve-chart", rec && { x: rec.pulse_width_us, y: rec.torque_nm, low: rec.lower_nm, high: rec.upper_nm }, known && known.curve_percent, words.curve, words.width + " (µs)", "N·m", largest);
  band("step-chart", step && { x: step.time_s, y: step.value, low: step.lower, high: step.upper }, known && known.step_percent, words.step, words.time_from_step, "", 1);
}

function band(name, curve, percent, title, xtitle, unit, largest) {
  const box = document.getElementById(name);
  const low = curve ? Math.min(0, ...curve.low) : 0, high = curve ? Math.max(...curve.high) : 1, last = curve ? curve.x[curve.x.length - 1] : largest;
  const heading = curve ? title.replace("{percent}", shown(percent.toFixed(1))) : title.split(",")[0] + ": " + words.nothing_known;
  const { pen, x, y } = frame(box, low, low + ((high - low) * 1.04 || 1), heading, unit, { last, words: xtitle });
  if (!curve) return;
  pen.fillStyle = colours["torque-band"]; pen.strokeStyle = colours.torque; pen.lineWidth = 1.8; pen.lineJoin = "round";
  pen.beginPath();
  curve.x.forEach((v, i) => (i ? pen.lineTo(x(v), y(curve.high[i])) : pen.moveTo(x(v), y(curve.high[i]))));
  for (let i = curve.x.length - 1; i >= 0; i--) pen.lineTo(x(curve.x[i]), y(curve.low[i]));
  pen.fill();
  pen.beginPath(); curve.x.forEach((v, i) => (i ? pen.lineTo(x(v), y(curve.y[i])) : pen.moveTo(x(v), y(curve.y[i])))); pen.stroke();
}
