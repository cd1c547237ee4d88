// A session that nobody touches locks. A person's actions are told to the service, which decides; scripts' are not.
"use strict";
{
  const EVERY_MS = 20000, locked = document.getElementById("locked");
  let told = performance.now(), waiting = false; // loading the page was an action

  function acted(event) {
    if (!event.isTrusted || waiting) return;
    waiting = true;
    setTimeout(() => {
      waiting = false; told = performance.now();
      act.request("POST /v1/sessions/acted").catch(() => {}); // the next action tells again
    }, Math.max(0, EVERY_MS - (performance.now() - told)));
  }

  if (document.getElementById("lock")) {
    for (const kind of ["pointerdown", "pointermove", "keydown", "wheel", "touchstart"]) addEventListener(kind, acted, { passive: true, capture: true });
    addEventListener("rig-now", ({ detail }) => { if (detail.locked) location.replace("/locked?next=" + encodeURIComponent(act.here())); });
  }
  if (locked) addEventListener("rig-now", ({ detail }) => { if (detail.signed_in) location.replace(locked.dataset.back); }); // unlocked in another tab
}
