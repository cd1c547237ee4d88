// Draws the figures that the server has prepared.
"use strict";
const figures = JSON.parse(document.getElementById("data").textContent);
const settings = JSON.parse(document.getElementById("chart-config").textContent);
for (const box of document.querySelectorAll("[data-figure]")) {
  const figure = figures[box.dataset.figure];
  if (figure && box.clientWidth < 560) figure.layout.annotations = (figure.layout.annotations || []).filter((a) => a.name); // no room for the segments' names
  if (figure) Plotly.newPlot(box, figure.data, figure.layout, settings);
}
