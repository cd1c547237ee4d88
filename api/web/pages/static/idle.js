// A session that nobody touches locks. A person's actions are told to the service, which decides; scripts' are not.
// What was typed is kept in this tab meanwhile, and put back for the same person.
"use strict";
{
  const EVERY_MS = 20000, lock = document.getElementById("lock"), locked = document.getElementById("locked");
  const name = document.querySelector(".who b")?.textContent || "", key = "typed " + act.here();
  const fields = () => [...document.querySelectorAll("main :is(input, textarea, select)")].filter((field) => !["hidden", "password", "file"].includes(field.type));
  const property = (field) => (["checkbox", "radio"].includes(field.type) ? "checked" : "value");
  let told = performance.now(), waiting = false; // loading the page was an action

  function acted(event) {
    if (!event.isTrusted || waiting) return;
    waiting = true;
    setTimeout(() => {
      waiting = false; told = performance.now();
      act.request("POST /v1/sessions/acted").catch(() => {}); // the next action tells again
    }, Math.max(0, EVERY_MS - (performance.now() - told)));
  }

  function keep() {
    try { sessionStorage.setItem(key, JSON.stringify({ name, typed: fields().map((field) => field[property(field)]) })); } catch { /* full: then it is typed anew */ }
  }

  function putBack() {
    const kept = JSON.parse(sessionStorage.getItem(key) || "null"), all = fields();
    sessionStorage.removeItem(key);
    if (kept?.name !== name || kept.typed.length !== all.length) return; // another page by now
    all.forEach((field, k) => { field[property(field)] = kept.typed[k]; });
  }

  if (lock) {
    putBack();
    for (const kind of ["pointerdown", "pointermove", "keydown", "wheel", "touchstart"]) addEventListener(kind, acted, { passive: true, capture: true });
    lock.addEventListener("submit", keep);
    addEventListener("rig-now", ({ detail }) => { if (detail.locked) { keep(); location.replace("/locked?next=" + encodeURIComponent(act.here())); } });
  }
  if (locked) { // unlocked in another tab; or somebody else signs in
    addEventListener("rig-now", ({ detail }) => { if (detail.signed_in) location.replace(locked.dataset.back); });
    addEventListener("submit", ({ target }) => { if (target.id === "leave") sessionStorage.clear(); });
  }
}
