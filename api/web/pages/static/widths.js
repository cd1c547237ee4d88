// Pulse widths for a reference torque: the file's text goes to REST; its answer is shown and can be saved as a table.
"use strict";
{
  const { plotly } = document.currentScript.dataset;
  const form = document.getElementById("reference-form"), file = document.getElementById("reference"), result = document.getElementById("result");
  const reasons = JSON.parse(document.getElementById("reasons").textContent);
  const COLUMNS = ["pulse_width_us", "reference_torque_nm", "predicted_torque_nm"];
  const at = (id) => document.getElementById(id);
  const times = (found) => found.pulse_width_us.map((_, k) => +(k / found.pulse_rate_hz).toPrecision(6));

  // `act` sends the form with what stands in its fields: it waits until the text is there.
  let read = null;
  addEventListener("submit", async (event) => {
    if (event.target !== form || read === file.files[0]) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    form.elements.table.value = await file.files[0].text();
    read = file.files[0];
    form.requestSubmit();
  }, true);
  file.addEventListener("change", () => { read = null; });
  form.addEventListener("reset", (event) => event.preventDefault()); // `act` would empty it: its file is named, and sent again for other colours

  form.addEventListener("answered", async ({ detail: answer }) => {
    result.hidden = !answer?.ok;
    if (!answer?.ok) return;
    const found = answer.body, fit = (percent) => `${percent.toFixed(1)} %`;
    at("result-title").querySelector("small").textContent = file.files[0].name;
    const reached = found.fit_percent === null ? "" : `Fit ${fit(found.fit_percent)} where it can be reached${found.unreachable.length && found.whole_fit_percent !== null ? `, ${fit(found.whole_fit_percent)} of all of it` : ""}. `;
    at("widths-words").textContent = `${reached}${found.duration_s.toFixed(1)} s, ${found.pulse_width_us.length} pulses, widest ${Math.max(...found.pulse_width_us).toFixed(0)} µs.${found.unreachable.length ? "" : " All of it can be reached."}`;
    at("lacking-title").hidden = at("lacking").hidden = !found.unreachable.length;
    const cell = (label, text) => Object.assign(document.createElement("td"), { textContent: text, className: label === "Why" ? "" : "num" });
    at("lacking").tBodies[0].replaceChildren(...found.unreachable.map((part) => {
      const row = document.createElement("tr"), texts = { When: `${part.begin_s.toFixed(2)} to ${part.end_s.toFixed(2)} s`, "Lacks at most": `${part.shortfall_nm.toFixed(2)} N·m`, Why: reasons[part.reason] || part.reason };
      row.append(...Object.entries(texts).map(([label, text]) => { const box = cell(label, text); box.dataset.label = label; return box; }));
      return row;
    }));
    at("save").onclick = () => {
      const rows = times(found).map((time_s, k) => [time_s, ...COLUMNS.map((name) => found[name][k])].join(","));
      const link = Object.assign(document.createElement("a"), { download: "widths.csv", href: URL.createObjectURL(new Blob([["time_s,", COLUMNS, "\r\n", rows.join("\r\n"), "\r\n"].join("")], { type: "text/csv" })) });
      link.click();
    };
    await draw(found);
    result.focus();
  });

  async function draw(found) {
    if (!window.Plotly) await new Promise((done, failed) => document.head.append(Object.assign(document.createElement("script"), { src: plotly, onload: done, onerror: failed })));
    const style = getComputedStyle(result), x = times(found), shade = { type: "rect", xref: "x", yref: "paper", y0: 0, y1: 1, line: { width: 0 }, fillcolor: colourOf("worst-band") };
    const line = (name, y, axis, color, dash) => ({ x, y, name, yaxis: axis, mode: "lines", line: { color: colourOf(color), dash, width: 1.8, shape: axis === "y2" ? "hv" : "linear" }, hovertemplate: `%{y:.2f}` });
    const axis = (title, domain) => ({ title: { text: title }, domain, gridcolor: colourOf("grid"), zerolinecolor: colourOf("zero") });
    Plotly.react(at("widths-plot"), [
      line("reference", found.reference_torque_nm, "y", "measured", "dash"), line("predicted", found.predicted_torque_nm, "y", "model"), { ...line("pulse width", found.pulse_width_us, "y2", "width"), showlegend: false },
    ], {
      height: 460, margin: { l: 64, r: 14, t: 30, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", hovermode: "x unified", font: { color: style.color, family: style.fontFamily },
      hoverlabel: { bgcolor: colourOf("card") }, legend: { orientation: "h", y: 1.02, yanchor: "bottom" }, separators: ". ", shapes: found.unreachable.map((part) => ({ ...shade, x0: part.begin_s, x1: part.end_s })),
      xaxis: { ...axis("Time (s)"), anchor: "y2" }, yaxis: axis("Torque above rest (N·m)", [0.36, 1]), yaxis2: axis("Pulse width (µs)", [0, 0.28]),
    }, { displaylogo: false, responsive: true, modeBarButtons: [["toImage"], ["zoom2d", "pan2d", "resetScale2d"]] });
  }
  addEventListener("colours", () => { if (!result.hidden && window.Plotly) form.requestSubmit(); });
}
