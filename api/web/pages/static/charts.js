// A model's charts: stills, fetched as they are reached; and the folded parts of its page.
"use strict";
{
  const { failed } = document.currentScript.dataset;

  async function load(box) { // what fails becomes a button that tries again
    const still = box.querySelector("svg.still"), there = still?.viewBox.baseVal.width ?? 0;
    if (!box.clientWidth || box.ariaBusy === "true" || Math.abs(there / box.clientWidth - 1) < 0.3) return;
    const width = 40 * Math.round(Math.min(2400, Math.max(240, box.clientWidth)) / 40); // few widths: the service keeps what it drew
    box.ariaBusy = "true";
    box.querySelector(".chart-failed")?.remove();
    try {
      const answer = await fetch(`${box.dataset.still}.html?width=${width}`);
      if (!answer.ok) throw new Error(String(answer.status));
      const html = await answer.text();
      still?.remove();
      box.insertAdjacentHTML("afterbegin", html);
    } catch {
      box.prepend(Object.assign(document.createElement("button"), { type: "button", className: "chart-failed", textContent: failed, onclick: () => load(box) }));
    }
    box.ariaBusy = "false";
  }
  const near = new IntersectionObserver((seen) => seen.forEach(({ isIntersecting, target }) => isIntersecting && load(target)), { rootMargin: "300px" });
  for (const box of document.querySelectorAll("[data-still]")) near.observe(box);

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
