// The calibration by keys: one press, one train; nothing is kept for later.
"use strict";
{
  const LOOK_MS = 250, READ_MS = 2000;
  const part = () => document.getElementById("calibration"), open = () => part().dataset.open !== undefined, plays = () => part().dataset.playing !== undefined;
  const buttons = () => [...part().querySelectorAll("button:not([disabled])")];
  const disable = () => { for (const box of buttons()) box.disabled = true; };
  let looking = false, refused_ms = -READ_MS;

  addEventListener("keydown", (event) => {
    if (!open() || event.ctrlKey || event.altKey || event.metaKey || event.shiftKey || event.isComposing) return;
    const at = event.target instanceof Element ? event.target : document.body;
    if (at.closest("input, textarea, select, a, dialog, [contenteditable], [role=region]")) return;
    if (event.key === "Enter" && at.closest("button") && !at.closest("[data-keys], [id^=mark-]")) return; // Stop, Discard, Sign out: Enter presses them, as anywhere
    const button = [...part().querySelectorAll("[data-keys]")].find((box) => box.dataset.keys.split(" ").includes(event.key));
    if (!button && event.key !== "Enter") return;
    event.preventDefault(); // Enter never presses the button that has the focus by chance
    if (!event.repeat && button && !button.disabled) button.form.requestSubmit(button);
  });

  addEventListener("submit", (event) => { // not queued: whoever wants another train presses again
    if (!open() || !part().contains(event.target)) return;
    if (act.busy() || plays()) { event.preventDefault(); event.stopImmediatePropagation(); }
    else setTimeout(disable); // after the form was read
  }, true);

  document.addEventListener("answered", ({ target, detail: answer }) => {
    if (!part().contains(target) || !open()) return;
    if (!answer) { part().dataset.playing = ""; doubt(); } // the next look says what became of it
    else if (!answer.ok) { refused_ms = performance.now(); look(true); }
  });

  addEventListener("renewed", () => {
    const status = document.getElementById("told"), left_ms = READ_MS - (performance.now() - refused_ms);
    if (status.textContent !== part().dataset.told) status.textContent = part().dataset.told;
    if (left_ms <= 0) return;
    const held = buttons(); // what came under the hand instead is read before it is pressed
    disable();
    setTimeout(() => { for (const box of held) box.disabled = act.busy() || plays(); }, left_ms);
  });

  function doubt() {
    disable();
    if (part().querySelector(".no-answer")) return;
    part().prepend(act.make("p", { className: "notice bad no-answer", role: "alert", textContent: "The service does not answer. It is not known whether the train was sent. If stimulation may be on, use the emergency switch on the stimulator." }));
  }

  async function look(anyway) {
    if (looking || act.busy() || !(anyway || plays()) || document.hidden) return;
    looking = true;
    try { await act.renew(["calibration"]); } catch { doubt(); }
    looking = false;
  }
  setInterval(look, LOOK_MS);
}
