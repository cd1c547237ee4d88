// drawChart(box, data, layout, settings): a figure in the page's colours, with the decimal sign of its language.
"use strict";
const drawChart = (() => {
  const NAMED = /^var\((--[\w-]+)\)$/;
  const coarse = matchMedia("(pointer: coarse)");
  const drawn = new Map();

  // A copy with the value of each var(--name): Plotly knows no style sheets, and writes into what it is given.
  function coloured(part, style) {
    if (typeof part === "string") {
      const name = NAMED.exec(part);
      return name ? style.getPropertyValue(name[1]).trim() : part;
    }
    if (Array.isArray(part)) return typeof part[0] === "number" || part[0] === null ? part.slice() : part.map((entry) => coloured(entry, style));
    if (part === null || typeof part !== "object") return part;
    return Object.fromEntries(Object.entries(part).map(([key, value]) => [key, coloured(value, style)]));
  }

  function separators() {
    const parts = new Intl.NumberFormat(document.documentElement.lang || "en").formatToParts(12345.6);
    const sign = (type, other) => (parts.find((part) => part.type === type) || { value: other }).value;
    return sign("decimal", ".") + sign("group", " ");
  }

  // Named after the model where the page is one's, else after the page.
  function filename(box) {
    const model = /^\/models\/([^/]+)/.exec(location.pathname);
    return ((model ? model[1] : document.title) + " " + (box.dataset.figure || "")).trim().replace(/[^\w.-]+/g, "-");
  }

  function paint(box) {
    const { data, layout, settings } = drawn.get(box), style = getComputedStyle(document.documentElement);
    const how = { ...settings, toImageButtonOptions: { filename: filename(box), scale: 2 } };
    const dragmode = box.layout ? box.layout.dragmode : coarse.matches ? false : "zoom";
    return Plotly.react(box, coloured(data, style), { ...coloured(layout, style), separators: separators(), dragmode }, how);
  }

  // A finger scrolls the page; the zoom button takes it for one zoom. The style says so to the browser beforehand: a
  // busy page would answer a touch too late, and the browser would scroll.
  function forFingers(box) {
    box.on("plotly_relayout", (change) => {
      if (!("dragmode" in change) && box.layout.dragmode) Plotly.relayout(box, { dragmode: false });
      box.classList.toggle("takes-fingers", Boolean(box.layout.dragmode));
    });
  }

  addEventListener("colours", () => { for (const box of drawn.keys()) paint(box); });

  return (box, data, layout, settings) => {
    drawn.set(box, { data, layout, settings });
    paint(box);
    if (coarse.matches) forFingers(box);
  };
})();

// Draws the figures that the server has prepared: those that are seen at once, those in a closed part when it is opened.
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
