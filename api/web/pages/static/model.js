// Draws the figures that the server has prepared: those that are seen at once, those in a closed part when it is opened.
"use strict";
{
  const figures = JSON.parse(document.getElementById("data").textContent);
  const settings = JSON.parse(document.getElementById("chart-config").textContent);
  const boxes = [...document.querySelectorAll("[data-figure]")];
  const drawn = new Set();

  function draw(box) {
    const figure = figures[box.dataset.figure];
    if (!figure || drawn.has(box) || box.closest("details:not([open])")) return; // in a closed part a box has no width
    drawn.add(box);
    const layout = structuredClone(figure.layout);
    if (box.clientWidth < 560) layout.annotations = (layout.annotations || []).filter((a) => a.name); // no room for the segments' names
    const said = (line) => line.yaxis === figure.only_said ? { ...line, line: { ...line.line, width: 0 } } : line;
    drawChart(box, figure.data || figures[figure.lines_of].data.map(said), layout, settings);
  }
  const drawAll = () => boxes.forEach(draw);

  // What a person opened or closed stays so when the page is read anew, as at the end of a diagnosis.
  const kept = "folds " + location.pathname;
  function remembered() {
    try { return JSON.parse(sessionStorage.getItem(kept)) || {}; } catch { return {}; }
  }
  function remember({ target: part }) {
    if (part.id) try { sessionStorage.setItem(kept, JSON.stringify({ ...remembered(), [part.id]: part.open })); } catch { /* not kept */ }
  }
  for (const [id, open] of Object.entries(remembered())) {
    const part = document.getElementById(id);
    if (part && part.tagName === "DETAILS") part.open = open;
  }

  function open(parts) {
    for (const part of parts) part.open = true;
  }

  // A link to a place in a closed part opens that part.
  function unfold() {
    const place = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (!place) return;
    for (let part = place.closest("details"); part; part = part.parentElement.closest("details")) part.open = true;
    drawAll();
    place.scrollIntoView();
  }

  document.addEventListener("toggle", drawAll, true); // toggle does not bubble
  document.addEventListener("toggle", remember, true);
  addEventListener("hashchange", unfold);
  document.addEventListener("click", (event) => { // the same link again: the hash does not change
    const link = event.target.closest?.("a[href^='#']");
    if (link && link.getAttribute("href") === location.hash) unfold();
  });
  // On paper nothing is folded.
  let closed = [];
  addEventListener("beforeprint", () => {
    closed = [...document.querySelectorAll("details:not([open])")];
    open(closed);
    drawAll();
  });
  addEventListener("afterprint", () => { for (const part of closed) part.open = false; closed = []; });
  drawAll();
  unfold();
}
