// A model's charts: stills, fetched as they are reached. Plotly comes only when somebody takes hold of a chart.
"use strict";
{
  const { plotly, failed } = document.currentScript.dataset;
  const ROLE = /"var\(--([\w-]+)\)"/g; // plotly knows no style sheets
  const coarse = matchMedia("(pointer: coarse)");
  const plots = new Map(); // of each box that is looked at closely: its figure as text, and the part that plotly draws in
  const still = (box) => box.querySelector("svg.still");

  async function text(at) {
    const answer = await fetch(at);
    if (!answer.ok) throw new Error(String(answer.status));
    return answer.text();
  }

  // One thing at a time; what fails becomes a button that tries again.
  async function attempt(box, work) {
    if (box.ariaBusy === "true") return;
    box.ariaBusy = "true";
    box.querySelector(".chart-failed")?.remove();
    try { await work(); } catch {
      box.prepend(Object.assign(document.createElement("button"), { type: "button", className: "chart-failed", textContent: failed, onclick: () => attempt(box, work) }));
    }
    box.ariaBusy = "false";
  }

  function load(box) {
    const there = still(box)?.viewBox.baseVal.width ?? 0;
    if (!box.clientWidth || plots.has(box) || Math.abs(there / box.clientWidth - 1) < 0.3) return;
    const width = 40 * Math.round(Math.min(2400, Math.max(240, box.clientWidth)) / 40); // few widths: the service keeps what it drew
    attempt(box, async () => {
      const html = await text(`${box.dataset.still}.html?width=${width}`);
      still(box)?.remove();
      box.insertAdjacentHTML("afterbegin", html);
    });
  }
  const near = new IntersectionObserver((seen) => seen.forEach(({ isIntersecting, target }) => isIntersecting && load(target)), { rootMargin: "300px" });
  for (const box of document.querySelectorAll("[data-still]")) near.observe(box);

  // ---- looking closer --------------------------------------------------------------------------------------------

  function paint(box) {
    const { figure, plot } = plots.get(box);
    const { data, layout, config } = JSON.parse(figure.replace(ROLE, (_, role) => JSON.stringify(colourOf(role))));
    layout.dragmode = plot.layout ? plot.layout.dragmode : coarse.matches ? false : "zoom";
    if (box.clientWidth < 560) layout.annotations = layout.annotations.filter((note) => note.name); // no room for the segments' names
    return Plotly.react(plot, data, layout, config);
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

  const lookCloser = (box) => attempt(box, async () => {
    const [figure] = await Promise.all([text(`${box.dataset.still}.json`), withPlotly()]);
    const plot = Object.assign(document.createElement("div"), { className: "plot" });
    plots.set(box, { figure, plot });
    box.prepend(plot);
    await paint(box);
    still(box)?.remove();
    if (coarse.matches) forFingers(plot);
    box.querySelector(".chart-tools button").ariaPressed = "true";
  });

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
  let folds = {};
  try { folds = JSON.parse(sessionStorage.getItem(kept)) || {}; } catch { /* nothing is kept */ }
  for (const part of document.querySelectorAll("details[id]")) part.open = folds[part.id] ?? part.open;
  document.addEventListener("toggle", ({ target: part }) => { // toggle does not bubble
    if (!part.id) return;
    folds[part.id] = part.open;
    try { sessionStorage.setItem(kept, JSON.stringify(folds)); } catch { /* nothing is kept */ }
  }, true);

  // A link to a place in a closed part opens that part; the same link again, too, although the hash does not change.
  function unfold(hash) {
    const place = hash.length > 1 && document.getElementById(decodeURIComponent(hash.slice(1)));
    if (!place) return;
    for (let part = place.closest("details"); part; part = part.parentElement.closest("details")) part.open = true;
    place.scrollIntoView();
  }
  addEventListener("hashchange", () => unfold(location.hash));
  document.addEventListener("click", (event) => {
    const link = event.target.closest?.("a[href^='#']");
    if (link && link.hash === location.hash) unfold(link.hash);
  });
  unfold(location.hash);
}
