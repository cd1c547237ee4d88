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
