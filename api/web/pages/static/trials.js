// The card of a controller's trials, asked for again every two seconds; not while somebody is at its button or a link.
"use strict";
{
  const box = document.getElementById("trials");
  let shown = null;
  // Who opened the table stays there, and the question of a new test comes all the same.
  const atTable = () => document.activeElement === box.querySelector("summary");
  async function renew() {
    if (document.hidden || (box.contains(document.activeElement) && !atTable())) return;
    try {
      const answer = await fetch(box.dataset.from, { cache: "no-store", headers: { Accept: "text/html" } });
      if (!answer.ok || answer.redirected) return;
      const text = await answer.text();
      if (text === shown) return;
      const [open, there] = [box.querySelector("details")?.open, atTable()];
      const fresh = document.createElement("template");
      fresh.innerHTML = text; // rendered by the service, as the page was
      const asks = fresh.content.querySelector("[role=alert]");
      if (asks && asks.textContent === box.querySelector(".notice")?.textContent) asks.removeAttribute("role"); // read aloud once
      box.replaceChildren(fresh.content);
      if (open) box.querySelector("details")?.setAttribute("open", "");
      if (there) box.querySelector("summary")?.focus({ preventScroll: true });
      shown = text;
    } catch { /* asked again */ }
  }
  let renewing = null; // one question at a time: more of them would keep a slow service from saying what the rig does
  setInterval(() => { renewing ??= renew().finally(() => { renewing = null; }); }, 2000);
}
