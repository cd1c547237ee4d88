// A session that nobody touches ends. A person's actions are told to the service, which decides; scripts' are not.
"use strict";
if (document.getElementById("sign-out")) {
  const EVERY_MS = 20000, STOP_MS = 10000;
  let told = performance.now(), waiting = false; // loading the page was an action

  function acted(event) {
    if (!event.isTrusted || waiting) return;
    waiting = true;
    setTimeout(() => {
      waiting = false; told = performance.now();
      act.request("POST /v1/sessions/acted").catch(() => {}); // the next action tells again
    }, Math.max(0, EVERY_MS - (performance.now() - told)));
  }

  for (const kind of ["pointerdown", "pointermove", "keydown", "wheel", "touchstart"]) addEventListener(kind, acted, { passive: true, capture: true });
  // Nothing of a participant stays on the screen. A page with stop keys stays until the rig is ready, and a stop that was sent leads on by itself.
  const stimulates = ({ ready }) => !ready && document.querySelector("[data-stop-keys]") !== null;
  let stopped = -Infinity;
  addEventListener("submit", (event) => { if (event.target.id === "stop-form") stopped = performance.now(); });
  addEventListener("rig-now", ({ detail }) => { if (detail.ended && performance.now() - stopped > STOP_MS && !stimulates(detail)) location.replace("/sign-in?next=" + encodeURIComponent(act.here())); });
}
