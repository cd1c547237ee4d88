// Esc or Space press the red stop button, on a page that holds [data-stop-keys]: the same form, the same answer.
// [data-stop-keys="Escape"]: Esc alone, where Space presses other buttons.
"use strict";
{
  const AGAIN_MS = 1500; // a key that is held presses once; one that is pressed again, because nothing happened, presses again
  const NO_TEXT = ["button", "checkbox", "color", "file", "image", "radio", "range", "reset", "submit"];
  let pressed = -Infinity;

  const writes = (node) => node instanceof HTMLTextAreaElement || (node instanceof HTMLInputElement && !NO_TEXT.includes(node.type)) || (node instanceof HTMLElement && node.isContentEditable);
  const keys = () => document.querySelector("[data-stop-keys]")?.dataset.stopKeys;
  const stops = (event) => (event.key === "Escape" && keys() !== undefined) || (event.key === " " && keys() === "" && !writes(event.target));

  addEventListener("keydown", (event) => {
    if (!stops(event)) return;
    event.preventDefault(); // Space presses whatever button has the focus, the stop button a second time, too
    event.stopImmediatePropagation();
    const form = document.getElementById("stop-form");
    if (!form || performance.now() - pressed < AGAIN_MS) return;
    pressed = performance.now();
    form.requestSubmit();
  }, true);
  addEventListener("keyup", (event) => { if (event.key === " " && stops(event)) event.preventDefault(); }, true); // there some browsers press a button
  addEventListener("pageshow", () => { pressed = -Infinity; });
}
