// Pulse widths for a reference torque: the answer of REST as charts, and as a table to keep.
"use strict";
{
  const COLUMNS = ["pulse_width_us", "reference_torque_nm", "predicted_torque_nm"], at = (id) => document.getElementById(id);
  const reasons = JSON.parse(at("reasons").textContent);
  let found = null;

  at("reference-form").addEventListener("answered", ({ detail: answer }) => {
    at("result").hidden = !answer?.ok;
    if (!answer?.ok) return;
    found = answer.body;
    const { unreachable: parts, fit_percent: fit, whole_fit_percent: whole } = found, widest = Math.max(...found.pulse_width_us);
    const follows = fit === null ? "" : `Fit ${shown(fit, 1)} % where it can be reached${parts.length && whole !== null ? `, ${shown(whole, 1)} % of all of it` : ""}. `;
    at("result-title").querySelector("small").textContent = at("reference").files[0].name;
    at("widths-words").textContent = `${follows}${shown(found.duration_s, 1)} s, ${found.pulse_width_us.length} pulses, widest ${shown(widest, 0)} µs.${parts.length ? "" : " All of it can be reached."}`;
    at("lacking").hidden = !parts.length;
    at("lacking").querySelector("tbody").replaceChildren(...parts.map((part) => act.make("tr", {},
      act.make("td", { textContent: `${shown(part.begin_s, 2)} to ${shown(part.end_s, 2)} s` }), act.make("td", { className: "right num", textContent: `${shown(part.shortfall_nm, 2)} N·m` }),
      act.make("td", { textContent: reasons[part.reason] || part.reason }))));
    draw();
  });

  function draw() {
    if (!found) return;
    const [widths_us, wanted_nm, predicted_nm] = COLUMNS.map((name) => found[name]), time_s = widths_us.map((_, k) => k / found.pulse_rate_hz);
    const [low, high] = extent([...wanted_nm, ...predicted_nm], 0, 0.1), shades = found.unreachable.map((part) => [part.begin_s, part.end_s, "worst-band"]);
    chart("torque-chart", { title: "Torque above rest (N·m)", low, high: high * 1.06, across: [found.duration_s, ""], shades, lines: [[time_s, wanted_nm, "measured"], [time_s, predicted_nm, "model"]] });
    chart("width-chart", { title: "Pulse width (µs)", low: 0, high: 1.08 * Math.max(1, ...widths_us), across: [found.duration_s, "Time (s)"], shades, lines: [[time_s, widths_us, "width", true]] });
  }
  for (const name of ["colours", "resize"]) addEventListener(name, draw);

  at("save").addEventListener("click", () => {
    const rows = found.pulse_width_us.map((_, k) => [+(k / found.pulse_rate_hz).toPrecision(6), ...COLUMNS.map((name) => found[name][k])]);
    const text = [["time_s", ...COLUMNS], ...rows].map((row) => row.join(",")).join("\r\n") + "\r\n";
    act.make("a", { download: "widths.csv", href: URL.createObjectURL(new Blob([text], { type: "text/csv" })) }).click();
  });
}
