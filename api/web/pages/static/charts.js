// A page's charts: stills, fetched as they are reached. Plotly comes only when somebody takes hold of a chart.
"use strict";
{
  const { plotly, failed } = document.currentScript.dataset;
  const NAMED = /^var\(--([\w-]+)\)$/;
  const coarse = matchMedia("(pointer: coarse)");
  const boxes = [...document.querySelectorAll("[data-still]")];
  const plots = new Map(); // of each box that is looked at closely: its figure, and the part that plotly draws in

  // ---- stills ----------------------------------------------------------------------------------------------------

  const still = (box) => box.querySelector("svg.still");
  const drawnWidth = (box) => (still(box) ? still(box).viewBox.baseVal.width : 0);
  const address = (box) => { const at = new URL(box.dataset.still, location.href); at.searchParams.set("width", 40 * Math.round(Math.min(2400, Math.max(240, box.clientWidth)) / 40)); return at; }; // few widths: the service keeps what it drew

  // One that stands there already is good enough where it is about as wide as its box.
  const wanted = (box) => box.clientWidth && !plots.has(box) && Math.abs(drawnWidth(box) / box.clientWidth - 1) > 0.08;

  function put(box, html) {
    for (const old of box.querySelectorAll("svg.still, .chart-failed")) old.remove();
    box.insertAdjacentHTML("afterbegin", html);
  }

  async function answer(at) {
    const found = await fetch(at);
    if (!found.ok) throw new Error(String(found.status));
    return found;
  }

  async function load(box) {
    if (box.ariaBusy === "true" || !wanted(box)) return;
    box.ariaBusy = "true";
    try { put(box, await (await answer(address(box))).text()); } catch { fail(box); }
    box.ariaBusy = "false";
  }

  function fail(box) {
    if (box.querySelector(".chart-failed")) return;
    const retry = Object.assign(document.createElement("button"), { type: "button", className: "chart-failed", textContent: failed });
    retry.onclick = () => { retry.remove(); load(box); };
    if (!still(box)) box.prepend(retry);
  }

  const near = new IntersectionObserver((seen) => seen.forEach(({ isIntersecting, target }) => isIntersecting && load(target)), { rootMargin: "300px" });
  for (const box of boxes) near.observe(box);
  let waiting = 0;
  addEventListener("resize", () => { clearTimeout(waiting); waiting = setTimeout(() => boxes.filter(still).forEach(load), 200); });

  // ---- looking closer --------------------------------------------------------------------------------------------

  // A copy with the value of each var(--name): Plotly knows no style sheets, and writes into what it is given.
  function coloured(part) {
    if (typeof part === "string") {
      const name = NAMED.exec(part);
      return name ? colourOf(name[1]) : part;
    }
    if (Array.isArray(part)) return typeof part[0] === "number" || part[0] === null ? part.slice() : part.map(coloured);
    if (part === null || typeof part !== "object") return part;
    return Object.fromEntries(Object.entries(part).map(([key, value]) => [key, coloured(value)]));
  }

  function paint(box) {
    const { figure, plot } = plots.get(box);
    const dragmode = plot.layout ? plot.layout.dragmode : coarse.matches ? false : "zoom";
    const layout = { ...coloured(figure.layout), dragmode };
    if (box.clientWidth < 560) layout.annotations = (layout.annotations || []).filter((note) => note.name); // no room for the segments' names
    return Plotly.react(plot, coloured(figure.data), layout, { ...figure.config });
  }

  // A finger scrolls the page; the zoom button takes it for one zoom. The style says so to the browser beforehand: a
  // busy page would answer a touch too late, and the browser would scroll.
  function forFingers(plot) {
    plot.on("plotly_relayout", (change) => {
      if (!("dragmode" in change) && plot.layout.dragmode) Plotly.relayout(plot, { dragmode: false });
      plot.classList.toggle("takes-fingers", Boolean(plot.layout.dragmode));
    });
  }

  let library = null;
  function withPlotly() {
    library = library || new Promise((done, fell) => {
      const script = Object.assign(document.createElement("script"), { src: plotly, onload: done });
      script.onerror = () => { library = null; script.remove(); fell(); };
      document.head.append(script);
    });
    return library;
  }

  async function lookCloser(box) {
    const button = box.querySelector(".chart-tools button");
    if (box.ariaBusy === "true") return;
    box.ariaBusy = "true";
    try {
      const [figure] = await Promise.all([answer(box.dataset.lines).then((found) => found.json()), withPlotly()]);
      const plot = Object.assign(document.createElement("div"), { className: "plot" });
      plots.set(box, { figure, plot });
      box.prepend(plot);
      await paint(box);
      put(box, "");
      if (coarse.matches) forFingers(plot);
      button.ariaPressed = "true";
    } catch { fail(box); }
    box.ariaBusy = "false";
  }

  function lookFromAfar(box) {
    Plotly.purge(plots.get(box).plot);
    plots.get(box).plot.remove();
    plots.delete(box);
    box.querySelector(".chart-tools button").ariaPressed = "false";
    load(box);
  }

  document.addEventListener("click", (event) => {
    const box = event.target.closest?.("[data-still]");
    if (box && event.target.closest(".chart-tools button")) plots.has(box) ? lookFromAfar(box) : lookCloser(box);
    else if (box && event.target.closest("svg.still")) lookCloser(box);
  });
  addEventListener("colours", () => { for (const box of plots.keys()) paint(box); });

  // ---- folded parts ----------------------------------------------------------------------------------------------

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

  // A link to a place in a closed part opens that part.
  function unfold() {
    const place = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (!place) return;
    for (let part = place.closest("details"); part; part = part.parentElement.closest("details")) part.open = true;
    place.scrollIntoView();
  }
  document.addEventListener("toggle", remember, true); // toggle does not bubble
  addEventListener("hashchange", unfold);
  document.addEventListener("click", (event) => { // the same link again: the hash does not change
    const link = event.target.closest?.("a[href^='#']");
    if (link && link.getAttribute("href") === location.hash) unfold();
  });

  // On paper nothing is folded, and each chart is there: print waits for no promise, so the stills are asked for at once.
  let closed = [];
  addEventListener("beforeprint", () => {
    closed = [...document.querySelectorAll("details:not([open])")];
    for (const part of closed) part.open = true;
    for (const box of boxes.filter((each) => !still(each) && wanted(each))) {
      const asked = new XMLHttpRequest();
      asked.open("GET", address(box), false);
      try { asked.send(); } catch { continue; }
      if (asked.status === 200) put(box, asked.responseText);
    }
  });
  addEventListener("afterprint", () => { for (const part of closed) part.open = false; closed = []; });
  unfold();
}
