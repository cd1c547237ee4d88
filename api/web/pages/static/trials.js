// The card of a controller's trials, asked for again every two seconds; not while somebody is in it.
"use strict";
{
  const box = document.getElementById("trials");
  let shown = null;
  async function renew() {
    if (document.hidden || box.contains(document.activeElement)) return;
    try {
      const answer = await fetch(box.dataset.from, { cache: "no-store", headers: { Accept: "text/html" } });
      if (!answer.ok || answer.redirected) return;
      const text = await answer.text();
      if (text === shown) return;
      const open = box.querySelector("details")?.open;
      box.innerHTML = text; // rendered by the service, as the page was
      if (open) box.querySelector("details")?.setAttribute("open", "");
      shown = text;
    } catch { /* asked again */ }
  }
  setInterval(renew, 2000);
}
