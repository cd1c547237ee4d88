// A session that nobody touches locks. A person's actions are told to the service, which decides; scripts' are not.
// What was typed is kept in this tab meanwhile, and put back for the same person.
"use strict";
{
  const EVERY_MS = 20000, lock = document.getElementById("lock"), waits = document.getElementById("locked");
  const who = () => (document.querySelector(".who b") || {}).textContent || "";
  const key = "typed " + location.pathname + location.search;
  let told = -Infinity, due = 0;

  function tell() {
    due = 0; told = performance.now();
    act.request("POST /v1/sessions/acted").catch(() => {}); // the next action tells again
  }

  function acted(event) {
    if (!event.isTrusted || due) return;
    due = setTimeout(tell, Math.max(0, EVERY_MS - (performance.now() - told)));
  }

  const fields = () => [...document.querySelectorAll("main input, main textarea, main select")]
    .filter((field) => !["hidden", "password", "file", "submit"].includes(field.type));

  function keep() {
    const typed = fields().map((field) => (field.type === "checkbox" || field.type === "radio" ? field.checked : field.value));
    try { sessionStorage.setItem(key, JSON.stringify({ who: who(), typed })); } catch { /* full: then it is typed anew */ }
  }

  function putBack() {
    const kept = JSON.parse(sessionStorage.getItem(key) || "null"), found = fields();
    sessionStorage.removeItem(key);
    if (!kept || kept.who !== who() || kept.typed.length !== found.length) return; // another page by now
    found.forEach((field, i) => {
      if (typeof kept.typed[i] === "boolean") field.checked = kept.typed[i]; else field.value = kept.typed[i];
    });
  }

  if (lock) {
    putBack();
    told = performance.now(); // loading the page was an action
    for (const name of ["pointerdown", "pointermove", "keydown", "wheel", "touchstart"]) addEventListener(name, acted, { passive: true, capture: true });
    lock.addEventListener("submit", keep);
    addEventListener("rig-now", (event) => {
      if (!event.detail.locked) return;
      keep();
      location.replace("/locked?next=" + encodeURIComponent(location.pathname + location.search));
    });
  }
  if (waits) { // unlocked in another tab
    addEventListener("rig-now", (event) => { if (event.detail.signed_in) location.replace(waits.dataset.back); });
    addEventListener("submit", (event) => { if (event.target.id === "leave") sessionStorage.clear(); });
  }
}
