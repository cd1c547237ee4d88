// A part of the page that is read again and again: whoever looks at it sees what rigs say now.
"use strict";
{
  const live = document.getElementById("live");
  const busy = () => live.querySelector("details[open]") || live.contains(document.activeElement);

  async function renew() {
    if (document.hidden || busy()) return;
    try {
      const answer = await fetch("/", { cache: "no-store", headers: { Accept: "text/html" } });
      if (answer.redirected) { location.replace(answer.url); return; } // locked, or signed out
      const fresh = new DOMParser().parseFromString(await answer.text(), "text/html").getElementById("live");
      if (fresh && !busy()) live.replaceChildren(...fresh.childNodes); else if (!fresh) location.replace("/");
    } catch { /* the next time */ }
  }

  let renewing = null; // one question at a time, also of a slow service
  if (live) setInterval(() => { renewing ??= renew().finally(() => { renewing = null; }); }, 1000 * live.dataset.everyS);
}
