// The calibration by keys and without loading the page anew: one press, one train; nothing is kept for later.
"use strict";
{
  const PATIENCE_MS = 15000, LOOK_MS = 250, READ_MS = 2000;
  const part = () => document.getElementById("calibration");
  const told = document.getElementById("told");
  let asking = false, focused = "", refused_ms = -READ_MS;

  document.addEventListener("focusin", (event) => { if (part().contains(event.target)) focused = event.target.id; });

  addEventListener("keydown", (event) => {
    if (part().dataset.open === undefined || event.ctrlKey || event.altKey || event.metaKey || event.shiftKey || event.isComposing) return;
    if (event.target instanceof Element && event.target.closest("input, textarea, select, a, [contenteditable], [role=region]")) return;
    const onOther = event.key === "Enter" && event.target instanceof Element && event.target.closest("button") && !event.target.closest("[data-keys], [id^=mark-], .touch button");
    if (onOther) return; // Stop, Discard, Sign out: Enter presses them, as anywhere
    const button = [...part().querySelectorAll("[data-keys]")].find((box) => box.dataset.keys.split(" ").includes(event.key));
    if (!button && event.key !== "Enter") return;
    event.preventDefault(); // Enter never presses the button that has the focus by chance
    if (!event.repeat && button && !button.disabled) press(button);
  });

  document.addEventListener("submit", (event) => {
    if (part().dataset.open === undefined || !part().contains(event.target)) return;
    event.preventDefault();
    if (event.submitter && !event.submitter.disabled) press(event.submitter);
  });

  async function press(button) {
    if (asking || part().dataset.playing !== undefined) return; // not queued: whoever wants another train presses again
    asking = true;
    const fields = new URLSearchParams(new FormData(button.form));
    if (button.name) fields.append(button.name, button.value);
    const address = button.formAction;
    for (const box of part().querySelectorAll("button")) box.disabled = true;
    await show(address, { method: "POST", body: fields });
    asking = false;
  }

  async function look() {
    if (asking || part().dataset.playing === undefined || document.hidden) return;
    asking = true;
    await show(location.pathname, {});
    asking = false;
  }

  async function show(address, options) {
    const ending = new AbortController();
    const timer = setTimeout(() => ending.abort(), PATIENCE_MS);
    try {
      const answer = await fetch(address, { ...options, headers: { Accept: "text/html" }, cache: "no-store", signal: ending.signal });
      const page = new DOMParser().parseFromString(await answer.text(), "text/html"), fresh = page.getElementById("calibration");
      if (answer.status === 409) refused_ms = performance.now();
      if (fresh && (fresh.dataset.open !== undefined || !answer.ok)) replace(fresh);
      else if (!fresh && answer.status === 409) refused(page);
      else location.assign(answer.redirected ? answer.url : location.pathname);
    } catch { unanswered(); }
    clearTimeout(timer);
  }

  function replace(fresh) {
    part().replaceWith(fresh);
    hold();
    if (told.textContent !== fresh.dataset.told) told.textContent = fresh.dataset.told;
    const box = focused && document.getElementById(focused);
    if (box && !box.disabled && (!document.activeElement || document.activeElement === document.body)) box.focus({ preventScroll: true });
  }

  function hold() { // what came under the hand instead is read before it is pressed
    const left_ms = READ_MS - (performance.now() - refused_ms);
    if (left_ms <= 0) return;
    for (const box of part().querySelectorAll("button:not([disabled])")) {
      box.disabled = true;
      setTimeout(() => { box.disabled = asking || part().dataset.playing !== undefined; }, left_ms);
    }
  }

  function refused(page) { // what was changed has a page of its own
    part().replaceChildren(...page.querySelectorAll("main > section"));
    delete part().dataset.open;
  }

  function unanswered() { // the next look asks again; until it is answered no button works
    if (!part().querySelector(".no-answer")) {
      const box = document.createElement("p");
      box.className = "notice bad no-answer"; box.setAttribute("role", "alert"); box.textContent = part().dataset.noAnswer;
      part().prepend(box);
    }
    for (const button of part().querySelectorAll("button")) button.disabled = true;
    part().dataset.playing = "";
  }

  setInterval(look, LOOK_MS);
}
